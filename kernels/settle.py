"""The second pass, over the face pairs that the filter left open: few, so that exactness costs little."""

import warp as wp

from warp_abtree.kernels.pools import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.predicates import EXACT
from warp_abtree.kernels.traverse import OUTPUT_ANY, Hits, locate_pair, report_hit, test_faces

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def settle_unsure_kernel(
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    hits_inout: Hits,
):
    """Decide the face pairs that the filter left open, one a thread, with exact signs."""
    tid = wp.tid()
    if tid >= wp.min(hits_inout.unsure_total[0], hits_inout.unsure.shape[0]):
        return
    item = hits_inout.unsure[tid]
    p = item[0]
    if output == OUTPUT_ANY and hits_inout.any_hit[p] != 0:
        return
    swapped, trees = locate_pair(models, states, objects, pairs[p])
    if test_faces(EXACT, models, states, trees, pair_poses[p], item[1], item[2]) == 1:
        wp.atomic_add(hits_inout.count, p, wp.int64(1))
        report_hit(output, p, swapped, item[1], item[2], hits_inout)
