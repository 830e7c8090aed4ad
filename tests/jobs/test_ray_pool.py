"""Shards on a local Ray of two workers: the bytes of one process, also after a kill or an interrupt."""

import os
import signal
import sys

import pytest
from helpers import refused
from helpers.jobs import ColumnJob, contents, job_of, run, stop_after

from warp_abtree.jobs import RayPool, run_shards


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


@pytest.mark.parametrize("output", ["count", "contacts"])
def test_ray_writes_the_same_bytes(tmp_path, pool, output):
    done = check_against_one_process(job_of(output, count=400, shard=25), tmp_path, pool)
    assert (done["shards"], done["workers"], done["lost"]) == (16, 2, 0)


def test_a_killed_worker_is_replaced(tmp_path, pool):
    killed = []

    def kill(_, done, total):
        if done >= 5 and not killed and pool.pids:
            killed.append(next(iter(pool.pids.values())))
            os.kill(killed[0], signal.SIGKILL)

    done = check_against_one_process(job_of("faces", count=400, shard=10), tmp_path, pool, progress=kill)
    assert killed and done["lost"] == 1


def test_an_interrupted_run_continues(tmp_path, pool):
    job = job_of(count=400, shard=10)
    with pytest.raises(KeyboardInterrupt):
        run_shards(job, tmp_path / "ray", pool=pool, progress=stop_after(7))
    assert check_against_one_process(job, tmp_path, pool)["kept"] == 7


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


@pytest.mark.parametrize("workers", [0, -1, 1.5])
def test_workers_are_counted_from_one(workers):
    refused(ValueError, f"^workers {workers} is ", RayPool, workers=workers)
