"""Branch and bound for first contacts by warps: node and face pairs of a few object pairs at once fill the lanes.

As `search`, whose answers it has. A face pair is advanced by normals first, which decide most; what is left goes on
step by step, each with 31 others, since a step takes as long as its slowest lane, and the others are ten times as long.
"""

from functools import cache
from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.counters import add_warp_sum
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.lanes import next_place, warp_any, warp_lane, warp_min, warp_size, warp_sync
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.motion.face_pair import (
    CLEAR,
    IN_PROGRESS,
    NORMALS,
    ONE_STEP,
    TOUCHES,
    UNDECIDED,
    FirstContact,
    PairProgress,
)
from warp_abtree.kernels.motion.kinds import advance_faces, advance_nodes
from warp_abtree.kernels.motion.linear import EndPoses
from warp_abtree.kernels.motion.start import OPEN, FirstContacts
from warp_abtree.kernels.search.item import FACES, NODES, Emitted, first_item, four_items, item_first, item_second
from warp_abtree.kernels.search.load_balance import DEPTH_FIRST_ROOM
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, read_item

MODULE_OPTIONS = native.options(
    "base/counters.cuh", "base/lanes.cuh", "exact/apart_until.cuh", "exact/determinant.cuh", "search/motion_stack.cuh"
)
wp.set_module_options(MODULE_OPTIONS)

GROUP = native.constant("MOTION_GROUP")
# Object pairs from which on a warp takes a group: fewer leave multiprocessors idle.
GROUPED_LEAST = wp.constant(8192)
MOTION_STACK_LENGTH = native.constant("MOTION_STACK_LENGTH")
GOING_START, TIMES_START = native.constant("MOTION_GOING_START"), native.constant("MOTION_TIMES_START")


@native.func_native()
def motion_stack() -> wp.uint64:
    """Return the address of this warp's lists, in shared memory on CUDA."""


@native.func_native()
def read_tag(items: wp.uint64, i: wp.int32) -> wp.float32:
    """Return the time until which the i-th pair is apart, or the number of steps of a face pair in progress."""


@native.func_native()
def read_slot(items: wp.uint64, i: wp.int32) -> wp.int32: ...


@native.func_native()
def write_entry(items: wp.uint64, i: wp.int32, item: wp.int64, tag: wp.float32, slot: wp.int32): ...


@native.func_native()
def write_time(items: wp.uint64, i: wp.int32, time: wp.float64):
    """Write the time of the i-th face pair that goes on."""


@wp.struct
class Group:
    """Object pairs that a warp searches, a slot each."""

    first: wp.int32  # the number of the first
    time: wp.vec4d  # of the first contact so far
    end: wp.vec4i  # CLEAR, TOUCHES or UNDECIDED
    nodes: wp.vec4i  # node pairs that this lane has compared
    faces: wp.vec4i  # face pairs that it has taken up


@wp.func
def time_of(group: Group, slot: wp.int32):
    """Return the time of a slot."""
    low = wp.where(slot == 0, group.time[0], group.time[1])
    return wp.where(slot < 2, low, wp.where(slot == 2, group.time[2], group.time[3]))


@wp.func
def count_in(counts: wp.ref[wp.vec4i], slot: wp.int32, more: wp.int32):
    """Count more in a slot."""
    for k in range(4):
        counts[k] += wp.where(slot == k, more, 0)


