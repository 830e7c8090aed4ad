"""`warp-abtree sweep` in this process: the answers of the calls, and what it prints. Bad input has its own test."""

import json

import numpy as np
import pytest
from helpers.jobs import intersect, lods_of, pair, poses_of, read, shard_at
from helpers.viewer import run_command

import warp_abtree as ab
from warp_abtree.app.cli import sweep_command


@pytest.fixture
def sweep(tmp_path, monkeypatch, capsys):
    """Give a function that sweeps in a folder with two models, poses and LODs, and returns what it prints as JSON."""
    monkeypatch.chdir(tmp_path)
    for name, model in zip("ab", pair()):
        model.save(f"{name}.npz")
    np.save("poses.npy", poses_of())
    np.save("lods.npy", lods_of(100))

    def sweep(words, here="--ray none --device cpu", status=0):
        shown, errors = run_command(capsys, "sweep", *words.split(), *here.split(), "--json", status=status)
        return json.loads(shown) if shown else None, errors

    return sweep


def test_answers_are_those_of_the_calls(sweep, tmp_path):
    first, second = pair()
    asked = "a.npz b.npz poses.npy --out out --shard 30 --output count"
    assert sweep(asked)[0]["shards"] == 4 and sweep(asked)[0]["kept"] == 4
    expected = ab.sweep(first, second, poses_of(), output="count", device="cpu")
    np.testing.assert_array_equal(read(tmp_path / "out")["count"], expected)
    sweep("a.npz b.npz poses.npy --out lods --lods lods.npy")
    expected = intersect("cpu", poses_of(), lods_of(100), "any").any
    np.testing.assert_array_equal(read(tmp_path / "lods")["any"], expected)
    sweep("a.npz a.npz poses.npy --out half --lod-a 0.5")
    expected = ab.sweep(first, first, poses_of(), first.lod_for(fraction=0.5), device="cpu")
    np.testing.assert_array_equal(read(tmp_path / "half")["any"], expected)


def test_shards_that_stay_are_counted(sweep, tmp_path):
    words = "a.npz b.npz poses.npy --out out --shard 40"
    for place, text, counts in ((0, None, (3, 0, 0)), (0, b"PK", (3, 2, 1)), (2, b"", (3, 2, 1))):
        if text is not None:
            shard_at(tmp_path / "out", place).write_bytes(text)
        found = sweep(words)[0]
        assert (found["shards"], found["kept"], found["damaged"]) == counts


@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
def test_intersecting_poses_are_counted(sweep, tmp_path, output):
    """Those of shards that were there already, too, and of damaged ones once."""
    words = f"a.npz b.npz poses.npy --out out --shard 40 --output {output}"
    expected = int(ab.sweep(*pair(), poses_of(), device="cpu").sum())
    assert 0 < expected < 100
    for damage in (False, False, True):
        if damage:
            shard_at(tmp_path / "out", 1).write_bytes(b"PK")
        found = sweep(words)[0]
        assert (found["count"], found["intersecting"], found["unit"]) == (100, expected, "pose")


def test_without_ray_one_line_says_so(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_command.importlib.util, "find_spec", lambda name: None)
    asked = "a.npz a.npz poses.npy --out out"
    assert sweep(asked, "")[1] == ["Ray is not installed (pip install ray): this process does all shards"]
    assert len(read(tmp_path / "out")["any"]) == 100
    _, (error,) = sweep(asked, "--workers 2", status=2)
    assert "need Ray" in error
