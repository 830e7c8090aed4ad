"""A chunk of a sweep: poses checked and set on the device, answers packed for the host."""

from typing import Any

import warp as wp

from warp_abtree.kernels.arrays import ObjectPool
from warp_abtree.kernels.place_poses import (
    is_matrix_pose,
    is_quaternion_pose,
    read_column,
    read_position,
    read_quaternion,
    read_rotation,
)
from warp_abtree.kernels.poses import rotate_quaternion
from warp_abtree.kernels.traversal.face_pairs import Hits

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NONE_REFUSED = wp.constant(2**31 - 1)

# report: what a chunk tells the host
REFUSED = wp.constant(0)  # first pose that is none, NONE_REFUSED if all are
UNCERTAIN = wp.constant(1)  # face pairs that float32 leaves to the later stages


@wp.func
def refuse_pose(objects: ObjectPool, report: wp.array(dtype=wp.int32), i: wp.int32):
    """Note that row i is no pose, and place its object where it meets nothing."""
    far = wp.float64(wp.nan)
    objects.position[i + 1] = wp.vec3d(far, far, far)
    objects.rotation[i + 1] = wp.identity(n=3, dtype=wp.float64)
    wp.atomic_min(report, REFUSED, i)


@wp.kernel
def place_quaternion_kernel(
    tolerance: wp.float64,
    poses: wp.array2d(dtype=Any),
    objects_inout: ObjectPool,
    report_inout: wp.array(dtype=wp.int32),
):
    """Set objects 1, 2, ... from x y z qx qy qz qw, and note the first row that is no pose.

    Args:
        tolerance: How far the norm of a quaternion may be off 1.
        poses: float32 or float64, shape [capacity, 7].
    """
    i = wp.tid()
    if is_quaternion_pose(tolerance, poses, i):
        objects_inout.position[i + 1] = read_position(poses, i)
        objects_inout.rotation[i + 1] = rotate_quaternion(read_quaternion(poses, i))
    else:
        refuse_pose(objects_inout, report_inout, i)


@wp.kernel
def place_matrix_kernel(
    tolerance: wp.float64,
    poses: wp.array2d(dtype=Any),
    objects_inout: ObjectPool,
    report_inout: wp.array(dtype=wp.int32),
):
    """Set objects 1, 2, ... from rigid 4x4 matrices, taken as they are, and note the first row that is none.

    Args:
        tolerance: How far R^T R may be off the identity.
        poses: float32 or float64, shape [capacity, 16].
    """
    i = wp.tid()
    if is_matrix_pose(tolerance, poses, i):
        objects_inout.position[i + 1] = read_column(poses, i)
        objects_inout.rotation[i + 1] = read_rotation(poses, i)
    else:
        refuse_pose(objects_inout, report_inout, i)


for _kernel in (place_quaternion_kernel, place_matrix_kernel):
    for _real in (wp.float32, wp.float64):
        wp.overload(_kernel, {"poses": wp.array2d(dtype=_real)})


@wp.kernel
def report_chunk_kernel(
    hits: Hits,
    report_inout: wp.array(dtype=wp.int32),
    any_out: wp.array(dtype=wp.uint8),
):
    """Pack yes and no into bytes, where there is room for them, and report how many face pairs waited."""
    i = wp.tid()
    if i == 0:
        report_inout[UNCERTAIN] = hits.uncertain_total[0]
    if i < any_out.shape[0]:
        any_out[i] = wp.uint8(wp.where(hits.any_hit[i] != 0, 1, 0))
