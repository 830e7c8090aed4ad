"""What exact answers imply for real meshes: changes that keep the geometry, or map it, keep or map the answer.

test_exact.py asks the same of small lattice meshes and compares with brute force. Here meshes are whole, faces number
thousands, and most changes mix: only some faces are cut, and each object has an order of its own.
"""

from functools import cache

import numpy as np
import pytest
from conftest import slow
from helpers.gpu_query import GpuQuery
from helpers.questions import QUARTERS, ask, coarse, pairs_of, scene_of, sort_rows, to_matrix
from helpers.samples import contact_poses, random_poses, sample, true_faces
from oracles.triangle import pose_matrix, relative_pose

import warp_abtree as ab

NAMES = [("cow", "fandisk"), ("fcl-rob", "woody"), ("woody", "cow"), ("cow", "cow"), ("warp:bear", "warp:bear")]
GRID = 4096.0


@cache
def grid_mesh(name):
    """Return a mesh rounded to multiples of 4 / 4096, and its model."""
    vertices, faces, _ = sample(name).mesh_at(sample(name).lod_max)
    vertices = np.round(vertices * GRID / 4) * 4 / GRID
    return vertices, faces, make_model(vertices, faces)


def make_model(vertices, faces):
    return ab.Model.from_arrays(vertices, faces, base_faces=10**6)


@cache
def grid_poses(names, count=3):
    """Return pairs of poses in contact at quarter turns and grid positions: every x' is exact.

    Of a mesh and itself, the last pair is one pose twice: each face on its twin.
    """
    rng = np.random.default_rng(21)
    poses = []
    for _ in range(count):
        (a, *_), (b, *_) = map(grid_mesh, names)
        rotations = [QUARTERS[k] for k in rng.integers(0, len(QUARTERS), 2)]
        place = rng.integers(-1000, 1000, 3) / GRID
        p, q = 0.875 * a[rng.integers(len(a))], 0.875 * b[rng.integers(len(b))]
        goal = rotations[0] @ p + place - rotations[1] @ q
        poses.append((to_matrix(rotations[0], place), to_matrix(rotations[1], np.round(goal * GRID) / GRID)))
    if names[0] == names[1]:
        poses[-1] = poses[-1][:1] * 2
    return poses


def ask_models(device, model_a, model_b, poses):
    """Return the faces that meet at each pair of poses."""
    result = ask(device, [(model_a, None, a, model_b, None, b) for a, b in poses])
    return [result.faces[result.faces[:, 0] == p][:, 1:] for p in range(len(poses))]


def ask_query(make_query, device, cases):
    """Return the result for cases from a query of some kind."""
    return make_query(scene_of(device, cases), "faces", pairs=pairs_of(cases)).run()


