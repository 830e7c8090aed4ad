"""Surfaces inside one another, near or touching; and specks nearer to a large object than coordinates round."""

import numpy as np
import trimesh
from oracles.triangle import into_frame_of_a, quaternion_matrix
from oracles.triangle_distance import triangle_distance

import warp_abtree as ab
from helpers.samples import STILL, mirrored, model_of_faces, random_poses, random_quaternions, sample

STEP = 2.0**-23  # of float32 from 1 to 2


def shells(rng, gap):
    """Return two models of a rippled torus, the second farther inside by about a gap, which is random."""
    model = sample("torus")
    mesh = trimesh.Trimesh(*model.mesh_at(model.lod_max)[:2], process=False)
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
