"""Scenes that several tests start from, all that can be read of one, and comparisons of captured frames with them."""

import numpy as np
import warp as wp

import warp_abtree as ab
from helpers.samples import random_poses, raw_state, sample, stored_state

TURN = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])
CROWD = ("small ball", "torus", "soup", "lattice soup", "twins", "crumbs", "one", "small ball", "torus")


def pair_scene(device):
    """Return a scene of three objects at several LODs, one in every world, with a pair filtered out."""
    scene = ab.Scene(device)
    scene.add(sample("small ball"), lod=30)
    scene.add(sample("box"), (0.5, 0.25, 0, 0, 0, 0, 1))
    scene.add(sample("small ball"), (0, 0.5, 0, 0, 0, 0, 1), world=-1, static=True, lod=12)
    scene.filter([(0, 1)])
    return scene


def everything(scene):
    """Return all that a scene holds, as bytes."""
    states, objects = scene.batch().states, scene.batch().objects
    held = [scene.object_count, scene.lods, objects.state, scene.batch().excluded, len(states.slots)]
    pool = objects.pool
    held += [objects.collision_bits.numpy(), scene.worlds, scene.object_importance, scene.object_model]
    held += [array.numpy() for array in (pool.rotation, pool.position, pool.world, pool.is_static, pool.state)]
    held += [value for i in range(scene.object_count) for value in raw_state(scene, i).values()]
    return [np.asarray(value).tobytes() for value in held]


def add_objects(device, names=CROWD, seed=0, spread=0.6, fractions=(1.0,)):
    """Return a scene of samples at random poses, with fractions of their faces, which repeat."""
    scene = ab.Scene(device)
    for i, pose in enumerate(random_poses(np.random.default_rng(seed), len(names), spread)):
        model = sample(names[i])
        scene.add(model, pose, lod=model.lod_for(fraction=fractions[i % len(fractions)]))
    return scene


def tops(scene):
    return np.array([scene.models[m].lod_max for m in scene.object_model])


def random_lods(rng, lods, top):
    """One LOD each: small steps, jumps to the ends and anywhere, and some that stay."""
    lods = np.clip(lods + rng.integers(-6, 7, len(top)) * rng.choice([0, 1, 1, 4], len(top)), 0, top)
    jump = rng.random(len(top))
    lods = np.where(jump < 0.1, rng.integers(0, top + 1), lods)
    return np.where(jump > 0.93, rng.choice([0, 1]) * top, lods)


def replay(frame):
    graph = frame.capture()
    return lambda: wp.capture_launch(graph)


def set_lods(frame, lods):
    frame.lods.assign(np.asarray(lods).astype(np.int32))


def check_states(frame, scene):
    """Check that every object's state in a frame holds the bits of a state built at the scene's LODs."""
    objects = [(scene.models[m], {"lod": int(lod)}) for m, lod in zip(scene.object_model, scene.lods)]
    fresh = scene_with(scene.device, *objects)
    for i in range(scene.object_count):
        truth = raw_state(fresh, i)
        state = stored_state(scene.models, frame.batch, frame.batch.objects.pool.state.numpy()[i])
        for name, value in truth.items():
            assert np.asarray(value).tobytes() == np.asarray(state[name]).tobytes(), (i, name)


def by_pair(result):
    """Return a result's answers with its pairs in order, each a NumPy array."""
    order = np.lexsort((result.pairs[:, 1], result.pairs[:, 0]))
    values = {name: getattr(result, name) for name in ("pairs", "any", "count", "apart", "pair_contacts")}
    values = {name: value[order] for name, value in values.items() if value is not None}
    if result.faces is not None:
        faces = np.concatenate([np.argsort(order)[result.faces[:, :1]], result.faces[:, 1:]], 1)
        rows = np.lexsort((faces[:, 2], faces[:, 1], faces[:, 0]))
        values["faces"] = faces[rows]
        if result.contacts is not None:
            values["contacts"] = result.contacts[rows]
            values["contacts"]["pair"] = values["faces"][:, 0]
    return values


def check_same(result, expected):
    """Check that two results hold the same answers, whatever the order of their pairs."""
    got, wanted = by_pair(result), by_pair(expected)
    assert got.keys() == wanted.keys()
    for name, value in wanted.items():
        assert np.array_equal(got[name].astype(value.dtype).tobytes(), value.tobytes()), name


def scene_with(device, *objects, **options):
    """Return a scene of models, each alone or in a tuple with a pose, options of its own, or both."""
    scene = ab.Scene(device)
    for model, *more in (each if isinstance(each, tuple) else (each,) for each in objects):
        own = more.pop() if more and isinstance(more[-1], dict) else {}
        scene.add(model, *more, **{**options, **own})
    return scene


def posed_triangles(scene, i):
    """Return the corners of an object's original faces in the world."""
    model, objects = scene.models[scene.object_model[i]], scene.batch().objects.pool
    vertices, faces, _ = model.mesh_at(model.lod_max)
    return (vertices @ objects.rotation.numpy()[i].T + objects.position.numpy()[i])[faces]


def names_of(scene):
    return [scene.name(i) for i in range(scene.object_count)]


def define_mesh(stage, where, points, faces):
    from pxr import Gf, UsdGeom

    mesh = UsdGeom.Mesh.Define(stage, where)
    mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, v)) for v in points])
    mesh.GetFaceVertexCountsAttr().Set([len(face) for face in faces])
    mesh.GetFaceVertexIndicesAttr().Set(np.ravel(faces).tolist())
    return mesh
