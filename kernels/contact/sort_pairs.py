"""Hits in the order of `Result.faces` where many object pairs have few each: a block sorts those of a pair."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.contact.chunks import chunk_span, first_chunk
from warp_abtree.kernels.contact.sort_hits import count_rows
from warp_abtree.kernels.traversal.face_pairs import NEAR_BIT, PAIR_MASK
from warp_abtree.kernels.traversal.warp_stack import warp_lane, warp_size

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SORT_ROOM = native.constant("SORT_ROOM")


@wp.func_native(native.body("sort_pairs.cuh", "warp_sum"))
def warp_sum(x: wp.int32) -> wp.int32: ...


@wp.func_native(native.body("sort_pairs.cuh", "sum_before"))
def sum_before(x: wp.int32) -> wp.int32:
    """Return the sum over the lanes before this one."""


@wp.func_native(native.body("sort_pairs.cuh", "take_place"))
def take_place(next: wp.array(dtype=wp.int32), p: wp.int32) -> wp.int32:
    """Count one into next[p] and return what it was; any for a negative p. For all threads of a warp."""


@wp.func_native(native.body("sort_pairs.cuh", "sort_block"))
def sort_block(key: wp.array(dtype=wp.int64), first: wp.int32, length: wp.int32):
    """Sort so many keys in place. For all threads of a block."""


@wp.func_native(native.body("sort_pairs.cuh", "block_size"))
def block_size() -> wp.int32: ...


@wp.kernel
def start_pair_kernel(
    capacity: wp.int32,
    total: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.vec3i),
    count: wp.array(dtype=wp.int64),
    start_out: wp.array(dtype=wp.int32),
    next_out: wp.array(dtype=wp.int32),
    deferred_total_out: wp.array(dtype=wp.int32),
):
    """Find where the hits of one object pair a thread start, by the counts of those before; defer none yet.

    A block is a warp. Where counts say more than was written, for lack of room, hits are counted anew.
    """
    lane = warp_lane()
    first = wp.tid() / warp_size() * warp_size()
    p = first + lane
    room = start_out.shape[0] - 1
    rows = wp.min(count_rows(total[0], face.shape[0]), capacity)
    all = wp.int32(0)
    before = wp.int32(0)
    k = wp.int32(lane)
    while k < room:
        own = wp.int32(count[k])
        all += own
        before += wp.where(k < first, own, 0)
        k += warp_size()
    own = wp.int32(0)
    if p < room:
        own = wp.int32(count[p])
    place = warp_sum(before) + sum_before(own)
    if warp_sum(all) != rows:
        place = wp.int32(0)
        for i in range(rows):
            place += wp.where((face[i][0] & PAIR_MASK) < p, 1, 0)
    if p == 0:
        deferred_total_out[0] = 0
    if p <= room:
        start_out[p] = wp.clamp(place, 0, rows)
    if p < room:
        next_out[p] = wp.clamp(place, 0, rows)


@wp.kernel
def place_key_kernel(
    capacity: wp.int32,
    total: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.vec3i),
    next_inout: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Put the faces of one hit a thread among those of its object pair, in any order; warps are whole:

    63         32 31          1    0
    [  face a  ][  face b    ][ near ]
    """
    i = wp.tid()
    p = wp.int32(-1)
    row = wp.vec3i()
    if i < wp.min(count_rows(total[0], face.shape[0]), capacity):
        row = face[i]
        p = row[0] & PAIR_MASK
    place = take_place(next_inout, p)
    if p >= 0 and place < capacity:
        near = wp.where((row[0] & NEAR_BIT) != 0, wp.int64(1), wp.int64(0))
        key_out[place] = (wp.int64(row[1]) << wp.int64(32)) | (wp.int64(row[2]) << wp.int64(1)) | near


@wp.kernel
def sort_pair_kernel(
    start: wp.array(dtype=wp.int32),
    key_inout: wp.array(dtype=wp.int64),
    sorted_out: wp.array(dtype=wp.vec3i),
    span_out: wp.array(dtype=wp.vec3i),
):
    """Sort the hits of one object pair a block, and locate its chunks and the places behind them."""
    p = wp.tid() / block_size()
    thread = wp.tid() - p * block_size()
    first = start[p]
    length = start[p + 1] - first
    c = first_chunk(p, start) + thread
    while c < first_chunk(p + 1, start):
        span_out[c] = chunk_span(p, c, start)
        c += block_size()
    if length == 0:
        return
    sort_block(key_inout, first, length)
    k = first + thread
    while k < first + length:
        key = key_inout[k]
        pair = p | wp.where((key & wp.int64(1)) != wp.int64(0), NEAR_BIT, 0)
        second = wp.int32((key >> wp.int64(1)) & wp.int64(0x7FFFFFFF))
        sorted_out[k] = wp.vec3i(pair, wp.int32(key >> wp.int64(32)), second)
        k += block_size()
