"""Poses that a caller hands in: checked before anything moves, and read where they lie on a GPU."""

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import is_device_array, to_numpy, wrap_array
from warp_abtree.checks.upload import view_memory
from warp_abtree.kernels.io import place_poses

QUATERNION_TOLERANCE = 1e-3
RIGID_TOLERANCE = 1e-6
ZERO_QUATERNION = "which is no rotation; a pose is x y z qx qy qz qw, and one that does not turn ends in 0 0 0 1"
# As a tolerance of quaternions: those of any norm but 0 are normalised.
ANY_NORM = 1e308
# A matrix that is no farther off was rigid before rounding, for all that its numbers tell.
ROUNDED_AT_MOST = 1e-2

# Warp's types of a pose, their numbers, and how many.
POSE_TYPES = {
    wp.transformf: (wp.float32, 7),
    wp.transformd: (wp.float64, 7),
    wp.mat44f: (wp.float32, 16),
    wp.mat44d: (wp.float64, 16),
}
NONE_BAD = 2**31 - 1
IDENTITY_POSE = (0, 0, 0, 0, 0, 0, 1)
IDENTITY, LAST_ROW = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


def pose_width(shape: tuple) -> int | None:
    """Return how many numbers a pose has in an array of this shape, 7 or 16; None where it holds no poses."""
    return {(7,): 7, (4, 4): 16}.get(tuple(shape[1:]))


def check_poses(poses, what="poses", first=0, removed=()) -> np.ndarray:
    """Return poses as float64, (n, 7) or (n, 4, 4).

    Args:
        first: Number of the first pose, for messages.
        removed: Places that have no object, rising: their poses are not read, but the identity.

    Raises:
        ValueError: Another shape, a number that is not finite, a quaternion whose norm is off by more than 1e-3, a
            matrix that is not rigid within 1e-6.
    """
    poses = to_numpy(poses, what)
    if pose_width(poses.shape) is None:
        raise ValueError(f"{what}: shape {poses.shape} is neither (n, 7) nor (n, 4, 4)")
    poses = poses.astype(np.float64)
    if len(removed) and len(poses) > removed[-1]:
        poses[removed] = IDENTITY_POSE if poses.ndim == 2 else np.eye(4)
    sound = np.isfinite(poses).all(tuple(range(1, poses.ndim)))
    if not sound.all():
        raise ValueError(f"{what}: pose {first + sound.argmin()} is not finite")
    if poses.ndim == 2:
        norm = np.sqrt((poses[:, 3:] ** 2).sum(1))
        sound = np.abs(norm - 1) <= QUATERNION_TOLERANCE
        if not sound.all():
            i = int(sound.argmin())
            why = f"off 1 by more than {QUATERNION_TOLERANCE}" if norm[i] else ZERO_QUATERNION
            raise ValueError(f"{what}: pose {first + i} has a quaternion of norm {norm[i]:.6g}, {why}")
        return poses
    rotation = poses[:, :3, :3]
    off = np.abs(rotation.transpose(0, 2, 1) @ rotation - IDENTITY)
    sound = (off <= RIGID_TOLERANCE).all((1, 2)) & (np.linalg.det(rotation) > 0) & (poses[:, 3] == LAST_ROW).all(1)
    if not sound.all():
        i = int(sound.argmin())
        why = _why_not_rigid(poses[i], off[i].max())
        raise ValueError(f"{what}: matrix {first + i} is not rigid within 1e-6: {why}")
    return poses


def _why_not_rigid(matrix, off) -> str:
    """Return what is wrong with a matrix (4, 4) whose R^T R is off the identity by so much."""
    if not (matrix[3] == LAST_ROW).all():
        return f"its last row is {matrix[3].tolist()}, not 0 0 0 1"
    if np.linalg.det(matrix[:3, :3]) <= 0:
        return "it mirrors or flattens"
    told = f"R^T R is off the identity by {off:.3g}"
    if off > ROUNDED_AT_MOST:
        return f"{told}; a scale or shear belongs in the model"
    nearest = "take the nearest rotation, u @ v of u, _, v = numpy.linalg.svd(R)"
    return f"{told}, as many products in float32 leave it; {nearest}"


def device_rows(poses, device, what="poses"):
    """Return poses that lie on a GPU as rows of 7 or 16 numbers of it, without a copy where they are contiguous.

    Args:
        poses: (n, 7) or (n, 4, 4), float32 or float64, of any framework; or Warp's transforms or matrices, (n,).

    Returns:
        Warp array (n, 7) or (n, 16); None where the poses do not lie on this device, or are of another kind.
    """
    if not device.is_cuda or not is_device_array(poses):
        return None
    array = wrap_array(poses, what)
    return view_rows(array) if array.device == device else None


