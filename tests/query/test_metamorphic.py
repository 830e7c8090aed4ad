"""What exact answers imply for real meshes: changes that keep the geometry, or map it, keep or map the answer.

test_exact.py asks the same of small lattice meshes, of scales and of distances, and compares with brute force. Here
meshes are whole, faces number thousands, and changes mix: only some faces are cut, and each object has its own order.
"""

from functools import cache

import numpy as np
import pytest
from helpers.questions import QUARTERS, ask, to_matrix
from helpers.samples import contact_poses, sample
from oracles.triangle import pose_matrix, relative_pose

import warp_abtree as ab

NAMES = [("cow", "fandisk"), ("fcl-rob", "woody"), ("cow", "cow"), ("warp:bear", "warp:bear")]
GRID = 4096.0


@pytest.fixture(params=NAMES, ids="-".join)
def names(request):
    return request.param


@cache
def grid_mesh(name):
    """Return a mesh rounded to multiples of 4 / 4096."""
    vertices, faces, _ = sample(name).mesh_at(sample(name).lod_max)
    return np.round(vertices * GRID / 4) * 4 / GRID, faces


def grid_poses(names, count=3):
    """Return pairs of poses in contact at quarter turns and grid positions: every x' is exact.

    Of a mesh and itself, the last pair is one pose twice: each face on its twin.
    """
    rng = np.random.default_rng(21)
    (a, _), (b, _) = map(grid_mesh, names)
    poses = []
    for _ in range(count):
        rotations = [QUARTERS[k] for k in rng.integers(0, len(QUARTERS), 2)]
        place = rng.integers(-1000, 1000, 3) / GRID
        p, q = 0.875 * a[rng.integers(len(a))], 0.875 * b[rng.integers(len(b))]
        goal = rotations[0] @ p + place - rotations[1] @ q
        poses.append((to_matrix(rotations[0], place), to_matrix(rotations[1], np.round(goal * GRID) / GRID)))
    if names[0] == names[1]:
        poses[-1] = poses[-1][:1] * 2
    return poses


def ask_meshes(device, meshes, poses):
    """Return rows (pair of poses, face of A, face of B) that meet."""
    model_a, model_b = (ab.Model.from_arrays(*mesh, base_faces=10**6) for mesh in meshes)
    return ask(device, [(model_a, None, a, model_b, None, b) for a, b in poses]).faces


def cut(rng, vertices, faces):
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


def shuffle(rng, vertices, faces):
    """Number vertices, faces and the corners of each face anew; return mesh and the old index of each face."""
    order, place = rng.permutation(len(faces)), rng.permutation(len(vertices))
    return vertices[np.argsort(place)], place[rng.permuted(faces[order], axis=1)], order


@pytest.mark.parametrize("change", [cut, shuffle])
def test_changed_meshes(device, names, change):
    """Two faces meet if and only if parts of them do, whatever the trees, the windings and the first corners."""
    rng, poses = np.random.default_rng(24), grid_poses(names)
    plain = ask_meshes(device, map(grid_mesh, names), poses)
    (*a, parents_a), (*b, parents_b) = (change(rng, *grid_mesh(name)) for name in names)
    rows = ask_meshes(device, (a, b), poses)
    rows = np.stack([rows[:, 0], parents_a[rows[:, 1]], parents_b[rows[:, 2]]], 1)
    assert len(plain) > 10 and (change is cut or len(rows) == len(plain))
    np.testing.assert_array_equal(np.unique(rows, axis=0), plain)


def test_common_motion(device, names):
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
