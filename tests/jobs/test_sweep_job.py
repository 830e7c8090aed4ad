"""A pair of models at many poses: shards have the answers of one scene or call, and bad input is named."""

import numpy as np
import pytest
from helpers import refused
from helpers.jobs import intersect, lods_of, pair, poses_of, read, run
from helpers.samples import sample

import warp_abtree as ab
from warp_abtree.jobs import SweepJob, sweep_job


@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
@pytest.mark.parametrize("kind", ["finest", "fixed", "each"])
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
        (poses_of(), {"output": "some"}, "output 'some'"),
        (poses_of(), {"precision": "good"}, "precision 'good'"),
        (poses_of(), {"shard": 0}, "shard 0 is outside"),
    ):
        refused(ValueError, what, SweepJob, *pair(), poses, **options)
    refused(TypeError, "not a Model", SweepJob, "torus", sample("torus"), poses_of())
