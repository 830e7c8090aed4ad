"""Jobs and their folders: continued, the same bytes on several devices; shards damaged, altered or of another job."""

import contextlib
import json
import os
import threading
import tracemalloc

import numpy as np
import pytest
from helpers import refused
from helpers.jobs import ColumnJob, contents, job_of, lods_of, pair, poses_of, read, run, shard_at, stop_after

from warp_abtree.jobs import SweepJob, ThisProcess, read_shards, run_shards, shard_folder, sweep_job
from warp_abtree.jobs import run as running
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


def test_no_flipped_bit_changes_what_is_read(tmp_path):
    out = tmp_path / "out"
    run(job_of(count=8, shard=8), out)
    path, expected = shard_at(out, 0), read(out)
    data, detected = path.read_bytes(), 0
    for place in range(0, len(data), 7):
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
    path.unlink()
    run(job, out)
    for name in ("000000000000-000000000030.npz", "000000000060-000000000080.npz"):  # of another job
        path = out / f"shard-{name}"
        path.write_bytes(shard_at(out, 0).read_bytes())
        refuse(job, out, "a shard of another job", str(path))
        path.unlink()


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
    out, size = tmp_path / "out", 25_000
    job = ColumnJob(count=40, shard=10, size=size, output="rows")  # 4 MB a shard
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


@pytest.mark.parametrize("output", ["count", "contacts"])
def test_several_devices_of_one_process_write_the_same(device, tmp_path, output):
    job = SweepJob(*pair(), poses_of(), lods_of(100), output=output, shard=7)
    run(job, tmp_path / "one", device=device)
    assert run(job, tmp_path / "three", device=[device] * 3)["workers"] == 3
    assert contents(tmp_path / "three") == contents(tmp_path / "one")
    with pytest.raises(KeyboardInterrupt):
        run(job, tmp_path / "four", device=[device] * 4, progress=stop_after(6))
    assert run(job, tmp_path / "four", device=[device] * 2)["kept"] == 6
    assert contents(tmp_path / "four") == contents(tmp_path / "one")
    refused(ValueError, "an empty list", ThisProcess, [])


@pytest.mark.parametrize("count", [1, 2])
def test_every_shard_is_computed_under_the_device_lock(tmp_path, monkeypatch, count):
    """With one device too: another thread may use the same GPU."""
    held, locked = threading.local(), []

    @contextlib.contextmanager
    def lock(device):
        held.device = device
        yield
        held.device = None

    def record(runner, task, device=None, plain=sweep_job.SweepRunner.run):
        locked.append(device is not None and getattr(held, "device", None) == device)
        return plain(runner, task, device)

    monkeypatch.setattr(running, "device_lock", lock)
    monkeypatch.setattr(sweep_job.SweepRunner, "run", record)
    run(job_of(count=100), tmp_path / "out", device=["cpu"] * count)
    assert locked == [True] * 5


def test_an_interrupted_job_continues(tmp_path, monkeypatch):
    job, again = (job_of("faces", count=100, shard=9) for _ in range(2))
    out = tmp_path / "out"
    run(job, tmp_path / "whole")
    out.mkdir()
    (out / f"{MANIFEST}.1-0123abcd.partial").write_text("{")  # of a run interrupted at its first file
    with pytest.raises(KeyboardInterrupt):
        run(job, out, progress=stop_after(4))
    assert len(list(out.glob("shard-*.npz"))) == 4
    refused(ValueError, "8 of 12 shards are missing", list, read_shards(out))
    (out / "shard-000000000099-000000000100.npz.77-0123abcd.partial").write_bytes(b"half")
    computed = []
    monkeypatch.setattr(again, "task", lambda *part: computed.append(part) or job.task(*part))
    assert run(again, out)["kept"] == 4
    assert computed == [(start, min(start + 9, 100)) for start in range(36, 100, 9)]
    assert contents(out) == contents(tmp_path / "whole")
    assert run(again, out)["kept"] == 12


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_pipe_is_no_shard_and_missing_rights_are_no_damage(tmp_path):
    """A pipe would be waited for."""
    job, out = job_of("any", count=20, shard=10), tmp_path / "out"
    run(job, out)
    path = out / "shard-000000000010-000000000020.npz"
    path.unlink()
    os.mkfifo(path)
    refused(ValueError, "1 of 2 shards are missing", list, read_shards(out))
    refused(OSError, "is neither a file nor a folder", run, job, out)
    path.unlink()
    path.mkdir()
    refuse(job, out, path.name, error=OSError)


def test_a_folder_is_of_one_job(tmp_path):
    (a, b), poses, last = pair(), poses_of(), poses_of()
    run(SweepJob(a, b, poses, shard=50), tmp_path / "out")
    before = contents(tmp_path / "out")
    last[99, 0] = np.nextafter(last[99, 0], 9)
    for what, other in (
        ("poses", SweepJob(a, b, last, shard=50)),
        ("output", SweepJob(a, b, poses, shard=50, output="count")),
        ("shard", SweepJob(a, b, poses, shard=51)),
        ("lods", SweepJob(a, b, poses, [3, 3], shard=50)),
        ("models", SweepJob(b, a, poses, shard=50)),
    ):
        refused(ValueError, f"holds another job; not the same: .*{what}", run, other, tmp_path / "out")
    assert contents(tmp_path / "out") == before


def test_folders_that_are_no_jobs_are_refused(tmp_path):
    for name, text in (("full/thesis.txt", "text"), (f"bad/{MANIFEST}", "{")):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text)
    for out, what in (
        ("full", "is not empty and holds no job.json"),
        ("full/thesis.txt", "is a file"),
        ("none/out", "there is no folder"),
        ("bad", "damaged"),
    ):
        refused(ValueError, what, run, job_of(), tmp_path / out)
    refused(ValueError, r"holds no job\.json", list, read_shards(tmp_path / "full"))
    (tmp_path / "full" / "thesis.txt").rename(tmp_path / "full" / "film.partial")
    refused(ValueError, "is not empty", run, job_of(), tmp_path / "full")
    job, out = SweepJob(*pair(), np.empty((0, 7))), tmp_path / "out"
    run(job, out)
    (out / "film.partial").write_text("half")  # files of other programs stay
    assert run(job, out)["shards"] == 0 and list(read_shards(out)) == []
    assert (out / "film.partial").read_text() == "half"


@pytest.mark.parametrize(
    ("deal", "what"),
    [(lambda r: [r[0], *r], "answered twice"), (lambda r: r[:1], "2 of 3 shards were not answered")],
)
def test_a_pool_that_answers_twice_or_not_at_all_is_detected(tmp_path, deal, what):
    class Pool(ThisProcess):
        def run(self, job, ranges):
            return super().run(job, deal(ranges))

    refused(RuntimeError, what, run_shards, job_of(), tmp_path / "out", pool=Pool("cpu"))
