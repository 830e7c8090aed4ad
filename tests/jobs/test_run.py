"""Running jobs: one folder per job, atomic files, continued after an interrupt, the same bytes on several devices."""

import contextlib
import os
import threading

import numpy as np
import pytest
from helpers import refused
from helpers.jobs import contents, job_of, lods_of, pair, poses_of, run, stop_after

from warp_abtree.jobs import SweepJob, ThisProcess, read_shards, run_shards, sweep_job
from warp_abtree.jobs import run as running
from warp_abtree.jobs.shard_folder import MANIFEST


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


def test_a_job_without_poses_has_no_shards(tmp_path):
    done = run(SweepJob(*pair(), np.empty((0, 7))), tmp_path / "out")
    assert done["shards"] == 0 and list(read_shards(tmp_path / "out")) == []


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
def test_a_pipe_is_no_shard(tmp_path):
    """It would be waited for."""
    job, out = job_of("any", count=20, shard=10), tmp_path / "out"
    run(job, out)
    path = out / "shard-000000000010-000000000020.npz"
    path.unlink()
    os.mkfifo(path)
    refused(ValueError, "1 of 2 shards are missing", list, read_shards(out))
    refused(OSError, "is neither a file nor a folder", run, job, out)


def test_files_of_other_programs_stay(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "film.partial").write_text("half")
    refused(ValueError, "is not empty", run, job_of("any", count=20), out)
    (out / "film.partial").unlink()
    run(job_of("any", count=20), out)
    (out / "film.partial").write_text("half")
    run(job_of("any", count=20), out)
    assert (out / "film.partial").read_text() == "half"


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
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("deal", "what"),
    [(lambda r: [r[0], *r], "answered twice"), (lambda r: r[:1], "2 of 3 shards were not answered")],
)
def test_a_pool_that_answers_twice_or_not_at_all_is_detected(tmp_path, deal, what):
    class Pool(ThisProcess):
        def run(self, job, ranges):
            return super().run(job, deal(ranges))

    refused(RuntimeError, what, run_shards, job_of(), tmp_path / "out", pool=Pool("cpu"))
