"""`sweep`: one pair of models at very many relative poses, no objects made."""

import numpy as np
import warp as wp

from warp_abtree.checks import to_numpy
from warp_abtree.intersect import Query, check_request
from warp_abtree.kernels.pose import set_pose_kernel
from warp_abtree.scene import Scene, check_poses
from warp_abtree.state import ObjectArrays

# Poses asked at a time: enough to fill a GPU, few enough that millions need no more memory.
CHUNK = 65536


class _PosedModel:
    """What a `Query` asks of a scene, for object 0, model A, and objects 1 to `room`, all of them model B."""

    def __init__(self, model_a, model_b, lod_a, lod_b, room, device):
        pair = Scene(device)
        pair.add(model_a, lod=lod_a)
        pair.add(model_b, lod=lod_b)
        models, states, objects = pair.arrays()
        self.device = pair.device
        self.room = room
        self.objects = ObjectArrays(np.zeros(room + 1), np.zeros(room + 1), self.device)
        self.objects.set_states(np.repeat(objects.state, [1, room]))
        self._rows = wp.empty((room + 1, 7), dtype=wp.float64, device=self.device)
        self._arrays = (models, states, self.objects)

    def arrays(self):
        return self._arrays

    def check_pairs(self, pairs):
        return pairs

    def place(self, poses):
        """Set the poses of B, at most as many as there is room for."""
        rows = np.tile([0.0, 0, 0, 0, 0, 0, 1], (self.room + 1, 1))
        rows[1 : len(poses) + 1] = poses
        self._rows.assign(rows)
        wp.launch(set_pose_kernel, len(rows), inputs=[self._rows, self.objects.pool], device=self.device)


def sweep(model_a, model_b, poses, lod_a=None, lod_b=None, output="any", precision="exact", device=None):
    """Test one pair of models at many poses of B in A's frame. Waits for the device, chunk by chunk.

    Args:
        model_a, model_b: `Model`; may be the same.
        poses: (p, 7) x y z qx qy qz qw [model units of A, unit quaternions], float32 or float64.
        lod_a, lod_b: LODs; None is the finest.
        output: "any", "count" or "faces".
        precision: As `Scene.intersect`, exact for A's vertices and the posed ones of B.
        device: Warp device; None for Warp's default.

    Returns:
        For "any" bool (p,), for "count" the intersecting face pairs of each pose, int64 (p,), for "faces" rows (pose,
        face of A, face of B), int32 (k, 3), sorted.

    Raises:
        TypeError: model_a or model_b is no Model.
        ValueError: Bad poses, a LOD out of range, an unknown option or device.
    """
    check_request(output, precision)
    poses = to_numpy(poses, "poses")
    if poses.shape in ((0,), (0, 7)):
        poses = np.empty((0, 7))
    poses = check_poses(poses)
    if poses.ndim != 2:
        raise ValueError(f"poses: shape {poses.shape}, not (p, 7)")
    posed = _PosedModel(model_a, model_b, lod_a, lod_b, min(CHUNK, max(1, len(poses))), device)
    query = None
    parts = []
    for start in range(0, len(poses), CHUNK):
        chunk = poses[start : start + CHUNK]
        posed.place(chunk)
        pairs = np.stack([np.zeros(len(chunk), np.int32), np.arange(1, len(chunk) + 1, dtype=np.int32)], 1)
        if query is None:
            query = Query(posed, output, pairs=pairs, precision=precision)
        elif len(pairs) < posed.room:
            query.set_pairs(pairs)
        found = getattr(query.run(), output)
        parts.append(found + [start, 0, 0] if output == "faces" else found)
    if not parts:
        return {"any": np.empty(0, bool), "count": np.empty(0, np.int64), "faces": np.empty((0, 3), np.int32)}[output]
    return np.concatenate(parts).astype(parts[0].dtype if output != "faces" else np.int32)
