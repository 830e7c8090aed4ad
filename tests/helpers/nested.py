"""Surfaces inside one another, near or touching; specks nearer to a large object than coordinates round; face pairs."""

import numpy as np
import trimesh
from oracles.triangle import into_frame_of_a, quaternion_matrix
from oracles.triangle_distance import triangle_distance

import warp_abtree as ab
from helpers.questions import to_matrix
from helpers.samples import STILL, mirrored, model_of_faces, random_poses, random_quaternions, sample

STEP = 2.0**-23  # of float32 from 1 to 2


def shells(rng, gap, mesh=None):
    """Return two models of a rippled torus, the second farther inside by about a gap, which is random."""
    if mesh is None:
        mesh = trimesh.Trimesh(*sample("torus").mesh_at(sample("torus").lod_max)[:2], process=False)
    rippled = mesh.vertices + 0.02 * np.sin(9 * mesh.vertices[:, [1, 2, 0]])
    inside = rippled - gap * rng.uniform(0.2, 1.8, (len(rippled), 1)) * mesh.vertex_normals
    return [ab.Model.from_arrays(points, mesh.faces) for points in (rippled, inside)]


def nested_cases(rng, gap, count=2):
    """Return cases (model, LOD, pose) twice: both shells under one random pose but for a small motion, at any LODs."""
    outer, inner = shells(rng, gap)
    cases = []
    for k in range(count):
        lods = [model.lod_max if k == 0 else model.lod_for(fraction=rng.uniform(0.3, 1)) for model in (outer, inner)]
        pose = np.asarray(random_poses(rng, 1, 1.0)[0], float)
        moved = pose.copy()
        moved[:3] += gap / 4 * rng.normal(size=3)
        cases.append((outer, lods[0], pose, inner, lods[1], moved))
    return cases


def nearly_halfway(x, sign):
    """Return numbers from 1 to 2 near x that float32 rounds by almost half a step, up or down by a sign."""
    return STEP * (np.floor(x / STEP) + 0.5 + 0.01 * sign)


def speck_cases(rng, count, gap, size=1e-3):
    """Return cases of a large object and a speck, and how far each pair is apart, about a gap, in integers.

    The first face of either is the nearest. A's looks outwards near (1, 1, 1), and B is over its first corner;
    roundings of that corner and of the place of B are towards one another, or apart.
    """
    cases, distances = [], []
    out = np.ones(3) / np.sqrt(3)
    across = np.linalg.svd(out[None])[2][1:]
    for k in range(count):
        sign = 1 if k % 2 else -1
        pose = np.array([*nearly_halfway(rng.uniform(1, 1.01, 3), sign), *random_quaternions(rng, 1)[0]])
        corner = nearly_halfway(pose[:3] - gap * out, -sign)
        face = np.stack([corner, *(corner + size * (rng.normal(size=(2, 2)) @ across - 0.1 * out))])
        above = size * (rng.normal(size=(2, 2)) @ across + rng.uniform(0.5, 1, (2, 1)) * out)
        speck = np.concatenate([np.zeros((1, 3)), above @ quaternion_matrix(pose[3:])])
        cases.append((mirrored(face), None, np.array(STILL), model_of_faces(speck), None, pose))
        distances.append(triangle_distance(face, into_frame_of_a(speck, STILL, pose)))
    return cases, np.array(distances)


def touching_soups(rng, count, reach_a, reach_b, gap=0.0):
    """Return models of two soups and the pose of the second.

    Faces of one number lie in about one plane and share a corner, to the bit in the frame of the first, or lie in two
    planes, so far apart.
    """
    first = rng.uniform(-1, 1, (count, 1, 3))
    turn = quaternion_matrix(random_quaternions(rng, 1)[0])
    pose = to_matrix(turn, rng.normal(size=3))
    meet = into_frame_of_a(first.reshape(-1, 3), np.eye(4), pose).reshape(-1, 1, 3)
    plane, along = rng.normal(size=(count, 2, 3)), rng.uniform(-1, 1, (2, count, 2, 2))
    a = np.concatenate([meet, meet + reach_a * (along[0] @ plane)], 1)
    normal = np.cross(plane[:, :1], plane[:, 1:])
    first = first + gap * (normal / np.linalg.norm(normal, axis=2, keepdims=True)) @ turn
    b = np.concatenate([first, first + reach_b * (along[1] @ plane @ turn)], 1)
    return [model_of_faces(points) for points in (a, b)], pose


