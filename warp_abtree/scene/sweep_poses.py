"""Poses of a sweep, where they lie: in the memory of the host, or of the device that asks."""

import functools

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.state.poses import device_rows, pose_width

SCALARS = {np.dtype(np.float32): wp.float32, np.dtype(np.float64): wp.float64}


class PoseRows:
    """Poses where they lie, rows of 7 or 16 numbers: on the host, or on the device that asks, there also `flat`."""

    def __init__(self, rows: np.ndarray | wp.array):
        self.rows, self.width = rows, rows.shape[1]
        self.flat = rows.flatten() if isinstance(rows, wp.array) else None
        self.scalar = SCALARS[rows.dtype] if self.flat is None else rows.dtype

    def __len__(self):
        return self.rows.shape[0]

    def row(self, i):
        """Return a row on the host."""
        return self.rows[i] if self.flat is None else self.rows[i].numpy()


def take_rows(poses, device, what="poses"):
    """Return poses where they are, or on the host; raise ValueError for another shape than (p, 7) and (p, 4, 4)."""
    rows = device_rows(poses, device, what)
    if rows is not None:
        return PoseRows(rows)
    rows = to_numpy(poses, what)
    if rows.shape == (0,):
        rows = np.empty((0, 7))
    width = pose_width(rows.shape)
    if width is None:
        raise ValueError(f"{what}: shape {rows.shape} is neither (p, 7) nor (p, 4, 4)")
    rows = rows.reshape(len(rows), width)
    return PoseRows(rows if rows.dtype in SCALARS else rows.astype(np.float64))


@functools.cache
def find_copy_stream(alias):
    """Return a device's stream for transfers, one for all: Warp makes and ends streams on one thread at a time."""
    return wp.Stream(alias)


class PoseSlot:
    """Buffers through which a chunk passes: poses in, answers out. On the CPU host and device share them."""

    def __init__(self, device, room, output, scalar, width):
        def mirror(array):
            return array if device.is_cpu else wp.empty(len(array), dtype=array.dtype, device="cpu", pinned=True)

        self.width = width
        self.poses = wp.empty((room, width), dtype=scalar, device=device)
        self.answer = wp.empty(room if output == "any" else 0, dtype=wp.uint8, device=device)
        self.report = wp.empty(2, dtype=wp.int32, device=device)
        self.poses_flat = self.poses.flatten()
        self.poses_host, self.report_host = mirror(self.poses_flat), mirror(self.report)
        answer = wp.empty(room, dtype=wp.int64, device=device) if output == "count" else self.answer
        self.answer_host = mirror(answer)
        self.uncertain_room = 0
        if device.is_cuda:
            self.loaded, self.done = wp.Event(device), wp.Event(device)
