"""The search of two trees for their first contact: depth first, the earliest children first.

Each node pair carries the time up to which it is proved apart, made of its own boxes and those above it alone, and is
dropped if that is after the best time so far. So the earliest time is found whatever the order, on every device. A warp
takes an object pair on CUDA; a thread of the CPU takes one after the other.
"""

from functools import cache
from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.distance.search import (
    DEPTH_FIRST_ROOM,
    nearest_stack,
    push_nearest,
    read_bound,
    warp_min,
    write_bound,
)
from warp_abtree.kernels.generation import STALE
from warp_abtree.kernels.motion.face_pair import (
    CLEAR,
    TO_THE_END,
    TOUCHES,
    UNDECIDED,
    Contact,
    Progress,
)
from warp_abtree.kernels.motion.kinds import advance_faces, advance_nodes, proves_clear, slide_floor, slides_past
from warp_abtree.kernels.motion.linear import EndPoses
from warp_abtree.kernels.motion.path import Motion
from warp_abtree.kernels.motion.start import OPEN, Contacts
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.face_pairs import Hits
from warp_abtree.kernels.traversal.load_balance import take_unit
from warp_abtree.kernels.traversal.node_pair import first_item, four_items, item_first, item_second
from warp_abtree.kernels.traversal.simd import take_thread
from warp_abtree.kernels.traversal.warp_stack import (
    STACK_LENGTH,
    STRADDLING_START,
    read_item,
    warp_any,
    warp_lane,
    warp_size,
    warp_sync,
    write_item,
)

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# Words of 8 bytes of the lists of a thread of the CPU.
LIST_WORDS = int(STRADDLING_START) + int(STRADDLING_START) // 2


@wp.func_native(native.body("nearest_stack.cuh", "thread_lists"))
def thread_lists(memory: wp.array2d(dtype=wp.int64), thread: wp.int32) -> wp.uint64:
    """Return where the lists of a thread of the CPU lie."""


@wp.func
def meet_faces(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    tolerance: wp.float64,
    models: ModelPool,
    states: StatePool,
    poses: EndPoses,
    pose: PairPose,
    motion: Any,
    before: Contact,
):
    """Advance the face pairs first to first + popped, one a lane; return the earliest, and how many this lane took."""
    at = STACK_LENGTH + first + wp.min(warp_lane(), popped - 1)
    item, start = read_item(items, at), wp.float64(read_bound(items, at))
    live = warp_lane() < popped and start <= before.time
    warp_sync()
    own = Contact()
    if live:
        faces = wp.vec2i(item_first(item), item_second(item))
        progress = Progress()
        progress.time = start
        progress.mode = TO_THE_END
        own, _ = advance_faces(tolerance, models, states, poses, pose, motion, faces, progress, before.time)
    time = wp.where(own.end == CLEAR, wp.float64(wp.inf), own.time)
    best = before
    earliest = warp_min(time)
    if earliest < best.time or (earliest == best.time and best.end != TOUCHES):
        # A pair that is undecided at the same time does not matter.
        touches = warp_any(time == earliest and own.end == TOUCHES)
        best.time = earliest
        best.end = wp.where(touches, TOUCHES, UNDECIDED)
    return best, wp.where(live, 1, 0)


