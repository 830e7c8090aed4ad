"""The lanes of a warp at work on lists in shared memory: a block is a warp, on the CPU one thread.

All lanes must reach these functions together, but for those that read or write one entry.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.traversal.node_pair import four_items

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WARP_SIZE = native.constant("WARP_SIZE")
RESOLVE_WARPS = native.constant("RESOLVE_WARPS")
STACK_LENGTH = native.constant("STACK_LENGTH")  # node pairs
STRADDLING_START = native.constant("STRADDLING_START")
SLAB_PAIR_START, SLAB_PAIR_LENGTH = native.constant("SLAB_PAIR_START"), native.constant("SLAB_PAIR_LENGTH")

six_numbers = wp.types.vector(length=6, dtype=wp.float64)

stack_code = functools.partial(native.body, "warp_stack.cuh")
vote_code = functools.partial(native.body, "warp_vote.cuh")


@wp.func_native(stack_code("warp_size"))
def warp_size() -> wp.int32: ...


@wp.func_native(stack_code("warp_lane"))
def warp_lane() -> wp.int32: ...


@wp.func_native(stack_code("resolve_lane"))
def resolve_lane() -> wp.int32:
    """Return the lane of a warp in a block of RESOLVE_WARPS."""


@wp.func_native(stack_code("warp_sync"))
def warp_sync(): ...


@wp.func_native(stack_code("warp_stack"))
def warp_stack() -> wp.uint64:
    """Return where this warp's items lie, an address in shared memory on CUDA.

    Its stack, its leaf pairs, those that straddle each other's planes, the signs of these, half an item each, and its
    slab pairs.
    """


@wp.func_native(stack_code("read_item"))
def read_item(items: wp.uint64, i: wp.int32) -> wp.int64: ...


@wp.func_native(stack_code("write_item"))
def write_item(items: wp.uint64, i: wp.int32, item: wp.int64): ...


@wp.func_native(native.body("push_children.cuh", "push_children"))
def push_children(items: wp.uint64, ends: wp.vec3i, lists: wp.vec4i, children: four_items) -> wp.vec3i:
    """Append children to the lists that they are for, if any, see `node_pair`.

    Returns the new ends of the stack, the slab pairs and the leaf pairs.
    """


@wp.func_native(stack_code("push_items"))
def push_items(items: wp.uint64, end: wp.int32, flag: bool, item: wp.int64) -> wp.int32:
    """Append the items whose flag is set to the stack; return its new end."""


@wp.func_native(stack_code("hold_uniform"))
def hold_uniform(x: wp.int32) -> wp.int32:
    """Return a number that is the same in all lanes, so that it is held and not computed again where it is used."""


@wp.func_native(stack_code("push_straddling"))
def push_straddling(items: wp.uint64, end: wp.int32, flag: bool, item: wp.int64, signs: wp.int32) -> wp.int32:
    """Append the leaf pairs whose flag is set, with their signs, to the straddling pairs; return the new end."""


@wp.func_native(stack_code("read_signs"))
def read_signs(items: wp.uint64, i: wp.int32) -> wp.int32:
    """Return the signs of the i-th straddling pair."""


@wp.func_native(stack_code("signed_pairs"))
def signed_pairs() -> wp.uint64:
    """Return where this warp holds face pairs with their signs, an address in shared memory on CUDA."""


@wp.func_native(stack_code("push_signed_pair"))
def push_signed_pair(list: wp.uint64, end: wp.int32, flag: bool, item: wp.vec3i, signs: wp.int32) -> wp.int32:
    """Append the face pairs whose flag is set, with their signs, to a list; return the new end."""


@wp.func_native(stack_code("read_signed_pair"))
def read_signed_pair(list: wp.uint64, i: wp.int32) -> wp.vec4i:
    """Return the i-th face pair of a list, and its signs."""


@wp.func_native(vote_code("warp_any"))
def warp_any(flag: bool) -> bool: ...


@wp.func_native(vote_code("add_in_order"))
def add_in_order(sum: six_numbers, x: six_numbers, count: wp.int32) -> six_numbers:
    """Return sums and the numbers of so many lanes, added one after the other; on the CPU, of the one thread."""


@wp.func_native(vote_code("warp_max"))
def warp_max(x: wp.float64) -> wp.float64: ...


@wp.func_native(vote_code("lowest_bit"))
def lowest_bit(bits: wp.int32) -> wp.int32: ...


@wp.func_native(vote_code("reserve_slot"))
def reserve_slot(total: wp.array(dtype=wp.int32), flag: bool) -> wp.int32:
    """Count the set flags into total[0] with one atomic a warp; return the slot of each lane whose flag is set."""


@wp.func_native(vote_code("take_slots"))
def take_slots(total: wp.array(dtype=wp.int32), count: wp.int32) -> wp.int32:
    """Count more into total[0] and return what it was; on the CPU, Warp's own atomics race with other threads."""


@wp.func_native(vote_code("add_warp_sum"))
def add_warp_sum(totals: wp.array(dtype=wp.int64), i: wp.int32, x: wp.int32):
    """Add a value of every lane to totals[i] with one atomic a warp."""


@wp.func_native(vote_code("count_flags"))
def count_flags(totals: wp.array(dtype=wp.int64), i: wp.int32, flag: bool):
    """Count the set flags into totals[i], i >= 0 of each lane, with one atomic for those that share it."""
