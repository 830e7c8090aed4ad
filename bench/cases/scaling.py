"""Scaling over devices: captured frames of many worlds of four objects, broad phase, face pairs counted.

A thread a device launches its frame; poses change and answers stay on the devices, so that the host transfers nothing.
Strong: as much work whatever the number of devices; weak: as much on each device. Devices are 1, 2, 4 and so on, and
all. Times are by the wall clock, all numbers of devices in turn. A CPU has one core.
"""

import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import testing

from ..shapes import knot, longest_side, scene_of_worlds, world_poses
from ..timing import make_replay, summarise, time_call, time_rounds

SIZES = {
    "cuda": {"faces": 5000, "worlds": 8192, "frames": 8, "repeats": 9},
    "cpu": {"faces": 2000, "worlds": 512, "frames": 2, "repeats": 7},
}
QUICK = {"faces": 300, "worlds": 8, "frames": 2, "repeats": 1}
OBJECTS = 4  # a world


def run(device, devices=None, quick=False):
    """Yield one row a way, strong and weak, and number of devices.

    Args:
        devices: Names with commas between; None is twice the CPU, or `device` alone.
    """
    devices = devices.split(",") if devices else [device] if device else ["cpu", "cpu"]
    name = wp.get_device(devices[0]).name
    sizes = QUICK if quick else SIZES["cuda" if wp.get_device(devices[0]).is_cuda else "cpu"]
    found = time_frames(devices, ab.Model.from_arrays(*knot(sizes["faces"])), sizes)
    base = float(np.median(found[1, 1]))
    for way in ("strong", "weak"):
        for parts in sorted({parts for parts, _ in found}):
            times = parts if way == "weak" else 1
            row = {"case": "frames", "way": way, "device": name, "devices": parts, "worlds": sizes["worlds"] * times}
            row |= summarise("frame", np.array(found[parts, times]) / sizes["frames"])
            efficiency = base * times / parts / float(np.median(found[parts, times]))
            yield row | {"efficiency": round(efficiency, 3), "cores_here": os.cpu_count()}


def list_sizes(devices) -> list:
    """Return what is asked, (devices, times the work of one): each number of devices once with one, once with its own.

    Numbers are the powers of two, and all.
    """
    numbers = [1 << i for i in range(len(devices).bit_length()) if 1 << i < len(devices)] + [len(devices)]
    return sorted({(parts, times) for parts in numbers for times in (1, parts)})


class WorldFrames:
    """A captured frame of worlds whose poses are on its device, in two sets that take turns."""

    def __init__(self, device, model, poses):
        self.device = wp.get_device(device)
        scene = scene_of_worlds(device, model, poses[0].reshape(-1, OBJECTS, 7))
        self.frame = ab.Pipeline(scene, "count", ladder=[[model.lod_max]])
        self.poses = [wp.array(rows, dtype=wp.float64, device=self.device) for rows in poses]
        self.answers = [self.answer(rows) for rows in self.poses]
        self.replay = make_replay(self.launch, self.device)

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
            self.replay()
        wp.synchronize_device(self.device)


def time_frames(devices, model, sizes):
    """Return times [ms] of a captured frame a device by (devices, times the work of one); nothing passes the host.

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
    return found


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
