"""Scaling over devices, and the rates of a worker and a driver of sharded jobs.

Frames: worlds of four objects, broad phase, face pairs counted, a captured frame a device that a thread of its own
launches; poses change and answers stay on the devices, so that the host transfers nothing. Shards: those of a
`SweepJob` through `ThisProcess`, as `warp-abtree sweep` does them but for the disk. Strong: as much work whatever the
number of devices; weak: as much on each device. Devices are 1, 2, 4 and so on, and all. Times are by the wall clock,
all numbers of devices in turn. A CPU has one core.
"""

import os
import tempfile
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.jobs import SweepJob, ThisProcess, run_shards

from ..shapes import knot, longest_side, random_poses, world_poses
from ..timing import capture, summarise, time_call, time_rounds

SIZES = {
    "cuda": {"faces": 5000, "worlds": 8192, "frames": 8, "repeats": 9, "driver": 2**21, "shards": 2**23},
    "cpu": {"faces": 2000, "worlds": 512, "frames": 2, "repeats": 7, "driver": 2**20, "shards": 2**18},
}
QUICK = {"faces": 300, "worlds": 8, "frames": 2, "repeats": 1, "driver": 4096, "shards": 64}
OBJECTS = 4  # a world
SHARD = 65536


def run(device, devices=None, quick=False):
    """Yield the rates of a worker and a driver of shards, then a row a workload, way and device count.

    Args:
        devices: Names with commas between; None is twice the CPU, or `device` alone.
    """
    devices = devices.split(",") if devices else [device] if device else ["cpu", "cpu"]
    first = wp.get_device(devices[0])
    sizes = QUICK if quick else SIZES["cuda" if first.is_cuda else "cpu"]
    model = ab.Model.from_arrays(*knot(sizes["faces"]))
    yield time_worker(first, model, min(SHARD, sizes["driver"]), sizes["repeats"])
    yield time_driver(model, sizes["driver"])
    yield from scale_frames(devices, model, sizes)
    yield from scale_shards(devices, model, sizes)


def time_worker(device, model, count, repeats):
    """Return the row of a shard asked on one device, on the CPU by one core: poses on the host, answers there."""
    job = SweepJob(model, model, random_poses(count, longest_side(model)))
    runner, task = job.runner(), job.task(0, count)
    with testing.regime(cpu_threads=1):
        times = time_rounds({"shard": time_call(lambda: runner.run(task, device), device)}, repeats)["shard"]
    row = {"case": "worker", "device": device.name, "faces": model.face_count, "poses": count}
    return row | summarise("shard", times) | {"worker_mposes_s": float(f"{count / np.median(times) / 1e3:.4g}")}


class IdlePool:
    """A pool that answers at once: what is left is what the driver does, reading poses and writing shards."""

    workers, lost = 1, 0

    def run(self, job, ranges):
        for start, stop in ranges:
            yield start, stop, {"any": np.zeros(len(job.task(start, stop)[1]), bool)}


def time_driver(model, count):
    """Return how many poses a second a driver checks, and reads and writes, with workers that take no time."""
    with tempfile.TemporaryDirectory() as folder:
        np.save(f"{folder}/poses.npy", random_poses(count, 1.0))
        begin = time.perf_counter()
        job = SweepJob(model, model, f"{folder}/poses.npy", shard=min(SHARD, count))
        made = time.perf_counter()
        run_shards(job, f"{folder}/out", pool=IdlePool())
        done = time.perf_counter()
    rates = {"check_mposes_s": count / (made - begin) / 1e6, "driver_mposes_s": count / (done - made) / 1e6}
    return {"case": "driver", "poses": count} | {name: float(f"{rate:.4g}") for name, rate in rates.items()}


def list_sizes(devices) -> list:
    """Return what is asked, (devices, times the work of one): each number of devices once with one, once with its own.

    Numbers are the powers of two, and all.
    """
    numbers = [1 << i for i in range(len(devices).bit_length()) if 1 << i < len(devices)] + [len(devices)]
    return sorted({(parts, times) for parts in numbers for times in (1, parts)})


def list_rows(case, devices, found, describe):
    """Yield a row a way and number of devices.

    Args:
        found: Times [ms] by (devices, times the work of one).
        describe: Returns the columns of a case: of such a key, and of the times that were found.
    """
    base = float(np.median(found[1, 1]))
    for way in ("strong", "weak"):
        for parts in sorted({parts for parts, _ in found}):
            key = parts, parts if way == "weak" else 1
            row = {"case": case, "way": way, "device": wp.get_device(devices[0]).name, "devices": parts}
            row |= {"asked_by": "threads"} | describe(key, found[key])
            efficiency = base * key[1] / parts / float(np.median(found[key]))
            yield row | {"efficiency": round(efficiency, 3), "cores_here": os.cpu_count()}