def view_rows(array: wp.array):
    """Return poses as rows of 7 or 16 numbers, without a copy where they are contiguous; None where they are none."""
    if array.ndim == 1 and array.dtype in POSE_TYPES:
        scalar, width = POSE_TYPES[array.dtype]
        array = array if array.is_contiguous else array.contiguous()
        return view_memory(array.ptr, scalar, (len(array), width), array.device, array)
    if array.dtype not in (wp.float32, wp.float64) or pose_width(array.shape) is None:
        return None
    array = array if array.is_contiguous else array.contiguous()
    return array if array.ndim == 2 else array.reshape((array.shape[0], 16))


def place_rows(rows, pool, tolerance=QUATERNION_TOLERANCE):
    """Check rows of `device_rows` on the device and set the objects of a pool from them. (synchronization point)

    Args:
        tolerance: That quaternions may be off unit length by.

    Raises:
        ValueError: As `check_poses`; nothing is changed.
    """
    first = wp.full(1, NONE_BAD, dtype=wp.int32, device=rows.device)
    inputs = [wp.float64(RIGID_TOLERANCE if rows.shape[1] == 16 else tolerance), rows, first]
    wp.launch(place_poses.pose_check(rows.dtype, rows.shape[1]), len(rows), inputs, device=rows.device)
    bad = int(first.numpy()[0])
    if bad != NONE_BAD:
        raise_bad_pose(rows[bad : bad + 1].numpy(), bad)
    launch_place(rows, pool)
    # Whose memory it is may free or change it as soon as this returns, on another stream.
    if rows.device.is_cuda:
        wp.synchronize_stream(wp.get_stream(rows.device))


def raise_bad_pose(row: np.ndarray, i: int, what="poses"):
    """Raise ValueError about pose i, a row of 7 or 16 numbers that the device has refused."""
    check_poses(row.reshape((1, 7) if row.size == 7 else (1, 4, 4)), what, first=i)
    raise ValueError(f"{what}: pose {i} is no pose")  # by rounding, where the host finds it just within


class PoseSetter:
    """Sets all objects of a pool from poses that a caller hands in: memory and launches are made once.

    Args:
        pool: `ObjectPool` whose arrays stay.
        removed: Places without an object, rising: what is given for them is not read.
        what: What errors call the poses.
    """

    def __init__(self, pool, device, removed=(), what="poses"):
        self._pool, self._device, self._removed, self._what = pool, device, list(removed), what
        self._made: dict = {}  # rows, their view on the host, and the launch, by numbers a pose

    def set(self, poses):
        """Set the objects from poses (n, 7) or (n, 4, 4), which are read where they lie. (synchronization point)

        Raises:
            ValueError: As `check_poses`, or another number of poses than of objects; nothing is changed.
        """
        rows, count = device_rows(poses, self._device, self._what), len(self._pool.position)
        given = check_poses(poses, self._what, removed=self._removed) if rows is None else rows
        if len(given) != count:
            raise ValueError(f"{self._what}: {len(given)} given for {count} objects")
        if rows is not None:
            try:
                return place_rows(rows, self._pool)
            except ValueError:
                if not self._removed:
                    raise
            given = check_poses(poses, self._what, removed=self._removed)
        self._place(given)

    def _place(self, poses: np.ndarray):
        """Set all objects from checked poses, float64 (n, 7) or (n, 4, 4). One launch: all of them move, or none."""
        given = poses.reshape(len(poses), -1)
        width = given.shape[1]
        if width not in self._made:
            rows = wp.empty(given.shape, dtype=wp.float64, device=self._device)
            view = rows.numpy() if self._device.is_cpu else None
            kernel = place_poses.pose_setter(wp.float64, width)
            command = wp.launch(kernel, len(rows), [rows, self._pool], device=self._device, record_cmd=True)
            self._made[width] = rows, view, command
        rows, view, command = self._made[width]
        if view is None:
            wp.copy(rows, wp.array(given, dtype=wp.float64, device="cpu"))
        else:
            view[:] = given
        command.launch()


def launch_place(rows, pool):
    """Set the objects of a pool from sound rows of 7 or 16 numbers. One launch: all objects move, or none."""
    wp.launch(place_poses.pose_setter(rows.dtype, rows.shape[1]), len(rows), [rows, pool], device=rows.device)


def place_row(pose: np.ndarray, pool, i: int):
    """Set object i of a pool from a checked pose, (1, 7) or (1, 4, 4)."""
    one = type(pool)()
    one.rotation, one.position = pool.rotation[i : i + 1], pool.position[i : i + 1]
    launch_place(wp.array(pose.reshape(1, -1), dtype=wp.float64, device=pool.position.device), one)
