"""Baselines find what brute force finds, or are named as skipped; checks of benchmarks notice wrong answers."""

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused

import warp_abtree as ab
from bench.baselines import newton, warp_mesh, wp_bvh
from bench.cases import query, scale, sweep, update
from bench.meshes import knot_model
from bench.shapes import knot, pair_poses, random_poses, scene_of_objects, scene_of_pairs
from bench.verify import count_differences
from warp_abtree import testing
from warp_abtree.state import work_lists

pytestmark = pytest.mark.slow


def test_a_wrong_answer_is_noticed(device):
    placed = pair_poses(3, 0.2)
    scene, pairs = scene_of_pairs(device, knot_model(300), placed)
    found, fewer, other = (scene.intersect(pairs, "faces") for _ in range(3))
    model, truth = scene.models[0], found.faces
    assert count_differences(truth[1:], truth) == (1, 0) and count_differences(truth, truth[1:]) == (0, 1)
    assert count_differences(np.empty((0, 3)), truth) == (len(truth), 0)
    apart = next(row for row in ((0, 0, b) for b in range(300)) if row not in set(map(tuple, truth.tolist())))
    poses = random_poses(2.0, 20).astype(np.float32)
    meets = ab.sweep(model, model, poses, device=scene.device)
    scale.check_alone(scene, found, found.pairs)
    sweep.check_sweep(scene.device, model, poses, meets)
    row = query.check_baseline(truth[1:], truth, model, placed)
    assert (row["judged"], row["ours_wrong"], row["peer_missed"]) == (1, 0, 1)
    fewer.faces = fewer.faces[:-1]
    other.count[1] += 1
    for message, check, *given in (
        ("by themselves have other face pairs", scale.check_alone, scene, fewer, fewer.pairs[2:]),
        ("differs from the checked one", scale.time_query, ab.Query(scene, "faces", pairs=pairs), {}, other, 1),
        ("1 of 1 face pairs", query.check_baseline, truth, truth[1:], model, placed),
        ("1 of 1 face pairs", query.check_baseline, truth, np.concatenate([truth, [apart]]), model, placed),
        ("the sweep and the query differ", sweep.check_sweep, scene.device, model, poses, ~meets),
    ):
        refused(RuntimeError, message, check, *given)


def test_worlds_alone_notice_a_lost_hit(device):
    scene = scene_of_objects(device, knot_model(200), random_poses(0.5, 9), 3)
    result = scene.intersect(output="faces")
    scale.check_worlds(scene, result, 3, 3)
    result.faces = np.delete(result.faces, 0, axis=0)
    refused(RuntimeError, "by themselves", scale.check_worlds, scene, result, 3, 3)
    result.pairs = result.pairs + [[0, 3]]
    refused(RuntimeError, "different worlds", scale.check_worlds, scene, result, 3, 3)


def test_an_update_that_forgets_nodes_is_noticed(device, monkeypatch):
    model, scene = knot_model(300), ab.Scene(device)
    scene.add(model)
    move, whole = (scene, [model.lod_max - 5], [model.lod_max], model.face_count), work_lists.active_update

    def forget(models, states, work):
        if work.full.all():
            return whole(models, states, work)
        work_lists.active_mark(models, states, work)
        counts = work.plan.level_count.numpy().copy()
        counts[: len(work.level_room) - 2] = 0  # a partial update refits but its leaves
        work.plan.level_count.assign(counts)
        work_lists.active_walk(models, states, work)

    with testing.regime(block_updates=False):
        k, *_, launches = update.check_update(*move)
        assert k[0] > 0 and set(launches) == {"update", "full"}
        monkeypatch.setattr(work_lists, "active_update", forget)
        refused(RuntimeError, "bits", update.check_update, *move)


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
    refused(RuntimeError, "with room for 3", small.result)


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
