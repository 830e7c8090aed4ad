"""Branch and bound for the first contact of two trees: depth first, the earliest children first.

Each node pair carries the time up to which it is proved apart, made of its own boxes and those above it alone, and is
dropped if that is after the best time so far. So the earliest time is found whatever the order, on every device. A
thread of the CPU takes one object pair after the other; warps search as in `group`.
"""

from functools import cache
from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.intersect.face_pairs import Hits, PairTests
from warp_abtree.kernels.motion.face_pair import CLEAR, TO_THE_END, TOUCHES, FirstContact, PairProgress
from warp_abtree.kernels.motion.kinds import advance_faces, advance_nodes
from warp_abtree.kernels.motion.linear import EndPoses
from warp_abtree.kernels.motion.start import OPEN, FirstContacts
from warp_abtree.kernels.search.item import first_item, item_first, item_second
from warp_abtree.kernels.search.load_balance import take_thread, take_unit
from warp_abtree.kernels.search.nearest_stack import push_nearest, read_bound, write_bound
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, STRADDLING_START, read_item, write_item

MODULE_OPTIONS = native.options(
    "exact/apart_until.cuh", "exact/determinant.cuh", "search/load_balance.cuh", "search/nearest_stack.cuh"
)
wp.set_module_options(MODULE_OPTIONS)

# Words of 8 bytes of the lists of a thread of the CPU.
LIST_WORDS = int(STRADDLING_START) + int(STRADDLING_START) // 2


@native.func_native()
def thread_lists(memory: wp.array2d(dtype=wp.int64), thread: wp.int32) -> wp.uint64:
    """Return the address of a CPU thread's lists."""


@wp.func
def advance_face_pair(
    items: wp.uint64,
    i: wp.int32,
    tolerance: wp.float64,
    trees: Trees,
    poses: EndPoses,
    pose: PairPose,
    motion: Any,
    before: FirstContact,
):
    """Advance the i-th face pair; return the earliest contact so far, and how many pairs were compared."""
    best = before
    progress = PairProgress()
    progress.time = wp.float64(read_bound(items, STACK_LENGTH + i))
    progress.mode = TO_THE_END
    if progress.time > best.time:
        return best, 0
    item = read_item(items, STACK_LENGTH + i)
    faces = wp.vec2i(item_first(item), item_second(item))
    own, _ = advance_faces(tolerance, trees, poses, pose, motion, faces, progress, best.time)
    if own.end != CLEAR and (own.time < best.time or (own.time == best.time and best.end != TOUCHES)):
        # A pair that is undecided at the same time does not matter.
        best = own
    return best, 1


@wp.func
def search_contact(
    items: wp.uint64,
    tolerance: wp.float64,
    trees: Trees,
    poses: EndPoses,
    pose: PairPose,
    motions: Any,
    p: wp.int32,
    start: wp.float64,
):
    """Return the first contact of an object pair that is apart until a start, and how many pairs were compared."""
    best = FirstContact()
    best.time = wp.float64(1.0)
    best.end = CLEAR
    write_item(items, 0, first_item(trees.states, pose))
    write_bound(items, 0, wp.float32(start))
    end, waiting = wp.int32(1), wp.int32(0)
    tests = PairTests()
    while end > 0 or waiting > 0:
        if waiting > 0:
            waiting -= 1
            best, advanced = advance_face_pair(items, waiting, tolerance, trees, poses, pose, motions[p], best)
            tests.faces += advanced
        else:
            end -= 1
            item, t = read_item(items, end), read_bound(items, end)
            if wp.float64(t) <= best.time:
                emitted = advance_nodes(trees.states, pose, motions[p], t, best.time, item, -1)
                push_nearest(items, end, waiting, emitted.kinds, emitted.items, emitted.bounds)
                tests.nodes += emitted.tests
    return best, tests


@cache
def thread_motion_search(kind):
    """Return the kernel of the CPU's threads for motions of a kind."""

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
        items = thread_lists(memory_out, thread)
        p = take_unit(contacts_inout.counter)
        while p < count:
            if contacts_inout.end[p] == OPEN:
                pose, start = batch.poses[p], contacts_inout.time[p]
                contact, tests = search_contact(items, tolerance, trees, poses, pose, motion, p, start)
                contacts_inout.time[p] = contact.time
                contacts_inout.end[p] = contact.end
                hits_inout.node_tests[p] += wp.int64(tests.nodes)
                hits_inout.triangle_tests[p] += wp.int64(tests.faces)
            p = take_unit(contacts_inout.counter)

    return search_thread_kernel
