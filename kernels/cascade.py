"""Lists of object pairs that coarse levels of detail leave open, made on the device, and their answers put in place."""

import warp as wp

from warp_abtree.kernels.faces import Hits

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# A rounded sum of two errors, times this and rounded, is no less than the true sum.
ROUND_UP = wp.constant(wp.float64(1.0 + 2.0**-50))


@wp.struct
class PairList:
    """Pairs still open: how many, shape [1]; the pairs and their places among those asked, shape [room].

    within: Distance beyond which the surfaces of the next rung prove a pair apart [world units], shape [room].
    """

    count: wp.array(dtype=wp.int32)
    pair: wp.array(dtype=wp.vec2i)
    origin: wp.array(dtype=wp.int32)
    within: wp.array(dtype=wp.float64)


@wp.struct
class Proof:
    """What the rungs did for each pair asked, shape [room]: the rung that settled it, else their number; tests made."""

    rung: wp.array(dtype=wp.int32)
    node_tests: wp.array(dtype=wp.int64)
    triangle_tests: wp.array(dtype=wp.int64)


@wp.func
def put_pair(slot: wp.int32, pair: wp.vec2i, origin: wp.int32, error: wp.array(dtype=wp.float64), open_pairs: PairList):
    """Write a pair to a list, and what proves it apart there; no rung follows where error is empty."""
    open_pairs.pair[slot] = pair
    open_pairs.origin[slot] = origin
    if error.shape[0] > 0:
        open_pairs.within[slot] = (error[pair[0]] + error[pair[1]]) * ROUND_UP


@wp.kernel
def open_pair_kernel(
    rung_count: wp.int32,
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    error: wp.array(dtype=wp.float64),
    list_counts_out: wp.array(dtype=wp.int32),
    open_pairs_out: PairList,
    proof_out: Proof,
    hits_out: Hits,
):
    """List every pair asked as open, and clear answers and counters.

    Args:
        error: Certified error [model units] of each object at the first rung, shape [object]; [0] without rungs.
        list_counts_out: Counts of all lists, the first one's first.
    """
    p = wp.tid()
    count = wp.min(pair_count[0], pairs.shape[0])
    if p == 0:
        for k in range(list_counts_out.shape[0]):
            list_counts_out[k] = wp.where(k == 0, count, 0)
        hits_out.total[0] = 0
    hits_out.any_hit[p] = 0
    hits_out.count[p] = wp.int64(0)
    hits_out.node_tests[p] = wp.int64(0)
    hits_out.triangle_tests[p] = wp.int64(0)
    hits_out.float64_tests[p] = wp.int64(0)
    hits_out.exact_tests[p] = wp.int64(0)
    proof_out.rung[p] = rung_count
    proof_out.node_tests[p] = wp.int64(0)
    proof_out.triangle_tests[p] = wp.int64(0)
    if p < count:
        put_pair(p, pairs[p], p, error, open_pairs_out)


@wp.kernel
def keep_pair_kernel(
    rung: wp.int32,
    asked: PairList,
    near: Hits,
    error: wp.array(dtype=wp.float64),
    proof_inout: Proof,
    open_pairs_inout: PairList,
):
    """Pass on the pairs that a rung has not proved apart, in no order.

    Args:
        near: What the rung found, an entry a pair of its list.
        error: Certified error [model units] of each object at the next rung, shape [object]; [0] after the last.
    """
    i = wp.tid()
    if i >= asked.count[0]:
        return
    p = asked.origin[i]
    proof_inout.node_tests[p] = proof_inout.node_tests[p] + near.node_tests[i]
    proof_inout.triangle_tests[p] = proof_inout.triangle_tests[p] + near.triangle_tests[i]
    if near.any_hit[i] == 0:
        proof_inout.rung[p] = rung
        return
    slot = wp.atomic_add(open_pairs_inout.count, 0, 1)
    put_pair(slot, asked.pair[i], p, error, open_pairs_inout)


@wp.kernel
def place_answer_kernel(asked: PairList, found: Hits, hits_out: Hits):
    """Put the answers of listed pairs in the places of the pairs asked."""
    i = wp.tid()
    if i >= asked.count[0]:
        return
    p = asked.origin[i]
    hits_out.any_hit[p] = found.any_hit[i]
    hits_out.count[p] = found.count[i]
    hits_out.node_tests[p] = found.node_tests[i]
    hits_out.triangle_tests[p] = found.triangle_tests[i]
    hits_out.float64_tests[p] = found.float64_tests[i]
    hits_out.exact_tests[p] = found.exact_tests[i]


@wp.kernel
def place_face_kernel(asked: PairList, hits_inout: Hits):
    """Number the pairs of intersecting faces as they were asked."""
    k = wp.tid()
    # A total that has wrapped stands for more than there is room for.
    if hits_inout.total[0] >= 0 and k >= hits_inout.total[0]:
        return
    face = hits_inout.face[k]
    hits_inout.face[k] = wp.vec3i(asked.origin[face[0]], face[1], face[2])
