"""Jobs of poses, the folders that they write, and a job of made-up columns."""

import numpy as np

from helpers.samples import STILL, random_poses, sample
from helpers.scenes import scene_with
from warp_abtree.jobs import SweepJob, ThisProcess, read_shards, run_shards

MODELS = ("torus", "small ball")


def pair():
    return [sample(name) for name in MODELS]


def poses_of(count=100, seed=0):
    return random_poses(np.random.default_rng(seed), count, 1.6)


def lods_of(count):
    rng = np.random.default_rng(1)
    return np.stack([rng.integers(0, model.lod_max + 1, count) for model in pair()], 1)


def job_of(output="count", seed=0, count=60, shard=20):
    return SweepJob(*pair(), poses_of(count, seed), output=output, shard=shard)


def run(job, out, device="cpu", **options):
    return run_shards(job, out, pool=ThisProcess(device), **options)


def read(out):
    """Return the columns of all shards, joined."""
    parts = list(read_shards(out))
    assert [part[0] for part in parts[1:]] == [part[1] for part in parts[:-1]]
    return {name: np.concatenate([columns[name] for _, _, columns in parts]) for name in parts[0][2]}


def contents(out):
    return {path.name: path.read_bytes() for path in out.iterdir()}


def shard_at(out, k):
    return sorted(out.glob("shard-*"))[k]


def intersect(device, poses, lods, output):
    """Return the result of a scene with two objects per pose, whose index is the pair's."""
    first, second = pair()
    objects = [(first, STILL, {"lod": int(lod)}) for lod in lods[:, 0]]
    objects += [(second, pose, {"lod": int(lod)}) for pose, lod in zip(poses, lods[:, 1])]
    scene = scene_with(device, *objects)
    return scene.intersect(np.arange(len(poses))[:, None] + [0, len(poses)], output=output)


def stop_after(count):
    def progress(_, done, total):
        if done == count:
            raise KeyboardInterrupt

    return progress


class ColumnJob:
    """A job whose columns have any length."""

    def __init__(self, count=4, shard=2, rows=None, size=1, output="count"):
        self.count, self.shard, self.rows, self.size, self.output = count, shard, rows, size, output

    def describe(self):
        return {"count": self.count, "shard": self.shard, "output": self.output}

    def task(self, start, stop):
        return start, stop

    def runner(self):
        return self

    def run(self, task, device=None):
        rows = (self.size * (task[1] - task[0]),) * 2 if self.rows is None else self.rows
        return {"count": np.arange(rows[0]), "more": np.arange(rows[1])}
