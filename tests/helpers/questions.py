"""Queries and kernels as plain functions, and poses that float64 holds exactly."""

from functools import cache

import numpy as np
import warp as wp
from oracles.distance import brute_distances, mesh_distance
from oracles.motion import posed
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from helpers.samples import SHAPES, contact_poses, sample
from helpers.scenes import scene_with
from warp_abtree import testing

# The 24 rotations of a cube, exactly, without negative zeros.
QUARTERS = Rotation.create_group("O").as_matrix().round() + 0.0


def GpuQuery(*arguments, **options):
    """Return a query that takes the CUDA regime on every device."""
    with testing.regime(warps=True):
        return ab.Query(*arguments, **options)


def launch(kernel, device, shape, *inputs, columns=0, block_dim=256):
    """Launch a kernel with a thread for each entry of a shape; return its last argument, so many columns for each.

    Arrays of NumPy, and lists, become Warp's, of the types that the kernel names.
    """
    types, given = [argument.type for argument in kernel.adj.args], []
    for value, kind in zip(inputs, types):
        is_host = isinstance(value, (list, np.ndarray))
        given.append(wp.array(value, dtype=kind.dtype, device=device) if is_host else value)
    out = wp.zeros((shape, columns) if columns else shape, dtype=types[-1].dtype, device=device)
    wp.launch(kernel, shape, [*given, out], device=device, block_dim=block_dim)
    return out.numpy()


def sort_rows(rows):
    return rows[np.lexsort(rows.T[::-1])]


def scene_of(device, cases, **options):
    """Return a scene of cases (model a, lod a, pose a, model b, lod b, pose b): case p is objects (2 p, 2 p + 1)."""
    objects = [(model, pose, {"lod": lod}) for case in cases for model, lod, pose in (case[:3], case[3:])]
    return scene_with(device, *objects, **options)


def pairs_of(cases):
    return np.arange(2 * len(cases)).reshape(-1, 2)


def starts_of(cases):
    return np.array([pose for case in cases for pose in (case[2], case[5])])


def ask(device, cases, **options):
    return scene_of(device, cases).intersect(pairs_of(cases), **{"output": "faces", **options})


def in_a_row(device, name, places):
    return scene_with(device, *[(sample(name), (x, 0, 0, 0, 0, 0, 1)) for x in places])


def random_lod(rng, model, most_faces):
    """Return a LOD of at most about so many faces, all sizes equally likely on a logarithmic scale."""
    most = min(most_faces, model.face_count)
    return model.lod_for(fraction=most ** rng.uniform(0.4, 1.0) / model.face_count)


def random_case(rng, names, most_faces):
    model_a, model_b = map(sample, names)
    lods = [random_lod(rng, model, most_faces) for model in (model_a, model_b)]
    pose_a, pose_b = contact_poses(rng, model_a, lods[0], model_b, lods[1])
    return model_a, lods[0], pose_a, model_b, lods[1], pose_b


def to_matrix(rotation, translation):
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


@cache
def coarse(name, faces=500):
    """Return vertices and faces of a sample at a modest LOD."""
    model = sample(name)
    return model.mesh_at(model.lod_for(fraction=min(1.0, faces / model.face_count)))[:2]


def captured(operator, *arguments):
    with wp.ScopedCapture(operator.device) as capture:
        operator.launch(*arguments)
    return lambda: wp.capture_launch(capture.graph)


def parted_cases(rng, names, faces=60, least=0.0):
    """Return a case for each pair of samples: in contact, but seven of ten moved by `least` up to 2 more."""
    cases = [random_case(rng, pair, faces) for pair in names]
    for case in cases:
        away = rng.normal(size=3)
        case[5][:3] += (least + 2 * rng.random()) * away / np.linalg.norm(away) * (rng.random() < 0.7)
    return cases


def scale_cases(cases, exponent):
    meshes = SHAPES["soup"](), SHAPES["small ball"]()
    a, b = (ab.Model.from_arrays(np.ldexp(points, exponent), faces, base_faces=4) for points, faces in meshes)
    by = np.array([2.0**exponent] * 3 + [1] * 4)
    return [(a, i, by * p, b, j, by * q) for _, i, p, _, j, q in cases]


def far_cases(rng, far):
    """Return cases far from the origin, of a mesh with coordinates far from its own origin too."""
    shift = np.array([far, -far, 0.3 * far, 0, 0, 0, 0])
    vertices, faces, _ = sample("small ball").mesh_at(sample("small ball").lod_max)
    models = sample("torus"), ab.Model.from_arrays(vertices + shift[:3], faces, base_faces=4)
    cases = []
    for k in range(20):
        a, b = [(models[k % 2], random_lod(rng, models[k % 2], 60)), (sample("soup"), 40)][:: 1 if k % 4 < 2 else -1]
        pose_a, pose_b = contact_poses(rng, *a, *b)
        pose_b[:3] += 3 * rng.normal(size=3)
        cases.append((*a, pose_a + shift, *b, pose_b + shift))
    return cases


def true_distances(scene, cases):
    """Return the distance of each pair by brute force, 0 where they intersect."""
    met = scene.intersect(pairs_of(cases)).any
    return np.array([0.0 if hit else mesh_distance(*case) for hit, case in zip(met, cases, strict=True)])


def check_points(result, cases):
    """Check that points lie on the faces that are named, of the meshes at their LODs, where any are."""
    for row, faces, case in zip(result.points, result.point_faces, cases, strict=True):
        for point, face, (model, lod, pose) in zip(row, faces, (case[:3], case[3:]), strict=True):
            if face >= 0:
                vertices, corners, ids = model.mesh_at(lod)
                assert brute_distances(point[None], posed(vertices[corners[ids == face]], pose))[0] < 1e-12


def check_brackets(result, truth, tolerance=0.0, relative=0.0, beyond=np.inf):
    """Hold a result to true distances, and to the options that it was asked with."""
    (lower, upper), close = result.bracket.T, 1 + 1e-12
    far = np.isinf(result.distance)
    np.testing.assert_array_equal(result.any, truth == 0)
    np.testing.assert_array_equal(result.distance == 0, truth == 0)
    assert (lower <= truth * close).all() and (truth <= upper * close).all()
    np.testing.assert_array_equal(far, truth > beyond)
    assert (lower[far] == np.broadcast_to(beyond, len(truth))[far]).all() and np.isinf(upper[far]).all()
    assert (result.point_faces[far] == -1).all() and np.isnan(result.points[far]).all()
    near = ~far
    width = np.maximum(tolerance, relative * result.distance[near])
    assert (upper[near] - lower[near] <= width * close + 1e-12).all()
    assert (lower[near] <= result.distance[near]).all() and (result.distance[near] <= upper[near]).all()
    between = np.linalg.norm(result.points[:, 0] - result.points[:, 1], axis=1)[near]
    np.testing.assert_allclose(between, result.distance[near], rtol=1e-9, atol=1e-13)


def to_bytes(result, names=("distance", "bracket", "points", "point_faces")):
    return [np.asarray(getattr(result, name)).tobytes() for name in names]