@wp.func
def push_steps(
    items: wp.uint64,
    ends: wp.vec2i,
    slot: wp.int32,
    given_kinds: wp.vec4i,
    given: four_items,
    given_times: wp.vec4,
):
    """Append node pairs to the stack, the earliest of each lane last, and face pairs to theirs; return both ends."""
    kinds, children, times = given_kinds, given, given_times
    for n in range(5):
        i, j = wp.static((0, 2, 0, 1, 1)[n]), wp.static((1, 3, 2, 3, 2)[n])
        turn = times[i] < times[j]
        t, u = times[i], times[j]
        c, d = children[i], children[j]
        k, m = kinds[i], kinds[j]
        times[i] = wp.where(turn, u, t)
        times[j] = wp.where(turn, t, u)
        children[i] = wp.where(turn, d, c)
        children[j] = wp.where(turn, c, d)
        kinds[i] = wp.where(turn, m, k)
        kinds[j] = wp.where(turn, k, m)
    end, waiting = wp.int32(ends[0]), wp.int32(ends[1])
    for k in range(4):
        node, face = kinds[k] == NODES, kinds[k] == FACES
        place, face_place = next_place(end, node), MOTION_STACK_LENGTH + next_place(waiting, face)
        if node or face:
            write_entry(items, wp.where(node, place, face_place), children[k], times[k], slot)
    return wp.vec2i(end, waiting)


@wp.func
def take_contacts(group: wp.ref[Group], slot: wp.int32, own: FirstContact):
    """Take the earliest of the contacts of all lanes."""
    time = wp.where(own.end == CLEAR or own.end == IN_PROGRESS, wp.float64(wp.inf), own.time)
    for k in range(4):
        mine = slot == k
        earliest = warp_min(wp.where(mine, time, wp.float64(wp.inf)))
        if earliest < group.time[k] or (earliest == group.time[k] and group.end[k] != TOUCHES):
            # A pair that is undecided at the same time does not matter.
            touches = warp_any(mine and time == earliest and own.end == TOUCHES)
            group.time[k] = earliest
            group.end[k] = wp.where(touches, TOUCHES, UNDECIDED)


@wp.func
def advance_face_pairs(
    items: wp.uint64,
    ends: wp.vec3i,
    mode: wp.int32,
    tolerance: wp.float64,
    trees: Trees,
    poses: EndPoses,
    pair_poses: wp.array(dtype=PairPose),
    motion: Any,
    before: Group,
):
    """Advance face pairs, one a lane; return the group with their contacts, and the lists' ends.

    Args:
        mode: ONE_STEP for those that go on, NORMALS for those that wait.
    """
    group = before
    waiting, going = wp.int32(ends[1]), wp.int32(ends[2])
    popped = wp.min(wp.where(mode == ONE_STEP, going, waiting), warp_size())
    lane = wp.min(warp_lane(), popped - 1)
    progress = PairProgress()
    progress.mode = mode
    at = wp.int32(0)
    if mode == ONE_STEP:
        going -= popped
        at = GOING_START + going + lane
        progress.time = wp.cast(read_item(items, TIMES_START + going + lane), wp.float64)
        progress.steps = wp.int32(read_tag(items, at))
    else:
        waiting -= popped
        at = MOTION_STACK_LENGTH + waiting + lane
        progress.time = wp.float64(read_tag(items, at))
    item, slot = read_item(items, at), read_slot(items, at)
    best = time_of(group, slot)
    live = warp_lane() < popped and progress.time <= best
    warp_sync()
    own, steps = FirstContact(), wp.int32(0)
    if live:
        p = group.first + slot
        faces = wp.vec2i(item_first(item), item_second(item))
        own, steps = advance_faces(tolerance, trees, poses, pair_poses[p], motion[p], faces, progress, best)
    count_in(group.faces, slot, wp.where(live and mode != ONE_STEP, 1, 0))
    take_contacts(group, slot, own)
    goes_on = own.end == IN_PROGRESS and own.time <= time_of(group, slot)
    place = next_place(going, goes_on)
    if goes_on:
        write_entry(items, GOING_START + place, item, wp.float32(steps), slot)
        write_time(items, place, own.time)
    warp_sync()
    return group, wp.vec3i(ends[0], waiting, going)


@wp.func
def start_group(
    items: wp.uint64,
    first: wp.int32,
    size: wp.int32,
    count: wp.int32,
    states: StatePool,
    pair_poses: wp.array(dtype=PairPose),
    contacts: FirstContacts,
):
    """Put the roots of the object pairs that are open on the empty stack; return their group, and how many."""
    group = Group()
    group.first = first
    end = wp.int32(0)
    for k in range(4):
        p = first + k
        group.time[k] = wp.float64(1.0)
        if k < size and p < count:
            if contacts.end[p] == OPEN:
                if warp_lane() == 0:
                    write_entry(items, end, first_item(states, pair_poses[p]), wp.float32(contacts.time[p]), k)
                end += 1
    warp_sync()
    return group, end


