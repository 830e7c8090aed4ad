"""Hits in the order of `Result.faces`, (pair, face a, face b), by a segment a pair: for many object pairs on CUDA.

A radix sort reads and writes all keys once for every few bits, the pair's included. Here hits take places among those
of their pair first, in any order, and a group of threads puts these in order in shared memory: three launches.

A key in a pair's segment, the same as that of `sort_by_pair`:

[ 63 .. 32 face of the first object | 31 .. 1 face of the second | 0 whether they are apart ]
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.contacts.summary import chunk_span, first_chunk
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, PAIR_MASK
from warp_abtree.kernels.io.sort_hits import count_rows

wp.set_module_options(native.options("io/segments.cuh"))

# Threads of a block of each kernel here; on the CPU a block is one thread.
SEGMENT_THREADS = native.constant("SEGMENT_THREADS")
# Keys that a thread of a group has room for in shared memory.
SEGMENT_KEYS = native.constant("SEGMENT_KEYS")


@native.func_native()
def start_segments(
    tile: wp.int32,
    rows: wp.int32,
    pair_mask: wp.int32,
    count: wp.array(dtype=wp.int64),
    face: wp.array(dtype=wp.vec3i),
    start: wp.array(dtype=wp.int32),
):
    """Write to start[p + 1] where the hits of pair p start, of as many pairs as a block has threads."""


@native.func_native()
def take_place(end: wp.array(dtype=wp.int32), pair: wp.int32) -> wp.int32: ...


@native.func_native()
def sort_segment(
    thread: wp.int32,
    threads: wp.int32,
    flag: wp.int32,
    start: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int64),
    sorted: wp.array(dtype=wp.vec3i),
):
    """Write the hits of one pair a group of threads in order."""


@wp.kernel
def start_segment_kernel(
    lanes: wp.int32,
    capacity: wp.int32,
    total: wp.array(dtype=wp.int32),
    count: wp.array(dtype=wp.int64),
    face: wp.array(dtype=wp.vec3i),
    start_out: wp.array(dtype=wp.int32),
    listed_totals_out: wp.array(dtype=wp.int32),
):
    """Prefix sum of the numbers of hits of the pairs; defers none yet.

    Args:
        lanes: SEGMENT_THREADS, 1 on the CPU.
        capacity: Hits that are sorted, at most.
        count: `Hits.count`. Where its sum is not what there is in the buffer, the rows there are counted.
        start_out: Start of pair p at p + 1, where `take_place_kernel` goes on counting; shape [pair + 1].
        listed_totals_out: Shape [2], or [0] if nobody asks.
    """
    i = wp.tid()
    if i == 0 and listed_totals_out.shape[0] > 0:
        listed_totals_out[0] = 0
        listed_totals_out[1] = 0
    start_segments(i // lanes, wp.min(count_rows(total[0], face.shape[0]), capacity), PAIR_MASK, count, face, start_out)


@wp.kernel
def take_place_kernel(
    capacity: wp.int32,
    total: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.vec3i),
    start_inout: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Put the key of one hit a thread anywhere into its pair's segment.

    A readout may sort ahead of the check that there are rows at all: whatever lies there, all stays in bounds.

    Args:
        start_inout: Of `start_segment_kernel`; becomes where the hits of each pair start, and after the last, end.
        key_out: Keys, then scratch, shape [2 capacity].
    """
    i = wp.tid()
    if i < wp.min(count_rows(total[0], face.shape[0]), capacity):
        row = face[i]
        apart = wp.int64(wp.where((row[0] & NEAR_BIT) != 0, 1, 0))
        pair = wp.min(row[0] & PAIR_MASK, start_inout.shape[0] - 2)
        place = wp.min(take_place(start_inout, pair), capacity - 1)
        key_out[place] = (wp.int64(row[1]) << wp.int64(32)) | (wp.int64(row[2]) << wp.int64(1)) | apart


@wp.kernel
def sort_segment_kernel(
    lanes: wp.int32,
    threads: wp.int32,
    start: wp.array(dtype=wp.int32),
    key_inout: wp.array(dtype=wp.int64),
    sorted_out: wp.array(dtype=wp.vec3i),
    span_out: wp.array(dtype=wp.vec3i),
):
    """Sort each pair's keys, and write them as rows; locate the pair's chunks, and places behind them.

    Args:
        lanes: 1, on the CPU `threads`.
        threads: Of a group, which sorts a pair's hits: a power of two from 32 to SEGMENT_THREADS.
        key_inout: Keys, then scratch, shape [2 capacity].
        span_out: `ChunkSums.span`, or [0] if nobody asks.
    """
    thread = wp.tid() * lanes
    p = thread // threads
    if span_out.shape[0] > 0 and p + 1 < start.shape[0]:
        c = first_chunk(p, start) + thread % threads
        while c < first_chunk(p + 1, start):
            span_out[c] = chunk_span(p, c, start)
            c += threads // lanes
    sort_segment(thread, threads, NEAR_BIT, start, key_inout, sorted_out)
