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


@wp.func
def part_of(part: wp.vec2i, batch: PairBatch):
    """Return the place of the first pair of a part, and how many it has; part is its number, of how many."""
    count = wp.min(batch.count[0], batch.pairs.shape[0])
    size = (count + part[1] - 1) / part[1]
    return part[0] * size, wp.clamp(count - part[0] * size, 0, size)


@wp.kernel
def take_part_kernel(
    part: wp.vec2i,
    record: LaunchRecord,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    asked: wp.array(dtype=wp.float64),
    hits_inout: Hits,
    manifolds_inout: Manifolds,
    part_out: PairBatch,
    gap_out: wp.array(dtype=wp.float64),
    asked_out: wp.array(dtype=wp.float64),
):
    """Give a part its pairs, one a thread, with their gaps; the first part clears what places without a pair have.

    Args:
        part: As for `part_of`.
        gap, asked: Of all pairs, as `find_resting_kernel` has them; [0] for none.
    """
    i = wp.tid()
    first, count = part_of(part, batch)
    if i == 0:
        if record_launch(record):
            count = 0
        part_out.count[0] = count
        if part[0] == 0:
            hits_inout.total[0] = 0
            hits_inout.witness_total[0] = 0
            hits_inout.uncertain_total[0] = 0
            hits_inout.inexact_total[0] = 0
            if gap.shape[0] > 0:
                hits_inout.apart_total[0] = 0
    if part[0] == 0 and i >= batch.count[0] and i < manifolds_inout.count.shape[0]:
        hits_inout.any_hit[i] = 0
        hits_inout.count[i] = wp.int64(0)
        hits_inout.node_tests[i] = wp.int64(0)
        hits_inout.triangle_tests[i] = wp.int64(0)
        hits_inout.float64_tests[i] = wp.int64(0)
        hits_inout.exact_tests[i] = wp.int64(0)
        manifolds_inout.count[i] = 0
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
    part: wp.vec2i,
    batch: PairBatch,
    found: Hits,
    points: Manifolds,
    hits_inout: Hits,
    manifolds_inout: Manifolds,
):
    """Put one contact point a thread of a part's pairs, and what there is one of a pair, in their places.

    Args:
        part: As for `part_of`.
        batch: Of all pairs.
    """
    i, k = wp.tid()
    first, count = part_of(part, batch)
    if i == 0 and k == 0:
        raise_total(hits_inout.total, found.total)
        raise_total(hits_inout.witness_total, found.witness_total)
        raise_total(hits_inout.uncertain_total, found.uncertain_total)
        raise_total(hits_inout.inexact_total, found.inexact_total)
        if found.gap.shape[0] > 0:
            raise_total(hits_inout.apart_total, found.apart_total)
    if i >= count:
        return
    p = first + i
    if k == 0:
        hits_inout.any_hit[p] = found.any_hit[i]
        hits_inout.count[p] = found.count[i]
        hits_inout.node_tests[p] = found.node_tests[i]
        hits_inout.triangle_tests[p] = found.triangle_tests[i]
        hits_inout.float64_tests[p] = found.float64_tests[i]
        hits_inout.exact_tests[p] = found.exact_tests[i]
        manifolds_inout.count[p] = points.count[i]
    if k < points.count[i]:
        manifolds_inout.point[p, k] = points.point[i, k]
        manifolds_inout.normal[p, k] = points.normal[i, k]
        manifolds_inout.depth[p, k] = points.depth[i, k]
