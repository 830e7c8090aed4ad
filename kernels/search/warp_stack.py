"""The lanes of a warp at work on lists in shared memory: a block is a warp, on the CPU one thread.

All lanes must reach these functions together, but for those that read or write one entry.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.search.item import four_items

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STACK_LENGTH = native.constant("STACK_LENGTH")  # node pairs
STRADDLING_START = native.constant("STRADDLING_START")
SLAB_PAIR_START, SLAB_PAIR_LENGTH = native.constant("SLAB_PAIR_START"), native.constant("SLAB_PAIR_LENGTH")


@native.func_native()
def warp_stack() -> wp.uint64:
    """Return the address of this warp's items, in shared memory on CUDA.

    Its stack, its leaf pairs, those that straddle each other's planes, the signs of these, half an item each, and its
    slab pairs.
    """


@native.func_native()
def read_item(items: wp.uint64, i: wp.int32) -> wp.int64: ...


@native.func_native()
def write_item(items: wp.uint64, i: wp.int32, item: wp.int64): ...


@native.func_native()
def push_children(items: wp.uint64, ends: wp.vec3i, lists: wp.vec4i, children: four_items) -> wp.vec3i:
    """Append children to the lists that they are for, if any, see `node_pair`.

    Returns the new ends of the stack, the slab pairs and the leaf pairs.
    """


@native.func_native()
def push_items(items: wp.uint64, end: wp.int32, flag: bool, item: wp.int64) -> wp.int32:
    """Append the items whose flag is set to the stack; return its new end."""


@native.func_native()
def push_straddling(items: wp.uint64, end: wp.int32, flag: bool, item: wp.int64, signs: wp.int32) -> wp.int32:
    """Append the leaf pairs whose flag is set, with their signs, to the straddling pairs; return the new end."""


@native.func_native()
def read_signs(items: wp.uint64, i: wp.int32) -> wp.int32:
    """Return the signs of the i-th straddling pair."""


@native.func_native()
def signed_pairs() -> wp.uint64:
    """Return the address of this warp's face pairs with their signs, in shared memory on CUDA."""


@native.func_native()
def push_signed_pair(list: wp.uint64, end: wp.int32, flag: bool, item: wp.vec3i, signs: wp.int32) -> wp.int32:
    """Append the face pairs whose flag is set, with their signs, to a list; return the new end."""


@native.func_native()
def read_signed_pair(list: wp.uint64, i: wp.int32) -> wp.vec4i:
    """Return the i-th face pair of a list, and its signs."""
