"""One frame on the device, captured on CUDA, of many objects with changing LODs, beside the host's plan."""

import gc

import numpy as np
import warp as wp

import warp_abtree as ab

from .memory import count_bytes
from .shapes import knot
from .timing import capture, summarise, time_graph, time_rounds, time_wall

FULL = {"faces": 5000, "objects": (16, 256, 4096), "repeats": 15}
QUICK = {"faces": 300, "objects": (16,), "repeats": 3}
OBJECTS_MAX_CPU = 256  # more take seconds a frame
STEPS = 50  # rungs of the ladder that LODs keep to, between a tenth of the operations and all
SPACING = 1.6  # between neighbours on a cubic grid; a knot is about 2 long and wide


@wp.kernel
def drive_kernel(
    rungs: wp.array(dtype=wp.int32),
    start: wp.array2d(dtype=wp.float64),
    time: wp.array(dtype=wp.int32),
    lods_out: wp.array(dtype=wp.int32),
    poses_out: wp.array2d(dtype=wp.float64),
):
    """Move each object to and fro, and its LOD up and down the rungs, by one every second frame on average."""
    i = wp.tid()
    phase = (time[0] + 37 * i) % (4 * rungs.shape[0])
    rung = phase / 2
    if rung >= rungs.shape[0]:
        rung = 2 * rungs.shape[0] - 1 - rung
    lods_out[i] = rungs[rung]
    for k in range(7):
        poses_out[i, k] = start[i, k]
    poses_out[i, i % 3] = start[i, i % 3] + wp.float64(0.2) * wp.sin(wp.float64(0.05) * wp.float64(phase))


@wp.kernel
def count_frame_kernel(time_inout: wp.array(dtype=wp.int32)):
    time_inout[0] = time_inout[0] + 1


def grid_poses(count, seed=0):
    """Return float64 (count, 7): a cubic grid of objects turned at random."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(count ** (1 / 3)))
    place = np.stack(np.unravel_index(np.arange(count), (side, side, side)), 1)
    q = rng.normal(size=(count, 4))
    return np.concatenate([SPACING * place, q / np.linalg.norm(q, axis=1, keepdims=True)], 1)


class Driven:
    """A frame and the kernels that drive it, one graph."""

    def __init__(self, scene, rungs, ladder):
        count = scene.object_count
        device = self.device = scene.device
        self.frame = ab.FrameGraph(
            scene, "count", capacity=ab.Buffers(pairs=16 * count), ladder=[rungs] if ladder else None
        )
        self.time = wp.zeros(1, dtype=wp.int32, device=device)
        self.inputs = [
            wp.array(rungs, dtype=wp.int32, device=device),
            wp.array(self.frame.poses.numpy(), dtype=wp.float64, device=device),
            self.time,
            self.frame.lods,
            self.frame.poses,
        ]
        self.launch()
        self.graph = capture(self.launch, device) if device.is_cuda else None

    def launch(self):
        wp.launch(count_frame_kernel, 1, [self.time], device=self.device)
        wp.launch(drive_kernel, len(self.frame.poses), self.inputs, device=self.device)
        self.frame.launch()

    def replay(self):
        if self.graph is None:
            self.launch()  # on all cores, which a graph of the CPU does not use
        else:
            wp.capture_launch(self.graph)

    def replay_and_read(self):
        self.replay()
        return self.frame.result()


class Planned:
    """The same frames by the host, from poses and LODs that it holds."""

    def __init__(self, scene, driven: Driven, frames):
        self.scene, self.moves, self.turn = scene, [], 0
        driven.time.zero_()
        for _ in range(frames):
            result = driven.replay_and_read()
            driven.frame.check()
            self.moves.append((driven.frame.poses.numpy().copy(), driven.frame.lods.numpy().copy()))
            answer = self.step()
            self.check(result, answer)
            self.pairs, self.hits = len(answer.pairs), int(answer.count.sum())
            marked = driven.frame.marked_count
            self.refitted = 0 if marked is None else int(marked.numpy().sum())

    def check(self, result, answer):
        order = np.lexsort((result.pairs[:, 1], result.pairs[:, 0]))
        same = np.array_equal(result.pairs[order], answer.pairs) and np.array_equal(result.count[order], answer.count)
        if not same:
            raise RuntimeError("the captured frame and the host's differ")

    def step(self):
        poses, lods = self.moves[self.turn % len(self.moves)]
        self.turn += 1
        self.scene.set_poses(poses)
        self.scene.set_lods(lods)
        return self.scene.intersect(output="count")


def run(device, quick=False):
    """Yield one row a number of objects and way to keep states: one an object, or one a rung of a ladder.

    pairs, hits and nodes_refitted are those of the last frame checked. frame is a frame by itself; frame_read the same
    with its results read by the host; host what set_poses, set_lods and intersect take for it; ratio host over
    frame_read.
    """
    device = wp.get_device(device)
    sizes = QUICK if quick else FULL
    model = ab.Model.from_arrays(*knot(sizes["faces"]))
    rungs = np.unique(np.linspace(model.lod_max // 10, model.lod_max, STEPS).astype(np.int32))
    for count in sizes["objects"]:
        if count > OBJECTS_MAX_CPU and device.is_cpu:
            continue
        for ladder in (False, True):
            yield run_case(device, model, rungs, count, ladder, sizes["repeats"])


def run_case(device, model, rungs, count, ladder, repeats):
    """Return the row of one number of objects and one way to keep states."""
    gc.collect()  # scenes and their queries hold each other
    scene = ab.Scene(device)
    for pose in grid_poses(count):
        scene.add(model, pose)
    driven = Driven(scene, rungs, ladder)
    planned = Planned(scene, driven, repeats)
    frame = time_graph(driven.graph, device) if device.is_cuda else time_wall(driven.replay, device)
    runs = {"frame": frame, "frame_read": time_wall(driven.replay_and_read, device)}
    runs["host"] = time_wall(planned.step, device)
    driven.time.zero_()
    times = time_rounds(runs, repeats)
    driven.frame.check()
    states = driven.frame.query.arrays[1]
    row = {"device": device.name, "faces": model.face_count, "objects": count, "ladder": ladder}
    row |= {"pairs": planned.pairs, "hits": planned.hits, "nodes_refitted": planned.refitted}
    row |= {"states": len(states.slots), "state_mib": round(count_bytes(states.pool) / 2**20, 1)}
    for name, values in times.items():
        row |= summarise(name, values)
    row["ratio"] = round(row["host_ms"] / row["frame_read_ms"], 2)
    return row
