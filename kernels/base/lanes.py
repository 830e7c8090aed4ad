"""Lanes of a warp: votes, counts, sums and extremes. On the CPU a warp is one thread.

All lanes must reach these functions together.
"""

import functools

import warp as wp

from warp_abtree.kernels import native

WARP_SIZE = native.constant("WARP_SIZE")
RESOLVE_WARPS = native.constant("RESOLVE_WARPS")
six_numbers = wp.types.vector(length=6, dtype=wp.float64)
lanes_code = functools.partial(native.body, "base/lanes.cuh")

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func_native(lanes_code("warp_min"))
def warp_min(x: wp.float64) -> wp.float64: ...


@wp.func_native(lanes_code("warp_min32"))
def warp_min32(x: wp.float32) -> wp.float32: ...


@wp.func_native(lanes_code("warp_min_item"))
def warp_min_item(x: wp.int64) -> wp.int64: ...


@wp.func_native(lanes_code("rank_flag"))
def rank_flag(flag: bool) -> wp.int32:
    """Return how many lanes have set their flag, and in the low half how many before this one."""


@wp.func_native(lanes_code("count_lanes"))
def count_lanes(flag: bool) -> wp.int32:
    """Return how many lanes have set their flag."""


@wp.func_native(lanes_code("first_lane"))
def first_lane(flag: bool) -> wp.int32:
    """Return the first lane that has set its flag, the number of lanes where none has."""


@wp.func_native(lanes_code("warp_size"))
def warp_size() -> wp.int32: ...


@wp.func_native(lanes_code("warp_lane"))
def warp_lane() -> wp.int32: ...


@wp.func_native(lanes_code("resolve_lane"))
def resolve_lane() -> wp.int32:
    """Return the lane of a warp in a block of RESOLVE_WARPS."""


@wp.func_native(lanes_code("warp_sync"))
def warp_sync(): ...


@wp.func_native(lanes_code("hold_uniform"))
def hold_uniform(x: wp.int32) -> wp.int32:
    """Return a number that is the same in all lanes; keeps the compiler from computing it again at each use."""


@wp.func_native(lanes_code("warp_any"))
def warp_any(flag: bool) -> bool: ...


@wp.func_native(lanes_code("add_in_order"))
def add_in_order(sum: six_numbers, x: six_numbers, count: wp.int32) -> six_numbers:
    """Add the numbers of so many lanes to sums, one lane after the other; on the CPU, of the one thread."""


@wp.func_native(lanes_code("warp_max"))
def warp_max(x: wp.float64) -> wp.float64: ...


@wp.func_native(lanes_code("lowest_bit"))
def lowest_bit(bits: wp.int32) -> wp.int32: ...


@wp.func_native(lanes_code("block_sync"))
def block_sync(): ...
