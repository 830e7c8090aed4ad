"""Baselines find what brute force finds, or are named as skipped."""

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_abtree as ab
from bench.baselines import newton, wp_bvh
from bench.shapes import knot, pair_poses, scene_of_pairs
from bench.verify import count_differences

pytestmark = pytest.mark.slow


def test_wp_bvh_finds_what_brute_force_finds(device):
    box = trimesh.creation.box()
    mesh = np.asarray(box.vertices), np.asarray(box.faces, np.int32)
    poses = np.zeros((4, 7), np.float32)
    poses[:, 6] = 1
    poses[1, :3] = 0.41, 0.27, 0.33
    poses[3, :3] = 3
    found = wp_bvh.BvhPosed(*mesh, poses, 144, wp.get_device(device))
    found.launch()
    scene, pairs = scene_of_pairs(device, ab.Model.from_arrays(*mesh, base_faces=12), poses)
    truth = scene.intersect(pairs, "faces").faces
    assert len(truth) > 6 and count_differences(found.result(), truth) == (0, 0)
    found.rebuild()
    found.launch()
    assert np.array_equal(found.result(), truth)
    small = wp_bvh.BvhPosed(*mesh, poses, 3, wp.get_device(device))
    small.launch()
    with pytest.raises(RuntimeError, match="with room for 3"):
        small.result()


def test_newton_agrees_on_which_pairs_intersect(device):
    pytest.importorskip("newton")
    poses = pair_poses(6, 0.2)
    poses[1::2, :3][3:] += 5
    made, skipped = newton.make_newton(*knot(300), poses, 600, wp.get_device(device))
    assert "newton_bvh" in made, skipped
    for other in made.values():
        other.launch()
        found = other.compare(np.arange(6) < 3)
        assert found["contacts"] > 0 and found["any_missed"] == found["any_invented"] == 0
        assert other.compare(np.arange(6) < 2)["any_invented"] == 1
