"""Scaling over devices, the cost model from counters, and what follows for more devices.

Frames: worlds of four objects, broad phase, face pairs counted, a `FrameGraph` a device that a thread of its own
launches; poses change and answers stay on the devices, so that the host brings nothing. Shards: those of a `SweepJob`
through `ThisProcess`, as `warp-abtree sweep` does them but for the disk. Strong: as much work whatever the number of
devices; weak: as much on each device. Devices are 1, 2, 4 and so on, and all. Times are by the wall clock, all numbers
of devices in turn. A CPU has one core.
"""

import json
import math
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

from .roofline import NODE_BYTES, PAIR_BYTES, TRIANGLE_BYTES
from .scale import world_poses
from .shapes import knot, pair_poses
from .sweep import random_poses
from .timing import capture, make_runs, summarise, time_rounds, time_wall

SIZES = {
    "cuda": {
        "faces": 5000,
        "worlds": 8192,
        "frames": 8,
        "repeats": 9,
        "counts": (256, 1024, 4096),
        "driver": 2**21,
        "shards": 2**23,
    },
    "cpu": {
        "faces": 2000,
        "worlds": 512,
        "frames": 2,
        "repeats": 7,
        "counts": (64, 256, 512),
        "driver": 2**20,
        "shards": 2**18,
    },
}
QUICK = {
    "faces": 300,
    "worlds": 8,
    "frames": 2,
    "repeats": 1,
    "counts": (4, 16),
    "driver": 4096,
    "shards": 64,
}
OBJECTS = 4  # a world
DISTANCES = (0.2, 0.9, 1.6)
TERMS = ("launch", "pair", "node")
# Instructions of a face test over those of a box test (docs/performance.md): the two rise together, so that a fit
# cannot tell them apart.
TRIANGLE_NODES = 5
PREDICTED, PREDICTED_POSES = (1, 2, 8, 64, 1000), (10**9, 10**12)
START_S = 10.0  # of Ray and its workers: assumed, kernels in their cache
SHARD = 65536


def run(device, devices=None, quick=False, predict=None):
    """Yield the cost model, the rates of a worker and a driver of shards, then a row a workload, way and device count.

    Args:
        devices: Names with commas between; None is twice the CPU, or `device` alone.
        predict: File that `--json` wrote: its rows are read, and what they predict is yielded in the place of a run.
    """
    if predict is not None:
        with open(predict) as file:
            yield from predict_rows(json.load(file)["rows"])
        return
    devices = devices.split(",") if devices else [device] if device else ["cpu", "cpu"]
    first = wp.get_device(devices[0])
    sizes = QUICK if quick else SIZES["cuda" if first.is_cuda else "cpu"]
    model = ab.Model.from_arrays(*knot(sizes["faces"]))
    yield run_cost(first, sizes)
    yield run_worker(first, model, min(SHARD, sizes["driver"]), sizes["repeats"])
    yield run_driver(model, sizes["driver"])
    yield from run_frames(devices, model, sizes)
    yield from run_shards(devices, model, sizes)


# The cost model.


