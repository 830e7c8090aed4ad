"""`warp-abtree sweep` in this process: the answers of the calls, what it prints, and one line for each wrong use."""

import contextlib
import io
import json
import re

import numpy as np
import pytest
from helpers.jobs import intersect, lods_of, pair, poses_of, read, shard_at
from helpers.samples import SHUTTLE_SCENE, sample

import warp_abtree as ab
from warp_abtree.app.cli import sweep_command
from warp_abtree.app.cli.main import main

HERE = ("--ray", "none", "--device", "cpu")


def command(*words):
    """Return the exit status of `warp-abtree sweep`, and what it printed."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(["sweep", *map(str, words)])
    return status, out.getvalue(), err.getvalue()


@pytest.fixture
def files(tmp_path):
    """Paths of two models, poses and LODs of both."""
    for name, model in zip("ab", pair()):
        model.save(tmp_path / f"{name}.npz")
    np.save(tmp_path / "poses.npy", poses_of())
    np.save(tmp_path / "lods.npy", lods_of(100))
    return [tmp_path / name for name in ("a.npz", "b.npz", "poses.npy", "lods.npy")]


def test_answers_are_those_of_the_calls(tmp_path, files):
    a, b, poses, lods = files
    asked = (a, b, poses, "--out", tmp_path / "out", "--shard", 30, "--output", "count", *HERE)
    status, text, _ = command(*asked, "--json")
    assert status == 0 and json.loads(text)["shards"] == 4
    np.testing.assert_array_equal(
        read(tmp_path / "out")["count"], ab.sweep(*pair(), poses_of(), output="count", device="cpu")
    )
    status, text, _ = command(*asked)
    assert status == 0 and re.search("^shards +4\nfound +4\ndamaged +0$", text, re.M)
    assert command(a, b, poses, "--out", tmp_path / "lods", "--lods", lods, *HERE)[0] == 0
    expected = intersect("cpu", poses_of(), lods_of(100), "any").any
    np.testing.assert_array_equal(read(tmp_path / "lods")["any"], expected)
    half = pair()[0].lod_for(fraction=0.5)
    assert command(a, a, poses, "--out", tmp_path / "half", "--lod-a", "0.5", *HERE)[0] == 0
    expected = ab.sweep(pair()[0], pair()[0], poses_of(), half, device="cpu")
    np.testing.assert_array_equal(read(tmp_path / "half")["any"], expected)


def test_wrong_uses_are_named(tmp_path, files):
    a, b, poses, lods = files
    scene = tmp_path / "scene.toml"
    scene.write_text(SHUTTLE_SCENE + '[[objects]]\nmodel = "ball"\n')
    for words, what in (
        ([a, b], "POSES.npy is missing"),
        ([a, poses], "is no scene; a sweep takes two models, or one twice"),
        ([a, b, a, poses], "two models and POSES.npy"),
        ([scene, poses], "takes a scene of two"),
        ([a, b, poses, "--lods", lods, "--lod-a", "3"], "--lods: LODs come from"),
        ([a, b, poses, "--lod-b", "tall"], "--lod-b: LOD 'tall'"),
        ([scene], "POSES.npy is missing"),
        ([a, b, poses, "--workers", 2], "--workers: they are Ray's"),
    ):
        status, _, err = command(*words, "--out", tmp_path / "x", *HERE)
        assert status == 2 and what in err and err.count("\n") == 1, err
    assert not (tmp_path / "x").exists()


def test_found_shards_are_counted(tmp_path, files):
    words = (*files[:3], "--out", tmp_path / "out", "--shard", 40, *HERE)
    assert command(*words)[0] == 0
    path = shard_at(tmp_path / "out", 0)
    path.write_bytes(path.read_bytes()[:99])
    assert re.search("^shards +3\nfound +2\ndamaged +1$", command(*words)[1], re.M)
    shard_at(tmp_path / "out", 2).write_bytes(b"")
    found = json.loads(command(*words, "--json")[1])
    assert (found["shards"], found["found"], found["damaged"]) == (3, 2, 1)


def test_without_ray_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_command.importlib.util, "find_spec", lambda name: None)
    sample("torus").save(tmp_path / "a.npz")
    np.save(tmp_path / "poses.npy", poses_of())
    asked = [tmp_path / "a.npz", tmp_path / "a.npz", tmp_path / "poses.npy", "--out", tmp_path / "out"]
    status, _, err = command(*asked)
    first, *_ = err.splitlines()  # a word about kernels being compiled may follow
    assert status == 0 and first == "Ray is not installed (pip install ray): this process does all shards"
    assert len(read(tmp_path / "out")["any"]) == 100
    status, _, err = command(*asked, "--workers", "2")
    assert status == 2 and "need Ray" in err
