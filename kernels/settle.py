"""The second pass, over the face pairs that float32 left open: few, so that exactness costs little."""

import functools

import warp as wp

from warp_abtree.kernels.faces import OUTPUT_ANY, OUTPUT_FACES, Hits, locate_pair, report_hit, settle_faces
from warp_abtree.kernels.pools import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.pose import PairPose

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


@functools.cache
def settle_traversal(mode: int):
    """Return the kernel that decides what `warp_traversal` left open, at a precision."""

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
        if output == OUTPUT_ANY and hits_inout.any_hit[p] != 0:
            return
        swapped, trees = locate_pair(models, states, objects, pairs[p])
        meet, hard = settle_faces(wp.static(mode), models, states, trees, pair_poses[p], item[1], item[2])
        if hard == 1:
            wp.atomic_add(hits_inout.exact_tests, p, wp.int64(1))
        if meet == 1:
            wp.atomic_add(hits_inout.count, p, wp.int64(1))
            hits_inout.any_hit[p] = 1
            if output == OUTPUT_FACES:
                slot = wp.atomic_add(hits_inout.total, 0, 1)
                report_hit(slot, p, swapped, item[1], item[2], hits_inout)

    return settle_faces_kernel
