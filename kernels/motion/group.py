"""Branch and bound for first contacts by warps: node and face pairs of a few object pairs at once fill the lanes.

As `search`, whose answers it has. A face pair is advanced by normals first, which decide most; what is left goes on
step by step, each with 31 others, since a step takes as long as its slowest lane, and the others are ten times as long.
"""

from functools import cache

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.counters import add_lanes
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.lanes import next_place, warp_any, warp_lane, warp_min, warp_size, warp_sync
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
from warp_abtree.kernels.motion.kinds import STEPS, motion_given
from warp_abtree.kernels.motion.start import OPEN, FirstContacts
from warp_abtree.kernels.search.best_first import BestFirstPolicy, Entry, SearchLists, best_first, start_lists
from warp_abtree.kernels.search.item import Emitted, first_item, item_first, item_second
from warp_abtree.kernels.search.nearest_stack import SearchMemory
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, read_item

MODULE_OPTIONS = native.options(
    "base/counters.cuh",
    "base/lanes.cuh",
    "exact/apart_until.cuh",
    "exact/determinant.cuh",
    "search/load_balance.cuh",
    "search/motion_stack.cuh",
    "search/nearest_stack.cuh",
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


MOTION_MEMORY = SearchMemory(MOTION_STACK_LENGTH, GOING_START, -1, read_tag, read_slot, write_entry)


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


@cache
def group_policy(kind) -> BestFirstPolicy:
    """Return the policy of warps for motions of a type."""
    given_type = motion_given(kind)
    _, advance_nodes, advance_faces = STEPS[kind]

    @wp.func
    def expand(trees: Trees, given: given_type, group: wp.ref[Group], entry: Entry):
        """Advance the children of node pairs, one a lane."""
        p, best = group.first + entry.slot, time_of(group, entry.slot)
        live = wp.where(entry.live and wp.float64(entry.bound) <= best, -1, 0)
        emitted = Emitted()
        if warp_any(live < 0):
            emitted = advance_nodes(
                trees.states, given.batch.poses[p], given.motion[p], entry.bound, best, entry.item, live
            )
        count_in(group.nodes, entry.slot, emitted.tests)
        return emitted

    @wp.func
    def advance(trees: Trees, given: given_type, group: wp.ref[Group], lists: wp.ref[SearchLists], entry: Entry):
        """Advance face pairs, one a lane: those that wait by normals, those that go on by a step."""
        goes_on = entry.at >= GOING_START
        progress = PairProgress()
        progress.mode = wp.where(goes_on, ONE_STEP, NORMALS)
        progress.time = wp.float64(entry.bound)
        if goes_on:
            progress.time = wp.cast(read_item(lists.items, TIMES_START + entry.at - GOING_START), wp.float64)
            progress.steps = wp.int32(entry.bound)
        best = time_of(group, entry.slot)
        live = entry.live and progress.time <= best
        own, steps = FirstContact(), wp.int32(0)
        if live:
            p = group.first + entry.slot
            faces = wp.vec2i(item_first(entry.item), item_second(entry.item))
            own, steps = advance_faces(trees, given, p, faces, progress, best)
        count_in(group.faces, entry.slot, wp.where(live and not goes_on, 1, 0))
        take_contacts(group, entry.slot, own)
        more = own.end == IN_PROGRESS and own.time <= time_of(group, entry.slot)
        place = next_place(lists.opened, more)
        if more:
            write_entry(lists.items, GOING_START + place, entry.item, wp.float32(steps), entry.slot)
            write_time(lists.items, place, own.time)

    return BestFirstPolicy(MOTION_MEMORY, given_type, Group, None, expand, advance, advance, turns=True)


@cache
def warp_motion_search(kind):
    """Return the kernel of warps for motions of a type: `path.Motion` or `linear.LinearMotion`."""
    policy = group_policy(kind)
    search_group, given_type = best_first(policy), policy.given

    # Fourteen warps a multiprocessor hide more of what loads wait for than spilled registers cost.
    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, launch_bounds=(32, 14))
    def search_warp_kernel(
        room: wp.int32,
        trees: Trees,
        given: given_type,
        hits_inout: Hits,
        contacts_inout: FirstContacts,
    ):
        """Search the object pairs that are open, a few a warp."""
        count = given.batch.count[0]
        size = wp.where(count >= GROUPED_LEAST, GROUP, 1)
        first = size * (wp.tid() / warp_size())
        if first >= count or given.batch.launched[0] == STALE:
            return
        lists = start_lists(motion_stack(), wp.where(room < STACK_LENGTH, room, MOTION_STACK_LENGTH))
        group = Group()
        group.first = first
        for k in range(4):
            p = first + k
            group.time[k] = wp.float64(1.0)
            if k < size and p < count:
                if contacts_inout.end[p] == OPEN:
                    item = first_item(trees.states, given.batch.poses[p])
                    if warp_lane() == 0:
                        write_entry(lists.items, lists.end, item, wp.float32(contacts_inout.time[p]), k)
                    lists.end += 1
        warp_sync()
        if lists.end == 0:
            return
        search_group(trees, given, group, lists)
        for k in range(4):
            p = first + k
            if k < size and p < count:
                if contacts_inout.end[p] == OPEN:
                    add_lanes(hits_inout.node_tests, p, wp.int64(group.nodes[k]))
                    add_lanes(hits_inout.triangle_tests, p, wp.int64(group.faces[k]))
                    warp_sync()
                    if warp_lane() == 0:
                        contacts_inout.time[p] = group.time[k]
                        contacts_inout.end[p] = group.end[k]

    return search_warp_kernel
