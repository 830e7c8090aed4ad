"""Baselines find what brute force finds, or are named as skipped."""

import numpy as np
import pytest
import trimesh
import warp as wp

import warp_abtree as ab
from bench.baselines import newton, warp_mesh, wp_bvh
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


def test_slopes_of_warps_meshes_are_those_of_boxes(device):
    """One over another, one deep in it by a corner that leaves upwards, one beyond the margin."""
    boxes = [trimesh.creation.box(sizes) for sizes in ((4, 4, 1), (1, 1, 1))]
    meshes = [(np.asarray(box.vertices), np.asarray(box.faces, np.int32)) for box in boxes]
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[1:, :3, 3] = (0.1, 0.2, 1.02), (0.1, 0.2, 0.7), (0, 0, 3)
    matrices[1, :3, :3] = trimesh.transformations.rotation_matrix(0.01, (1, 2, 0))[:3, :3]
    made = warp_mesh.WarpMeshSlopes([meshes[0], *[meshes[1]] * 3], matrices, device)
    distances, slopes = made.slopes(np.array([(0, 1), (0, 2), (0, 3)]), 0.05)
    lowest = (meshes[1][0] @ matrices[1, :3, :3].T + matrices[1, :3, 3])[:, 2].min() - 0.5
    np.testing.assert_allclose(distances, [lowest, -0.3, 2], atol=1e-6)
    np.testing.assert_allclose(slopes[:, :3], [(0, 0, 1), (0, 0, 1), (0, 0, 0)], atol=2e-3)
    assert not slopes[2].any() and np.abs(slopes[0, 3:5]).min() > 0.4
