"""A pair of models at many poses: answers of scenes and calls, bad input, and the same bytes on a local Ray."""

import json
import os
import signal
import sys

import numpy as np
import pytest
from helpers import refused
from helpers.jobs import (
    ColumnJob,
    contents,
    intersect,
    job_of,
    lods_of,
    pair,
    poses_of,
    read,
    run,
    shard_at,
    stop_after,
)
from helpers.questions import to_matrix
from helpers.samples import sample
from helpers.viewer import run_command
from oracles.triangle import pose_matrix

import warp_abtree as ab
from warp_abtree.app.cli import sweep_command
from warp_abtree.jobs import RayPool, SweepJob, read_shards, run_shards, sweep_job


@pytest.mark.parametrize(
    ("output", "kind"), [("any", "finest"), ("count", "each"), ("faces", "fixed"), ("contacts", "each")]
)
def test_answers_are_those_of_a_scene(device, tmp_path, monkeypatch, output, kind):
    monkeypatch.setattr(sweep_job, "SCENE_POSES", 11)
    monkeypatch.setattr(sweep_job, "READ_ROWS", 16)
    poses = poses_of()
    lods = np.tile([model.lod_max for model in pair()], (len(poses), 1))
    given = None
    if kind == "fixed":
        given = lods[0] // 2
        lods = np.tile(given, (len(poses), 1))
    elif kind == "each":
        lods, given = lods_of(len(poses)), tmp_path / "lods.npy"
        np.save(given, lods)
    np.save(tmp_path / "poses.npy", poses)
    job = SweepJob(*pair(), tmp_path / "poses.npy", given, output=output, shard=27)
    done = run(job, tmp_path / "out", device=device)
    assert 0 < done.pop("intersecting") < 100
    assert done == {"count": 100, "shards": 4, "kept": 0, "damaged": 0, "workers": 1, "lost": 0}
    found, expected = read(tmp_path / "out"), intersect(device, poses, lods, output)
    assert 10 < expected.any.sum() < 90
    if output in ("any", "count"):
        np.testing.assert_array_equal(found[output], getattr(expected, output))
        return
    for column, name in enumerate(("pose", "face_a", "face_b")):
        np.testing.assert_array_equal(found[name], expected.faces[:, column])
    for name in expected.contacts.dtype.names[2:] if output == "contacts" else ():
        np.testing.assert_array_equal(found[name], expected.contacts[name])
    assert len(found) == (3 if output == "faces" else 9)


@pytest.mark.parametrize(
    ("output", "options", "matrices"),
    [
        ("any", {"within": 0.1}, True),
        ("count", {"within": 0.1}, False),
        ("any", {"solid": True}, False),
        ("distance", {"beyond": 0.5, "tolerance": 1e-3}, True),
        ("distance", {"solid": True}, False),
        ("first_contact", {"tolerance": 1e-4}, False),
        ("first_contact", {}, True),
    ],
)
def test_answers_are_those_of_a_call(device, tmp_path, output, options, matrices):
    poses, ends = poses_of(), poses_of(seed=4)
    if matrices:
        poses, ends = (np.array([to_matrix(*pose_matrix(row)) for row in rows]) for rows in (poses, ends))
    names = {"poses": poses, **({"ends": ends} if output == "first_contact" else {})}
    for name, rows in names.items():
        np.save(tmp_path / f"{name}.npy", rows)
    paths = {"end_poses": tmp_path / "ends.npy"} if output == "first_contact" else {}
    job = SweepJob(*pair(), tmp_path / "poses.npy", output=output, shard=27, **options, **paths)
    done = run(job, tmp_path / "out", device)
    found = read(tmp_path / "out")
    asked = {"end_poses": ends} if output == "first_contact" else {}
    expected = ab.sweep(*pair(), poses, output=output, device=device, **options, **asked)
    columns = expected.dtype.names or (output,)
    assert set(found) == set(columns)
    for name in columns:
        np.testing.assert_array_equal(found[name], expected[name] if expected.dtype.names else expected)
    meets = {"distance": lambda: expected["distance"] <= 0, "first_contact": lambda: ~expected["clear"]}
    truth = meets.get(output, lambda: found[output] > 0)()
    assert done["intersecting"] == np.count_nonzero(truth) and 0 < done["intersecting"] < 100


def test_tree_states_of_the_scene_have_bounded_memory(monkeypatch):
    faces = sum(model.face_count for model in pair())
    monkeypatch.setattr(sweep_job, "STATE_BYTES", 5 * sweep_job.BYTES_A_FACE * faces)
    job = SweepJob(*pair(), poses_of(), lods_of(100), output="count")
    runner = job.runner()
    found = runner.run(job.task(0, 100), "cpu")["count"]
    assert runner._scene.object_count == 10
    np.testing.assert_array_equal(found, intersect("cpu", poses_of(), lods_of(100), "count").count)


def test_float32_poses_are_taken_as_they_are(tmp_path):
    poses = poses_of().astype(np.float32)
    run(SweepJob(*pair(), poses, output="count", shard=64), tmp_path / "out")
    np.testing.assert_array_equal(read(tmp_path / "out")["count"], ab.sweep(*pair(), poses, output="count"))