def check_equal(found, expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.fixture(params=NAMES, ids="-".join)
def names(request):
    return request.param


@pytest.fixture
def models(names):
    return [grid_mesh(name)[2] for name in names]


@pytest.fixture
def plain(device, names, models):
    """What meets before any change."""
    faces = ask_models(device, *models, grid_poses(names))
    assert sum(map(len, faces)) > 10
    return faces


@pytest.mark.slow
def test_swapped_objects(device, names, models, plain):
    """As A and B; test_intersect names pairs the other way round."""
    swapped = ask_models(device, *models[::-1], [pair[::-1] for pair in grid_poses(names)])
    check_equal([sort_rows(rows[:, ::-1]) for rows in swapped], plain)


def test_common_motion(device, names, models, plain):
    """Quarter turns and steps from 2^-11 to 2^20 sizes keep each bit of the relative pose."""
    rng = np.random.default_rng(22)
    for step in (2.0**-11, 1.0, 2.0**20):
        motion = to_matrix(QUARTERS[rng.integers(len(QUARTERS))], step * rng.integers(-7, 8, 3))
        moved = [(motion @ a, motion @ b) for a, b in grid_poses(names)]
        check_equal(ask_models(device, *models, moved), plain)


def test_common_motion_of_meshes_as_they_are(device, names):
    """Coordinates of full length and a rotation that rounds, at several LODs: the relative pose is what counts."""
    rng = np.random.default_rng(23)
    model_a, model_b = map(sample, names)
    cases, moved = [], []
    for fraction in (0.05, 0.3, 1.0):
        lods = [model.lod_for(fraction=fraction) for model in (model_a, model_b)]
        pose_a, pose_b = contact_poses(rng, model_a, lods[0], model_b, lods[1])
        rotation, shift = relative_pose(*pose_matrix(pose_a), *pose_matrix(pose_b))
        posed = to_matrix(rotation, np.round(shift * GRID) / GRID)
        turn = to_matrix(QUARTERS[rng.integers(len(QUARTERS))], rng.integers(-99, 100, 3))
        cases.append((model_a, lods[0], np.eye(4), model_b, lods[1], posed))
        moved.append((model_a, lods[0], turn, model_b, lods[1], turn @ posed))
    whole, other = ask(device, cases), ask(device, moved)
    assert len(whole.faces) > 0
    for name in ("faces", "node_tests", "triangle_tests"):
        np.testing.assert_array_equal(getattr(other, name), getattr(whole, name))


def cut_faces(rng, vertices, faces):
    """Cut each face in a way of its own at points that are exact; return all corners, faces and their parents."""
    corners = vertices[faces]
    turn = rng.integers(0, 3, len(faces))
    a, b, c = (corners[np.arange(len(faces)), (turn + k) % 3] for k in range(3))
    mid, rest, inner = (a + b) / 2, (b + c) / 2, ((a + b) / 2 + c) / 2
    ways = [
        [(a, b, c)],
        [(a, mid, c), (mid, b, c)],
        [(a, mid, c), (mid, b, rest), (mid, rest, c)],
        [(a, b, inner), (b, c, inner), (c, a, inner)],
    ]
    way = rng.integers(0, len(ways), len(faces))
    parts, parents = [], []
    for k, triangles in enumerate(ways):
        for triangle in triangles:
            parts.append(np.stack(triangle, 1)[way == k])
            parents.append(np.flatnonzero(way == k))
    parts = np.concatenate(parts)
    return parts.reshape(-1, 3), np.arange(3 * len(parts)).reshape(-1, 3), np.concatenate(parents)


def test_cut_faces(device, names, plain):
    """Two faces meet if and only if parts of them do."""
    rng = np.random.default_rng(24)
    (*a, parents_a), (*b, parents_b) = (cut_faces(rng, *grid_mesh(name)[:2]) for name in names)
    found = ask_models(device, make_model(*a), make_model(*b), grid_poses(names))
    found = [np.stack([parents_a[rows[:, 0]], parents_b[rows[:, 1]]], 1) for rows in found]
    check_equal([np.unique(rows, axis=0) for rows in found], plain)


def shuffle(rng, vertices, faces):
    """Number vertices, faces and the corners of each face anew; return mesh and the old index of each face."""
    order, place = rng.permutation(len(faces)), rng.permutation(len(vertices))
    return vertices[np.argsort(place)], place[rng.permuted(faces[order], axis=1)], order


def test_order_of_faces_and_corners(device, names, plain):
    """Other trees, other windings, other corners first: the same faces."""
    rng = np.random.default_rng(25)
    (*a, order_a), (*b, order_b) = (shuffle(rng, *grid_mesh(name)[:2]) for name in names)
    found = ask_models(device, make_model(*a), make_model(*b), grid_poses(names))
    check_equal([sort_rows(np.stack([order_a[r[:, 0]], order_b[r[:, 1]]], 1)) for r in found], plain)


@pytest.mark.parametrize("make_query", [ab.Query, *slow(GpuQuery)], ids=["threads", "as on CUDA"])
@pytest.mark.parametrize("names", [("soup", "torus"), *slow(*NAMES)], ids="-".join)
def test_scale(device, names, make_query):
    """2^-60 to 2^60: the same faces from the same work, also where coordinates and poses round."""
    rng = np.random.default_rng(26)
    meshes = [sample(name).mesh_at(sample(name).lod_for(fraction=0.5))[:2] for name in names]
    lods = [make_model(*mesh).lod_max for mesh in meshes]
    pose_a, pose_b = contact_poses(rng, make_model(*meshes[0]), lods[0], make_model(*meshes[1]), lods[1])
    cases = []
    for k in (-60, -40, -23, -1, 0, 1, 20, 31, 60):
        by = np.array([2.0**k] * 3 + [1.0] * 4)
        a, b = (make_model(np.ldexp(vertices, k), faces) for vertices, faces in meshes)
        cases.append((a, None, by * pose_a, b, None, by * pose_b))
    result = ask_query(make_query, device, cases)
    assert result.count[0] > 0
    for name in ("count", "node_tests", "triangle_tests", "float64_tests", "exact_tests"):
        assert len(np.unique(getattr(result, name))) == 1
    rows = result.faces[:, 1:].reshape(len(cases), -1, 2)
    assert (rows == rows[0]).all()


@pytest.mark.parametrize("make_query", [ab.Query, *slow(GpuQuery)], ids=["threads", "as on CUDA"])
@pytest.mark.parametrize(
    "names", [("cow", "fandisk"), ("fcl-rob", "woody"), ("torus", "ball"), ("crumbs", "soup")], ids="-".join
)
def test_distance_from_the_origin(device, names, make_query):
    """Up to 1e9 sizes, of poses and of the meshes' own coordinates, against brute force in integers."""
    rng = np.random.default_rng(27)
    meshes = [coarse(name, 300) for name in names]
    still = [make_model(*mesh) for mesh in meshes]
    poses = contact_poses(rng, still[0], still[0].lod_max, still[1], still[1].lod_max)
    cases = []
    for far in (0.0, 1e1, 1e4, 1e7, 1e9):
        way = far * np.array([0.6, -1.0, 0.3])
        away = np.concatenate([way, np.zeros(4)])
        cases.append((still[0], None, poses[0] + away, still[1], None, poses[1] + away))
        # The models lie far from their own origins, in other directions; poses bring them back together.
        a, b = make_model(meshes[0][0] + way, meshes[0][1]), make_model(meshes[1][0] - way[::-1], meshes[1][1])
        back = [pose.copy() for pose in poses]
        for pose, shift in zip(back, (way, -way[::-1]), strict=True):
            pose[:3] -= rotate(pose, shift)
        cases.append((a, None, back[0], b, None, back[1]))
        twin = random_poses(rng, 1, 1.0)[0]
        cases.append((a, None, twin, a, None, twin))
    result = ask_query(make_query, device, cases)
    for p, (model_a, _, pose_a, model_b, _, pose_b) in enumerate(cases):
        truth = true_faces(model_a, model_a.lod_max, pose_a, model_b, model_b.lod_max, pose_b)
        np.testing.assert_array_equal(result.faces[result.faces[:, 0] == p][:, 1:], truth)
    assert (result.count > 0).all()


def rotate(pose, vector):
    """Return a vector turned by the quaternion of a pose."""
    u, w = pose[3:6], pose[6]
    return vector + 2 * np.cross(u, np.cross(u, vector) + w * vector)
