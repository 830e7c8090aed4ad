"""A warp's lists of node pairs and face pairs in shared memory, with a bound for each entry."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.search.item import four_items

OPEN_START = native.constant("NEAREST_OPEN_START")
OPEN_LENGTH = native.constant("NEAREST_OPEN_LENGTH")

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@native.func_native()
def nearest_stack() -> wp.uint64:
    """Return the address of this warp's lists, in shared memory on CUDA, each entry's bound behind them.

    Node pairs, face pairs for float32, and face pairs for float64.
    """


@native.func_native()
def read_bound(items: wp.uint64, i: wp.int32) -> wp.float32: ...


@native.func_native()
def write_bound(items: wp.uint64, i: wp.int32, bound: wp.float32): ...


@native.func_native()
def push_nearest(
    items: wp.uint64,
    end: wp.ref[wp.int32],
    leaf_end: wp.ref[wp.int32],
    kinds: wp.vec4i,
    children: four_items,
    bounds: wp.vec4,
):
    """Append node pairs to the stack, the nearest of each lane last, and face pairs to theirs."""


@native.func_native()
def push_open(items: wp.uint64, end: wp.ref[wp.int32], flag: bool, item: wp.int64, bound: wp.float32):
    """Append the face pairs whose flag is set to those for float64."""
