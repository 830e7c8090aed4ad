"""Counters and totals in memory, which the lanes of a warp add to by one atomic."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import hold_uniform

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@native.func_native()
def add_lanes(totals: wp.array(dtype=wp.int64), i: wp.int32, x: wp.int64):
    """Add the values of all lanes of a warp to a total; all lanes call it together, with the same i."""


@native.func_native()
def reserve_slot(total: wp.array(dtype=wp.int32), flag: bool) -> wp.int32:
    """Count the set flags into total[0] with one atomic a warp; return the slot of each lane whose flag is set."""


@native.func_native()
def take_slots(total: wp.array(dtype=wp.int32), count: wp.int32) -> wp.int32:
    """Count more into total[0] and return what it was; on the CPU, Warp's own atomics race with other threads."""


@native.func_native()
def take_once(counts: wp.array(dtype=wp.int32), i: wp.int32, count: wp.int32) -> wp.int32:
    """Count more into counts[i] once a warp; return what it was, in the first lane alone, without waiting for it."""


@wp.func
def take_together(counts: wp.array(dtype=wp.int32), i: wp.int32, count: wp.int32):
    """Count more into counts[i] once a warp; return what it was to all lanes."""
    return hold_uniform(take_once(counts, i, count))


@native.func_native()
def wait_for_counts(counts: wp.array(dtype=wp.int32), ids: wp.vec2i, values: wp.vec2i):
    """Wait until two counts have at least their values, and see what was written before these were published.

    On the CPU one thread takes all turns, so nothing is to be waited for.
    """


@native.func_native()
def publish_counts(counts: wp.array(dtype=wp.int32), ids: wp.vec2i, values: wp.vec2i):
    """Set two counts, but to no value below 1, after all that the warp has written."""


@native.func_native()
def ends_launch(ended: wp.array(dtype=wp.int32), threads: wp.int32) -> bool:
    """Return true to one thread, the last of a launch of so many to come here; it sees what warps added before.

    Args:
        ended: 0 before, and again when the launch is over, shape [1].
        threads: A multiple of the threads of a warp.
    """


@native.func_native()
def count_flags(totals: wp.array(dtype=wp.int64), i: wp.int32, flag: bool):
    """Count the set flags into totals[i], i >= 0 of each lane, with one atomic for those that share it."""
