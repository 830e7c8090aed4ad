"""Recorded runs, and playbacks of scene files, recordings and meshes: the poses, LODs and rows that were used."""

import itertools
import json

import numpy as np
import pytest
import trimesh
from helpers.samples import SHUTTLE_SCENE
from helpers.viewer import BODIES, make_models, make_playback, write_scene
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.open_playback import lay_out, open_playback
from warp_abtree.app.playback import RecordedPlayback, ScenePlayback
from warp_abtree.app.recording import FORMAT_VERSION, Recording, record_run

FRAMES = 4
TURNING = SHUTTLE_SCENE + "random = { rotation = true, turn = 90 }\n"
FALLING = (
    TURNING.replace("shuttle = { by = [0.4, 0, 0], period = 2 }", "velocity = [1, 0, 2]")
    + "[dynamics]\ngravity = [0, -1, 0]\n"
)


def watch(loaded) -> list:
    """Return the list into which positions and rotations go whenever a frame asks what intersects."""
    used, make = [], loaded.frame

    def make_watched(**options):
        frame = make(**options)
        place, name = (frame.motion, "find") if hasattr(frame.motion, "find") else (loaded.scene, "intersect")
        ask = getattr(place, name)

        def ask_watched(*arguments, **named):
            pool = loaded.scene.batch().objects.pool
            used.append((pool.position.numpy().copy(), pool.rotation.numpy().copy()))
            return ask(*arguments, **named)

        setattr(place, name, ask_watched)
        return frame

    loaded.frame = make_watched
    return used


@pytest.mark.parametrize("text", [TURNING, FALLING], ids=["prescribed", "bodies"])
def test_poses_are_those_that_were_asked_at(tmp_path, text):
    loaded = load_scene(write_scene(tmp_path, text), device="cpu")
    used = watch(loaded)
    _, recording = record_run(loaded, FRAMES)
    recording.save(tmp_path / "run.npz")
    assert len(used) == FRAMES
    assert all(len({arrays[k].tobytes() for arrays in used}) == FRAMES for k in (0, 1))
    for poses in (recording.poses, Recording.open(tmp_path / "run.npz").poses):
        assert poses.shape == (FRAMES, 2, 7) and poses.dtype == np.float64
        for i, (position, rotation) in enumerate(used):
            assert poses[i, :, :3].tobytes() == position.tobytes()
            turned = [quaternion_matrix(quaternion) for quaternion in poses[i, :, 3:]]
            np.testing.assert_allclose(turned, rotation, rtol=0, atol=1e-14)
        assert poses.tobytes() == recording.poses.tobytes()


def test_damaged_recordings_are_refused(tmp_path):
    path = tmp_path / "run.npz"
    record_run(load_scene(write_scene(tmp_path, TURNING), device="cpu"), 2)[1].save(path)
    with np.load(path) as file:
        good = {name: file[name] for name in file.files}
    settings, (row, _) = (json.loads(str(good[name])) for name in ("settings", "rows"))
    for changes, message in (
        ({"format": np.array("x")}, "not a recording of a run"),
        ({"version": np.array(FORMAT_VERSION + 1)}, f"version {FORMAT_VERSION + 1}"),
        ({"lods": good["lods"][:1]}, "lods: shape"),
        ({"lods": good["lods"].astype(np.int64)}, "int64"),
        ({"poses": good["poses"][:, :, :6]}, "poses: shape"),
        ({"rows": np.array(json.dumps([{**row, "hits": 0.5}, row]))}, "damaged .*int.* got .*float.*hits"),
        ({"rows": None}, "rows' is missing"),
        ({"settings": np.array("{")}, "damaged"),
        ({"settings": np.array(json.dumps({**settings, "objects": "many"}))}, "damaged .*objects"),
        ({"poses": np.array([{}], dtype=object)}, "not a recording"),
        (b"", "not a recording"),
        (b"PK\x03\x04junk", "not a recording"),
    ):
        if isinstance(changes, bytes):
            path.write_bytes(changes)
        else:
            np.savez(path, **{name: array for name, array in (good | changes).items() if array is not None})
        with pytest.raises(ValueError, match=message) as caught:
            Recording.open(path)
        assert str(caught.value).startswith(str(path)) and len(str(caught.value).splitlines()) == 1


def test_another_mesh_is_noticed(tmp_path):
    path = write_scene(tmp_path, '[models.m]\nmesh = "m.obj"\n[[objects]]\nmodel = "m"\n')
    trimesh.creation.box().export(tmp_path / "m.obj")
    _, recording = record_run(load_scene(path, device="cpu"), 1)
    trimesh.creation.box([1, 1, 2]).export(tmp_path / "m.obj")
    with pytest.raises(ValueError, match=r"run.npz: the mesh of models.m is not"):
        recording.load_scene("run.npz")
    (tmp_path / "m.obj").unlink()
    with pytest.raises(SceneError, match=r"m.obj: no such file"):
        recording.load_scene("run.npz")


# Playbacks.


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
    with pytest.raises(ValueError, match="needs lod"):
        playback.choose("tolerance")
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
        assert len(scene.intersect(output="faces").faces) == len(snapshot.result.faces)
    assert any(len(snapshot.result.faces) for snapshot in snapshots)


def test_a_recording_is_shown_as_it_was(tmp_path, device):
    _, recording = record_run(load_scene(write_scene(tmp_path), device=device), 4)
    recording.save(tmp_path / "run.npz")
    playback = open_playback([tmp_path / "run.npz"], device)
    assert isinstance(playback, RecordedPlayback) and playback.length == 4 and playback.modes() == ["scene", "hold"]
    for k in (0, 1, 2, 3, 0):
        snapshot = playback.step("count")
        assert snapshot.number == k and np.array_equal(snapshot.lods, recording.lods[k])
        assert np.array_equal(snapshot.poses, recording.poses[k])
        assert snapshot.row == recording.rows[k] and snapshot.result.count.sum() == recording.rows[k].hits
    playback.seek(2)
    assert playback.query("count").result.count.sum() == recording.rows[2].hits
    playback.hold([2] * len(playback.chosen))
    assert playback.step("count").lods[0] == 2
    with pytest.raises(ValueError, match="holds its LODs"):
        playback.choose("predictive", 3.0)


def test_meshes_side_by_side_reach_into_each_other():
    ball, ring = make_models()
    boxes = []
    for model, pose in zip((ball, ring, ball), lay_out([ball, ring, ball])):
        vertices = model.mesh_at(model.lod_max)[0] + pose[:3]
        boxes.append((vertices.min(axis=0), vertices.max(axis=0)))
    for (_, upper), (lower, _) in itertools.pairwise(boxes):
        assert upper[0] - lower[0] == pytest.approx(0.25 * 2.0)
    assert np.allclose([0.5 * (low + high)[1:] for low, high in boxes], 0)
