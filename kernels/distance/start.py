"""The first launch of a search by warps: what each object pair starts from, and whose slabs are due."""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.distance.frame import Found, start_pair
from warp_abtree.kernels.distance.slabs import Slabs, count_uses
from warp_abtree.kernels.generation import STALE
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.load_balance import NO_UNIT, Work

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def start_distance_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    slabs_inout: Slabs,
    found_inout: Found,
    work_out: Work,
):
    """Prepare an object pair a thread, see `start_pair`.

    A unit of work is an object pair; a stale launch is left none.
    """
    p = wp.tid()
    if p < work_out.flag.shape[0]:
        work_out.flag[p] = 0
    if p == 0:
        stale = found_inout.launched[0] == STALE
        work_out.counter[0] = 0
        work_out.counter[1] = 0
        work_out.counter[2] = wp.where(stale, 0, wp.min(pair_count[0], pairs.shape[0]))
        work_out.counter[3] = wp.where(stale, NO_UNIT, 0)
    if p >= wp.min(pair_count[0], pairs.shape[0]) or found_inout.launched[0] == STALE:
        return
    count_uses(p, models, states, objects, pairs, slabs_inout)
    start_pair(p, models, states, objects, pairs, pair_poses, found_inout)
