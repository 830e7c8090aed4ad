"""Queries as plain functions, and poses that float64 holds exactly."""

import itertools
from functools import cache

import numpy as np

import warp_abtree as ab
from helpers.samples import sample

QUARTERS = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
    if np.linalg.det(np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
]


def sort_rows(rows):
    return rows[np.lexsort(rows.T[::-1])]


def ask(device, cases, **options):
    """Return the result for cases (model a, lod a, pose a, model b, lod b, pose b) in one scene, pair p the p-th."""
    scene = ab.Scene(device)
    for model_a, lod_a, pose_a, model_b, lod_b, pose_b in cases:
        scene.add(model_a, pose_a, lod=lod_a)
        scene.add(model_b, pose_b, lod=lod_b)
    return scene.intersect(np.arange(2 * len(cases)).reshape(-1, 2), **{"output": "faces", **options})


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
