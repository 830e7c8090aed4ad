"""Dual-tree search by warps that share many object pairs, each with a stack of its own in shared memory.

One loop for every question about face pairs: boxes and slabs of two trees drop node pairs, and what is asked of the
face pairs that are left is a policy. Threads of the CPU (`thread_search`) test the same pairs of nodes in another
order. Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.lanes import WARP_SIZE, hold_uniform, warp_any, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.poses import NO_NODE, PairBatch, PairPose
from warp_abtree.kernels.search.item import OUTPUT_ANY, compare_node_pair
from warp_abtree.kernels.search.load_balance import (
    DEPTH_FIRST_ROOM,
    STACK_MASK,
    Work,
    await_items,
    claim_ahead,
    count_idle,
    count_to_pop,
    donate_items,
    first_ended,
    first_unit,
    load_tickets,
    next_unit,
    receive_items,
    start_items,
    units_of_pair,
)
from warp_abtree.kernels.search.slab_overlap import slabs_overlap
from warp_abtree.kernels.search.warp_stack import (
    SLAB_PAIR_LENGTH,
    SLAB_PAIR_START,
    WarpLists,
    push_children,
    push_items,
    read_item,
    warp_stack,
)

WARP_HEADERS = (
    "base/counters.cuh",
    "base/lanes.cuh",
    "search/load_balance.cuh",
    "search/push_children.cuh",
    "search/warp_stack.cuh",
)
wp.set_module_options(native.options(*WARP_HEADERS) | {"block_dim": WARP_SIZE})


# An early hit ends a pair for `any`, so few leaf pairs wait, and none for slabs, until so many turns have had no hit.
LEAF_PAIRS_FOR_ANY = wp.constant(8)
LONG_SEARCH = wp.constant(16)
# Where warps share a pair of so few nodes above those of slabs that each has little to do, slabs would but delay it.
SLAB_NODES = wp.constant(8)
# A warp with work for two looks at every second turn whether others are idle, at every one where pairs are few: a turn
# is so many visits, or fewer until a warp of leaf pairs waits, and their tests.
DONATION_LEAST = wp.constant(16)
MANY_PARTS = wp.constant(8)
TESTS_A_TURN = wp.constant(4)


@wp.struct
class TraversalTests:
    """Tests of an object pair by a warp or a lane of it."""

    nodes: wp.int32  # pairs of boxes compared
    faces: wp.int32  # pairs of faces tested
    uncertain: wp.int32  # those that are uncertain in float32
    hits: wp.int32  # those that meet


class WarpPolicy(NamedTuple):
    """What a search by warps asks of face pairs: functions of all lanes of a warp, and what they write.

    Attributes:
        headers: Headers that the functions need beside those of the search.
        for_any: Whether one hit ends a pair.
        mode: What `separate` and `test` are given first.
        within: Whether faces nearer than a distance are asked for, not only those that meet. Then warps give work away
            whatever the sizes of trees are.
        found: Struct of what is found.
        try_small: (output, slot, task, count, trees, pose, items, found, work) -> the parts of a pair for the search,
            of a task (pair, part, parts), 0 where the part is done; None where all go to the search.
        separate: (mode, own, popped, trees, pose): takes leaf pairs, and lets some wait as straddling pairs.
        test: (mode, output, own, popped, pair, trees, pose, found) -> whether this lane's straddling pair is a hit, and
            whether it is uncertain.
        has_hit: (pair, found) -> whether a pair has a hit; of policies for any.
        add_tests: (pair, tests, found): adds the tests of a lane to those of its pair.
    """

    headers: tuple[str, ...]
    mode: int
    for_any: bool
    within: bool
    found: Any
    try_small: Callable | None
    separate: Callable
    test: Callable
    has_hit: Callable
    add_tests: Callable


@wp.struct
class Pace:
    """Work of a warp in a turn, and turns between its looks for idle warps."""

    tests_max: wp.int32  # node pair tests of each lane in a turn
    balance_mask: wp.int32  # turns whose number has none of these bits look for idle warps
    stack_room: wp.int32  # items that the stack takes, STACK_LENGTH at most


@wp.func
def expand_items(own: wp.ref[WarpLists], popped: wp.int32, floor: wp.vec2i, states: StatePool, pose: PairPose):
    """Expand so many of the last items, one a lane, and append what they emit; return the pairs of boxes compared.

    Lanes without an item look at another's, so that none branches.
    """
    lane = warp_lane()
    own.end -= popped
    item = read_item(own.items, (own.end + wp.min(lane, popped - 1)) & STACK_MASK)
    warp_sync()
    children, lists, tests = compare_node_pair(states, pose, floor, item, wp.where(lane < popped, -1, 0))
    push_children(own, lists, children)
    warp_sync()
    return tests


@wp.func
def separate_slab_pairs(own: wp.ref[WarpLists], popped: wp.int32, trees: Trees, pose: PairPose):
    """Put the slab pairs on the stack that slabs do not separate, one a lane."""
    lane = warp_lane()
    own.slab_pairs -= popped
    item = read_item(own.items, SLAB_PAIR_START + own.slab_pairs + wp.min(lane, popped - 1))
    overlap = slabs_overlap(trees, pose, item)
    push_items(own.items, own.end, overlap and lane < popped, item)
    warp_sync()


@wp.func
def first_items(items: wp.uint64, slot: wp.int32, task: wp.vec3i, pose: PairPose, work: Work):
    """Push the items of a slot, or without one those that a unit starts with, on the empty stack; return its end."""
    if slot >= 0:
        return receive_items(items, slot, work)
    return start_items(items, task[1], task[2], pose)


@wp.func
def slab_floor(pose: PairPose, parts: wp.int32):
    """Return the nodes of A and B from which on slabs are compared, NO_NODE where many warps share a small pair."""
    small = wp.max(pose.floor[0], pose.floor[1]) <= SLAB_NODES * parts
    return wp.where(small, wp.vec2i(NO_NODE, NO_NODE), pose.floor)


@wp.func
def descend_warp(own: wp.ref[WarpLists], pace: Pace, ready: wp.int32, floor: wp.vec2i, trees: Trees, pose: PairPose):
    """Test node pairs for a turn, or until enough slab pairs or leaf pairs wait, and then a warp of slab pairs.

    Returns the pairs of nodes compared.
    """
    ready_slab = wp.int32(ready)
    visits, node_tests = wp.int32(0), wp.int32(0)
    while visits < pace.tests_max and own.end > own.head and own.slab_pairs < ready_slab and own.leaf_pairs < ready:
        # Slab pairs come back to the stack.
        size = own.end - own.head
        room = wp.min(pace.stack_room - DEPTH_FIRST_ROOM - size, SLAB_PAIR_LENGTH) - own.slab_pairs
        ready_slab = wp.min(ready, wp.max(1, room - 3))
        popped = count_to_pop(room, 2, size)
        node_tests += expand_items(own, popped, floor, trees.states, pose)
        visits += 1
    if own.slab_pairs >= ready_slab or (own.end == own.head and own.slab_pairs > 0):
        popped = wp.min(own.slab_pairs, warp_size())
        separate_slab_pairs(own, popped, trees, pose)
        node_tests += wp.where(warp_lane() < popped, 1, 0)
    return node_tests


@wp.func
def set_pace(stack_room: wp.int32, parts: wp.int32, for_any: bool):
    pace = Pace()
    pace.stack_room = stack_room
    pace.balance_mask = hold_uniform(wp.where(parts >= MANY_PARTS, wp.where(for_any, 3, 0), 1))
    # Where many warps look for one hit of a pair, each asks at every visit whether there is one.
    pace.tests_max = hold_uniform(wp.where(for_any and parts >= MANY_PARTS, 1, TESTS_A_TURN))
    return pace


@functools.cache
def items_searcher(policy: WarpPolicy):
    """Return the function by which a warp searches the items on its stack."""
    separate, test, has_hit, add_tests = policy.separate, policy.test, policy.has_hit, policy.add_tests
    mode, for_any, found_type = policy.mode, policy.for_any, policy.found

    @wp.func
    def search_items(
        output: wp.int32,
        pace: Pace,
        pair: wp.int32,
        trees: Trees,
        pose: PairPose,
        own: wp.ref[WarpLists],
        found: found_type,
        work: Work,
    ):
        """Search the stack, less the items donated, and count the tests of all lanes."""
        turn, tests = wp.int32(0), TraversalTests()
        own.head = 0
        ready = wp.where(wp.static(for_any), wp.min(LEAF_PAIRS_FOR_ANY, warp_size()), warp_size())
        ready_straddling = wp.where(wp.static(for_any), 1, warp_size())
        floor = wp.where(wp.static(for_any), wp.vec2i(NO_NODE, NO_NODE), pose.floor)
        while own.end > own.head or own.slab_pairs > 0 or own.leaf_pairs > 0 or own.straddling > 0:
            is_hit, tickets = False, wp.int64(0)
            turn += 1
            if (turn & pace.balance_mask) == 0:
                tickets = load_tickets(work.counter)
            if turn == LONG_SEARCH and wp.static(for_any):
                ready = warp_size()
                floor = pose.floor
            tests.nodes += descend_warp(own, pace, ready, floor, trees, pose)
            empty = own.end == own.head and own.slab_pairs == 0
            if own.leaf_pairs >= ready or (empty and own.leaf_pairs > 0):
                popped = wp.min(own.leaf_pairs, warp_size())
                separate(wp.static(mode), own, popped, trees, pose)
                tests.faces += popped
            if own.straddling >= ready_straddling or (empty and own.leaf_pairs == 0 and own.straddling > 0):
                popped = wp.min(own.straddling, warp_size())
                is_hit, uncertain = test(wp.static(mode), output, own, popped, pair, trees, pose, found)
                tests.hits += wp.where(is_hit, 1, 0)
                tests.uncertain += wp.where(uncertain, 1, 0)
            idle = count_idle(tickets)
            if idle > 0 and own.end - own.head >= 2 * DONATION_LEAST:
                own.head = donate_items(DONATION_LEAST, pair, idle, own.items, own.head, own.end, work)
            if wp.static(for_any):
                if warp_any(is_hit or has_hit(pair, found)):
                    own.end = own.head
                    own.slab_pairs = 0
                    own.leaf_pairs = 0
                    own.straddling = 0
        add_tests(pair, tests, found)

    return search_items


@functools.cache
def warp_search(policy: WarpPolicy):
    """Return the kernel that has warps share the object pairs."""
    try_small, search_items, found_type = policy.try_small, items_searcher(policy), policy.found
    for_any, within = policy.for_any, policy.within
    options = native.options(*WARP_HEADERS, *policy.headers) | {"block_dim": WARP_SIZE}

    @wp.kernel(module="unique", module_options=options, cuda_max_registers=128)
    def search_warp_kernel(
        stack_room: wp.int32,
        output: wp.int32,
        trees: Trees,
        batch: PairBatch,
        found_inout: found_type,
        work_inout: Work,
    ):
        """Search units of work, each a part of one object pair, and donated items, until there are none."""
        # Which the compiler then knows.
        asked = wp.where(wp.static(for_any), OUTPUT_ANY, output)
        count = wp.min(batch.count[0], batch.poses.shape[0])
        ended = first_ended(wp.static(within), work_inout.counter)
        unit = first_unit(work_inout.counter)
        parts = units_of_pair(ended, count, work_inout)
        pace = set_pace(stack_room, parts, wp.static(for_any))
        own = WarpLists()
        own.items = warp_stack()
        units = count * parts
        while True:
            p = unit / parts
            slot = wp.int32(-1)
            if unit >= units:
                slot = await_items(ended, work_inout)
                if slot < 0:
                    return
                ended = 0
                p = work_inout.owner[slot][0]
            task = wp.vec3i(p, unit - p * parts, parts)
            unit = claim_ahead(ended, unit, units, work_inout)
            pose = batch.poses[p]
            if not wp.static(within):
                pose.within = wp.float64(0.0)  # so, too
            left = wp.int32(parts)
            if wp.static(try_small is not None):
                left = try_small(asked, slot, task, count, trees, pose, own.items, found_inout, work_inout)
            if left > 0:
                task[2] = left
                pose.floor = slab_floor(pose, parts)
                own.end = first_items(own.items, slot, task, pose, work_inout)
                search_items(asked, pace, p, trees, pose, own, found_inout, work_inout)
            ended += 1
            unit = next_unit(ended, unit, units, work_inout)

    return search_warp_kernel
