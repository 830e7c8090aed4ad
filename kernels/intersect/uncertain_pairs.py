"""The passes over uncertain face pairs: float64 for all of them, exact signs for the few that are inexact there.

Each pass works off a list of its own, so that the threads of a warp do much the same. Neighbours on a list are of
the same few object pairs, and a warp counts for them together.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees, load_vertex
from warp_abtree.kernels.base.counters import count_flags, reserve_slot
from warp_abtree.kernels.base.lanes import RESOLVE_WARPS, WARP_SIZE, resolve_lane, warp_size, warp_sync
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.exact.predicates import EXACT, FLOAT32, UNCERTAIN
from warp_abtree.kernels.intersect.face_pairs import Hits, append_row, report_hit, test_faces
from warp_abtree.kernels.search.item import OUTPUT_ANY, OUTPUT_FACES
from warp_abtree.kernels.search.warp_stack import push_signed_pair, read_signed_pair, signed_pairs
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_face_pair
from warp_abtree.kernels.triangle.float64_filter import (
    PLANES_UNDECIDED,
    SHARED_CORNER,
    filter_planes,
    filter_straddling,
)
from warp_abtree.kernels.triangle.signs import SEPARATED, rotate_corners

RESOLVE_THREADS = RESOLVE_WARPS * WARP_SIZE  # of a block
MODULE_OPTIONS = native.options(
    "base/counters.cuh", "base/lanes.cuh", "exact/determinant.cuh", "search/warp_stack.cuh"
) | {"block_dim": RESOLVE_THREADS}
wp.set_module_options(MODULE_OPTIONS)


@wp.func
def report_item(output: wp.int32, pair_poses: wp.array(dtype=PairPose), item: wp.vec3i, meets: bool, hits: Hits):
    """Count and report a face pair that meets. For all threads of a warp."""
    p = item[0]
    count_flags(hits.count, p, meets)
    if meets:
        hits.any_hit[p] = 1
    if output == OUTPUT_FACES:
        slot = reserve_slot(hits.total, meets)
        if meets:
            report_hit(slot, p, pair_poses[p].swapped, item[1], item[2], hits)


@wp.func
def list_apart_item(item: wp.vec3i, apart: bool, hits: Hits):
    """Put a face pair on the list of those that are apart where a gap is asked. For all threads of a warp."""
    if hits.gap.shape[0] > 0:
        append_row(apart, item, hits.apart_total, hits.apart)


@wp.func
def items_at_once(count: wp.int32, threads: wp.int32):
    """Return how many face pairs of a list a warp takes at a time: as many as it has threads, or fewer of a short list.

    Divergence serialises lanes within a warp, not across warps.
    """
    warps = threads / warp_size()
    return wp.clamp((count + warps - 1) / warps, 1, warp_size())


@wp.func
def resolve_list(
    mode: wp.int32,
    thread: wp.int32,
    threads: wp.int32,
    output: wp.int32,
    trees: Trees,
    batch: PairBatch,
    items: wp.array(dtype=wp.vec3i),
    end: wp.int32,
    hits: Hits,
):
    """Decide the face pairs of a list, in a grid-stride loop, and count and report hits. For all threads of a warp."""
    lane = resolve_lane()
    at_once = items_at_once(end, threads)
    first = at_once * (thread / warp_size())
    while first < end:
        waits = lane < wp.min(at_once, end - first)
        item, meet = wp.vec3i(), wp.int32(0)
        if waits:
            item = items[first + lane]
        p = item[0]
        if waits and not (output == OUTPUT_ANY and hits.any_hit[p] != 0):
            meet = test_faces(mode, trees, batch.poses[p], item[1], item[2])
        report_item(output, batch.poses, item, meet == 1, hits)
        list_apart_item(item, waits and meet == 0, hits)
        first += wp.min(at_once * (threads / warp_size()), end - first)


@wp.func
def defer_inexact(hits: Hits, inexact: bool, item: wp.vec3i):
    """Put a face pair on the list that `resolve_inexact_kernel` works off. For all threads of a warp."""
    count_flags(hits.exact_tests, item[0], inexact)
    append_row(inexact, item, hits.inexact_total, hits.inexact)


@wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=80)
def resolve_rounded_kernel(threads: wp.int32, output: wp.int32, trees: Trees, batch: PairBatch, hits_inout: Hits):
    """Decide the uncertain face pairs of FLOAT32 by rounded determinants, in a grid-stride loop."""
    end = wp.min(hits_inout.uncertain_total[0], hits_inout.uncertain.shape[0])
    resolve_list(FLOAT32, wp.tid(), threads, output, trees, batch, hits_inout.uncertain, end, hits_inout)


@wp.func
def item_plane_signs(trees: Trees, pose: PairPose, item: wp.vec3i):
    """Return the signs of `filter_planes` for a face pair."""
    a = load_corner_ids(trees.states, pose.corner_a + item[1])
    b = load_corner_ids(trees.states, pose.corner_b + item[2])
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    return filter_planes(a0, a1, a2, b0, b1, b2)


@wp.func
def intersect_straddling_item(trees: Trees, pose: PairPose, item: wp.vec3i, signs: wp.int32):
    """Return whether straddling faces meet, with the signs of `filter_planes`: 1, 0 or UNCERTAIN."""
    a = load_corner_ids(trees.states, pose.corner_a + item[1])
    b = load_corner_ids(trees.states, pose.corner_b + item[2])
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a, b)
    return filter_straddling(
        load_vertex(trees.models.vertex_pos, p1),
        load_vertex(trees.models.vertex_pos, q1),
        load_vertex(trees.models.vertex_pos, r1),
        pose_point(pose.rotation, pose.translation, load_vertex(trees.models.vertex_pos, p2)),
        pose_point(pose.rotation, pose.translation, load_vertex(trees.models.vertex_pos, q2)),
        pose_point(pose.rotation, pose.translation, load_vertex(trees.models.vertex_pos, r2)),
    )


@wp.func
def resolve_straddling(
    output: wp.int32,
    list: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    trees: Trees,
    pair_poses: wp.array(dtype=PairPose),
    hits: Hits,
):
    """Decide straddling pairs, one a lane, and report those that meet."""
    lane = resolve_lane()
    item = wp.vec3i()
    signs = read_signed_pair(list, first + wp.min(lane, popped - 1), item)
    p = item[0]
    meet = wp.int32(1)
    if signs != SHARED_CORNER:
        meet = intersect_straddling_item(trees, pair_poses[p], item, signs)
    list_apart_item(item, lane < popped and meet == 0, hits)
    meet = wp.where(lane < popped, meet, 0)
    warp_sync()
    report_item(output, pair_poses, item, meet == 1, hits)
    defer_inexact(hits, meet == UNCERTAIN, item)


@wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=96)
def float64_filter_kernel(threads: wp.int32, output: wp.int32, trees: Trees, batch: PairBatch, hits_inout: Hits):
    """Decide the uncertain face pairs, in a grid-stride loop, and list those that are inexact in float64.

    Planes first: they separate most pairs, and only straddling pairs take edges, when a warp of them waits.
    """
    lane = resolve_lane()
    list = signed_pairs()
    end = wp.min(hits_inout.uncertain_total[0], hits_inout.uncertain.shape[0])
    at_once = items_at_once(end, threads)
    first = at_once * (wp.tid() / warp_size())
    straddling = wp.int32(0)
    while first < end or straddling > 0:
        if first < end:
            item = hits_inout.uncertain[first + wp.min(lane, end - 1 - first)]
            signs = wp.int32(SEPARATED)
            waits = lane < wp.min(at_once, end - first)
            if waits and not (output == OUTPUT_ANY and hits_inout.any_hit[item[0]] != 0):
                signs = item_plane_signs(trees, batch.poses[item[0]], item)
            list_apart_item(item, waits and signs == SEPARATED, hits_inout)
            push_signed_pair(list, straddling, signs >= 0, item, signs)
            defer_inexact(hits_inout, signs == PLANES_UNDECIDED, item)
            warp_sync()
            first += wp.min(at_once * (threads / warp_size()), end - first)
        if straddling >= warp_size() or (first >= end and straddling > 0):
            popped = wp.min(straddling, warp_size())
            straddling -= popped
            resolve_straddling(output, list, straddling, popped, trees, batch.poses, hits_inout)


@wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=168)
def resolve_inexact_kernel(threads: wp.int32, output: wp.int32, trees: Trees, batch: PairBatch, hits_inout: Hits):
    """Decide the inexact face pairs by exact signs, in a grid-stride loop."""
    end = hits_inout.inexact_total[0]
    resolve_list(EXACT, wp.tid(), threads, output, trees, batch, hits_inout.inexact, end, hits_inout)
