"""The scene: what it takes, what holds across changes, and bad arguments: one clear error, and no trace."""

import numpy as np
import pytest
from helpers import refused
from helpers.questions import in_a_row, to_matrix
from helpers.samples import STILL, random_poses, sample
from helpers.scenes import TURN, everything, pair_scene, scene_with
from oracles.triangle import pose_matrix

import warp_abtree as ab
from warp_abtree.scene import posed_objects


def placed(scene):
    pool = scene.batch().objects.pool
    return pool.rotation.numpy(), pool.position.numpy()


def test_quaternions_are_normalised_in_float64(device):
    scene = pair_scene(device)
    poses = random_poses(np.random.default_rng(1), 3, 5.0)
    poses[:, 3:] *= [[1.0009], [0.9991], [1.0]]
    scene.set_poses(poses)
    added = scene_with(device, *[(sample("box"), pose) for pose in poses])
    for found in (placed(scene), placed(added)):
        for pose, rotation, position in zip(poses, *found, strict=True):
            np.testing.assert_equal((rotation, position), pose_matrix(pose))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_matrices_are_taken_as_they_are(device, dtype):
    """Also those that are a rotation only within 1e-6; float32 is widened, not improved."""
    rng = np.random.default_rng(2)
    poses = np.array([to_matrix(*pose_matrix(row)) for row in random_poses(rng, 3, 5.0)])
    poses[:, :3, :3] += rng.uniform(-1e-7, 1e-7, (3, 3, 3))
    poses = poses.astype(dtype)
    scene = pair_scene(device)
    scene.set_poses(poses)
    mixed = ab.Scene(device)
    for i, pose in enumerate(poses):
        mixed.add(sample("box"), pose)
        mixed.add(sample("box"), (i, 0, 0, 0, 0, 0, 1))
    for rotation, position in (placed(scene), [part[::2] for part in placed(mixed)]):
        np.testing.assert_array_equal(rotation, poses[:, :3, :3].astype(np.float64))
        np.testing.assert_array_equal(position, poses[:, :3, 3].astype(np.float64))


@pytest.mark.parametrize("matrices", [False, True])
def test_many_objects_are_added_as_one_by_one(device, matrices):
    """To the bit; also onto a scene whose poses and LODs have changed since its objects were added."""
    rng, scenes = np.random.default_rng(6), [pair_scene(device), pair_scene(device)]
    poses = random_poses(rng, 12, 2.0)
    if matrices:
        poses = np.array([to_matrix(*pose_matrix(pose)) for pose in poses])
    models = [sample(name) for name in rng.choice(["box", "torus", "three"], 12)]
    lods = [int(rng.integers(0, model.lod_max + 1)) for model in models]
    worlds, importances, statics = rng.integers(-1, 3, 12), rng.integers(1, 4, 12), rng.random(12) < 0.5
    bits = rng.integers(0, 2**32, (2, 12), dtype=np.uint32)
    for scene in scenes:
        scene.set_lods([3, 2, 1])
        scene.set_poses(random_poses(np.random.default_rng(7), 3, 2.0))
    added = scenes[0].add_many(models, poses, worlds, lods, importances, statics, *bits)
    assert added.tolist() == list(range(3, 15))
    rows = zip(models, poses, worlds, lods, importances, statics, *bits, strict=True)
    assert [scenes[1].add(*row) for row in rows] == added.tolist()
    assert everything(scenes[0]) == everything(scenes[1])
    np.testing.assert_array_equal(scenes[0].broad_phase(), scenes[1].broad_phase())
    assert scenes[0].lods.tolist() == [3, 2, 1, *lods] and scenes[0].worlds[3:].tolist() == worlds.tolist()


def test_an_interrupt_while_objects_are_added_leaves_no_trace(device, monkeypatch):
    def stop(lods, models):
        yield 3
        raise KeyboardInterrupt

    scene = pair_scene(device)
    before, models = everything(scene), [sample("torus"), sample("three")]
    with monkeypatch.context() as patch:
        patch.setattr(posed_objects, "check_lods", stop)
        with pytest.raises(KeyboardInterrupt):
            scene.add_many(models, [STILL] * 2)
    assert everything(scene) == before and len(scene.models) == 2
    assert scene.add_many(models, [STILL] * 2).tolist() == [3, 4] and scene.object_model == [0, 1, 0, 2, 3]