@wp.func
def search_contact(
    items: wp.uint64,
    room: wp.int32,
    tolerance: wp.float64,
    models: ModelPool,
    states: StatePool,
    poses: EndPoses,
    pose: PairPose,
    motions: Any,
    p: wp.int32,
    start: wp.float64,
):
    """Return the first contact of an object pair that is apart until a start, and what this lane compared."""
    best = Contact()
    best.time = wp.float64(1.0)
    best.end = CLEAR
    if warp_lane() == 0:
        write_item(items, 0, first_item(states, pose))
        write_bound(items, 0, wp.float32(start))
    warp_sync()
    end, waiting = wp.int32(1), wp.int32(0)
    tests, floor = wp.vec2i(), slide_floor(pose, motions[p])
    while end > 0 or waiting > 0:
        if end > 0 and waiting < warp_size():
            # One at a time, depth first, needs little room; more where there is.
            popped = wp.max(1, (room - DEPTH_FIRST_ROOM - end) >> 2)
            popped = wp.min(popped, wp.min(warp_size(), end))
            end -= popped
            at = end + wp.min(warp_lane(), popped - 1)
            item, t = read_item(items, at), read_bound(items, at)
            live = wp.where(warp_lane() < popped and wp.float64(t) <= best.time, -1, 0)
            if live < 0 and slides_past(floor, models, states, pose, motions[p], t, item):
                live = 0
            warp_sync()
            children, kinds, times, compared = four_items(), wp.vec4i(), wp.vec4(), wp.int32(0)
            if warp_any(live < 0):
                children, kinds, times, compared = advance_nodes(states, pose, motions[p], t, best.time, item, live)
            ends = push_nearest(items, end, waiting, kinds, children, times)
            warp_sync()
            end = item_second(ends)
            waiting = item_first(ends)
            tests[0] += compared
        # The first face pairs are advanced at once: until then, little is dropped.
        if waiting >= warp_size() or (waiting > 0 and (end == 0 or best.end == CLEAR)):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            best, advanced = meet_faces(
                items, waiting, popped, tolerance, models, states, poses, pose, motions[p], best
            )
            tests[1] += advanced
    return best, tests


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def profile_warp_kernel(
    models: ModelPool,
    states: StatePool,
    pair_count: wp.array(dtype=wp.int32),
    pair_poses: wp.array(dtype=PairPose),
    motion: wp.array(dtype=Motion),
    contacts_inout: Contacts,
):
    """Decide the object pairs that `profile` proves apart, a warp a pair; within `warp_search` it would spill."""
    p = wp.tid() / warp_size()
    if p >= pair_count[0] or contacts_inout.launched[0] == STALE:
        return
    if contacts_inout.end[p] != OPEN:
        return
    if proves_clear(nearest_stack(), models, states, pair_poses[p], motion[p]):
        # All lanes have read what the first one writes.
        warp_sync()
        if warp_lane() == 0:
            contacts_inout.time[p] = wp.float64(1.0)
            contacts_inout.end[p] = CLEAR


@cache
def thread_search(kind):
    """Return the kernel of the CPU's threads for motions of a kind."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def search_thread_kernel(
        # static
        room: wp.int32,
        tolerance: wp.float64,
        models: ModelPool,
        # state
        states: StatePool,
        poses: EndPoses,
        pair_count: wp.array(dtype=wp.int32),
        pair_poses: wp.array(dtype=PairPose),
        motion: wp.array(dtype=kind),
        # out
        hits_inout: Hits,
        contacts_inout: Contacts,
        memory_out: wp.array2d(dtype=wp.int64),
    ):
        """Take one object pair after the other that is open, and search it; CPU only."""
        if contacts_inout.launched[0] == STALE:
            return
        count = wp.min(pair_count[0], pair_poses.shape[0])
        thread = take_thread(contacts_inout.counter)
        if thread >= memory_out.shape[0]:
            return
        items = thread_lists(memory_out, thread)
        p = take_unit(contacts_inout.counter)
        while p < count:
            if contacts_inout.end[p] == OPEN and proves_clear(items, models, states, pair_poses[p], motion[p]):
                contacts_inout.time[p] = wp.float64(1.0)
                contacts_inout.end[p] = CLEAR
            if contacts_inout.end[p] == OPEN:
                pose, start = pair_poses[p], contacts_inout.time[p]
                contact, tests = search_contact(items, room, tolerance, models, states, poses, pose, motion, p, start)
                contacts_inout.time[p] = contact.time
                contacts_inout.end[p] = contact.end
                hits_inout.node_tests[p] += wp.int64(tests[0])
                hits_inout.triangle_tests[p] += wp.int64(tests[1])
            p = take_unit(contacts_inout.counter)

    return search_thread_kernel
