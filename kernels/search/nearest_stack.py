"""A warp's lists of node pairs and face pairs in shared memory, with a bound for each entry."""

from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.search.item import four_items
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, write_item

OPEN_START = native.constant("NEAREST_OPEN_START")
OPEN_LENGTH = native.constant("NEAREST_OPEN_LENGTH")

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


class SearchMemory(NamedTuple):
    """Lists of a search in memory: node pairs from 0 on, then leaf pairs, then open pairs.

    Attributes:
        stack_length: Where leaf pairs begin.
        open_start: Where open pairs begin.
        mask: What places on the stack are taken by, -1 where it is no ring.
        read_bound, read_slot: (items, place) -> what belongs to an entry beside its item.
        write_entry: (items, place, item, bound, slot).
    """

    stack_length: int
    open_start: int
    mask: int
    read_bound: Callable
    read_slot: Callable
    write_entry: Callable


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
def put_nearest_last(kinds: wp.ref[wp.vec4i], children: wp.ref[four_items], bounds: wp.ref[wp.vec4]):
    """Sort children by falling bounds."""


@native.func_native()
def put_nearer_last(kinds: wp.ref[wp.vec4i], children: wp.ref[four_items], bounds: wp.ref[wp.vec4]):
    """Sort the first two children so, where there are no others."""


@wp.func
def only_slot(items: wp.uint64, i: wp.int32):
    return 0


@wp.func
def write_bounded(items: wp.uint64, i: wp.int32, item: wp.int64, bound: wp.float32, slot: wp.int32):
    write_item(items, i, item)
    write_bound(items, i, bound)


NEAREST_MEMORY = SearchMemory(STACK_LENGTH, OPEN_START, STACK_LENGTH - 1, read_bound, only_slot, write_bounded)


@native.func_native()
def push_open(items: wp.uint64, end: wp.ref[wp.int32], flag: bool, item: wp.int64, bound: wp.float32):
    """Append the face pairs whose flag is set to those for float64."""
