"""Certified errors against original meshes that just touch: never proved apart, and some are by a smaller bound."""

import numpy as np
import pytest
from helpers.samples import random_quaternions, sample
from oracles.triangle import pose_matrix

import warp_abtree as ab

FRACTIONS = (0.01, 0.05, 0.2, 0.5)
PAIRS = [
    ("torus", "torus"),
    ("torus", "grid"),
    ("small ball", "crumbs"),
    ("soup", "capsule"),
    ("grid", "grid"),
    ("crumbs", "torus"),
    ("lattice soup", "small ball"),
    ("ball", "box"),
]
WORLD = np.eye(4)
WORLD[:3, :3], WORLD[:3, 3] = pose_matrix((0, 0, 0, 0.1, -0.7, 0.5, 0.5))[0], (3, -20, 0.7)


def touching_poses(rng, scene, names, count):
    """Return matrices of A and of copies of B where B is last in contact on its way out of A, and which of them count.

    Found by bisection of the exact answer down to neighbouring floats, or nearly.
    """
    corners = [sample(name).mesh_at(sample(name).lod_max)[0] for name in names]
    centres = [(points.min(0) + points.max(0)) / 2 for points in corners]
    reach = sum(np.linalg.norm(p - c, axis=1).max() for p, c in zip(corners, centres, strict=True))
    turned = np.tile(np.eye(4), (count, 1, 1))
    turned[:, :3, :3] = [pose_matrix((0, 0, 0, *q))[0] for q in random_quaternions(rng, count)]
    turned[:, :3, :3] *= rng.choice([1 - 4e-7, 1, 1 + 4e-7], (count, 1, 1))  # rotations that are a little off
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    query = ab.Query(scene, "any", pairs=[(0, k + 1) for k in range(count)])

    def at(along):
        matrices = turned.copy()
        matrices[:, :3, 3] = centres[0] + along[:, None] * away - matrices[:, :3, :3] @ centres[1]
        return WORLD @ np.concatenate([np.eye(4)[None], matrices])

    def meets(along):
        scene.set_poses(at(along))
        return query.run().any

    steps = np.linspace(0, 1.01 * reach, 40)
    low = np.full(count, -1.0)
    for step in steps:
        low = np.where(meets(np.full(count, step)), step, low)
    chosen = low >= 0
    assert chosen.sum() > count / 3
    high = low + steps[1]
    for _ in range(50):
        middle = (low + high) / 2
        met = meets(middle)
        low, high = np.where(met, middle, low), np.where(met, high, middle)
    return at(low), chosen


@pytest.mark.slow
def test_poses_that_touch_tell_a_wrong_bound(device):
    rng = np.random.default_rng(9)
    count, wrong = 300, {0.5: 0, 0.8: 0}
    for names in PAIRS:
        models = [sample(name) for name in names]
        scene = ab.Scene(device)
        scene.add(models[0])
        for _ in range(count):
            scene.add(models[1])
        matrices, chosen = touching_poses(rng, scene, names, count)
        scene.set_poses(matrices)
        pairs = np.array([(0, k + 1) for k in range(count)])[chosen]
        for fraction in FRACTIONS:
            lods = [model.lod_for(fraction=fraction) for model in models]
            scene.set_lods([lods[0]] + [lods[1]] * count)
            bound = sum(model.error_at(lod) for model, lod in zip(models, lods, strict=True))
            for factor in wrong:
                wrong[factor] += scene.intersect(pairs, within=factor * bound).apart.sum()
            assert not scene.intersect(pairs, within=bound).apart.any()
    assert all(wrong.values()), wrong
