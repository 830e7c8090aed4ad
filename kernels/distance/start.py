"""The first launch of a search by warps: what each object pair starts from, and whose slabs are due."""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.distance.frame import Found, start_pair
from warp_abtree.kernels.distance.slabs import Slabs, count_uses
from warp_abtree.kernels.generation import STALE
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.load_balance import NO_UNIT, Work

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


# Pairs, or depth of both trees, from which on slabs make a search shorter; else it takes as many steps, longer ones.
PAIRS_LEAST, DEPTH_LEAST = wp.constant(24), wp.constant(36)


@wp.func
def wants_slabs(count: wp.int32, models: ModelPool, states: StatePool, a: wp.int32, b: wp.int32):
    """Return whether a search by warps is shorter with slabs: many warps that share few pairs have the time anyway.

    Args:
        a, b: Tree states of the object pair.
    """
    return count >= PAIRS_LEAST or models.depth[states.model[a]] + models.depth[states.model[b]] >= DEPTH_LEAST


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
    a, b = objects.state[pairs[p][0]], objects.state[pairs[p][1]]
    if wants_slabs(pair_count[0], models, states, a, b):
        count_uses(p, models, states, objects, pairs, slabs_inout)
    else:
        slabs_inout.states[p] = wp.vec2i(-1, -1)
    start_pair(p, models, states, objects, pairs, pair_poses, found_inout)