def test_one_value_serves_all_objects_that_are_added(device):
    scene = ab.Scene(device)
    assert scene.add_many(sample("box"), np.empty((0, 7))).shape == (0,)
    scene.add_many(sample("box"), [STILL] * 4, worlds=2, lods=3, importances=2, statics=True)
    assert scene.worlds.tolist() == [2] * 4 and scene.lods.tolist() == [3] * 4 and len(scene.models) == 1
    assert scene.object_importance == [2] * 4 and len(scene.broad_phase()) == 0
    refused(TypeError, None, scene.add_many, [sample("torus"), "torus"], [STILL] * 2)
    assert scene.models == [sample("box")] and scene.object_count == 4


def test_what_is_printed_says_what_is_held(device):
    """A user's first `print` of a scene and of a result, and a path in the place of a model."""
    scene = scene_with(device, sample("box"), sample("box"))
    assert repr(scene) == f"Scene('{device}', objects=2, models=1)"
    assert repr(scene.intersect(output="faces")) == "Result(pairs=1, any, faces, count)"
    assert repr(scene.intersect(device=True)) == "Result(pairs=1, any)"
    refused(TypeError, "model is a str, not a Model: ", scene.add, "part.obj")


def test_names_of_a_model_may_repeat(device):
    vertices, faces, _ = sample("box").mesh_at(sample("box").lod_max)
    twins = [ab.Model.from_arrays(vertices * s, faces, name="same") for s in (1.0, 5.0)]
    scene = scene_with(device, *twins, twins[0])
    assert len(scene.models) == 2 and scene.object_model == [0, 1, 0]
    assert scene.tree_state(1).upper[1][0] > 4 * scene.tree_state(0).upper[1][0]


NAN, INF = float("nan"), float("inf")
BOX_TOP = sample("box").lod_max


# What is given, and words that the message needs beside the name of the argument.
POSES = {
    "not finite": (np.array((0, NAN, 0, 0, 0, 0, 1)), "finite"),
    "quaternion not finite": (np.array((0, 0, 0, 0, 0, INF, 1)), "finite"),
    "not normalised": (np.array((0, 0, 0, 0, 0, 0, 1.002)), "quaternion", "1.002"),
    "no quaternion": (np.zeros(7), "quaternion of norm 0, which is no rotation", "0 0 0 1"),
    "a number": (1.0, "shape"),
    "skewed": (TURN + 1e-4 * np.diag([1, 0, 0, 0]), "rigid"),
    "mirror": (np.diag([1.0, 1.0, -1.0, 1.0]), "rigid"),
    "bad last row": (np.eye(4) + 1e-9 * np.eye(4, k=-3), "rigid"),
    "matrix not finite": (np.where(np.eye(4, k=3), INF, np.eye(4)), "finite"),
    "3 by 4": (np.eye(4)[:3], "shape"),
    "text": ("origin",),
    "complex": (np.array(STILL, complex),),
    "ragged": ([0, 0, 0, [0, 0, 0, 1]],),
}
OBJECTS = [
    (dict(model="box.obj"), "model", "str"),
    (dict(model=None), "model", "NoneType"),
    (dict(world=-2), "world", "-2"),
    (dict(world=0.5), "world", "0.5"),
    (dict(world=NAN), "world", "nan"),
    (dict(importance=4), "importance", "4"),
    (dict(lod=-1), "LOD", "-1", "box"),
    (dict(lod=BOX_TOP + 1), "LOD", str(BOX_TOP + 1), "box"),
    (dict(lod=1.5), "LOD", "1.5"),
    (dict(lod=True), "LOD", "True"),
    (dict(static=1), "static"),
    (dict(collision_group=-1), "collision_group", "-1"),
    (dict(collision_group=2**32), "collision_group", str(2**32)),
    (dict(collision_mask=0.5), "collision_mask", "0.5"),
]
# What `add_many` refuses of three objects.
MANY = [
    (dict(models=[sample("box"), "box.obj", sample("box")]), "model", "str"),
    (dict(models=None), "model", "NoneType"),
    (dict(models=[sample("box")] * 2), "2", "3"),
    (dict(poses=STILL), "poses", "(7,)"),
    (dict(poses=[STILL, STILL, (0, 0, 0, 0, 0, 0, 2)]), "pose 2", "quaternion"),
    (dict(worlds=[0, -2, 0]), "worlds[1]", "-2"),
    (dict(worlds=[0, 1]), "worlds", "(2,)"),
    (dict(worlds=[[0, 1], [2]]), "worlds"),
    (dict(worlds=[0, NAN, 0]), "worlds[1]", "nan"),
    (dict(worlds=[0, True, 0.5]), "worlds[2]", "0.5"),
    (dict(lods=[1, 2, BOX_TOP + 1]), "LOD", str(BOX_TOP + 1), "box"),
    (dict(lods=[1, 2]), "lods", "(2,)"),
    (dict(lods=-1), "LOD", "-1"),
    (dict(importances=[1, 2, 4]), "importances[2]", "4"),
    (dict(statics=[0, 1, 0]), "static"),
    (dict(statics=[True]), "statics", "(1,)"),
    (dict(collision_groups=[1, 2**32, 1]), "collision_groups[1]"),
    (dict(collision_masks=["all"] * 3), "collision_masks"),
]
LODS = [
    ([1, 2], "(2,)", "3"),
    (3, "()"),
    ([1, -1, 2], "object 1", "-1"),
    ([1, BOX_TOP + 1, 2], "object 1", str(BOX_TOP + 1)),
    ([1, 2, 2**62], "object 2"),
    ([1, NAN, 2],),
    (["a", "b", "c"],),
    ([True, False, True],),
    ([1, [2], 3],),
]
PAIRS = [
    ([(0, 1), (0, 3)], "pair 1", "(0, 3)"),
    ([(-1, 0)], "pair 0", "(-1, 0)"),
    ([(0, 1), (1, 2), (2, 2)], "pair 2", "itself"),
    ([(0, 1, 2)], "(1, 3)"),
    ([(0.0, 1.0)], "float64"),
    ([(False, True)], "bool"),
    ("all of them",),
    ([(0, 1), (1,)],),
]
OPTIONS = [(dict(output="some"), "output", "'some'"), (dict(precision="float64"), "precision", "'float64'")]
OPTIONS += [(dict(within=x), "within") for x in (-1e-300, NAN, INF, [1, 2, 3], [[1]], [1, -1], "1", [], True)]


