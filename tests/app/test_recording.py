"""Poses of recorded runs: those that were really used, to the bit, in memory, in the file and in the comparison."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.samples import SHUTTLE_SCENE

from warp_abtree.app import SceneError, load_scene
from warp_abtree.app.cli import main as cli
from warp_abtree.app.cli.run_command import first_difference
from warp_abtree.app.recording import FORMAT_VERSION, Recording, record_run
from warp_abtree.lod.timing import ReplayClock

FRAMES = 4
TURNING = SHUTTLE_SCENE + "random = { rotation = true, turn = 90 }\n"
BODIES = (
    TURNING.replace("shuttle = { by = [0.4, 0, 0], period = 2 }", "velocity = [1, 0, 2]")
    + "[dynamics]\ngravity = [0, -1, 0]\n"
)


def load(tmp_path, text):
    (tmp_path / "scene.toml").write_text(text)
    return load_scene(tmp_path / "scene.toml", device="cpu")


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


def rotations(quaternions):
    """Return the matrices of unit quaternions x y z w."""
    x, y, z, w = quaternions.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


@pytest.mark.parametrize("text", [TURNING, BODIES], ids=["prescribed", "bodies"])
def test_poses_are_those_that_were_asked_at(tmp_path, text):
    loaded = load(tmp_path, text)
    used = watch(loaded)
    _, recording = record_run(loaded, FRAMES)
    recording.save(tmp_path / "run.npz")
    opened = Recording.open(tmp_path / "run.npz")
    assert len(used) == FRAMES and len({position.tobytes() for position, _ in used}) == FRAMES
    assert len({rotation.tobytes() for _, rotation in used}) == FRAMES
    for poses in (recording.poses, opened.poses):
        assert poses.shape == (FRAMES, 2, 7) and poses.dtype == np.float64
        for i, (position, rotation) in enumerate(used):
            assert poses[i, :, :3].tobytes() == position.tobytes()
            np.testing.assert_allclose(rotations(poses[i, :, 3:]), rotation, rtol=0, atol=1e-14)
    assert opened.poses.tobytes() == recording.poses.tobytes()


@pytest.mark.parametrize("text", [TURNING, BODIES], ids=["prescribed", "bodies"])
def test_one_bit_of_one_pose_is_a_difference(tmp_path, text):
    _, first = record_run(load(tmp_path, text), FRAMES)
    _, second = record_run(load(tmp_path, text), FRAMES, clock=ReplayClock(first.rows))
    assert first_difference(first, second) is None
    for place in np.ndindex(first.poses.shape):
        for bit in (0, 30, 63):  # the last also tells the zeros apart
            poses = first.poses.copy()
            poses.view(np.uint64)[place] ^= np.uint64(1) << np.uint64(bit)
            told = f"frame {place[0]}: poses are not those recorded"
            assert first_difference(first, replace(second, poses=poses)) == told
    second.lods[2, 1] += 1
    assert first_difference(first, second) == "frame 2: lods are not those recorded"
    _, other = record_run(load(tmp_path, text), FRAMES, clock=ReplayClock(first.rows), budget_ms=1e4)
    assert "frame 0: " in first_difference(first, other)


@pytest.mark.parametrize("text", [TURNING, BODIES], ids=["prescribed", "bodies"])
def test_a_recorded_run_runs_again_without_its_scene_file(tmp_path, device, text):
    """Under a budget that every machine keeps, so that LODs climb."""
    frame, first = record_run(load(tmp_path, text), 8, budget_ms=1e4)
    assert len({row.cost_ms for row in first.rows}) == 8, "real times"
    path = tmp_path / "run.npz"
    first.save(path)
    assert [entry.name for entry in tmp_path.iterdir() if "partial" in entry.name] == []
    opened = Recording.open(path)
    assert opened.rows == frame.history and opened.settings == first.settings
    (tmp_path / "scene.toml").unlink()
    loaded = opened.load_scene(path, device)
    again, second = record_run(loaded, 8, budget_ms=1e4, clock=ReplayClock(opened.rows))
    assert again.history == frame.history and first_difference(opened, second) is None
    assert len(np.unique(first.lods)) > 1 and not np.array_equal(first.poses[0], first.poses[-1])


def test_a_run_from_a_recording_with_another_pose_fails(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(TURNING)
    assert cli.main(["run", "scene.toml", "--device", "cpu", "--record", "run.npz"]) == 0
    assert cli.main(["run", "run.npz"]) == 0
    with np.load("run.npz") as file:
        arrays = {name: file[name] for name in file.files}
    arrays["poses"].view(np.uint64)[2, 1, 4] ^= np.uint64(1)
    np.savez("run.npz", **arrays)
    capsys.readouterr()
    assert cli.main(["run", "run.npz"]) == 1
    assert capsys.readouterr().err == "warp-abtree: run.npz: frame 2: poses are not those recorded\n"


def test_damaged_recordings_are_refused(tmp_path):
    _, recording = record_run(load(tmp_path, TURNING), 2)
    path = tmp_path / "run.npz"
    recording.save(path)
    with np.load(path) as file:
        good = {name: file[name] for name in file.files}
    settings, rows = (json.loads(str(good[name])) for name in ("settings", "rows"))
    row = rows[0]
    bad = [
        ({"format": np.array("x")}, "not a recording of a run"),
        ({"version": np.array(FORMAT_VERSION + 1)}, f"version {FORMAT_VERSION + 1}"),
        ({"lods": good["lods"][:1]}, "lods: shape"),
        ({"lods": good["lods"].astype(np.int64)}, "int64"),
        ({"lods": good["lods"].ravel()}, "lods: shape"),
        ({"poses": good["poses"][:, :, :6]}, "poses: shape"),
        ({"rows": np.array(json.dumps(rows[:1]))}, "lods: shape"),
        ({"rows": np.array(json.dumps([{**row, "hits": 0.5}, row]))}, "damaged .*int.* got .*float.*hits"),
        ({"rows": np.array(json.dumps([{**row, "query_ms": None}, row]))}, "damaged .*query_ms"),
        ({"settings": np.array("{}")}, "missing required field"),
        ({"settings": np.array("{")}, "damaged"),
        ({"settings": np.array(json.dumps({**settings, "objects": "many"}))}, "damaged .*objects"),
        ({"poses": np.array([{}], dtype=object)}, "not a recording"),
    ]
    for changes, message in bad:
        np.savez(path, **{**good, **changes})
        with pytest.raises(ValueError, match=message) as caught:
            Recording.open(path)
        assert str(caught.value).startswith(str(path)) and len(str(caught.value).splitlines()) == 1
    np.savez(path, **{name: value for name, value in good.items() if name != "rows"})
    with pytest.raises(ValueError, match="rows' is missing"):
        Recording.open(path)
    for content in (b"", b"junk", b"PK\x03\x04junk"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="not a recording"):
            Recording.open(path)
    with pytest.raises(ValueError, match="No such file"):
        Recording.open(tmp_path / "gone.npz")


def test_another_mesh_is_noticed(tmp_path):
    trimesh.creation.box().export(tmp_path / "m.obj")
    loaded = load(tmp_path, '[models.m]\nmesh = "m.obj"\n[[objects]]\nmodel = "m"\n')
    _, recording = record_run(loaded, 1)
    trimesh.creation.box([1, 1, 2]).export(tmp_path / "m.obj")
    with pytest.raises(ValueError, match=r"run.npz: the mesh of models.m is not"):
        recording.load_scene("run.npz")
    (tmp_path / "m.obj").unlink()
    with pytest.raises(SceneError, match=r"m.obj: no such file"):
        recording.load_scene("run.npz")
