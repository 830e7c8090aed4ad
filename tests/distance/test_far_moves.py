"""Searches that start from the last faces where objects have moved far since, or where these faces are gone."""

import numpy as np
import trimesh
import warp as wp
from helpers.questions import launch
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.distance.frame import is_active


@wp.kernel(module="unique")
def is_active_kernel(trees: Trees, active_out: wp.array(dtype=wp.int32)):
    """Tell of each face of state 0, and of some beyond its last."""
    active_out[wp.tid()] = wp.where(is_active(trees, 0, wp.tid()), 1, 0)


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


def test_searches_never_start_from_faces_that_are_not_there(device):
    """Faces that a LOD lacks, of a ring about its frame's origin and of a ball there or beside it."""
    ring, ball = ab.Model.load(trimesh.creation.torus(0.5, 0.1, major_sections=24, minor_sections=12)), sample("ball")
    small = ab.Model.from_arrays(ball.mesh_at(ball.lod_max)[0] / 8, ball.mesh_at(ball.lod_max)[1])
    scene, lods = ab.Scene(device), [model.lod_for(fraction=0.3) for model in (ring, small)]
    for offset in 0.1 * np.random.default_rng(1).normal(size=(20, 3)):
        for model, lod, place in zip((ring, small), lods, (np.zeros(3), offset)):
            scene.add(model, (*place, 0, 0, 0, 1), lod=lod)
    pairs, gone = np.arange(40).reshape(-1, 2), 0
    query = ab.DistanceQuery(scene, pairs)
    there = [np.isin(np.arange(model.face_count), model.mesh_at(lod)[2]) for model, lod in zip((ring, small), lods)]
    active = launch(is_active_kernel, device, ring.face_count + 5, scene.batch().trees)
    np.testing.assert_array_equal(active, [*there[0], *[False] * 5])
    # The last faces of other LODs: some of these are gone.
    for fractions in ((1.0, 1.0), (0.3, 0.3), (1.0, 0.3), (0.3, 0.3), (0.05, 1.0), (0.3, 0.3)):
        found = query.run()
        lods = [model.lod_for(fraction=fraction) for model, fraction in zip((ring, small), fractions)]
        scene.set_lods(np.tile(lods, 20))
        there = [np.isin(np.arange(model.face_count), model.mesh_at(lod)[2]) for model, lod in zip((ring, small), lods)]
        gone += int((~there[0][found.point_faces[:, 0]] | ~there[1][found.point_faces[:, 1]]).sum())
        found, expected = query.run(), ab.DistanceQuery(scene, pairs).run()
        for name in ("distance", "bracket", "points", "point_faces"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert gone > 20