def refused_calls():
    """Yield (name, call of a scene of three objects, words that the error needs)."""
    box, two = sample("box"), [(0, 1), (1, 0)]
    for name, (pose, *words) in POSES.items():
        yield f"add {name}", lambda scene, pose=pose: scene.add(box, pose), ["pose", *words]
        poses = [pose] * 3 if name != "text" else pose
        if isinstance(pose, np.ndarray) and pose.dtype == float and pose.shape in ((7,), (4, 4)):
            good = np.eye(4) if pose.ndim == 2 else np.array(STILL)
            poses, words = np.stack([good, pose, good]), [*words, "1"]
        yield f"set_poses {name}", lambda scene, poses=poses: scene.set_poses(poses), ["pose", *words]
    yield "too many poses", lambda scene: scene.set_poses(np.tile(STILL, (4, 1))), ["poses", "4", "3"]
    for options, *words in OBJECTS:
        yield f"add {options}", lambda scene, o=options: scene.add(**{"model": box, **o}), words
    for options, *words in MANY:
        three = {"models": box, "poses": [STILL] * 3, **options}
        yield f"add_many {words}", lambda scene, three=three: scene.add_many(**three), words
    for lods, *words in LODS:
        yield f"set_lods {lods}", lambda scene, lods=lods: scene.set_lods(lods), ["lods", *words]
    for pairs, *words in PAIRS:
        words = ["pairs", *words]
        yield f"intersect {pairs}", lambda scene, pairs=pairs: scene.intersect(pairs), words
        yield f"filter {pairs}", lambda scene, pairs=pairs: scene.filter(pairs), words
        yield f"query {pairs}", lambda scene, pairs=pairs: ab.Query(scene, pairs=pairs), words
    for options, *words in OPTIONS:
        yield f"intersect {options}", lambda scene, options=options: scene.intersect(two, **options), words
        yield f"query {options}", lambda scene, options=options: ab.Query(scene, pairs=two, **options), words
    yield "distances of found pairs", lambda scene: ab.Query(scene, within=[1, 2]), ["within"]
    yield "query of contacts", lambda scene: ab.Query(scene, "contacts", pairs=two), ["ab.ContactQuery"]
    yield "contacts precision", lambda scene: ab.ContactQuery(scene, two, precision="best"), ["precision"]
    for dtype in (np.int32, np.float16, "double trouble"):
        words = ["contact_dtype"]
        yield f"contact {dtype}", lambda s, dtype=dtype: s.intersect(two, "contacts", contact_dtype=dtype), words
        yield f"contacts {dtype}", lambda s, dtype=dtype: ab.ContactQuery(s, two, contact_dtype=dtype), words
    for room in (0, 2**31, NAN, "many"):
        yield f"query {room}", lambda s, room=room: ab.Query(s, capacity=room), ["capacity", str(room)]
        yield f"contacts {room}", lambda s, room=room: ab.ContactQuery(s, capacity=room), ["capacity", str(room)]
        for name in ("hits", "pairs", "uncertain"):
            words = [f"buffers: {name} ", str(room)]
            yield f"{name} {room}", lambda _, name=name, room=room: ab.Buffers(**{name: room}), words
    for i in (-1, 3, 0.5, "first", None):
        yield f"tree_state {i}", lambda scene, i=i: scene.tree_state(i), ["object", str(i)]


