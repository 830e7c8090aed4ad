"""A chunk of a sweep: poses checked and set on the device, answers packed for the host."""

from functools import cache

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.io.place_poses import pose_readers

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# report: what a chunk tells the host
REFUSED = wp.constant(0)  # first pose that is none, NONE_REFUSED if all are
UNCERTAIN_COUNT = wp.constant(1)  # face pairs that float32 leaves to the later stages


@cache
def pose_placer(real, width: int):
    """Return the kernel that sets objects 1, 2, ... from poses, and notes the first row that is none."""
    is_pose, position_of, rotation_of = pose_readers(width)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def place_pose_kernel(
        tolerance: wp.float64,
        poses: wp.array2d(dtype=real),
        objects_inout: ObjectPool,
        report_inout: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        if is_pose(tolerance, poses, i):
            objects_inout.position[i + 1] = position_of(poses, i)
            objects_inout.rotation[i + 1] = rotation_of(poses, i)
        else:
            # At NaN it meets nothing.
            far = wp.float64(wp.nan)
            objects_inout.position[i + 1] = wp.vec3d(far, far, far)
            objects_inout.rotation[i + 1] = wp.identity(n=3, dtype=wp.float64)
            wp.atomic_min(report_inout, REFUSED, i)

    return place_pose_kernel


@wp.kernel
def report_chunk_kernel(
    hits: Hits,
    report_inout: wp.array(dtype=wp.int32),
    any_out: wp.array(dtype=wp.uint8),
):
    """Pack yes and no into bytes, where there is room for them, and report the number of uncertain face pairs."""
    i = wp.tid()
    if i == 0:
        report_inout[UNCERTAIN_COUNT] = hits.uncertain_total[0]
    if i < any_out.shape[0]:
        any_out[i] = wp.uint8(wp.where(hits.any_hit[i] != 0, 1, 0))
