"""One frame on the device, captured on CUDA, of many objects with changing LODs, beside the same work from the host."""

import gc

import numpy as np
import warp as wp

import warp_abtree as ab

from ..shapes import knot, random_directions, scene_of_objects
from ..timing import make_replay, make_runs, ratio_of, summarise, time_call, time_rounds

FULL = {"faces": 5000, "objects": (16, 256, 4096), "repeats": 15}
QUICK = {"faces": 300, "objects": (16,), "repeats": 3}
OBJECTS_MAX_CPU = 256  # more take seconds a frame
STEPS = 50  # levels of the LOD ladder, between a tenth of the operations and all
SPACING = 1.6  # between neighbours on a cubic grid; a knot is about 2 long and wide


@wp.kernel
def drive_kernel(
    levels: wp.array(dtype=wp.int32),
    start: wp.array2d(dtype=wp.float64),
    frame_inout: wp.array(dtype=wp.int32),
    lods_out: wp.array(dtype=wp.int32),
    poses_out: wp.array2d(dtype=wp.float64),
):
    """Move each object to and fro, and its LOD up and down the levels, by one every second frame on average."""
    i = wp.tid()
    frame_inout[i] = frame_inout[i] + 1
    phase = (frame_inout[i] + 37 * i) % (4 * levels.shape[0])
    level = phase / 2
    if level >= levels.shape[0]:
        level = 2 * levels.shape[0] - 1 - level
    lods_out[i] = levels[level]
    for k in range(7):
        poses_out[i, k] = start[i, k]
    poses_out[i, i % 3] = start[i, i % 3] + wp.float64(0.2) * wp.sin(wp.float64(0.05) * wp.float64(phase))


class Frames:
    """A captured frame and the kernel that drives it, one graph; and the same frames from the host.

    Those take poses and LODs on the host to `set_poses`, `set_lods` and `intersect`.
    """

    def __init__(self, scene, levels, ladder):
        self.scene, self.device, self.moves, self.turn = scene, scene.device, [], 0
        room = ab.Buffers(pairs=16 * scene.object_count)
        self.frame = ab.Pipeline(scene, "count", capacity=room, ladder=[levels] if ladder else None)
        self.frames = wp.zeros(len(self.frame.poses), dtype=wp.int32, device=self.device)  # driven, of each object
        start, levels = wp.clone(self.frame.poses), wp.array(levels, dtype=wp.int32, device=self.device)
        self.inputs = [levels, start, self.frames, self.frame.lods, self.frame.poses]
        self.launch()
        self.replay = make_replay(self.launch, self.device)

    def launch(self):
        wp.launch(drive_kernel, len(self.frame.poses), self.inputs, device=self.device)
        self.frame.launch()

    def replay_and_read(self):
        self.replay()
        return self.frame.result()

    def host_frame(self):
        poses, lods = self.moves[self.turn % len(self.moves)]
        self.turn += 1
        self.scene.set_poses(poses)
        self.scene.set_lods(lods)
        return self.scene.intersect(output="count")

    def check(self, count):
        """Run some frames both ways and compare their answers; return columns of the last one."""
        frame = self.frame
        self.frames.zero_()
        for _ in range(count):
            result = self.replay_and_read()
            frame.check()
            self.moves.append((frame.poses.numpy().copy(), frame.lods.numpy().copy()))
            answer = self.host_frame()
            order = np.lexsort((result.pairs[:, 1], result.pairs[:, 0]))
            same = np.array_equal(result.pairs[order], answer.pairs)
            if not same or not np.array_equal(result.count[order], answer.count):
                raise RuntimeError("the captured frame and the host's differ")
        refitted = 0 if frame.marked_count is None else frame.marked_count.numpy().sum()
        return {"pairs": len(answer.pairs), "hits": answer.count.sum(), "nodes_refitted": refitted}


def run(device, quick=False):
    """Yield one row a number of objects and way to keep states: one an object, or one a level of a ladder.

    pairs, hits and nodes_refitted are those of the last frame checked. frame is a frame by itself; frame_read the same
    with its results read by the host; host what set_poses, set_lods and intersect take for it; ratio host over
    frame_read.
    """
    sizes = QUICK if quick else FULL
    model = ab.Model.from_arrays(*knot(sizes["faces"]))
    levels = np.unique(np.linspace(model.lod_max // 10, model.lod_max, STEPS).astype(np.int32))
    for count in sizes["objects"]:
        side = int(np.ceil(count ** (1 / 3)))
        place = np.stack(np.unravel_index(np.arange(count), (side, side, side)), 1)
        poses = np.concatenate([SPACING * place, random_directions(np.random.default_rng(0), count, 4)], 1)
        for ladder in (False, True) if device.is_cuda or count <= OBJECTS_MAX_CPU else ():
            gc.collect()  # scenes and their queries hold each other
            frames = Frames(scene_of_objects(device, model, poses), levels, ladder)
            row = {"faces": model.face_count, "objects": count, "ladder": ladder}
            row |= frames.check(sizes["repeats"])
            runs = make_runs({"frame": frames.launch}, device)
            runs |= {"frame_read": time_call(frames.replay_and_read, device)}
            times = time_rounds(runs | {"host": time_call(frames.host_frame, device)}, sizes["repeats"])
            frames.frame.check()
            row |= summarise(times) | {"states": len(frames.frame.query.batch.states.slots)}
            yield row | {"ratio": ratio_of(times["host"], times["frame_read"])}
