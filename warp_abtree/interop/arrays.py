"""Poses from arrays of any framework on the same device, without copies."""

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, wrap_array
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.kernels.io import pipeline as kernels
from warp_abtree.scene.posed_objects import expect_scene
from warp_abtree.state.device_update import NO_FAULTS
from warp_abtree.state.generation import STALE_GRAPH, LaunchGuard
from warp_abtree.state.poses import QUATERNION_TOLERANCE


class PoseInput(DeviceMemory):
    """Operator that sets the poses of a scene's objects from device memory, without the host.

    It is to `Query` and `ContactQuery` what `Pipeline.poses` is to a frame. `launch()` only launches, so that a CUDA
    graph can capture it.

    Attributes:
        poses: x y z qx qy qz qw [world units, unit quaternion], device float64 (n, 7); initially those of the scene.
            `wp.to_torch(poses)` and the like return writable views.
    """

    def __init__(self, scene):
        check_device(expect_scene(scene).device, "making a PoseInput")
        self.scene = scene
        self.device = scene.device
        self._batch = scene.batch()
        self._guard = LaunchGuard(self.device, self._batch.objects.generation)
        count = scene.object_count
        self.poses = wp.empty((count, 7), dtype=wp.float64, device=self.device)
        self._widened = wp.empty_like(self.poses)
        self._faults = wp.array(NO_FAULTS, dtype=wp.int32, device=self.device)
        wp.launch(kernels.read_pose_kernel, count, [self._batch.objects.pool, self.poses], device=self.device)

    def launch(self, poses=None):
        """Place every object. Launches only.

        Args:
            poses: (n, 7) array of any framework on the scene's device, float64 (read in place) or float32 (widened on
                the device); None reads `poses`, which only its owner writes. A graph keeps the address of the capture:
                capture `launch()`, and write to `poses`.

        Raises:
            ValueError: Another shape, type or device; nothing is changed.
            RuntimeError: Objects were added to the scene since this was made.
        """
        self._batch.check("pose input")
        check_device(self.device)
        with self._guard.launching(self):
            rows = self.poses if poses is None else self._check(wrap_array(poses, "poses"))
            if rows.dtype == wp.float32:
                wp.utils.array_cast(rows, self._widened)
                rows = self._widened
            inputs = [QUATERNION_TOLERANCE, rows, self._batch.objects.pool, self._faults, self._guard.record()]
            wp.launch(kernels.place_object_kernel, len(self.poses), inputs, device=self.device)

    def _check(self, rows):
        if rows.shape != self.poses.shape or rows.dtype not in (wp.float32, wp.float64):
            kind = getattr(rows.dtype, "__name__", rows.dtype)
            raise ValueError(
                f"poses: shape {tuple(rows.shape)} of {kind}, not {tuple(self.poses.shape)} of float32 or float64"
            )
        if rows.device != self.device:
            raise ValueError(f"poses: on {rows.device}, the scene is on {self.device}; Scene.set_poses copies them")
        return rows

    def check(self):
        """Raise an error if poses since the last call were invalid. Waits for the device.

        Raises:
            ValueError: A pose was not finite, or a quaternion off unit length by more than 1e-3; its object kept the
                pose before.
            RuntimeError: Poses were set by a graph captured before objects were added to the scene; they are lost.
        """
        check_device(self.device, "PoseInput.check")
        stale = self._guard.launched.numpy()[1]
        if stale:
            self._guard.clear_stale()
            raise RuntimeError(f"poses since the last check are lost: the graph {STALE_GRAPH}")
        count, first = self._faults.numpy().tolist()
        self._faults.assign(np.array(NO_FAULTS, np.int32))
        if count:
            raise ValueError(
                f"poses: {count} rows since the last check were not finite or not of unit quaternions; the first "
                f"object that had one is {first}, and kept its pose"
            )
