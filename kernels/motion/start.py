"""The start of a search for first contacts: each pair's motion, what is known at once, and steps of both roots."""

from functools import cache
from typing import Any

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.distance.node_pair import DROPPED
from warp_abtree.kernels.generation import STALE
from warp_abtree.kernels.motion.face_pair import CLEAR, TOUCHES, UNDECIDED
from warp_abtree.kernels.motion.kinds import advance_nodes, has_way, make_motion
from warp_abtree.kernels.motion.path import Paths
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.face_pairs import Hits
from warp_abtree.kernels.traversal.node_pair import first_item

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# Beside the ends of face pairs: to be searched from `time` on; of an object without a shortest turn.
OPEN, HALF_TURN = wp.constant(3), wp.constant(4)
ROOT_STEPS = wp.constant(16)


@wp.struct
class Contacts:
    """Answers, an entry an object pair."""

    time: wp.array(dtype=wp.float64)  # of first contact, 1 where clear
    end: wp.array(dtype=wp.int32)  # CLEAR, TOUCHES, UNDECIDED, OPEN or HALF_TURN
    counter: wp.array(dtype=wp.int32)  # of threads and object pairs that are taken, as `load_balance` counts
    launched: wp.array(dtype=wp.int32)  # STALE where nothing is to be done, see `generation.LaunchRecord`


@wp.struct
class Ways:
    """Where objects go."""

    paths: Paths  # the way of each
    ends: ObjectPool  # their poses at the end


@wp.func
def advance_roots(states: StatePool, pose: PairPose, motion: Any):
    """Return a time until which two roots stay apart, as the search finds it, and whether that is all the way."""
    t = wp.float32(0.0)
    item = first_item(states, pose)
    tests = wp.int32(0)
    while tests < ROOT_STEPS:
        items, kinds, times, _ = advance_nodes(states, pose, motion, t, wp.float64(1.0), item, -1)
        tests += 1
        if kinds[0] == DROPPED:
            return t, True, tests
        if items[0] != item:
            return t, False, tests
        t = times[0]
    return t, False, tests


@cache
def contact_starter(kind):
    """Return the kernel that prepares object pairs for motions of a kind: `path.Motion` or `linear.LinearMotion`."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def start_contact_kernel(
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        ways: Ways,
        pair_count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
        contacts_inout: Contacts,
        motion_out: wp.array(dtype=kind),
    ):
        """Prepare an object pair a thread: decide what intersects at first, and what the root boxes prove clear."""
        p = wp.tid()
        if p == 0:
            contacts_inout.counter[1] = 0
            contacts_inout.counter[3] = 0
        if p >= pair_count[0] or contacts_inout.launched[0] == STALE:
            return
        pair = wp.vec2i(wp.min(pairs[p][0], pairs[p][1]), wp.max(pairs[p][0], pairs[p][1]))
        contacts_inout.time[p] = wp.float64(0.0)
        if hits_inout.any_hit[p] != 0:
            contacts_inout.end[p] = TOUCHES
            return
        motion = kind()
        if not has_way(motion, ways.paths, pair):
            contacts_inout.end[p] = HALF_TURN
            return
        motion = make_motion(motion, ways.paths, ways.ends, models, states, objects, pair_poses[p], pair)
        if not (motion.slack < wp.float64(wp.inf)):
            # Beyond float64, or no numbers: nothing could be proved.
            contacts_inout.end[p] = UNDECIDED
            return
        t, clear, tests = advance_roots(states, pair_poses[p], motion)
        hits_inout.node_tests[p] += wp.int64(tests)
        contacts_inout.time[p] = wp.where(clear, wp.float64(1.0), wp.float64(t))
        contacts_inout.end[p] = wp.where(clear, CLEAR, OPEN)
        motion_out[p] = motion

    return start_contact_kernel
