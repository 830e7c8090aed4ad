"""Branch and bound for the first contact of two trees: depth first, the earliest children first.

Each node pair carries the time up to which it is proved apart, made of its own boxes and those above it alone, and is
dropped if that is after the best time so far. So the earliest time is found whatever the order, on every device. A
thread of the CPU takes one object pair after the other; warps search as in `group`.
"""

from functools import cache

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.motion.group import Group, motion_policy
from warp_abtree.kernels.motion.linear import EndPoses
from warp_abtree.kernels.motion.start import OPEN, FirstContacts
from warp_abtree.kernels.search.best_first import best_first, start_lists
from warp_abtree.kernels.search.item import first_item
from warp_abtree.kernels.search.load_balance import take_thread, take_unit
from warp_abtree.kernels.search.nearest_stack import write_bounded
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, STRADDLING_START

MODULE_OPTIONS = native.options(
    "base/lanes.cuh",
    "exact/apart_until.cuh",
    "exact/determinant.cuh",
    "search/load_balance.cuh",
    "search/motion_stack.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)

# Words of 8 bytes of the lists of a thread of the CPU.
LIST_WORDS = int(STRADDLING_START) + int(STRADDLING_START) // 2


@native.func_native()
def thread_lists(memory: wp.array2d(dtype=wp.int64), thread: wp.int32) -> wp.uint64:
    """Return the address of a CPU thread's lists."""


@cache
def thread_motion_search(kind):
    """Return the kernel of the CPU's threads for motions of a kind."""
    policy = motion_policy(kind, True)
    search_pair, given_type = best_first(policy), policy.given

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def search_thread_kernel(
        tolerance: wp.float64,
        trees: Trees,
        poses: EndPoses,
        batch: PairBatch,
        motion: wp.array(dtype=kind),
        hits_inout: Hits,
        contacts_inout: FirstContacts,
        memory_out: wp.array2d(dtype=wp.int64),
    ):
        """Take one object pair after the other that is open, and search it; CPU only."""
        if batch.launched[0] == STALE:
            return
        count = wp.min(batch.count[0], batch.poses.shape[0])
        thread = take_thread(contacts_inout.counter)
        if thread >= memory_out.shape[0]:
            return
        given = given_type()
        given.tolerance = tolerance
        given.batch = batch
        given.poses = poses
        given.motion = motion
        lists = start_lists(thread_lists(memory_out, thread), STACK_LENGTH)
        p = take_unit(contacts_inout.counter)
        while p < count:
            if contacts_inout.end[p] == OPEN:
                group = Group()
                group.first = p
                group.time[0] = wp.float64(1.0)
                write_bounded(
                    lists.items, 0, first_item(trees.states, batch.poses[p]), wp.float32(contacts_inout.time[p]), 0
                )
                lists.end = 1
                search_pair(trees, given, group, lists)
                contacts_inout.time[p] = group.time[0]
                contacts_inout.end[p] = group.end[0]
                hits_inout.node_tests[p] += wp.int64(group.nodes[0])
                hits_inout.triangle_tests[p] += wp.int64(group.faces[0])
            p = take_unit(contacts_inout.counter)

    return search_thread_kernel
