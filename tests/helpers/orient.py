"""Kernels that ask for single signs."""

import warp as wp

from warp_abtree.kernels.arithmetic.predicates import orient2d

# Signs are exact only where no multiplication and addition are contracted into one rounding.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def orient2d_kernel(mode: wp.int32, points: wp.array2d(dtype=wp.vec2d), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = orient2d(mode, points[i, 0], points[i, 1], points[i, 2])
