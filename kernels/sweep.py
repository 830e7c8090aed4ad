"""A chunk of a sweep: poses checked and set on the device, answers packed for the host."""

from typing import Any

import warp as wp

from warp_abtree.kernels.faces import Hits
from warp_abtree.kernels.pools import ObjectPool
from warp_abtree.kernels.pose import rotate_quaternion

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NONE_REFUSED = wp.constant(2**31 - 1)

# report: what a chunk tells the host
REFUSED = wp.constant(0)  # first pose that is none, NONE_REFUSED if all are
UNSURE = wp.constant(1)  # face pairs that float32 left open


@wp.kernel
def place_poses_kernel(
    tolerance: wp.float64,
    poses: wp.array2d(dtype=Any),
    objects_inout: ObjectPool,
    report_inout: wp.array(dtype=wp.int32),
):
    """Set objects 1, 2, ... from x y z qx qy qz qw, and note the first row that is no pose.

    Such a row is placed where it meets nothing.

    Args:
        tolerance: How far the norm of a quaternion may be off 1.
        poses: float32 or float64, shape [capacity, 7].
    """
    i = wp.tid()
    x = wp.vec3d(wp.float64(poses[i, 0]), wp.float64(poses[i, 1]), wp.float64(poses[i, 2]))
    q = wp.vec4d(wp.float64(poses[i, 3]), wp.float64(poses[i, 4]), wp.float64(poses[i, 5]), wp.float64(poses[i, 6]))
    norm = wp.sqrt(((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3])
    finite = wp.isfinite(x[0]) and wp.isfinite(x[1]) and wp.isfinite(x[2])
    if finite and wp.abs(norm - wp.float64(1.0)) <= tolerance:
        objects_inout.position[i + 1] = x
        objects_inout.rotation[i + 1] = rotate_quaternion(q)
    else:
        far = wp.float64(wp.nan)
        objects_inout.position[i + 1] = wp.vec3d(far, far, far)
        objects_inout.rotation[i + 1] = wp.identity(n=3, dtype=wp.float64)
        wp.atomic_min(report_inout, REFUSED, i)


for _real in (wp.float32, wp.float64):
    wp.overload(place_poses_kernel, {"poses": wp.array2d(dtype=_real)})


@wp.kernel
def report_chunk_kernel(
    hits: Hits,
    report_inout: wp.array(dtype=wp.int32),
    any_out: wp.array(dtype=wp.uint8),
):
    """Pack yes and no into bytes, where there is room for them, and report how many face pairs waited."""
    i = wp.tid()
    if i == 0:
        report_inout[UNSURE] = hits.unsure_total[0]
    if i < any_out.shape[0]:
        any_out[i] = wp.uint8(wp.where(hits.any_hit[i] != 0, 1, 0))