def test_bad_input_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_job, "READ_ROWS", 8)
    nan, long, lods = poses_of(), poses_of(), lods_of(100)
    nan[42, 1] = np.nan
    long[77, 3:] *= 1.1
    lods[63, 1] = 10**6
    (tmp_path / "text.npy").write_text("text")
    np.save(tmp_path / "fortran.npy", np.asfortranarray(poses_of()))
    for poses, options, what in (
        (nan, {}, "pose 42 is not finite"),
        (long, {}, "pose 77 has a quaternion of norm 1.1"),
        (poses_of()[:, :6], {}, r"poses: shape \(100, 6\)"),
        (poses_of(), {"lods": lods}, "those of pose 63"),
        (poses_of(), {"lods": lods[:9]}, "lods: 9 given for 100 poses"),
        (poses_of(), {"lods": [0, 10**6]}, "LOD 1000000 is outside"),
        (tmp_path / "none.npy", {}, "no such file"),
        (tmp_path / "text.npy", {}, "cannot be read as .npy"),
        (tmp_path / "fortran.npy", {}, "in C order"),
        (poses_of(), {"precision": "good"}, "precision 'good'"),
        (poses_of(), {"shard": 0}, "shard 0 is outside"),
        (poses_of(), {"beyond": 1.0}, "beyond means nothing for output 'any'"),
        (poses_of(), {"output": "contacts", "solid": True}, "contacts: not with solid"),
        (poses_of(), {"output": "distance", "lods": lods}, "lods and contacts: not with output 'distance'"),
        (poses_of(), {"output": "distance", "tolerance": -1.0}, "tolerance"),
        (poses_of(), {"output": "first_contact"}, "end_poses: needed"),
        (poses_of(), {"end_poses": poses_of()}, "end_poses: needed for output 'first_contact' alone"),
        (poses_of(), {"output": "first_contact", "end_poses": poses_of(99)}, "99 given for 100"),
        (poses_of(), {"output": "first_contact", "end_poses": np.zeros((100, 7))}, "end_poses: pose 0"),
        (poses_of(), {"output": "nothing"}, "output 'nothing'"),
    ):
        refused(ValueError, what, SweepJob, *pair(), poses, **options)
    refused(TypeError, "not a Model", SweepJob, "torus", sample("torus"), poses_of())
    for workers in (0, -1, 1.5):
        refused(ValueError, f"^workers {workers} is ", RayPool, workers=workers)


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


@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
def test_shards_and_their_intersecting_poses_are_counted(sweep, tmp_path, output):
    """Poses of shards that were there already, too, and of damaged ones once; a shard has no row of faces."""
    words = f"a.npz b.npz poses.npy --out out --shard 40 --output {output}"
    poses = poses_of()
    poses[40:80, :3] += 9
    np.save("poses.npy", poses)
    expected = int(ab.sweep(*pair(), poses, device="cpu").sum())
    assert 0 < expected < 60
    for kept, damaged in ((0, 0), (3, 0), (2, 1)):
        if damaged:
            rows = [len(next(iter(columns.values()))) for _, _, columns in read_shards(tmp_path / "out")]
            assert rows == [40, 40, 20] if output in ("any", "count") else rows[1] == 0 < min(rows[0], rows[2])
            shard_at(tmp_path / "out", 2).write_bytes(b"PK")
        found = sweep(words)[0]
        assert (found["shards"], found["kept"], found["damaged"]) == (3, kept, damaged)
        assert (found["count"], found["intersecting"], found["unit"]) == (100, expected, "pose")


def test_without_ray_one_line_says_so(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_command.importlib.util, "find_spec", lambda name: None)
    asked = "a.npz a.npz poses.npy --out out"
    assert sweep(asked, "")[1] == ["Ray is not installed (pip install ray): this process does all shards"]
    assert len(read(tmp_path / "out")["any"]) == 100
    _, (error,) = sweep(asked, "--workers 2", status=2)
    assert "need Ray" in error


@pytest.fixture(scope="module")
def pool():
    pytest.importorskip("ray")
    with RayPool(workers=2) as made:
        yield made


def check_against_one_process(job, folder, pool, **options):
    """Run a job on Ray and in this process; return what the former reports."""
    run(job, folder / "plain", device="cuda:0" if pool.on_gpus else "cpu")
    done = run_shards(job, folder / "ray", pool=pool, **options)
    assert contents(folder / "ray") == contents(folder / "plain")
    return done


def test_a_killed_worker_is_replaced(tmp_path, pool):
    killed = []

    def kill(_, done, total):
        if done >= 5 and not killed and pool.pids:
            killed.append(next(iter(pool.pids.values())))
            os.kill(killed[0], signal.SIGKILL)

    done = check_against_one_process(job_of("contacts", count=400, shard=10), tmp_path, pool, progress=kill)
    assert killed and (done["shards"], done["workers"], done["lost"]) == (40, 2, 1)


def test_an_interrupted_run_continues(tmp_path, pool):
    job = job_of(count=400, shard=10)
    with pytest.raises(KeyboardInterrupt):
        run_shards(job, tmp_path / "ray", pool=pool, progress=stop_after(7))
    done = check_against_one_process(job, tmp_path, pool)
    assert (done["kept"], done["lost"]) == (7, 0)


class FailingJob(ColumnJob):
    """Fails, or ends its worker, at one task."""

    def run(self, task, device=None):
        if task[0] == 20 and self.output == "end":
            os._exit(1)
        if task[0] == 20:
            raise ValueError("no such task: 20")
        return super().run(task)


@pytest.mark.parametrize(
    ("how", "error", "what"),
    [
        ("end", RuntimeError, r"shard \(20, 30\) ended its worker, 3 times"),
        ("fail", ValueError, "^no such task: 20$"),
    ],
)
def test_a_shard_that_cannot_be_computed_is_given_up(tmp_path, pool, how, error, what):
    for module in (__name__, ColumnJob.__module__):  # workers cannot import the tests
        pool.ray.cloudpickle.register_pickle_by_value(sys.modules[module])
    refused(error, what, run_shards, FailingJob(count=40, shard=10, output=how), tmp_path / "out", pool=pool)
    assert not (tmp_path / "out" / "shard-000000000020-000000000030.npz").exists()
