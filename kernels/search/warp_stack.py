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


@wp.struct
class WarpLists:
    """What a warp has in shared memory: node pairs, in a ring, the oldest first, and what follows from them."""

    items: wp.uint64  # `warp_stack`
    head: wp.int32  # node pairs that were taken from the ring's other end
    end: wp.int32  # node pairs, with these
    slab_pairs: wp.int32  # node pairs that slabs are to decide
    leaf_pairs: wp.int32  # pairs of faces that planes are to decide
    straddling: wp.int32  # pairs of faces that edges are to decide


@native.func_native()
def push_children(own: wp.ref[WarpLists], lists: wp.vec4i, children: four_items):
    """Append children to the lists that they are for, if any, see `node_pair`."""


@native.func_native()
def push_items(items: wp.uint64, end: wp.ref[wp.int32], flag: bool, item: wp.int64):
    """Append the items whose flag is set to the stack."""


@native.func_native()
def push_straddling(items: wp.uint64, end: wp.ref[wp.int32], flag: bool, item: wp.int64, signs: wp.int32):
    """Append the leaf pairs whose flag is set, with their signs, to the straddling pairs."""


@native.func_native()
def read_signs(items: wp.uint64, i: wp.int32) -> wp.int32:
    """Return the signs of the i-th straddling pair."""


@native.func_native()
def signed_pairs() -> wp.uint64:
    """Return the address of this warp's face pairs with their signs, in shared memory on CUDA."""


@native.func_native()
def push_signed_pair(list: wp.uint64, end: wp.ref[wp.int32], flag: bool, item: wp.vec3i, signs: wp.int32):
    """Append the face pairs whose flag is set, with their signs, to a list."""


@native.func_native()
def read_signed_pair(list: wp.uint64, i: wp.int32, item: wp.ref[wp.vec3i]) -> wp.int32:
    """Read the i-th face pair of a list; return its signs."""
