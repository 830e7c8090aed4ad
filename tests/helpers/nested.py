"""Surfaces inside one another, near or touching."""

import numpy as np

import warp_abtree as ab
from helpers.samples import random_poses, sample


def shells(rng, gap):
    """Return two models of a rippled torus, the second farther inside by about a gap, which is random."""
    model = sample("torus")
    vertices, faces, _ = model.mesh_at(model.lod_max)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.zeros_like(vertices)
    for k in range(3):
        np.subtract.at(inwards, faces[:, k], normals)
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    rippled = vertices + 0.02 * np.sin(9 * vertices[:, [1, 2, 0]])
    inside = rippled + gap * rng.uniform(0.2, 1.8, (len(vertices), 1)) * inwards
    return [ab.Model.from_arrays(points, faces) for points in (rippled, inside)]


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
