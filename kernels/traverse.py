"""ACTIVE-INTERSECT: dual-tree traversal of many object pairs, every intersecting face pair reported.

Two regimes, one answer: a thread a pair, depth first (CPU), and warps, one or more a pair, each with a stack of its own
in shared memory (CUDA). Both visit the same pairs of nodes and differ in their order only.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import functools

import warp as wp

from warp_abtree.kernels.faces import (
    OUTPUT_ANY,
    OUTPUT_FACES,
    Hits,
    PairTrees,
    defer_faces,
    locate_pair,
    report_hit,
    settle_faces,
    try_faces,
)
from warp_abtree.kernels.nodes import load_node
from warp_abtree.kernels.pools import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.predicates import UNSURE
from warp_abtree.kernels.vector import take_slot, visit_items
from warp_abtree.kernels.visit import visit_item
from warp_abtree.kernels.warps import (
    STACK_LENGTH,
    add_warp_sum,
    four_items,
    item_first,
    item_second,
    pack_item,
    push_items,
    read_item,
    reserve_slot,
    warp_any,
    warp_lane,
    warp_size,
    warp_stack,
    warp_sync,
    write_item,
)

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# A visit replaces an item by four at most, each a level deeper in both trees, or by two, a level deeper in one. So
# depth first leaves three items a level at most, 31 levels deep, and two items at a time six.
DEPTH_FIRST_ROOM = wp.constant(128)
DEPTH_FIRST_LENGTH = 256
depth_first_stack = wp.types.vector(length=DEPTH_FIRST_LENGTH, dtype=wp.int64)

# One thread tests so many face pairs at a time, so that its processor finds its way through either loop.
FACES_READY = wp.constant(16)
waiting_list = wp.types.vector(length=24, dtype=wp.int64)

STACK_MASK = wp.constant(STACK_LENGTH - 1)
# Warps on one pair part its work when there are about so many items for each, or as many as the stack takes then.
ITEMS_PER_WARP = wp.constant(8)
ITEMS_TO_PART = wp.constant(STACK_LENGTH // 2)
# An early hit ends a pair for `any`, so few face pairs wait.
FEW_CANDIDATES = wp.constant(8)


@wp.func
def first_item(states: StatePool, trees: PairTrees):
    """Return the item that compares the roots."""
    return pack_item(load_node(states, trees.node_a + 1).skip, load_node(states, trees.node_b + 1).skip)


@wp.func
def keep_hit(output: wp.int32, pair: wp.int32, swapped: wp.int32, face_a: wp.int32, face_b: wp.int32, hits: Hits):
    hits.any_hit[pair] = 1
    if output == OUTPUT_FACES:
        report_hit(take_slot(hits.total), pair, swapped, face_a, face_b, hits)


@functools.cache
def thread_traversal(mode: int):
    """Return the kernel that gives a thread each object pair, at a precision or WITHIN."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def traverse_thread_kernel(
        first: wp.int32,
        step: wp.int32,
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        pair_count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
    ):
        """Traverse every step-th object pair from the first on, depth first; CPU only, on several cores at once."""
        p = first + step * wp.tid()
        if p >= wp.min(pair_count[0], pairs.shape[0]):
            return
        swapped, trees = locate_pair(models, states, objects, pairs[p])
        pose = pair_poses[p]
        stack = depth_first_stack(first_item(states, trees))
        waiting_faces = waiting_list()
        top, waiting = wp.int32(1), wp.int32(0)
        node_tests, triangle_tests = wp.int64(0), wp.int64(0)
        float64_tests, exact_tests, hit_count = wp.int64(0), wp.int64(0), wp.int64(0)
        while top > 0:
            taken = wp.min(top, 2)
            top -= taken
            items = visit_items(states, trees, pose, stack[top], stack[top + 1], taken)
            mask = wp.int32(items[8])
            node_tests += items[9]
            # Written without branches, which could not be predicted; what is not in use is written over.
            for k in range(8):
                stack[top] = items[k]
                top += (mask >> k) & 1
                waiting_faces[waiting] = items[k]
                waiting += (mask >> (k + 8)) & 1
            if top > 0 and waiting < FACES_READY and output != OUTPUT_ANY:
                continue
            while waiting > 0:
                waiting -= 1
                item = waiting_faces[waiting]
                face_a, face_b = item_first(item), item_second(item)
                meet = try_faces(wp.static(mode), models, states, trees, pose, face_a, face_b)
                triangle_tests += wp.int64(1)
                if meet == UNSURE:
                    meet, hard = settle_faces(wp.static(mode), models, states, trees, pose, face_a, face_b)
                    float64_tests += wp.int64(1)
                    exact_tests += wp.int64(hard)
                if meet == 1:
                    hit_count += wp.int64(1)
                    keep_hit(output, p, swapped, face_a, face_b, hits_inout)
                    if output == OUTPUT_ANY:
                        top = 0
                        waiting = 0
        hits_inout.count[p] = hit_count
        hits_inout.node_tests[p] = node_tests
        hits_inout.triangle_tests[p] = triangle_tests
        hits_inout.float64_tests[p] = float64_tests
        hits_inout.exact_tests[p] = exact_tests

    return traverse_thread_kernel


@wp.func
def expand_items(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    end: wp.int32,
    waiting: wp.int32,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
):
    """Visit items first to first + popped, one a thread, append what follows; return ends and pairs compared."""
    lane = warp_lane()
    item = wp.int64(0)
    if lane < popped:
        item = read_item(items, (first + lane) & STACK_MASK)
    warp_sync()
    mask = wp.int32(0)
    tests = wp.int32(0)
    children = four_items()
    if lane < popped:
        children, mask, tests = visit_item(states, trees, pose, item)
    ends = push_items(items, end, waiting, mask, children)
    warp_sync()
    return item_second(ends), item_first(ends), tests


