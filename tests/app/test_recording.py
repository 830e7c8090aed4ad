"""Poses of recorded runs: those that were really used, to the bit, in memory, in the file and in the comparison."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.samples import SHUTTLE_SCENE

import warp_abtree as ab
from warp_abtree.app.cli import main as cli
from warp_abtree.app.recording import Recording, record_run

FRAMES = 4
TURNING = SHUTTLE_SCENE + "random = { rotation = true, turn = 90 }\n"
BODIES = (
    TURNING.replace("shuttle = { by = [0.4, 0, 0], period = 2 }", "velocity = [1, 0, 2]")
    + "[dynamics]\ngravity = [0, -1, 0]\n"
)


def load(tmp_path, text):
    (tmp_path / "scene.toml").write_text(text)
    return ab.load_scene(tmp_path / "scene.toml", device="cpu")


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
    _, second = record_run(load(tmp_path, text), FRAMES, first)
    assert first.difference(second) is None
    for place in np.ndindex(first.poses.shape):
        for bit in (0, 30, 63):  # the last also tells the zeros apart
            poses = first.poses.copy()
            poses.view(np.uint64)[place] ^= np.uint64(1) << np.uint64(bit)
            told = f"frame {place[0]}: poses are not those recorded"
            assert first.difference(replace(second, poses=poses)) == told
            assert replace(second, poses=poses).difference(first) == told


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