def scale_shards(devices, model, sizes):
    """Yield rows of devices that do the shards of a sweep, each from a thread; nothing is written.

    Raises:
        RuntimeError: Answers are not those of one device.
    """
    shard, repeats = min(SHARD, sizes["shards"] // 32), min(5, sizes["repeats"])
    poses = random_poses(sizes["shards"] * len(devices), longest_side(model))
    expected = ab.sweep(model, model, poses, device=devices[0])
    with testing.regime(cpu_threads=1):
        runs = {}
        for parts, times in list_sizes(devices):
            count = sizes["shards"] * times
            job = SweepJob(model, model, poses[:count], shard=shard)
            ranges = [(start, start + shard) for start in range(0, count, shard)]
            pool = ThisProcess(devices[:parts])
            answers = {start: columns["any"] for start, _, columns in pool.run(job, ranges)}
            if not np.array_equal(np.concatenate([answers[start] for start, _ in ranges]), expected[:count]):
                raise RuntimeError(f"shards: {parts} devices answer otherwise than one")
            runs[parts, times] = time_call(
                lambda pool=pool, job=job, ranges=ranges: deque(pool.run(job, ranges), 0), devices[0]
            )
        found = time_rounds(runs, repeats)

    def describe(key, values):
        count = sizes["shards"] * key[1]
        rate = float(f"{count / np.median(values) / 1e3:.4g}")
        return {"poses": count} | summarise("shards", values) | {"mposes_s": rate}

    yield from list_rows("shards", devices, found, describe)


class WorldFrames:
    """A captured frame of worlds whose poses are on its device, in two sets that take turns."""

    def __init__(self, device, model, poses):
        self.device = wp.get_device(device)
        scene = ab.Scene(device)
        for row, pose in enumerate(poses[0]):
            scene.add(model, pose, world=row // OBJECTS)
        self.frame = ab.Pipeline(scene, "count", ladder=[[model.lod_max]])
        self.poses = [wp.array(rows, dtype=wp.float64, device=self.device) for rows in poses]
        self.answers = [self.answer(rows) for rows in self.poses]
        self.graph = capture(self.launch, self.device) if self.device.is_cuda else None

    def answer(self, rows):
        """Return the pairs of a set of poses with their counts, int64 (p, 3), sorted; buffers grow as needed."""
        wp.copy(self.frame.poses, rows)
        result = self.frame.run()
        found = np.column_stack([result.pairs, result.count])
        return found[np.lexsort((found[:, 1], found[:, 0]))]

    def launch(self):
        for rows in self.poses:
            wp.copy(self.frame.poses, rows)
            self.frame.launch()

    def run(self, count):
        """Run an even number of frames and wait for them."""
        for _ in range(count // 2):
            if self.graph is None:
                self.launch()
            else:
                wp.capture_launch(self.graph)
        wp.synchronize_device(self.device)


def scale_frames(devices, model, sizes):
    """Yield rows of a captured frame a device, each launched from a thread of its own; nothing passes the host.

    Raises:
        RuntimeError: Answers are not those of one device.
    """
    count = sizes["worlds"]
    shape = count * len(devices), OBJECTS, longest_side(model)
    poses = [world_poses(*shape, seed).reshape(-1, 7) for seed in (0, 1)]
    with testing.regime(cpu_threads=1), ThreadPoolExecutor(len(devices)) as threads:
        made = {}
        for parts, times in list_sizes(devices):
            bounds = [OBJECTS * (count * times * k // parts) for k in range(parts + 1)]
            spans = [slice(start, stop) for start, stop in pairwise(bounds)]
            frames = [
                WorldFrames(device, model, [rows[span] for rows in poses]) for device, span in zip(devices, spans)
            ]
            made[parts, times] = frames
            check_frames(made[1, 1][0], frames, bounds)
        launches = {
            key: lambda frames=frames: deque(threads.map(WorldFrames.run, frames, [sizes["frames"]] * len(frames)), 0)
            for key, frames in made.items()
        }
        calls = {key: time_call(launch, devices[0]) for key, launch in launches.items()}
        found = time_rounds(calls, sizes["repeats"])
        for frames in made.values():
            for one in frames:
                one.frame.check()

    def describe(key, values):
        return {"worlds": count * key[1]} | summarise("frame", np.array(values) / sizes["frames"])

    yield from list_rows("frames", devices, found, describe)


def check_frames(one, made, bounds):
    """Check that frames on several devices find what those on one find in its worlds.

    Raises:
        RuntimeError: They do not.
    """
    last = len(one.poses[0])
    for turn, expected in enumerate(one.answers):
        found = np.concatenate([frames.answers[turn] + [start, start, 0] for frames, start in zip(made, bounds)])
        if not np.array_equal(found[found[:, 0] < last], expected):
            raise RuntimeError(f"frames: {len(made)} devices answer otherwise than one")
