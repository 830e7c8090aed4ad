"""The passes over face pairs that float32 left open: float64 for all of them, exact signs for the few that it leaves.

Each pass works off a list of its own, so that the threads of a warp do much the same.
"""

import functools

import warp as wp

from warp_abtree.kernels.faces import OUTPUT_ANY, OUTPUT_FACES, Hits, locate_pair, report_hit, test_faces
from warp_abtree.kernels.pools import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.predicates import EXACT, UNSURE

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


@wp.func
def is_settled(output: wp.int32, hits: Hits, pair: wp.int32):
    return output == OUTPUT_ANY and hits.any_hit[pair] != 0


@wp.func
def settle_hit(output: wp.int32, item: wp.vec3i, swapped: wp.int32, hits: Hits):
    """Count a face pair that meets, and report it where that is asked."""
    wp.atomic_add(hits.count, item[0], wp.int64(1))
    hits.any_hit[item[0]] = 1
    if output == OUTPUT_FACES:
        slot = wp.atomic_add(hits.total, 0, 1)
        report_hit(slot, item[0], swapped, item[1], item[2], hits)


@functools.cache
def settle_traversal(mode: int):
    """Return the kernel that decides what `warp_traversal` left open in float64; FILTER lists what that leaves."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def settle_faces_kernel(
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        pairs: wp.array(dtype=wp.vec2i),
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
    ):
        """Decide the face pairs on the list of those left open, one a thread."""
        tid = wp.tid()
        if tid >= wp.min(hits_inout.unsure_total[0], hits_inout.unsure.shape[0]):
            return
        item = hits_inout.unsure[tid]
        p = item[0]
        if is_settled(output, hits_inout, p):
            return
        swapped, trees = locate_pair(models, states, objects, pairs[p])
        meet = test_faces(wp.static(mode), models, states, trees, pair_poses[p], item[1], item[2])
        if meet == UNSURE:
            wp.atomic_add(hits_inout.exact_tests, p, wp.int64(1))
            slot = wp.atomic_add(hits_inout.hard_total, 0, 1)
            hits_inout.hard[slot] = item
        if meet == 1:
            settle_hit(output, item, swapped, hits_inout)

    return settle_faces_kernel


@wp.kernel
def settle_hard_kernel(
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    hits_inout: Hits,
):
    """Decide the face pairs that float64 left open, one a thread, by exact signs."""
    tid = wp.tid()
    if tid >= hits_inout.hard_total[0]:
        return
    item = hits_inout.hard[tid]
    p = item[0]
    if is_settled(output, hits_inout, p):
        return
    swapped, trees = locate_pair(models, states, objects, pairs[p])
    if test_faces(EXACT, models, states, trees, pair_poses[p], item[1], item[2]) == 1:
        settle_hit(output, item, swapped, hits_inout)