@wp.func
def test_candidates(
    output: wp.int32,
    mode: wp.int32,
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    pair: wp.int32,
    swapped: wp.int32,
    models: ModelPool,
    states: StatePool,
    trees: PairTrees,
    pose: PairPose,
    hits: Hits,
):
    """Test face pairs that waited, one a thread; return (hits, tests, tests left open, 0) and whether this one met."""
    lane = warp_lane()
    meet = wp.int32(0)
    item = wp.int64(0)
    if lane < popped:
        item = read_item(items, STACK_LENGTH + first + lane)
        meet = try_faces(mode, models, states, trees, pose, item_first(item), item_second(item))
    warp_sync()
    found = meet == 1
    if output == OUTPUT_FACES:
        slot = reserve_slot(hits.total, found)
        if found:
            report_hit(slot, pair, swapped, item_first(item), item_second(item), hits)
    if found:
        hits.any_hit[pair] = 1
    slot = reserve_slot(hits.unsure_total, meet == UNSURE)
    if meet == UNSURE:
        defer_faces(slot, pair, item_first(item), item_second(item), hits)
    tested = wp.where(lane < popped, 1, 0)
    return wp.vec4i(wp.where(found, 1, 0), tested, wp.where(meet == UNSURE, 1, 0), 0), found


@wp.func
def part_items(items: wp.uint64, head: wp.int32, end: wp.int32, part: wp.int32, parts: wp.int32):
    """Keep every so many-th item from head on, for one of several warps that hold the same; return the new end."""
    kept = (end - head - part + parts - 1) / parts
    done = wp.int32(0)
    while done < kept:
        item = wp.int64(0)
        i = done + warp_lane()
        if i < kept:
            item = read_item(items, (head + part + parts * i) & STACK_MASK)
        warp_sync()
        if i < kept:
            write_item(items, (head + i) & STACK_MASK, item)
        warp_sync()
        done += warp_size()
    return head + kept


@wp.func
def spread_items(
    items: wp.uint64, part: wp.int32, parts: wp.int32, states: StatePool, trees: PairTrees, pose: PairPose
):
    """Start a pair: expand the roots breadth first, the same in every warp at work on it, and keep a share.

    Returns where the share starts and ends, the face pairs that wait, and the pairs of boxes compared: these two are
    the first warp's.
    """
    if warp_lane() == 0:
        write_item(items, 0, first_item(states, trees))
    warp_sync()
    head, end = wp.int32(0), wp.int32(1)
    waiting, compared = wp.int32(0), wp.int32(0)
    wanted = wp.min(parts * ITEMS_PER_WARP, ITEMS_TO_PART)
    while parts > 1 and end > head and end - head < wanted and waiting < warp_size():
        first = head
        head += wp.min(warp_size(), end - head)
        end, waiting, more = expand_items(items, first, head - first, end, waiting, states, trees, pose)
        compared += more
    if part > 0:
        waiting = 0
        compared = 0
    end = part_items(items, head, end, part, parts)
    return head, end, waiting, compared


@functools.cache
def warp_traversal(mode: int):
    """Return the kernel that gives each object pair one or more warps: FLOAT32, WITHIN, or for both other precisions.

    What float32 leaves open waits for `settle_traversal`.
    """

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=128)
    def traverse_warp_kernel(
        parts_max: wp.int32,
        stack_room: wp.int32,
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        pair_count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
    ):
        """Traverse a share of one object pair a warp."""
        count = wp.min(pair_count[0], pairs.shape[0])
        # Measured best for 1 to 8,192 pairs: with more parts, more of the start is done again in each of them.
        parts = wp.max(1, wp.int32(wp.float32(parts_max) / wp.sqrt(wp.float32(wp.max(count, 1)))))
        p = (wp.tid() / warp_size()) / parts
        if p >= count:
            return
        part = (wp.tid() / warp_size()) % parts
        swapped, trees = locate_pair(models, states, objects, pairs[p])
        pose = pair_poses[p]
        items = warp_stack()
        head, end, waiting, node_tests = spread_items(items, part, parts, states, trees, pose)
        tests = wp.vec4i()
        ready = wp.where(output == OUTPUT_ANY, wp.min(FEW_CANDIDATES, warp_size()), warp_size())
        while end > head or waiting > 0:
            found = False
            if waiting >= ready or end == head:
                popped = wp.min(waiting, warp_size())
                waiting -= popped
                more, found = test_candidates(
                    output, wp.static(mode), items, waiting, popped, p, swapped, models, states, trees, pose, hits_inout
                )
                tests += more
            else:
                # One at a time, depth first, needs little room; more where there is.
                popped = wp.max(1, (stack_room - DEPTH_FIRST_ROOM - (end - head)) / 3)
                popped = wp.min(popped, wp.min(warp_size(), end - head))
                end -= popped
                end, waiting, compared = expand_items(items, end, popped, end, waiting, states, trees, pose)
                node_tests += compared
            if output == OUTPUT_ANY:
                if warp_any(found or hits_inout.any_hit[p] != 0):
                    end = head
                    waiting = 0
        add_warp_sum(hits_inout.node_tests, p, node_tests)
        add_warp_sum(hits_inout.count, p, tests[0])
        add_warp_sum(hits_inout.triangle_tests, p, tests[1])
        add_warp_sum(hits_inout.float64_tests, p, tests[2])

    return traverse_warp_kernel
