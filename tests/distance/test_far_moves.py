"""Searches that start from the last faces where objects have moved far since."""

import numpy as np
import trimesh
from helpers.samples import random_poses

import warp_abtree as ab


def test_far_moves_cost_no_more_than_a_fresh_search():
    """On the CPU, where the same tests are done each time: the last faces are no use at poses that are unrelated."""
    ring = ab.Model.load(trimesh.creation.torus(0.5, 0.2, 60, 40))
    rng = np.random.default_rng(3)
    poses = random_poses(rng, 200, 1.0)
    poses[:, :3] *= rng.uniform(1.1, 1.4, (200, 1)) / np.linalg.norm(poses[:, :3], axis=1)[:, None]
    poses[0, :3] = 0
    scene = ab.Scene("cpu")
    for pose in poses:
        scene.add(ring, pose=pose)
    query = ab.DistanceQuery(scene, [(0, k) for k in range(1, 200)])
    apart = ~query.run().any
    scene.set_poses(np.concatenate([poses[:1], rng.permutation(poses[1:])]))
    moved = query.run().node_tests
    query.forget()
    fresh = query.run()
    apart &= ~fresh.any
    assert apart.sum() > 100 and moved[apart].sum() < 1.1 * fresh.node_tests[apart].sum()
