"""Broad phase of a thread of the CPU: sweep and prune in each group, along the axis in which objects lie widest.

Source: Baraff 1992, Dynamic Simulation of Non-Penetrating Rigid Bodies.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.counters import take_slots
from warp_abtree.kernels.intersect.broad_phase import PairFilter, PosedBounds, box_middle, may_pair, write_pair

wp.set_module_options(native.options("base/counters.cuh", "intersect/sweep.h"))

# Places that a thread of the CPU lists at a time.
SWEEP_ROOM = 272


@wp.struct
class Sweep:
    """What a thread of the CPU sorts the boxes of groups with."""

    start: wp.array(dtype=wp.int32)  # where each group starts in the order, and its end, shape [group + 1]
    order: wp.array(dtype=wp.int32)  # objects in the order of their groups, shape [object]
    place: wp.array(dtype=wp.int32)  # the same, those of each group along the axis, shape [object]
    rows: wp.array(dtype=wp.float32)  # their boxes by column, with room for 16 more, shape [6 * (object + 16)]
    words: wp.array(dtype=wp.int64)  # scratch, shape [2 * object]


@native.func_native(cpu=True)
def sort_sweep(
    first: wp.int32,
    end: wp.int32,
    axis: wp.int32,
    order: wp.array(dtype=wp.int32),
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    words: wp.array(dtype=wp.int64),
    place: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.float32),
):
    """Sort some of an order by their lower ends along an axis, and list their boxes."""


@native.func_native(cpu=True)
def scan_sweep(
    own: wp.int32,
    at: wp.ref[wp.int32],
    end: wp.int32,
    axis: wp.int32,
    rows: wp.array(dtype=wp.float32),
    found: wp.array(dtype=wp.int32),
) -> wp.int32:
    """List the places from one on whose boxes overlap that of a place, as far as there is room; return how many.

    Where to go on is written to `at`, the end where none can follow.
    """


@wp.func
def sweep_axis(boxes: PosedBounds):
    """Return the axis along which the middles of boxes lie farthest apart in the mean of squares."""
    sum, squares, count = wp.vec3d(), wp.vec3d(), boxes.lower.shape[0]
    for i in range(count):
        x = wp.vec3d(box_middle(boxes, i))
        sum += x
        squares += wp.cw_mul(x, x)
    spread = squares - wp.cw_mul(sum, sum) / wp.float64(count)
    return wp.where(spread[0] >= wp.max(spread[1], spread[2]), 0, wp.where(spread[1] >= spread[2], 1, 2))


@wp.func
def scan_group(
    own: wp.int32,
    first: wp.int32,
    end: wp.int32,
    axis: wp.int32,
    filter: PairFilter,
    sweep: Sweep,
    objects: ObjectPool,
    boxes: PosedBounds,
    found: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
):
    """Find the pairs of the object in a place with those in the places of a group from one on."""
    at = wp.int32(first)
    i = sweep.place[own]
    while at < end and boxes.pair_count[0] >= 0:
        count = scan_sweep(own, at, end, axis, sweep.rows, found)
        for k in range(count):
            j = sweep.place[found[k]]
            if may_pair(i, j, filter, objects):
                write_pair(take_slots(boxes.pair_count, 1), i, j, pairs)


@wp.kernel
def sweep_pair_kernel(
    filter: PairFilter,
    sweep: Sweep,
    objects: ObjectPool,
    boxes_inout: PosedBounds,
    pairs_out: wp.array(dtype=wp.vec2i),
):
    """Find the pairs of each group, and of each with what is in every world, by one thread; CPU only."""
    found = wp.zeros(shape=SWEEP_ROOM, dtype=wp.int32)
    axis = sweep_axis(boxes_inout)
    for g in range(sweep.start.shape[0] - 1):
        first, end = sweep.start[g], sweep.start[g + 1]
        lower, upper = boxes_inout.lower, boxes_inout.upper
        sort_sweep(first, end, axis, sweep.order, lower, upper, sweep.words, sweep.place, sweep.rows)
        for own in range(first, end):
            scan_group(own, own + 1, end, axis, filter, sweep, objects, boxes_inout, found, pairs_out)
        if filter.shared_group == 0 and g > 0:
            for own in range(sweep.start[1]):
                scan_group(own, first, end, axis, filter, sweep, objects, boxes_inout, found, pairs_out)
