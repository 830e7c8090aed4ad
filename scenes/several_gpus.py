"""Worlds on several GPUs: a `Pipeline` a device, captured once, launched by a thread of its own. Meant to be copied.

Worlds never meet, so devices have nothing to tell each other: a simulator's kernel moves the objects where they are,
answers stay there, and the host only launches. Without a GPU the CPU is the only device; a device may be named twice:

    python scenes/several_gpus.py [--devices cuda:0,cuda:1] [--worlds 64] [--frames 60]
"""

import argparse
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab

OBJECTS, PAIRS = 4, 6  # of a world
SHRINK = 0.98


@wp.kernel
def move_kernel(poses_inout: wp.array2d(dtype=wp.float64)):
    """Bring each object nearer to the middle of its world: this stands for a simulator."""
    i, axis = wp.tid()
    poses_inout[i, axis] = poses_inout[i, axis] * wp.float64(SHRINK)


def make_scene(model, poses, device):
    """Return a scene of the worlds whose poses are given, (worlds, OBJECTS, 7)."""
    scene = ab.Scene(device)
    for world, rows in enumerate(poses):
        for pose in rows:
            scene.add(model, pose, world=world)
    return scene


def capture(frame):
    """Return a step of the simulator and the frame after it as one graph."""
    with wp.ScopedCapture(frame.device) as step:
        wp.launch(move_kernel, (len(frame.poses), 3), [frame.poses], device=frame.device)
        frame.launch()
    return step.graph


def run(graph, device, count):
    """Launch all frames of a device and wait for it; this is what each thread does."""
    for _ in range(count):
        wp.capture_launch(graph)
    wp.synchronize_device(device)


def count_by_world(result, worlds):
    """Return the intersecting face pairs of each world, int (worlds,)."""
    return np.bincount(result.pairs[:, 0] // OBJECTS, result.count, worlds).astype(int)


def main(words=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    gpus = ",".join(device.alias for device in wp.get_cuda_devices())
    parser.add_argument("--devices", default=gpus or "cpu", help="with commas between, every GPU by default")
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args(words)
    devices = arguments.devices.split(",")[: arguments.worlds]
    model = ab.Model.load(trimesh.creation.torus(0.5, 0.15))
    poses = np.random.default_rng(0).normal(size=(arguments.worlds, OBJECTS, 7))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)

    dealt = np.array_split(poses, len(devices))  # worlds that follow each other
    options = {"output": "count", "ladder": [[model.lod_max]]}  # objects share one tree
    made = zip(devices, dealt)
    frames = [
        ab.Pipeline(make_scene(model, part, d), capacity=ab.Buffers(pairs=PAIRS * len(part)), **options)
        for d, part in made
    ]
    graphs = [capture(frame) for frame in frames]  # kernels load here, on one thread
    with ThreadPoolExecutor(len(devices)) as threads:
        list(threads.map(run, graphs, devices, [arguments.frames] * len(devices)))
    for frame in frames:
        frame.check()  # raises what went wrong in any frame
    counts = np.concatenate([count_by_world(frame.result(), len(part)) for frame, part in zip(frames, dealt)])
    print("face pairs of each world:", *counts)

    for _ in range(arguments.frames):
        poses[..., :3] *= SHRINK
    expected = count_by_world(make_scene(model, poses, devices[0]).intersect(output="count"), arguments.worlds)
    if not np.array_equal(counts, expected):
        raise SystemExit(f"one scene on {devices[0]} counts otherwise: {expected}")
    print(f"one scene on {devices[0]} counts the same")
    return counts


if __name__ == "__main__":
    main()
