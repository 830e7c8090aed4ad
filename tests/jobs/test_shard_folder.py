"""Shards that are damaged, altered or of another job: detected when read, computed again or refused by the next run."""

import json
import tracemalloc

import numpy as np
import pytest
from helpers import refused
from helpers.jobs import ColumnJob, contents, job_of, pair, poses_of, read, run, shard_at

from warp_abtree.jobs import SweepJob, read_shards, shard_folder
from warp_abtree.jobs.shard_folder import MANIFEST


def refuse(job, out, *words, error=ValueError, readers=True):
    """Check that a run, and a reader, refuse a folder, naming all words, and change nothing."""
    before = contents(out) if error is ValueError else None
    for call in [lambda: run(job, out), lambda: list(read_shards(out))][: 1 + readers]:
        caught = refused(error, None, call)
        assert all(word in str(caught) for word in words)
    assert before is None or contents(out) == before


def rewrite(alter):
    """Return what writes a valid .npz of other arrays: alter(arrays, name of a column) returns these."""

    def damage(path):
        with np.load(path) as held:
            arrays = dict(held)
        np.savez(path, **alter(arrays, "count" if "count" in arrays else "face_a"))

    return damage


def without(arrays, name):
    return {key: values for key, values in arrays.items() if key != name}


DAMAGE = {  # by what it does to the second shard's file
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "another shard": lambda path: path.write_bytes(shard_at(path.parent, 2).read_bytes()),
    "value": rewrite(lambda held, name: {**held, name: held[name] + (np.arange(len(held[name])) == 3)}),
    "type": rewrite(lambda held, name: {**held, name: held[name].astype(np.int16)}),
    "rows lost": rewrite(lambda held, _: {name: part[:-3] if part.ndim else part for name, part in held.items()}),
    "column lost": rewrite(without),
    "no digest": rewrite(lambda held, _: without(held, "digest")),
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("output", ["count", "faces"])
def test_a_damaged_shard_is_detected_and_computed_again(tmp_path, monkeypatch, output, damage):
    job, out = job_of(output), tmp_path / "out"
    run(job, out)
    whole, path = contents(out), shard_at(out, 1)
    DAMAGE[damage](path)
    assert path.read_bytes() != whole[path.name]
    shards = read_shards(out)
    assert next(shards)[:2] == (0, 20)
    caught = refused(ValueError, "run the job again", next, shards)
    assert str(path) in str(caught) and len(str(caught).splitlines()) == 1
    computed, told = [], []
    monkeypatch.setattr(job, "task", lambda *part, plain=job.task: computed.append(part) or plain(*part))
    done = run(job, out, progress=lambda *call: told.append(call))
    assert computed == [(20, 40)] and (done["shards"], done["kept"], done["damaged"]) == (3, 2, 1)
    assert told == [*(("check", k, 3) for k in (1, 2, 3)), ("shards", 2, 3), ("shards", 3, 3)]
    assert contents(out) == whole
    assert run(job, out)["damaged"] == 0


@pytest.mark.parametrize("output", ["count", pytest.param("contacts", marks=pytest.mark.slow)])
def test_no_flipped_bit_changes_what_is_read(tmp_path, output):
    """Flip a bit of some bytes: it is detected, or the byte has no meaning."""
    out = tmp_path / "out"
    run(job_of(output, count=8, shard=8), out)
    path, expected = shard_at(out, 0), read(out)
    data, detected = path.read_bytes(), 0
    for place in range(0, len(data), 7 if output == "count" else 101):
        changed = bytearray(data)
        changed[place] ^= 1 << place % 8
        path.write_bytes(changed)
        try:
            found = read(out)
        except ValueError as error:
            assert str(path) in str(error)
            detected += 1
            continue
        assert list(found) == list(expected)
        for name, values in expected.items():
            assert found[name].dtype == values.dtype and found[name].tobytes() == values.tobytes()
    assert detected > 0


def test_a_damaged_header_allocates_no_memory(tmp_path):
    out, job = tmp_path / "out", ColumnJob(count=6000, shard=2000)
    run(job, out)
    path = shard_at(out, 1)
    data = path.read_bytes()
    shape, huge = b"'shape': (2000,), }", b"'shape': (%d,), }" % 10**15
    assert data.count(shape) == 2
    path.write_bytes(data.replace(shape + b" " * (len(huge) - len(shape)), huge, 1))
    refused(ValueError, r"damaged .*count\.npy", list, read_shards(out))
    assert run(job, out)["damaged"] == 1 and path.read_bytes() == data


@pytest.mark.parametrize("place", [0, 1])
def test_a_shard_of_another_job_is_refused(tmp_path, place):
    """Also under the name of another range."""
    job, out = job_of(), tmp_path / "out"
    run(job, out)
    run(job_of(seed=1), tmp_path / "other")
    path = shard_at(out, place)
    path.write_bytes(shard_at(tmp_path / "other", 1).read_bytes())
    shard_at(out, 1 - place).write_bytes(b"")
    held = path.read_bytes()
    refuse(job, out, "a shard of another job", str(path), readers=place == 0)
    path.unlink()
    assert (run(job, out)["damaged"], run(job, out)["kept"]) == (1, 3)
    path.write_bytes(held)
    refuse(job, out, "a shard of another job", str(path))


@pytest.mark.parametrize("name", ["000000000000-000000000030.npz", "000000000060-000000000080.npz"])
def test_a_shard_with_a_name_of_another_job_is_refused(tmp_path, name):
    job, out = job_of(), tmp_path / "out"
    run(job, out)
    path = out / f"shard-{name.format(f'{0:012d}', f'{20:012d}')}"
    path.write_bytes(shard_at(out, 0).read_bytes())
    refuse(job, out, "a shard of another job", str(path))


@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
def test_shards_of_every_output_are_kept(tmp_path, output):
    """With a shard without rows, and a shorter last one."""
    poses = poses_of(50)
    poses[20:40, :3] += 9
    job, out = SweepJob(*pair(), poses, output=output, shard=20), tmp_path / "out"
    run(job, out)
    rows = [len(next(iter(columns.values()))) for _, _, columns in read_shards(out)]
    assert rows == [20, 20, 10] if output in ("any", "count") else rows[1] == 0 < min(rows[0], rows[2])
    assert run(job, out)["kept"] == 3
    assert not set(shard_folder.STAMP_FIELDS) & set(read(out))


@pytest.mark.parametrize(
    ("rows", "output", "fault"),
    [
        ((1, 1), "count", "1 rows, not 2"),
        ((3, 3), "any", "3 rows, not 2"),
        ((2, 1), "count", "columns of different lengths"),
        ((2, 1), "faces", "columns of different lengths"),
    ],
)
def test_rows_are_counted(tmp_path, monkeypatch, rows, output, fault):
    job, out = ColumnJob(rows=rows, output=output), tmp_path / "out"
    refused(RuntimeError, f"shard 0 to 2 was answered with {fault}", run, job, out)
    assert list(contents(out)) == [MANIFEST]
    with monkeypatch.context() as patch:
        patch.setattr(shard_folder, "_row_fault", lambda *_: None)
        run(job, out)
    refused(ValueError, f"shard-000000000000-000000000002.npz: holds {fault}", next, read_shards(out))
    job.rows = None
    assert run(job, out)["damaged"] == 2


def test_one_column_is_in_memory_while_all_are_checked(tmp_path):
    out, size = tmp_path / "out", 100_000
    job = ColumnJob(count=40, shard=10, size=size, output="rows")  # 16 MB a shard
    run(job, out)
    tracemalloc.start()
    try:
        assert run(job, out)["kept"] == 4
        checked = tracemalloc.get_traced_memory()[1]
        tracemalloc.reset_peak()
        for _, _, columns in read_shards(out):
            assert len(columns["count"]) == 10 * size
            del columns
        reading = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    column = 8 * 10 * size
    assert checked < 1.3 * column and reading < 2.3 * column


@pytest.mark.parametrize("change", [{"version": 1}, {"job": {"count": 40}}, {"hash": "0" * 64}, {"job": None}])
def test_an_altered_manifest_is_refused(tmp_path, change):
    job, out = job_of(), tmp_path / "out"
    run(job, out)
    held = json.loads((out / MANIFEST).read_text())
    (out / MANIFEST).write_text(json.dumps(held | change))
    what = "not of warp_abtree shards, version 2" if "version" in change else "the hash is not that of the job"
    refuse(job, out, what, str(out / MANIFEST))


def test_missing_rights_are_no_damage(tmp_path):
    run(job_of(), tmp_path / "out")
    path = shard_at(tmp_path / "out", 1)
    path.unlink()
    path.mkdir()
    refuse(job_of(), tmp_path / "out", path.name, error=OSError)
