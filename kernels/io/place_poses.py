"""Poses from arrays: checked, and set as the rotation and position of objects."""

from functools import cache
from typing import Any

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.poses import rotate_quaternion

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


@wp.func
def is_finite(x: wp.vec3d):
    return wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])


@wp.func
def is_unit(tolerance: wp.float64, q: wp.vec4d):
    """Return whether the norm of a quaternion is over 0, and off 1 by no more than a tolerance; false for NaN."""
    norm = wp.sqrt(((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3])
    return norm > wp.float64(0.0) and wp.abs(norm - wp.float64(1.0)) <= tolerance


@wp.func
def is_rigid(tolerance: wp.float64, r: wp.mat33d):
    """Return whether R^T R is within a tolerance of the identity, and R no reflection; false for NaN."""
    gram = wp.transpose(r) * r
    off = wp.float64(0.0)
    for i in range(3):
        for j in range(3):
            difference = wp.abs(gram[i, j] - wp.where(i == j, wp.float64(1.0), wp.float64(0.0)))
            # Written so that NaN stays.
            off = wp.where(difference <= off, off, difference)
    return off <= tolerance and wp.determinant(r) > wp.float64(0.0)


@wp.func
def read_position(poses: wp.array2d(dtype=Any), i: wp.int32):
    return wp.vec3d(wp.float64(poses[i, 0]), wp.float64(poses[i, 1]), wp.float64(poses[i, 2]))


@wp.func
def read_quaternion(poses: wp.array2d(dtype=Any), i: wp.int32):
    return wp.vec4d(wp.float64(poses[i, 3]), wp.float64(poses[i, 4]), wp.float64(poses[i, 5]), wp.float64(poses[i, 6]))


@wp.func
def read_rotation(poses: wp.array2d(dtype=Any), i: wp.int32):
    """Return the upper left block of a 4x4 matrix, a row of 16 numbers."""
    r = wp.mat33d()
    for j in range(3):
        for k in range(3):
            r[j, k] = wp.float64(poses[i, 4 * j + k])
    return r


@wp.func
def read_column(poses: wp.array2d(dtype=Any), i: wp.int32):
    """Return the translation of a 4x4 matrix, a row of 16 numbers."""
    return wp.vec3d(wp.float64(poses[i, 3]), wp.float64(poses[i, 7]), wp.float64(poses[i, 11]))


@wp.func
def is_quaternion_pose(tolerance: wp.float64, poses: wp.array2d(dtype=Any), i: wp.int32):
    return is_finite(read_position(poses, i)) and is_unit(tolerance, read_quaternion(poses, i))


@wp.func
def is_matrix_pose(tolerance: wp.float64, poses: wp.array2d(dtype=Any), i: wp.int32):
    """Return whether a row of 16 numbers is a rigid 4x4 matrix."""
    last = wp.float64(poses[i, 15]) == wp.float64(1.0)
    for k in range(12, 15):
        if wp.float64(poses[i, k]) != wp.float64(0.0):
            last = False
    return last and is_finite(read_column(poses, i)) and is_rigid(tolerance, read_rotation(poses, i))


@wp.func
def read_turn(poses: wp.array2d(dtype=Any), i: wp.int32):
    return rotate_quaternion(read_quaternion(poses, i))


def pose_readers(width: int):
    """Return the functions that check a pose, and read its position and rotation.

    Rows of 7 numbers are x y z qx qy qz qw of a unit quaternion; rows of 16 a rigid 4x4 matrix, taken as it is.
    """
    if width == 7:
        return is_quaternion_pose, read_position, read_turn
    return is_matrix_pose, read_column, read_rotation


# Of two widths and two types most programs need one: each is a module of its own, compiled when it is first used.


@cache
def pose_check(real, width: int):
    """Return the kernel that finds the first row that is no pose."""
    is_pose, _, _ = pose_readers(width)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def check_pose_kernel(tolerance: wp.float64, poses: wp.array2d(dtype=real), first_inout: wp.array(dtype=wp.int32)):
        i = wp.tid()
        if not is_pose(tolerance, poses, i):
            wp.atomic_min(first_inout, 0, i)

    return check_pose_kernel


@cache
def pose_setter(real, width: int):
    """Return the kernel that sets rotation and position [world units], one row an object."""
    _, position_of, rotation_of = pose_readers(width)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def set_pose_kernel(poses: wp.array2d(dtype=real), objects_inout: ObjectPool):
        i = wp.tid()
        objects_inout.position[i] = position_of(poses, i)
        objects_inout.rotation[i] = rotation_of(poses, i)

    return set_pose_kernel
