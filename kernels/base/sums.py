"""Sums of several numbers over the lanes of a warp, the same bits on every device: one lane after the other.

All lanes must reach these functions together; on the CPU a warp is one thread.
"""

import warp as wp

from warp_abtree.kernels import native

six_numbers = wp.types.vector(length=6, dtype=wp.float64)
nine_numbers = wp.types.vector(length=9, dtype=wp.float64)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@native.func_native()
def add_in_order(sum: six_numbers, x: six_numbers, count: wp.int32) -> six_numbers:
    """Add the numbers of so many lanes to sums, in blocks of one warp."""


@native.func_native()
def add_nine_in_order(sum: nine_numbers, x: nine_numbers, count: wp.int32) -> nine_numbers:
    """As `add_in_order`."""
