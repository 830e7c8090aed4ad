"""Hits in the order of `Result.faces`, (pair, face a, face b), on the device: what goes before and after a radix sort.

All of it has the size of the buffer of hits, so that a CUDA graph can hold it; places without a hit sort behind them.
One thread of the CPU sorts the hits of contacts by itself, in the caches.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, PAIR_MASK

wp.set_module_options(native.options("io/sort_by_pair.h"))


@wp.func
def count_rows(total: wp.int32, capacity: wp.int32):
    """Return how many hits are in the buffer; a total that wrapped below 0 means more than it holds."""
    return wp.where(total < 0, capacity, wp.min(total, capacity))


@wp.kernel
def make_key_kernel(
    room: wp.int32,
    widths: wp.vec3i,
    fresh: wp.bool,
    total: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.vec3i),
    order_inout: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Make the radix key of one place a thread, of the fields that a pass of the sort looks at, the last one lowest.

    Args:
        room: Object pairs that there is room for; in place of the pair, it marks places without a hit.
        widths: Bits of each field, at most 63 in all; 0 leaves it out.
        fresh: Whether this is the first pass, which takes the hits as they lie.
    """
    i = wp.tid()
    at = order_inout[i]
    if fresh:
        at = i
        order_inout[i] = i
    row = wp.vec3i(room, 0, 0)
    if at < count_rows(total[0], face.shape[0]):
        row = face[at]
        row[0] = row[0] & PAIR_MASK
    key = wp.int64(0)
    for k in range(3):
        if widths[k] > 0:
            key = (key << wp.int64(widths[k])) | wp.int64(row[k])
    key_out[i] = key


@wp.kernel
def place_row_kernel(
    capacity: wp.int32,
    shift: wp.int32,
    total: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.vec3i),
    order: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int64),
    sorted_out: wp.array(dtype=wp.vec3i),
    start_out: wp.array(dtype=wp.int32),
    listed_totals_out: wp.array(dtype=wp.int32),
):
    """Put one hit a thread in its place, find where the hits of each object pair start, and defer none yet.

    Args:
        capacity: Places that were sorted.
        key: Sorted keys of the last pass, with the pair above `shift` bits, then scratch, shape [2 capacity].
        start_out: Shape [pair + 1], or [0] if nobody asks.
    """
    i = wp.tid()
    if i < wp.min(count_rows(total[0], face.shape[0]), capacity):
        sorted_out[i] = face[order[i]]
    if i < start_out.shape[0]:
        if i == 0:
            listed_totals_out[0] = 0
            listed_totals_out[1] = 0
        # One more than there are keys: the search never looks at its end, and returns the place before it if all are
        # less.
        start_out[i] = wp.lower_bound(key, 0, capacity + 1, wp.int64(i) << wp.int64(shift))


@native.func_native(cpu=True)
def sort_by_pair(
    count: wp.int32,
    pair_mask: wp.int32,
    flag: wp.int32,
    face: wp.array(dtype=wp.vec3i),
    key: wp.array(dtype=wp.int64),
    sorted: wp.array(dtype=wp.vec3i),
    start: wp.array(dtype=wp.int32),
):
    """Write the first hits in order, whose pairs are numbers with a flag, and where those of each pair start."""


@wp.kernel
def sort_by_pair_kernel(
    capacity: wp.int32,
    total: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.vec3i),
    key_inout: wp.array(dtype=wp.int64),
    sorted_out: wp.array(dtype=wp.vec3i),
    start_out: wp.array(dtype=wp.int32),
    listed_totals_out: wp.array(dtype=wp.int32),
):
    """Do all that the sort of contacts does, in one thread; CPU only.

    Args:
        key_inout: Scratch, shape [2 capacity].
    """
    count = wp.min(count_rows(total[0], face.shape[0]), capacity)
    sort_by_pair(count, PAIR_MASK, NEAR_BIT, face, key_inout, sorted_out, start_out)
    listed_totals_out[0] = 0
    listed_totals_out[1] = 0