def run_cost(device, sizes):
    """Return the row of a fit: time = launch + pairs * pair + (node tests + 5 triangle tests) * node.

    Least squares of relative errors, none of the three below 0, over face counts, distances and numbers of pairs.
    """
    counted, times = [], []
    for faces in (max(100, sizes["faces"] // 8), sizes["faces"]):
        model = ab.Model.from_arrays(*knot(faces))
        for distance in DISTANCES:
            for count in sizes["counts"]:
                scene = ab.Scene(device)
                for pose in pair_poses(count, distance):
                    scene.add(model, pose)
                query = ab.Query(scene, "count", pairs=np.arange(2 * count).reshape(-1, 2))
                result = query.run()
                found = time_rounds(make_runs({"query": query.launch}, device), sizes["repeats"])["query"]
                counted.append([1.0, count, (result.node_tests + TRIANGLE_NODES * result.triangle_tests).sum()])
                times.append(np.median(found))
    counted, times = np.array(counted, np.float64), np.array(times)
    cost = fit_cost(counted / times[:, None], np.ones(len(times)))
    off = np.abs(counted @ cost / times - 1)
    row = {"case": "cost", "device": device.name, "samples": len(times)}
    row |= {f"{term}_us": float(f"{1e3 * value:.4g}") for term, value in zip(TERMS, cost)}
    row |= {"pair_in_nodes": round(float(cost[1] / cost[2]), 2) if cost[2] > 0 else None}
    row |= {"off_mean": round(float(off.mean()), 3), "off_worst": round(float(off.max()), 3)}
    return row | {"pair_bytes": PAIR_BYTES, "node_bytes": NODE_BYTES, "triangle_bytes": TRIANGLE_BYTES}


def fit_cost(rows, values):
    """Return the coefficients, none below 0, that fit best in least squares; terms that would be are left out."""
    kept = list(range(rows.shape[1]))
    while True:
        found = np.linalg.lstsq(rows[:, kept], values, rcond=None)[0]
        if (found >= 0).all():
            cost = np.zeros(rows.shape[1])
            cost[kept] = found
            return cost
        del kept[int(found.argmin())]


# Shards: a worker, and the driver.


def run_worker(device, model, count, repeats):
    """Return the row of a shard asked on one device, on the CPU by one core: poses on the host, answers there."""
    job = ab.SweepJob(model, model, random_poses(count, float(np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max())))
    runner, task = job.runner(), job.task(0, count)
    with testing.regime(cpu_threads=1):
        times = time_rounds({"shard": time_wall(lambda: runner.run(task, device), device)}, repeats)["shard"]
    row = {"case": "worker", "device": device.name, "faces": model.face_count, "poses": count}
    return row | summarise("shard", times) | {"worker_mposes_s": float(f"{count / np.median(times) / 1e3:.4g}")}


class Silent:
    """A pool that answers at once: what is left is what the driver does, reading poses and writing shards."""

    workers, lost = 1, 0

    def run(self, job, ranges):
        for start, stop in ranges:
            yield start, stop, {"any": np.zeros(len(job.task(start, stop)[1]), bool)}


def run_driver(model, count):
    """Return how many poses a second a driver checks, and reads and writes, with workers that take no time."""
    with tempfile.TemporaryDirectory() as folder:
        np.save(f"{folder}/poses.npy", random_poses(count, 1.0))
        begin = time.perf_counter()
        job = ab.SweepJob(model, model, f"{folder}/poses.npy", shard=min(SHARD, count))
        made = time.perf_counter()
        ab.run_shards(job, f"{folder}/out", pool=Silent())
        done = time.perf_counter()
    rates = {"check_mposes_s": count / (made - begin) / 1e6, "driver_mposes_s": count / (done - made) / 1e6}
    return {"case": "driver", "poses": count} | {name: float(f"{rate:.4g}") for name, rate in rates.items()}


# Devices.


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
            ideal = base * key[1] / parts
            row |= describe(key, found[key])
            yield row | {"efficiency": round(ideal / float(np.median(found[key])), 3), "cores_here": os.cpu_count()}


def one_core():
    """Return a context that gives each launch on the CPU one core."""
    return testing.regime(cpu_threads=1)


def run_shards(devices, model, sizes):
    """Yield rows of devices that do the shards of a sweep, each from a thread; nothing is written.

    Raises:
        RuntimeError: Answers are not those of one device.
    """
    size = float(np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max())
    shard, repeats = min(SHARD, sizes["shards"] // 32), min(5, sizes["repeats"])
    poses = random_poses(sizes["shards"] * len(devices), size)
    expected = ab.sweep(model, model, poses, device=devices[0])
    with one_core():
        runs = {}
        for parts, times in list_sizes(devices):
            count = sizes["shards"] * times
            job = ab.SweepJob(model, model, poses[:count], shard=shard)
            ranges = [(start, start + shard) for start in range(0, count, shard)]
            pool = ab.ThisProcess(devices[:parts])
            answers = {start: columns["any"] for start, _, columns in pool.run(job, ranges)}
            if not np.array_equal(np.concatenate([answers[start] for start, _ in ranges]), expected[:count]):
                raise RuntimeError(f"shards: {parts} devices answer otherwise than one")
            runs[parts, times] = time_wall(
                lambda pool=pool, job=job, ranges=ranges: deque(pool.run(job, ranges), 0), wp.get_device(devices[0])
            )
        found = time_rounds(runs, repeats)

    def describe(key, values):
        count = sizes["shards"] * key[1]
        row = {"asked_by": "threads", "poses": count} | summarise("shards", values)
        return row | {"mposes_s": float(f"{count / np.median(values) / 1e3:.4g}")}

    yield from list_rows("shards", devices, found, describe)


class Frames:
    """A `FrameGraph` of worlds whose poses are on its device, in two sets that take turns."""

    def __init__(self, device, model, poses):
        self.device = wp.get_device(device)
        scene = ab.Scene(device)
        for row, pose in enumerate(poses[0]):
            scene.add(model, pose, world=row // OBJECTS)
        self.frame = ab.FrameGraph(scene, "count", ladder=[[model.lod_max]])
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


def run_frames(devices, model, sizes):
    """Yield rows of a `FrameGraph` a device, each launched from a thread of its own; nothing passes the host.

    Raises:
        RuntimeError: Answers are not those of one device.
    """
    size, count = float(np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max()), sizes["worlds"]
    poses = [world_poses(count * len(devices), OBJECTS, size, seed).reshape(-1, 7) for seed in (0, 1)]
    with one_core(), ThreadPoolExecutor(len(devices)) as threads:
        runs = {}
        for parts, times in list_sizes(devices):
            bounds = [OBJECTS * (count * times * k // parts) for k in range(parts + 1)]
            spans = [slice(start, stop) for start, stop in pairwise(bounds)]
            made = [Frames(device, model, [rows[span] for rows in poses]) for device, span in zip(devices, spans)]
            runs[parts, times] = made
            check_frames(runs[1, 1][0], made, bounds)
        rounds = {
            key: lambda made=made: deque(threads.map(Frames.run, made, [sizes["frames"]] * len(made)), 0)
            for key, made in runs.items()
        }
        calls = {key: time_wall(launch, devices[0]) for key, launch in rounds.items()}
        found = time_rounds(calls, sizes["repeats"])
        for frames in (frames for made in runs.values() for frames in made):
            frames.frame.check()

    def describe(key, values):
        return {"asked_by": "threads", "worlds": count * key[1]} | summarise(
            "frame", np.array(values) / sizes["frames"]
        )

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


# What follows.


def predict_rows(rows):
    """Yield what measured rows predict for a sweep through shards on more devices, nothing else measured.

    n workers, each with the measured rate r, that share nothing: the time is START_S, poses / (n r), and a last shard
    for which the others wait. Efficiency is poses / (n r) over that. A driver feeds as many workers as its rate is
    times r; with more, each driver has a file of poses of its own, and their folders together are the answer.
    """
    worker = next(row for row in rows if row["case"] == "worker")
    driver = next(row for row in rows if row["case"] == "driver")
    rate, limit = 1e6 * worker["worker_mposes_s"], 1e6 * driver["driver_mposes_s"]
    for poses in PREDICTED_POSES:
        for count in PREDICTED:
            working = poses / (count * rate)
            total = START_S + working + SHARD / rate
            yield {
                "case": "predicted",
                "device": worker["device"],
                "poses": poses,
                "devices": count,
                "seconds": float(f"{total:.4g}"),
                "efficiency": round(working / total, 3),
                "drivers": math.ceil(count * rate / limit),
                "one_driver_seconds": float(f"{max(total, START_S + poses / limit):.4g}"),
            }
