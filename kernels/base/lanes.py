"""Lanes of a warp: votes, counts, sums and extremes. On the CPU a warp is one thread.

All lanes must reach these functions together.
"""

import warp as wp

from warp_abtree.kernels import native

WARP_SIZE = native.constant("WARP_SIZE")
RESOLVE_WARPS = native.constant("RESOLVE_WARPS")

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@native.func_native()
def warp_min(x: wp.float64) -> wp.float64: ...


@native.func_native()
def warp_min32(x: wp.float32) -> wp.float32: ...


@native.func_native()
def warp_min_item(x: wp.int64) -> wp.int64: ...


@native.func_native()
def next_place(end: wp.ref[wp.int32], flag: bool) -> wp.int32:
    """Return this lane's place in a list that ends there, of the lanes whose flag is set, and move the end."""


@native.func_native()
def value_of_lane(x: wp.int32, lane: wp.int32) -> wp.int32: ...


@native.func_native()
def vector_of_lane(x: wp.vec3, lane: wp.int32) -> wp.vec3: ...


@native.func_native()
def vote_lanes(flag: bool) -> wp.uint32:
    """Return a word with the bit of each lane that has set its flag."""


@native.func_native()
def count_lanes(flag: bool) -> wp.int32:
    """Return how many lanes have set their flag."""


@native.func_native()
def first_lane(flag: bool) -> wp.int32:
    """Return the first lane that has set its flag, the number of lanes where none has."""


@native.func_native()
def lane_in_turn(flag: bool, backward: bool) -> wp.int32:
    """Return the first lane, or backward the last one, that has set its flag, -1 where none has."""


@native.func_native()
def warp_size() -> wp.int32: ...


@native.func_native()
def warp_lane() -> wp.int32: ...


@native.func_native()
def resolve_lane() -> wp.int32:
    """Return the lane of a warp in a block of several, or where the compiler should know that it is below 32."""


@native.func_native()
def warp_sync(): ...


@native.func_native()
def hold_uniform(x: wp.int32) -> wp.int32:
    """Return a number that is the same in all lanes; keeps the compiler from computing it again at each use."""


@native.func_native()
def warp_any(flag: bool) -> bool: ...


@native.func_native()
def warp_sum(x: wp.int32) -> wp.int32: ...


@native.func_native()
def warp_max(x: wp.float64) -> wp.float64: ...


@native.func_native()
def lowest_bit(bits: wp.int32) -> wp.int32: ...


@native.func_native()
def count_set_bits(bits: wp.int32) -> wp.int32: ...


@native.func_native()
def block_sync(): ...
