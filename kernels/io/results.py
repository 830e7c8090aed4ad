"""Results of each object pair, packed into one block of memory that one transfer brings over.

The block of n pairs, in words of 8 bytes:

    [ header 6 | count n | node tests n | triangle tests n | float64 tests n | exact tests n | pairs n | flags ]

The header holds what became of the launch, object pairs found, face pairs found, uncertain face pairs, those that are
listed as apart for a gap, and rows that face pairs are reduced to. Pairs stand there only where they are asked. The
flags are bytes: n whether a pair intersects, n whether it is apart.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.intersect.face_pairs import Hits, read_total

wp.set_module_options(native.options())

HEADER_WORDS = wp.constant(6)
COUNT_COLUMNS = wp.constant(5)
BLOCK_DIM = 256


@native.func_native()
def store_flag(words: wp.array(dtype=wp.int64), at: wp.int64, flag: wp.int32):
    """Write a byte of 0 or 1 at a place counted in bytes."""


@wp.kernel
def pack_pair_kernel(
    n: wp.int32,
    with_pairs: wp.bool,
    batch: PairBatch,
    hits: Hits,
    near_hit: wp.array(dtype=wp.int32),
    words_inout: wp.array(dtype=wp.int64),
):
    """Sum the demands of all pairs, and write the first n pairs, one a thread; blocks of threads are whole.

    Args:
        with_pairs: Whether the objects of pairs are written; the host may know them.
        near_hit: Whether each pair is near, shape [pair]; [0] where no distance was asked.
        words_inout: Block of n pairs, its header 0.
    """
    i = wp.tid()
    hit_count = wp.int64(0)
    uncertain = wp.int64(0)
    if i < hits.count.shape[0]:
        hit_count = hits.count[i]
        uncertain = hits.float64_tests[i]
    wp.tile_atomic_add(words_inout, wp.tile_sum(wp.tile(hit_count)), offset=2)
    wp.tile_atomic_add(words_inout, wp.tile_sum(wp.tile(uncertain)), offset=3)
    if i == 0:
        words_inout[0] = wp.int64(batch.launched[0])
        words_inout[1] = wp.int64(batch.count[0])
        words_inout[4] = read_total(hits.apart_total)
        words_inout[5] = read_total(hits.witness_total)
    if i < n:
        words_inout[HEADER_WORDS + i] = hit_count
        words_inout[HEADER_WORDS + n + i] = hits.node_tests[i]
        words_inout[HEADER_WORDS + 2 * n + i] = hits.triangle_tests[i]
        words_inout[HEADER_WORDS + 3 * n + i] = uncertain
        words_inout[HEADER_WORDS + 4 * n + i] = hits.exact_tests[i]
        end = HEADER_WORDS + COUNT_COLUMNS * n
        if with_pairs:
            first = wp.int64(batch.pairs[i][0])
            words_inout[end + i] = first | (wp.int64(batch.pairs[i][1]) << wp.int64(32))
            end += n
        flags = wp.int64(8) * wp.int64(end) + wp.int64(i)
        store_flag(words_inout, flags, wp.where(hits.any_hit[i] != 0, 1, 0))
        if near_hit.shape[0] > 0:
            store_flag(words_inout, flags + wp.int64(n), wp.where(near_hit[i] == 0, 1, 0))
