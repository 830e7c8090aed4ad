"""The passes over face pairs that float32 left open: float64 for all of them, exact signs for the few that it leaves.

Each pass works off a list of its own, so that the threads of a warp do much the same. A block is a warp: neighbours on
a list are of the same few object pairs, and count for them together.
"""

import functools

import warp as wp

from warp_abtree.kernels.faces import OUTPUT_ANY, OUTPUT_FACES, Hits, report_hit, test_faces
from warp_abtree.kernels.pools import ModelPool, StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.predicates import EXACT, FILTER, UNSURE
from warp_abtree.kernels.warps import count_flags, reserve_slot, warp_lane

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


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
    """Decide a face pair if it waits, count and report a hit; return 1, 0 or UNSURE. For all threads of a warp."""
    p = item[0]
    meet = wp.int32(0)
    if waits and not (output == OUTPUT_ANY and hits.any_hit[p] != 0):
        meet = test_faces(mode, models, states, pair_poses[p], item[1], item[2])
    count_flags(hits.count, p, meet == 1)
    if meet == 1:
        hits.any_hit[p] = 1
    if output == OUTPUT_FACES:
        slot = reserve_slot(hits.total, meet == 1)
        if meet == 1:
            report_hit(slot, p, pair_poses[p].swapped, item[1], item[2], hits)
    return meet


@functools.cache
def settle_traversal(mode: int):
    """Return the kernel that decides what `warp_traversal` left open in float64; FILTER lists what that leaves."""

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
        end = wp.min(hits_inout.unsure_total[0], hits_inout.unsure.shape[0])
        first = wp.tid() - warp_lane()
        while first < end:
            waits = first + warp_lane() < end
            item = wp.vec3i()
            if waits:
                item = hits_inout.unsure[first + warp_lane()]
            meet = settle_item(wp.static(mode), output, models, states, pair_poses, waits, item, hits_inout)
            if wp.static(mode == int(FILTER)):
                hard = meet == UNSURE
                count_flags(hits_inout.exact_tests, item[0], hard)
                slot = reserve_slot(hits_inout.hard_total, hard)
                if hard:
                    hits_inout.hard[slot] = item
            first += threads

    return settle_faces_kernel


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
    first = wp.tid() - warp_lane()
    while first < hits_inout.hard_total[0]:
        waits = first + warp_lane() < hits_inout.hard_total[0]
        item = wp.vec3i()
        if waits:
            item = hits_inout.hard[first + warp_lane()]
        settle_item(EXACT, output, models, states, pair_poses, waits, item, hits_inout)
        first += threads
