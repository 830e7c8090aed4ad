"""Parts of a query's object pairs, which take turns in lists that have room for one part: pairs in, contact points out.

Totals of the whole query's hits are the greatest of any part, so that they stand beside the room of a part's lists.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.generation import LaunchRecord, record_launch
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.contacts.manifold import Manifolds
from warp_abtree.kernels.intersect.face_pairs import Hits

wp.set_module_options(native.options())


@wp.kernel
def take_part_kernel(
    first: wp.int32,
    record: LaunchRecord,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    asked: wp.array(dtype=wp.float64),
    hits_inout: Hits,
    part_out: PairBatch,
    gap_out: wp.array(dtype=wp.float64),
    asked_out: wp.array(dtype=wp.float64),
):
    """Give a part its pairs, one a thread, with their gaps; the first part empties the totals of the query.

    Args:
        first: Place of the part's first pair.
        gap, asked: Of all pairs, as `find_resting_kernel` has them; [0] for none.
    """
    i = wp.tid()
    room = part_out.pairs.shape[0]
    count = wp.clamp(wp.min(batch.count[0], batch.pairs.shape[0]) - first, 0, room)
    if i == 0:
        if record_launch(record):
            count = 0
        part_out.count[0] = count
        if first == 0:
            hits_inout.total[0] = 0
            hits_inout.witness_total[0] = 0
            hits_inout.uncertain_total[0] = 0
            hits_inout.inexact_total[0] = 0
            if gap.shape[0] > 0:
                hits_inout.apart_total[0] = 0
    if i < count:
        part_out.pairs[i] = batch.pairs[first + i]
        if gap.shape[0] > 0:
            gap_out[i] = gap[first + i]
        if asked.shape[0] > 0:
            asked_out[i] = asked[first + i]


@wp.func
def raise_total(total: wp.array(dtype=wp.int32), found: wp.array(dtype=wp.int32)):
    """Raise a counter to another, both read as uint32."""
    total[0] = wp.int32(wp.max(wp.uint32(total[0]), wp.uint32(found[0])))


@wp.kernel
def put_part_kernel(
    first: wp.int32, part: PairBatch, found: Hits, points: Manifolds, hits_inout: Hits, manifolds_inout: Manifolds
):
    """Put one contact point a thread of a part's pairs, and what there is one of a pair, in their places.

    Args:
        first: Place of the part's first pair.
    """
    i, k = wp.tid()
    if i == 0 and k == 0:
        raise_total(hits_inout.total, found.total)
        raise_total(hits_inout.witness_total, found.witness_total)
        raise_total(hits_inout.uncertain_total, found.uncertain_total)
        raise_total(hits_inout.inexact_total, found.inexact_total)
        if found.gap.shape[0] > 0:
            raise_total(hits_inout.apart_total, found.apart_total)
    p = first + i
    if p >= manifolds_inout.count.shape[0]:
        return
    if k == 0:
        hits_inout.any_hit[p] = found.any_hit[i]
        hits_inout.count[p] = found.count[i]
        hits_inout.node_tests[p] = found.node_tests[i]
        hits_inout.triangle_tests[p] = found.triangle_tests[i]
        hits_inout.float64_tests[p] = found.float64_tests[i]
        hits_inout.exact_tests[p] = found.exact_tests[i]
        manifolds_inout.count[p] = points.count[i]
    if i < part.count[0] and k < points.count[i]:
        manifolds_inout.point[p, k] = points.point[i, k]
        manifolds_inout.normal[p, k] = points.normal[i, k]
        manifolds_inout.depth[p, k] = points.depth[i, k]