CALLS = {name: (call, words) for name, call, words in refused_calls()}


@pytest.mark.parametrize("case", CALLS)
def test_a_refused_call_leaves_no_trace(device, case):
    call, words = CALLS[case]
    scene = pair_scene(device)
    before, batch = everything(scene), scene.batch()
    error = TypeError if words[0] == "model" else ValueError
    caught = refused(error, None, call, scene)
    assert type(caught) is error
    message = str(caught)
    assert "\n" not in message and all(word in message for word in words), message
    assert scene.batch() is batch, "a refused call makes nothing anew"
    assert everything(scene) == before


def test_contacts_beyond_any_memory(device):
    refused(ab.CapacityError, "fewer than 2", ab.ContactQuery, pair_scene(device), [(0, 1)], capacity=2**30)


@pytest.mark.parametrize("name", ["cuda:99", 7, ""])
def test_missing_devices_are_named(name):
    refused(ValueError, r"no device .* cpu", ab.Scene, name)


def test_a_result_is_its_owners(device):
    """Whoever writes into one changes no later answer, also where the same pairs are asked again."""
    scene = in_a_row(device, "box", (0, 0.5, 5))
    for pairs in ([(0, 1), (0, 2)], [(1, 2), (1, 2)], [(1, 2), (1, 2)], [(0, 2), (0, 1)], [(0, 1)]):
        for given in (pairs, np.array(pairs), np.array(pairs), pairs):
            result = scene.intersect(given)
            assert result.pairs.tolist() == [list(pair) for pair in pairs]
            assert result.any.tolist() == [pair == (0, 1) for pair in pairs]
            result.pairs[:] = 1, 2
            result.any[:] = True


def test_a_question_that_repeats_the_last_one_is_answered_anew(device):
    """After other poses, pairs, outputs and options; a question that the last one could be is refused as ever."""
    scene, pairs = in_a_row(device, "box", (0, 0.5, 5)), np.array([(0, 1)])
    for place, meets in ((0.5, True), (0.5, True), (5.0, False), (0.5, True)):
        scene.set_pose(1, [place, 0, 0, 0, 0, 0, 1])
        assert scene.intersect(pairs).any.tolist() == [meets]
        assert not scene.intersect(np.array([(0, 2)])).any
    for ask in ({"output": "count"}, {}, {"within": 4.0}, {"precision": "float32"}, {"output": "faces"}):
        for _ in range(2):
            found = scene.intersect(pairs, **ask)
            assert found.any.all() and (found.count is None) == ("output" not in ask)
            assert (found.apart is None) == ("within" not in ask)
    for bad, output in ((pairs[0], "any"), (pairs, "all"), (pairs.astype(float), "any"), (pairs + 3, "any")):
        with pytest.raises(ValueError):
            scene.intersect(bad, output)
        assert scene.intersect(pairs).any.all()
    for other in (1, 2):
        masked = np.ma.array([(0, other)], mask=True)  # both have the bytes of what fills them
        assert scene.intersect(masked).any.tolist() == [other == 1]
    scene.remove(1)
    with pytest.raises(ValueError, match="removed"):
        scene.intersect(pairs)


def test_an_empty_scene(device):
    scene, none, other = ab.Scene(device), "^the scene has no object$", "no object|0 objects|outside"
    assert scene.object_count == 0 and len(scene.lods) == 0 and scene.broad_phase().shape == (0, 2)
    calls = [(call, (scene,), none) for call in (ab.Scene.intersect, ab.Query, ab.Pipeline, ab.Frame)]
    calls += [(scene.set_poses, (np.empty((0, 7)),), none)]
    calls += [(call, ([],), none) for call in (scene.set_lods, scene.intersect)]
    for call, given, message in [*calls, (scene.intersect, ([(0, 1)],), other), (scene.tree_state, (0,), other)]:
        refused(ValueError, message, call, *given)
    scene.add(sample("box"))
    assert scene.broad_phase().shape == (0, 2) and scene.intersect().pairs.shape == (0, 2)
