"""Blocks of triangles that one thread of the CPU adds and any thread takes, and what threads tell each other."""

import functools

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Entries of the counters. Blocks are numbered from the first one on and never anew, so that no number comes twice.
BLOCKS_ADDED = wp.constant(native.constant("BLOCKS_ADDED"))
ENDED = wp.constant(native.constant("WINDOWS_ENDED"))
THREADS = wp.constant(native.constant("THREADS"))  # that have come
COUNTER_COUNT = 65

block_code = functools.partial(native.body, "build/blocks.h")


@wp.func_native(block_code("take_block"))
def take_block(counter: wp.array(dtype=int)) -> wp.int32:
    """Return the number of a block that no other thread has, the lowest first; -1 where there is none now."""


@wp.func_native(block_code("withdraw_blocks"))
def withdraw_blocks(counter: wp.array(dtype=int)) -> wp.int32:
    """Take all blocks that are left, and return the number of the first; nobody adds any meanwhile."""


@wp.func_native(block_code("write_flag"))
def write_flag(flag: wp.array(dtype=int), i: wp.int32, value: wp.int32):
    """Write an entry that other threads read; they see all that was written before."""


@wp.func_native(block_code("read_flag"))
def read_flag(flag: wp.array(dtype=int), i: wp.int32) -> wp.int32:
    """Read an entry that another thread writes."""


@wp.func_native(block_code("count_up"))
def count_up(flag: wp.array(dtype=int), i: wp.int32) -> wp.int32:
    """Raise an entry by one and return what it was."""


@wp.func_native(block_code("pause"))
def pause():
    """Wait for a moment."""
