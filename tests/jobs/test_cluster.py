"""Shards on a local Ray of two workers: the bytes of one process, also after a kill or an interrupt."""

import os
import signal
import sys

import numpy as np
import pytest
from helpers.jobs import contents, load_worlds, pair, poses_of, stop_after

import warp_abtree as ab


@pytest.fixture(scope="module")
def pool():
    pytest.importorskip("ray")
    with ab.RayPool(workers=2) as made:
        yield made


@pytest.mark.parametrize("output", ["count", "contacts"])
def test_ray_writes_the_same_bytes(tmp_path, pool, output):
    job = ab.SweepJob(*pair(), poses_of(400), output=output, shard=25)
    ab.run_shards(job, tmp_path / "plain", pool=ab.ThisProcess("cuda:0" if pool.on_gpus else "cpu"))
    done = ab.run_shards(job, tmp_path / "ray", pool=pool)
    assert (done["shards"], done["workers"], done["lost"]) == (16, 2, 0)
    assert contents(tmp_path / "ray") == contents(tmp_path / "plain")


def test_ray_goes_on_without_a_worker_that_is_killed(tmp_path, pool):
    job = ab.SweepJob(*pair(), poses_of(400), output="faces", shard=10)
    ab.run_shards(job, tmp_path / "plain", pool=ab.ThisProcess("cuda:0" if pool.on_gpus else "cpu"))
    killed = []

    def kill(_, done, total):
        if done >= 5 and not killed and pool.pids:
            killed.append(next(iter(pool.pids.values())))
            os.kill(killed[0], signal.SIGKILL)

    done = ab.run_shards(job, tmp_path / "ray", pool=pool, progress=kill)
    assert killed and done["lost"] == 1
    assert contents(tmp_path / "ray") == contents(tmp_path / "plain")


def test_ray_goes_on_after_an_interrupt(tmp_path, pool):
    job = ab.SweepJob(*pair(), poses_of(400), output="count", shard=10)
    ab.run_shards(job, tmp_path / "plain", pool=ab.ThisProcess("cuda:0" if pool.on_gpus else "cpu"))
    with pytest.raises(KeyboardInterrupt):
        ab.run_shards(job, tmp_path / "ray", pool=pool, progress=stop_after(7))
    assert ab.run_shards(job, tmp_path / "ray", pool=pool)["found"] == 7
    assert contents(tmp_path / "ray") == contents(tmp_path / "plain")


def test_ray_runs_worlds(tmp_path, pool):
    job = ab.WorldsJob(load_worlds(tmp_path, "[dynamics]"), 4, "poses", 2)
    ab.run_shards(job, tmp_path / "plain", pool=ab.ThisProcess("cuda:0" if pool.on_gpus else "cpu"))
    ab.run_shards(job, tmp_path / "ray", pool=pool)
    assert contents(tmp_path / "ray") == contents(tmp_path / "plain")


class Asker:
    """Fails, or ends its worker, at one item."""

    def __init__(self, how):
        self.how = how

    def ask(self, item, device=None):
        if item == 20 and self.how == "end":
            os._exit(1)
        if item == 20:
            raise ValueError("no such item: 20")
        return {"any": np.zeros(10, bool)}


class Job:
    unit, count, shard = "pose", 40, 10

    def __init__(self, how):
        self.how = how

    def describe(self):
        return {"count": self.count, "shard": self.shard}

    def item(self, start, stop):
        return start

    def asker(self):
        return Asker(self.how)


@pytest.mark.parametrize("how", ["end", "fail"])
def test_ray_gives_up_on_a_shard_that_cannot_be_done(tmp_path, pool, how):
    pool.ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import the tests
    error, what = RuntimeError, r"shard \(20, 30\) ended its worker, 3 times"
    if how == "fail":
        error, what = ValueError, "^no such item: 20$"
    with pytest.raises(error, match=what):
        ab.run_shards(Job(how), tmp_path / "out", pool=pool)
    held = sorted(path.name for path in (tmp_path / "out").glob("shard-*"))
    assert "shard-000000000020-000000000030.npz" not in held
