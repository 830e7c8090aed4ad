"""Playbacks of scene files and meshes: the poses, LODs and rows of their frames."""

import itertools

import numpy as np
import pytest
from helpers import refused
from helpers.viewer import BODIES, make_models, make_playback, write_scene

import warp_abtree as ab
from warp_abtree.app import load_scene
from warp_abtree.app.open_playback import open_playback, row_poses
from warp_abtree.app.playback import ScenePlayback


def test_meshes_sweep_and_stay_where_they_are_held(device):
    playback = make_playback(device)
    lods = [playback.step("count").lods for _ in range(3)]
    top = [playback.scene.models[i].lod_max for i in playback.scene.object_model]
    assert lods[0].tolist() == top and (lods[2] < top).all()
    lods = playback.scene.lods
    lods[1] = 5
    playback.hold(lods)
    snapshot = playback.query("faces")
    assert snapshot.lods.tolist() == lods.tolist() and snapshot.number == 2 and snapshot.row is None
    after = playback.step("faces")
    assert after.lods.tolist() == lods.tolist() and after.number == 3 and after.row.hits == len(after.result.faces)
    playback.choose("scene")
    assert (playback.step("count").lods < top).all() and playback.scene.lods[1] > 5
    playback.choose("hold")
    before = playback.scene.lods
    assert playback.step("count").lods.tolist() == before.tolist()
    playback.restart()
    assert playback.query("count").lods.tolist() == top and playback.time == 0
    assert playback.step("count").lods.tolist() == top, "still held, from the start"


def test_a_scene_plays_as_it_runs(tmp_path, device):
    path = write_scene(tmp_path)
    playback = open_playback([path], device)
    assert isinstance(playback, ScenePlayback) and playback.modes() == ["scene", "hold", "predictive", "paper"]
    loaded = load_scene(path, device=device)
    frame = loaded.frame(output="faces")
    for k in range(5):
        snapshot, result = playback.step("faces"), frame.step()
        assert snapshot.row.hits == frame.history[-1].hits and snapshot.number == k
        assert np.array_equal(snapshot.result.faces, result.faces)
        assert np.array_equal(snapshot.lods, loaded.scene.lods)
        assert np.array_equal(snapshot.poses, loaded.motion.poses(0.25 * k))
    playback.choose("predictive", 50.0)
    assert playback.budget_ms == 50 and playback.step("count").row.budget_ms == 50
    refused(ValueError, "needs lod", playback.choose, "tolerance")
    assert playback.budget_ms == 50
    playback.hold([3] * len(playback.chosen))
    assert playback.step("count").lods[0] == 3
    playback.choose("scene")
    assert playback.step("count").row.budget_ms is None and playback.scene.lods[0] > 3
    playback.restart()
    assert playback.step("count").number == 0


def test_rigid_bodies_are_shown_where_they_stand(tmp_path, device):
    playback = open_playback([write_scene(tmp_path, BODIES)], device)
    snapshots = [playback.step("contacts") for _ in range(20)]
    snapshots.append(playback.query("contacts"))
    heights = [snapshot.poses[1, 1] for snapshot in snapshots]
    assert (np.diff(heights[:8]) < 0).all() and heights[-1] == heights[-2]
    for snapshot in snapshots:
        scene = ab.Scene(device=device)
        for i in range(2):
            scene.add(playback.scene.models[playback.scene.object_model[i]], snapshot.poses[i])
        # Bodies stop where they touch, so that the last bit of a pose decides.
        apart = scene.intersect([(0, 1)], output="distance").distance[0]
        assert (apart < 1e-12) == (len(snapshot.result.faces) > 0)
    assert any(len(snapshot.result.faces) for snapshot in snapshots)


def test_meshes_side_by_side_reach_into_each_other():
    ball, ring = make_models()
    boxes = []
    for model, pose in zip((ball, ring, ball), row_poses([ball, ring, ball])):
        vertices = model.mesh_at(model.lod_max)[0] + pose[:3]
        boxes.append((vertices.min(axis=0), vertices.max(axis=0)))
    for (_, upper), (lower, _) in itertools.pairwise(boxes):
        assert upper[0] - lower[0] == pytest.approx(0.25 * 2.0)
    assert np.allclose([0.5 * (low + high)[1:] for low, high in boxes], 0)
