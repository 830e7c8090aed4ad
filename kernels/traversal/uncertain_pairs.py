"""The passes over face pairs that float32 left open: float64 for all of them, exact signs for the few that it leaves.

Each pass works off a list of its own, so that the threads of a warp do much the same. A block is a warp: neighbours on
a list are of the same few object pairs, and count for them together.
"""

import functools

import warp as wp

from warp_abtree.kernels.arithmetic.predicates import EXACT, UNSURE
from warp_abtree.kernels.arrays import ModelPool, StatePool, load_vertex
from warp_abtree.kernels.poses import PairPose, pose_point
from warp_abtree.kernels.traversal.face_pairs import (
    OUTPUT_ANY,
    OUTPUT_FACES,
    Hits,
    load_corner_ids,
    report_hit,
    test_faces,
)
from warp_abtree.kernels.traversal.warp_stack import (
    count_flags,
    keep_item,
    read_kept,
    reserve_slot,
    warp_kept,
    warp_lane,
    warp_size,
    warp_sync,
)
from warp_abtree.kernels.triangle.float32_filter import PARTED, turn_corners
from warp_abtree.kernels.triangle.float64_filter import JOINED, UNDECIDED, filter_crossing, filter_planes

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
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
def settle_item(
    mode: wp.int32,
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    waits: bool,
    item: wp.vec3i,
    hits: Hits,
):
    """Decide a face pair if it waits, count and report a hit. For all threads of a warp."""
    p = item[0]
    meet = wp.int32(0)
    if waits and not (output == OUTPUT_ANY and hits.any_hit[p] != 0):
        meet = test_faces(mode, models, states, pair_poses[p], item[1], item[2])
    report_item(output, pair_poses, item, meet == 1, hits)


@wp.func
def items_at_once(count: wp.int32, threads: wp.int32):
    """Return how many face pairs of a list a warp takes at a time: as many as it has threads, or fewer of a short list.

    Threads that go different ways wait for one another, those of different warps do not.
    """
    warps = threads / warp_size()
    return wp.clamp((count + warps - 1) / warps, 1, warp_size())


@wp.func
def defer_hard(hits: Hits, hard: bool, item: wp.vec3i):
    """Put a face pair on the list that `settle_hard_kernel` works off. For all threads of a warp."""
    count_flags(hits.exact_tests, item[0], hard)
    slot = reserve_slot(hits.hard_total, hard)
    if hard:
        hits.hard[slot] = item


@functools.cache
def settle_traversal(mode: int):
    """Return the kernel that decides what `warp_traversal` left open by rounded determinants, FLOAT64 or FLOAT32."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=80)
    def settle_faces_kernel(
        threads: wp.int32,
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
    ):
        """Decide the face pairs on the list of those left open: every so many-th a thread."""
        lane = warp_lane()
        end = wp.min(hits_inout.unsure_total[0], hits_inout.unsure.shape[0])
        at_once = items_at_once(end, threads)
        first = at_once * (wp.tid() / warp_size())
        while first < end:
            waits = lane < wp.min(at_once, end - first)
            item = wp.vec3i()
            if waits:
                item = hits_inout.unsure[first + lane]
            settle_item(wp.static(mode), output, models, states, pair_poses, waits, item, hits_inout)
            first += wp.min(at_once * (threads / warp_size()), end - first)

    return settle_faces_kernel


@wp.func
def part_item(models: ModelPool, states: StatePool, pose: PairPose, item: wp.vec3i):
    """Return what `filter_planes` says of a face pair."""
    a = load_corner_ids(states, pose.corner_a + item[1])
    b = load_corner_ids(states, pose.corner_b + item[2])
    return filter_planes(
        load_vertex(models.vertex_pos, a[0]),
        load_vertex(models.vertex_pos, a[1]),
        load_vertex(models.vertex_pos, a[2]),
        pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, b[0])),
        pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, b[1])),
        pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, b[2])),
    )


@wp.func
def cross_item(models: ModelPool, states: StatePool, pose: PairPose, item: wp.vec3i, signs: wp.int32):
    """Return whether faces meet that no plane parts, with the signs of `filter_planes`: 1, 0 or UNSURE."""
    a = load_corner_ids(states, pose.corner_a + item[1])
    b = load_corner_ids(states, pose.corner_b + item[2])
    p1, q1, r1, p2, q2, r2 = turn_corners(signs, a[0], a[1], a[2], b[0], b[1], b[2])
    return filter_crossing(
        load_vertex(models.vertex_pos, p1),
        load_vertex(models.vertex_pos, q1),
        load_vertex(models.vertex_pos, r1),
        pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, p2)),
        pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, q2)),
        pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, r2)),
    )


@wp.func
def settle_crossing(
    output: wp.int32,
    kept: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    models: ModelPool,
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    hits: Hits,
):
    """Decide face pairs that no plane parts, one a thread, and report those that meet."""
    lane = warp_lane()
    waiting = read_kept(kept, first + wp.min(lane, popped - 1))
    item = wp.vec3i(waiting[0], waiting[1], waiting[2])
    p = item[0]
    meet = wp.int32(1)
    if waiting[3] != JOINED:
        meet = cross_item(models, states, pair_poses[p], item, waiting[3])
    meet = wp.where(lane < popped, meet, 0)
    warp_sync()
    report_item(output, pair_poses, item, meet == 1, hits)
    defer_hard(hits, meet == UNSURE, item)


@wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=96)
def filter_faces_kernel(
    threads: wp.int32,
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    hits_inout: Hits,
):
    """Decide the face pairs on the list of those left open, every so many-th a thread, and list what float64 leaves.

    Planes first: most pairs are parted, and only those that are left take edges, when a warp of them waits.
    """
    lane = warp_lane()
    kept = warp_kept()
    end = wp.min(hits_inout.unsure_total[0], hits_inout.unsure.shape[0])
    at_once = items_at_once(end, threads)
    first = at_once * (wp.tid() / warp_size())
    crossing = wp.int32(0)
    while first < end or crossing > 0:
        if first < end:
            item = hits_inout.unsure[first + wp.min(lane, end - 1 - first)]
            signs = wp.int32(PARTED)
            waits = lane < wp.min(at_once, end - first)
            if waits and not (output == OUTPUT_ANY and hits_inout.any_hit[item[0]] != 0):
                signs = part_item(models, states, pair_poses[item[0]], item)
            crossing = keep_item(kept, crossing, signs >= 0, item, signs)
            defer_hard(hits_inout, signs == UNDECIDED, item)
            warp_sync()
            first += wp.min(at_once * (threads / warp_size()), end - first)
        if crossing >= warp_size() or (first >= end and crossing > 0):
            popped = wp.min(crossing, warp_size())
            crossing -= popped
            settle_crossing(output, kept, crossing, popped, models, states, pair_poses, hits_inout)


@wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=168)
def settle_hard_kernel(
    threads: wp.int32,
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    hits_inout: Hits,
):
    """Decide the face pairs that float64 left open by exact signs: every so many-th a thread."""
    lane = warp_lane()
    end = hits_inout.hard_total[0]
    at_once = items_at_once(end, threads)
    first = at_once * (wp.tid() / warp_size())
    while first < end:
        waits = lane < wp.min(at_once, end - first)
        item = wp.vec3i()
        if waits:
            item = hits_inout.hard[first + lane]
        settle_item(EXACT, output, models, states, pair_poses, waits, item, hits_inout)
        first += wp.min(at_once * (threads / warp_size()), end - first)