@wp.func
def search_group(
    items: wp.uint64,
    room: wp.int32,
    tolerance: wp.float64,
    trees: Trees,
    poses: EndPoses,
    pair_poses: wp.array(dtype=PairPose),
    motion: Any,
    begun: Group,
    roots: wp.int32,
):
    """Return a group with its first contacts."""
    group = begun
    ends = wp.vec3i(roots, 0, 0)
    while ends[0] > 0 or ends[1] > 0 or ends[2] > 0:
        if ends[0] > 0 and ends[1] < warp_size() and ends[2] < warp_size():
            # One at a time, depth first, needs little room; more where there is.
            popped = wp.max(1, (room - DEPTH_FIRST_ROOM - ends[0]) >> 2)
            popped = wp.min(popped, wp.min(warp_size(), ends[0]))
            end = ends[0] - popped
            at = end + wp.min(warp_lane(), popped - 1)
            item, t, slot = read_item(items, at), read_tag(items, at), read_slot(items, at)
            p, best = group.first + slot, time_of(group, slot)
            live = wp.where(warp_lane() < popped and wp.float64(t) <= best, -1, 0)
            warp_sync()
            emitted = Emitted()
            if warp_any(live < 0):
                emitted = advance_nodes(trees.states, pair_poses[p], motion[p], t, best, item, live)
            pushed = push_steps(items, wp.vec2i(end, ends[1]), slot, emitted.kinds, emitted.items, emitted.bounds)
            warp_sync()
            ends = wp.vec3i(pushed[0], pushed[1], ends[2])
            count_in(group.nodes, slot, emitted.tests)
        mode = wp.where(ends[2] >= warp_size() or ends[1] == 0, ONE_STEP, NORMALS)
        most = wp.where(mode == ONE_STEP, ends[2], ends[1])
        if most >= warp_size() or (ends[0] == 0 and most > 0):
            group, ends = advance_face_pairs(items, ends, mode, tolerance, trees, poses, pair_poses, motion, group)
    return group


@cache
def warp_motion_search(kind):
    """Return the kernel of warps for motions of a kind: `path.Motion` or `linear.LinearMotion`."""

    # Fourteen warps a multiprocessor hide more of what loads wait for than spilled registers cost.
    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, launch_bounds=(32, 14))
    def search_warp_kernel(
        room: wp.int32,
        tolerance: wp.float64,
        trees: Trees,
        poses: EndPoses,
        batch: PairBatch,
        motion: wp.array(dtype=kind),
        hits_inout: Hits,
        contacts_inout: FirstContacts,
    ):
        """Search the object pairs that are open, a few a warp."""
        count = batch.count[0]
        size = wp.where(count >= GROUPED_LEAST, GROUP, 1)
        first = size * (wp.tid() / warp_size())
        if first >= count or batch.launched[0] == STALE:
            return
        items = motion_stack()
        group, roots = start_group(items, first, size, count, trees.states, batch.poses, contacts_inout)
        if roots == 0:
            return
        stack_room = wp.where(room < STACK_LENGTH, room, MOTION_STACK_LENGTH)
        group = search_group(items, stack_room, tolerance, trees, poses, batch.poses, motion, group, roots)
        for k in range(4):
            p = first + k
            if k < size and p < count:
                if contacts_inout.end[p] == OPEN:
                    add_warp_sum(hits_inout.node_tests, p, group.nodes[k])
                    add_warp_sum(hits_inout.triangle_tests, p, group.faces[k])
                    warp_sync()
                    if warp_lane() == 0:
                        contacts_inout.time[p] = group.time[k]
                        contacts_inout.end[p] = group.end[k]

    return search_warp_kernel