FACE_PAIRS = ("random", "parallel", "parallel edges", "nearly parallel edges", "shared corners", "slivers", "caps")
FACE_PAIRS += ("zero area", "nearly points", "coplanar", "nearly touching", "huge and tiny", "lattice")
FACE_PAIRS += ("far from the origin",)


def face_pairs(kind, rng, count):
    """Return pairs of triangles, float64 (count, 2, 3, 3), some of them crossing."""
    pairs = rng.normal(size=(count, 2, 3, 3))
    pairs[:, 1] += rng.normal(size=(count, 1, 3)) * rng.choice([0.1, 1, 10], (count, 1, 1))
    a, b = pairs[:, 0], pairs[:, 1]
    small = 2.0 ** -rng.integers(5, 50, (count, 1))
    if kind == "parallel":
        b[:] = a * rng.uniform(0.5, 2, (count, 1, 1)) + rng.normal(size=(count, 1, 3))
    elif kind == "parallel edges":
        b[:, 1] = b[:, 0] + (a[:, 1] - a[:, 0]) * rng.choice([-1, 0.5, 1, 2], (count, 1))
    elif kind == "nearly parallel edges":
        b[:, 1] = b[:, 0] + (a[:, 1] - a[:, 0]) + small * rng.normal(size=(count, 3))
        b += (a[:, :1] - b[:, :1]) * (1 - small[:, None] * rng.choice([1, 0.1, 1e-3], (count, 1, 1)))
    elif kind == "shared corners":
        b[:, 0] = a[:, rng.integers(3)] + small * rng.normal(size=(count, 3)) * rng.choice([0, 1], (count, 1))
    elif kind in ("slivers", "caps"):
        for t in (a, b):
            at = rng.random((count, 1)) if kind == "caps" else 0.0
            t[:, 2] = t[:, 0] + at * (t[:, 1] - t[:, 0]) + small * rng.normal(size=(count, 3))
    elif kind == "zero area":
        pairs[:] = np.round(pairs * 64) / 64
        a[:, 2] = np.where(rng.random((count, 1)) < 0.5, (a[:, 0] + a[:, 1]) / 2, a[:, 0])
        b[:, 1:] = np.where(rng.random((count, 1, 1)) < 0.5, b[:, :1], b[:, 1:])
    elif kind == "nearly points":
        b[:, 1:] = b[:, :1] + 2.0**-40 * np.eye(3)[:2]
    elif kind == "coplanar":
        pairs[..., 2] = rng.integers(0, 2, (count, 2, 1)) * small[:, :, None]
    elif kind == "nearly touching":
        weights = rng.dirichlet(np.ones(3), count)
        b += np.einsum("nk,nkx->nx", weights, a)[:, None] - b[:, :1]
        normal = np.cross(a[:, 1] - a[:, 0], a[:, 2] - a[:, 0])
        b += (small * normal)[:, None]
        turn = np.sign(np.einsum("nkx,nx->nk", b - b[:, :1], normal))[..., None]
        b[:, 1:] = (b[:, :1] + (b - b[:, :1]) * turn)[:, 1:]
    elif kind == "huge and tiny":
        pairs *= 2.0 ** rng.integers(-90, 90, (count, 1, 1, 1))
        b *= 2.0 ** rng.integers(-60, 5, (count, 1, 1))
    elif kind == "lattice":
        pairs[:] = np.round(1.5 * pairs)
    elif kind == "far from the origin":
        pairs += 2.0 ** rng.integers(0, 40, (count, 1, 1, 1))
    return pairs
