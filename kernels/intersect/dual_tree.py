"""ACTIVE-INTERSECT on CUDA: warps that share many object pairs, each with a stack of its own in shared memory.

Threads of the CPU (`simd`) test the same pairs of nodes in another order, and report the same face pairs.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.counters import add_warp_sum
from warp_abtree.kernels.base.lanes import WARP_SIZE, hold_uniform, warp_any, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.poses import NO_NODE, PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import OUTPUT_ANY, Hits
from warp_abtree.kernels.intersect.leaf_pairs import separate_leaf_pairs, test_straddling
from warp_abtree.kernels.intersect.small_trees import SmallLists, gather_leaves, is_small, test_small_trees
from warp_abtree.kernels.search.item import compare_node_pair
from warp_abtree.kernels.search.load_balance import (
    DEPTH_FIRST_ROOM,
    STACK_MASK,
    Work,
    await_items,
    claim_ahead,
    count_idle,
    donate_items,
    first_ended,
    first_unit,
    load_tickets,
    next_unit,
    parts_at_once,
    receive_items,
    start_items,
    units_of_pair,
)
from warp_abtree.kernels.search.slab_overlap import slabs_overlap
from warp_abtree.kernels.search.warp_stack import (
    SLAB_PAIR_LENGTH,
    SLAB_PAIR_START,
    push_children,
    push_items,
    read_item,
    warp_stack,
)

MODULE_OPTIONS = native.options(
    "base/counters.cuh",
    "base/lanes.cuh",
    "intersect/small_trees.cuh",
    "search/load_balance.cuh",
    "search/push_children.cuh",
    "search/warp_stack.cuh",
) | {"block_dim": WARP_SIZE}
wp.set_module_options(MODULE_OPTIONS)


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
class Pace:
    """Work of a warp in a turn, and turns between its looks for idle warps."""

    tests_max: wp.int32  # node pair tests of each lane in a turn
    balance_mask: wp.int32  # turns whose number has none of these bits look for idle warps
    stack_room: wp.int32  # items that the stack takes, STACK_LENGTH at most
    for_any: wp.bool  # one hit ends a pair


@wp.struct
class WarpItems:
    """What a warp has in shared memory: node pairs, in a ring, the oldest first."""

    items: wp.uint64  # `warp_stack`
    end: wp.int32  # node pairs


@wp.func
def expand_items(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    ends: wp.vec3i,
    floor: wp.vec2i,
    states: StatePool,
    pose: PairPose,
):
    """Expand items first to first + popped, one a lane, and append what they emit; return ends and pairs compared.

    Lanes without an item look at another's, so that none branches.
    """
    lane = warp_lane()
    item = read_item(items, (first + wp.min(lane, popped - 1)) & STACK_MASK)
    warp_sync()
    children, lists, tests = compare_node_pair(states, pose, floor, item, wp.where(lane < popped, -1, 0))
    found = push_children(items, ends, lists, children)
    warp_sync()
    return found, tests


@wp.func
def separate_slab_pairs(
    items: wp.uint64, first: wp.int32, popped: wp.int32, end: wp.int32, trees: Trees, pose: PairPose
):
    """Put the slab pairs on the stack that slabs do not separate, one a lane; return its new end."""
    lane = warp_lane()
    item = read_item(items, SLAB_PAIR_START + first + wp.min(lane, popped - 1))
    overlap = slabs_overlap(trees, pose, item)
    end = push_items(items, end, overlap and lane < popped, item)
    warp_sync()
    return end


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
def descend_warp(
    items: wp.uint64,
    pace: Pace,
    ready: wp.int32,
    head: wp.int32,
    ends: wp.vec3i,
    floor: wp.vec2i,
    trees: Trees,
    pose: PairPose,
):
    """Test node pairs for a turn, or until enough slab pairs or leaf pairs wait, and then a warp of slab pairs.

    Returns the new ends and the pairs of nodes compared.
    """
    end, slab_pairs, waiting = wp.int32(ends[0]), wp.int32(ends[1]), wp.int32(ends[2])
    ready_slab = wp.int32(ready)
    visits, node_tests = wp.int32(0), wp.int32(0)
    while visits < pace.tests_max and end > head and slab_pairs < ready_slab and waiting < ready:
        # One at a time, depth first, needs little room; more where there is. Slab pairs come back to the stack.
        room = wp.min(pace.stack_room - DEPTH_FIRST_ROOM - (end - head), SLAB_PAIR_LENGTH) - slab_pairs
        ready_slab = wp.min(ready, wp.max(1, room - 3))
        popped = wp.min(wp.max(1, room >> 2), wp.min(warp_size(), end - head))
        end -= popped
        found, compared = expand_items(
            items, end, popped, wp.vec3i(end, slab_pairs, waiting), floor, trees.states, pose
        )
        end = found[0]
        slab_pairs = found[1]
        waiting = found[2]
        node_tests += compared
        visits += 1
    if slab_pairs >= ready_slab or (end == head and slab_pairs > 0):
        popped = wp.min(slab_pairs, warp_size())
        slab_pairs -= popped
        end = separate_slab_pairs(items, slab_pairs, popped, end, trees, pose)
        node_tests += wp.where(warp_lane() < popped, 1, 0)
    return wp.vec3i(end, slab_pairs, waiting), node_tests


@wp.func
def traverse_items(
    output: wp.int32,
    mode: wp.int32,
    pace: Pace,
    pair: wp.int32,
    trees: Trees,
    pose: PairPose,
    own: WarpItems,
    hits: Hits,
    work: Work,
):
    """Traverse the stack, less the items donated; return pairs of boxes compared, and face pair tests."""
    items, for_any = own.items, pace.for_any
    head, ends = wp.int32(0), wp.vec3i(own.end, 0, 0)
    node_tests, turn = wp.int32(0), wp.int32(0)
    tested, hit_count, uncertain_count = wp.int32(0), wp.int32(0), wp.int32(0)
    straddling = wp.int32(0)
    ready = wp.where(for_any, wp.min(LEAF_PAIRS_FOR_ANY, warp_size()), warp_size())
    ready_straddling = wp.where(for_any, 1, warp_size())
    floor = wp.where(for_any, wp.vec2i(NO_NODE, NO_NODE), pose.floor)
    while ends[0] > head or ends[1] > 0 or ends[2] > 0 or straddling > 0:
        found, tickets = False, wp.int64(0)
        turn += 1
        if (turn & pace.balance_mask) == 0:
            tickets = load_tickets(work.counter)
        if turn == LONG_SEARCH and for_any:
            ready = warp_size()
            floor = pose.floor
        ends, compared = descend_warp(items, pace, ready, head, ends, floor, trees, pose)
        node_tests += compared
        waiting = ends[2]
        empty = ends[0] == head and ends[1] == 0
        if waiting >= ready or (empty and waiting > 0):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            ends[2] = waiting
            straddling = separate_leaf_pairs(mode, items, waiting, popped, straddling, trees, pose)
            tested += popped
        if straddling >= ready_straddling or (empty and waiting == 0 and straddling > 0):
            popped = wp.min(straddling, warp_size())
            straddling -= popped
            found, uncertain = test_straddling(output, mode, items, straddling, popped, pair, trees, pose, hits)
            hit_count += wp.where(found, 1, 0)
            uncertain_count += wp.where(uncertain, 1, 0)
        idle = count_idle(tickets)
        if idle > 0 and ends[0] - head >= 2 * DONATION_LEAST:
            head = donate_items(DONATION_LEAST, pair, idle, items, head, ends[0], work)
        if for_any:
            if warp_any(found or hits.any_hit[pair] != 0):
                ends = wp.vec3i(head, 0, 0)
                straddling = 0
    return node_tests, wp.vec3i(hit_count, wp.where(warp_lane() == 0, tested, 0), uncertain_count)


@wp.func
def set_pace(stack_room: wp.int32, parts: wp.int32, for_any: bool):
    pace = Pace()
    pace.stack_room = stack_room
    pace.for_any = for_any
    pace.balance_mask = hold_uniform(wp.where(parts >= MANY_PARTS, wp.where(for_any, 3, 0), 1))
    # Where many warps look for one hit of a pair, each asks at every visit whether there is one.
    pace.tests_max = hold_uniform(wp.where(for_any and parts >= MANY_PARTS, 1, TESTS_A_TURN))
    return pace


@wp.func
def open_stack():
    own = WarpItems()
    own.items = warp_stack()
    return own


@wp.func
def count_tests(hits: Hits, pair: wp.int32, node_tests: wp.int32, tests: wp.vec3i):
    """Count the tests of all lanes: pairs of boxes, and the face pair tests of `traverse_items`."""
    add_warp_sum(hits.node_tests, pair, node_tests)
    add_warp_sum(hits.count, pair, tests[0])
    add_warp_sum(hits.triangle_tests, pair, tests[1])
    add_warp_sum(hits.float64_tests, pair, tests[2])


@functools.cache
def warp_traversal(mode: int, for_any: bool):
    """Return the kernel that has warps share the object pairs: EXACT, FLOAT32 or WITHIN.

    One for OUTPUT_ANY and one for the other outputs, each with what it takes as constants. Uncertain face pairs wait
    for passes of their own.
    """

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=128)
    def traverse_warp_kernel(
        stack_room: wp.int32, output: wp.int32, trees: Trees, batch: PairBatch, hits_inout: Hits, work_inout: Work
    ):
        """Traverse units of work, each a part of one object pair, and donated items, until there are none."""
        count = wp.min(batch.count[0], batch.poses.shape[0])
        ended = first_ended(wp.static(mode != int(EXACT)), work_inout.counter)
        unit = first_unit(work_inout.counter)
        parts = units_of_pair(ended, count, work_inout)
        pace = set_pace(stack_room, parts, wp.static(for_any))
        asked = wp.where(wp.static(for_any), OUTPUT_ANY, output)
        own = open_stack()
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
            lists = SmallLists()
            if wp.static(mode == int(EXACT)):
                if slot < 0 and is_small(pose, work_inout.small_faces):
                    task[2] = parts_at_once(parts, count, work_inout.warps)
                    lists = gather_leaves(task, own.items, trees.states, pose)
            if lists.fits:
                test_small_trees(asked, pace.for_any, task, lists, trees, pose, own.items, hits_inout)
            else:
                pose.floor = slab_floor(pose, parts)
                own.end = first_items(own.items, slot, task, pose, work_inout)
                node_tests, tests = traverse_items(
                    asked, wp.static(mode), pace, p, trees, pose, own, hits_inout, work_inout
                )
                count_tests(hits_inout, p, node_tests, tests)
            ended += 1
            unit = next_unit(ended, unit, units, work_inout)

    return traverse_warp_kernel
