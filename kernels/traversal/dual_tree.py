"""ACTIVE-INTERSECT: dual-tree traversal of many object pairs, every intersecting face pair reported.

Two regimes, one answer: threads that take one pair after the other, depth first (CPU), and warps that share the pairs
among them, each with a stack of its own in shared memory (CUDA). Both visit the same pairs of nodes and differ in their
order only.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import functools

import warp as wp

from warp_abtree.kernels.arithmetic.predicates import EXACT, FLOAT32
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.face_pairs import OUTPUT_ANY, OUTPUT_FACES, WITHIN, Hits, report_hit, test_faces
from warp_abtree.kernels.traversal.leaf_pairs import part_candidates, test_crossing
from warp_abtree.kernels.traversal.load_balance import (
    MAILBOX_COUNT,
    MAILBOX_ITEMS,
    SHARES_AT_ONCE,
    Work,
    await_share,
    close_mailbox,
    count_hungry,
    empty_mailbox,
    end_unit,
    load_tickets,
    open_mailbox,
    part_count,
    take_unit,
)
from warp_abtree.kernels.traversal.node_pair import visit_item
from warp_abtree.kernels.traversal.nodes import load_node
from warp_abtree.kernels.traversal.simd import (
    ITEMS_AT_ONCE,
    STACK_ROOM,
    descend,
    screen_waiting,
    single_node,
    take_slots,
)
from warp_abtree.kernels.traversal.simd_float64 import filter_waiting
from warp_abtree.kernels.traversal.warp_stack import (
    STACK_LENGTH,
    add_warp_sum,
    item_first,
    item_second,
    keep_value,
    pack_item,
    push_items,
    read_item,
    warp_any,
    warp_lane,
    warp_size,
    warp_stack,
    warp_sync,
    write_item,
)
from warp_abtree.kernels.triangle.float32_filter import SCREEN_UNIT

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# A visit replaces an item by four at most, each a level deeper in both trees, or by two, a level deeper in one. So
# depth first leaves three items a level at most, 31 levels deep.
DEPTH_FIRST_ROOM = wp.constant(128)

# A thread tests so many face pairs at a time, so that its processor finds its way through either loop; an early hit
# ends a pair for `any`.
FACES_READY, FACES_FOR_ANY = wp.constant(128), wp.constant(1)
ITEMS_FOR_ANY = wp.constant(8)
WAITING_ROOM = int(FACES_READY) + 4 * ITEMS_AT_ONCE + 16  # 16 are written at a time

STACK_MASK = wp.constant(STACK_LENGTH - 1)
# Warps on one pair part its work when there are about so many items for each, or as many as the stack takes then.
ITEMS_PER_WARP = wp.constant(8)
ITEMS_TO_PART = wp.constant(STACK_LENGTH // 2)
# An early hit ends a pair for `any`, so few face pairs wait.
FEW_CANDIDATES = wp.constant(8)
# A warp with work for two looks at every second turn whether others wait, at every one where pairs are few: a turn is
# so many visits, or fewer until a warp of face pairs waits, and their tests.
SHARE_LEAST = wp.constant(16)
MANY_PARTS = wp.constant(8)
VISITS_A_TURN = wp.constant(4)

long_counts = wp.types.vector(length=4, dtype=wp.int64)


@wp.func
def first_item(states: StatePool, pose: PairPose):
    """Return the item that compares the roots."""
    return pack_item(load_node(states, pose.node_a + 1).skip, load_node(states, pose.node_b + 1).skip)


@wp.func
def keep_hits(
    output: wp.int32, pair: wp.int32, swapped: wp.int32, count: wp.int32, faces: wp.array(dtype=wp.int64), hits: Hits
):
    """Note that an object pair meets, and report the pairs of faces on a list, if that is asked."""
    hits.any_hit[pair] = 1
    if output == OUTPUT_FACES:
        slot = take_slots(hits.total, count)
        for i in range(count):
            report_hit(slot + i, pair, swapped, item_first(faces[i]), item_second(faces[i]), hits)


@wp.func
def settle_waiting(
    mode: wp.int32,
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    met: wp.int32,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    met_inout: wp.array(dtype=wp.int64),
):
    """Decide pairs of faces that wait, perhaps until the first hit, and add hits to those on a list that have met.

    Returns how many have met then, and how many were decided. Both lists may be one: what is added stands before what
    is looked at.
    """
    tested = wp.int32(0)
    for i in range(waiting):
        if output != OUTPUT_ANY or met == 0:
            item = faces[i]
            tested += 1
            if test_faces(mode, models, states, pose, item_first(item), item_second(item)) == 1:
                met_inout[met] = item
                met += 1
    return met, tested


@wp.func
def settle_open(
    mode: wp.int32,
    output: wp.int32,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    met: wp.int32,
    left: wp.int32,
    left_open: wp.array(dtype=wp.int64),
    met_inout: wp.array(dtype=wp.int64),
):
    """Decide pairs of faces that float32 left open, as `settle_waiting`: for EXACT in float64, then what that leaves.

    Returns how many have met then, how many were decided, and how many of these took exact signs.
    """
    if mode != EXACT:
        met, tested = settle_waiting(mode, output, models, states, pose, met, left, left_open, met_inout)
        return met, tested, 0
    if left == 0 or (output == OUTPUT_ANY and met > 0):
        return met, 0, 0
    counts = filter_waiting(models, states, pose, output == OUTPUT_ANY, met, left, left_open, met_inout)
    met, hard = settle_waiting(
        mode, output, models, states, pose, wp.int32(counts[0]), wp.int32(counts[1]), left_open, met_inout
    )
    return met, wp.int32(counts[2]), hard


@wp.func
def write_counts(p: wp.int32, hit_count: wp.int64, tests: long_counts, hits: Hits):
    """Write what an object pair took: boxes, faces, those in float64 and those with exact signs."""
    hits.count[p] = hit_count
    hits.node_tests[p] = tests[0]
    hits.triangle_tests[p] = tests[1]
    hits.float64_tests[p] = tests[2]
    hits.exact_tests[p] = tests[3]


@functools.cache
def thread_traversal(mode: int):
    """Return the kernel whose threads share the object pairs, at a precision or WITHIN."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def traverse_thread_kernel(
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        pair_count: wp.array(dtype=wp.int32),
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
        work_inout: Work,
    ):
        """Take one object pair after the other and traverse it depth first; CPU only, a thread a core."""
        count = wp.min(pair_count[0], pair_poses.shape[0])
        stack = wp.zeros(shape=STACK_ROOM, dtype=wp.int64)
        waiting_faces = wp.zeros(shape=WAITING_ROOM, dtype=wp.int64)
        left_open = wp.zeros(shape=WAITING_ROOM, dtype=wp.int64)
        at_once, ready = ITEMS_AT_ONCE, FACES_READY
        if output == OUTPUT_ANY:
            at_once, ready = ITEMS_FOR_ANY, FACES_FOR_ANY
        p = take_unit(work_inout.counter)
        while p < count:
            pose = pair_poses[p]
            root = first_item(states, pose)
            stack[0] = pack_item(single_node(item_first(root)), single_node(item_second(root)))
            error, unit = wp.float32(pose.error), wp.float32(SCREEN_UNIT)
            if wp.static(mode == int(FLOAT32)):
                error, unit = wp.float32(0.0), wp.float32(0.0)
            top, hit_count = wp.int32(1), wp.int64(0)
            tests = long_counts()
            while top > 0:
                progress = descend(states, pose, at_once, ready, top, stack, waiting_faces)
                top, waiting = wp.int32(progress[0]), wp.int32(progress[1])
                if wp.static(mode == int(WITHIN)):
                    met, tested = settle_waiting(
                        wp.static(mode), output, models, states, pose, 0, waiting, waiting_faces, waiting_faces
                    )
                    tests += long_counts(progress[2], wp.int64(tested), wp.int64(0), wp.int64(0))
                else:
                    screened = screen_waiting(
                        models, states, pose, error, unit, output == OUTPUT_ANY, waiting, waiting_faces, left_open
                    )
                    met, left = wp.int32(screened[0]), wp.int32(screened[1])
                    met, filtered, hard = settle_open(
                        wp.static(mode), output, models, states, pose, met, left, left_open, waiting_faces
                    )
                    tests += long_counts(progress[2], screened[2], wp.int64(filtered), wp.int64(hard))
                if met > 0:
                    hit_count += wp.int64(met)
                    keep_hits(output, p, pose.swapped, met, waiting_faces, hits_inout)
                    if output == OUTPUT_ANY:
                        top = 0
            write_counts(p, hit_count, tests, hits_inout)
            p = take_unit(work_inout.counter)

    return traverse_thread_kernel


@wp.func
def expand_items(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    end: wp.int32,
    waiting: wp.int32,
    states: StatePool,
    pose: PairPose,
):
    """Visit items first to first + popped, one a thread, append what follows; return ends and pairs compared.

    Threads without an item look at another's, so that none branches.
    """
    lane = warp_lane()
    item = read_item(items, (first + wp.min(lane, popped - 1)) & STACK_MASK)
    warp_sync()
    children, steps, tests = visit_item(states, pose, item, wp.where(lane < popped, -1, 0))
    ends = push_items(items, end, waiting, steps, children)
    warp_sync()
    return item_second(ends), item_first(ends), tests


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
def spread_items(items: wp.uint64, part: wp.int32, parts: wp.int32, states: StatePool, pose: PairPose):
    """Start a pair: expand the roots breadth first, the same in every warp at work on it, and keep a share.

    Returns where the share starts and ends, the face pairs that wait, and the pairs of boxes compared: these two are
    the first warp's.
    """
    if warp_lane() == 0:
        write_item(items, 0, first_item(states, pose))
    warp_sync()
    head, end = wp.int32(0), wp.int32(1)
    waiting, compared = wp.int32(0), wp.int32(0)
    wanted = wp.min(parts * ITEMS_PER_WARP, ITEMS_TO_PART)
    while parts > 1 and end > head and end - head < wanted and waiting < warp_size():
        first = head
        head += wp.min(warp_size(), end - head)
        end, waiting, more = expand_items(items, first, head - first, end, waiting, states, pose)
        compared += more
    if part > 0:
        waiting = 0
        compared = 0
    end = part_items(items, head, end, part, parts)
    return head, end, waiting, compared


@wp.func
def take_share(items: wp.uint64, box: wp.int32, work: Work):
    """Put what lies in a mailbox on the empty stack; return the stack's end."""
    size = work.owner[box][1]
    lane = warp_lane()
    if lane < size:
        write_item(items, lane, work.item[box * MAILBOX_ITEMS + lane])
    empty_mailbox(work.flag, box)
    return size


@wp.func
def give_shares(items: wp.uint64, pair: wp.int32, head: wp.int32, end: wp.int32, hungry: wp.int32, work: Work):
    """Serve waiting warps with the oldest items, which have most below them; return the new head."""
    wanted = wp.min(hungry, SHARES_AT_ONCE)
    size = wp.min(wp.max((end - head) / (wanted + 1), SHARE_LEAST), MAILBOX_ITEMS)
    lane = warp_lane()
    while wanted > 0 and end - head >= 2 * size:
        ticket = open_mailbox(work.counter, work.flag)
        box = ticket & (MAILBOX_COUNT - 1)
        if lane < size:
            work.item[box * MAILBOX_ITEMS + lane] = read_item(items, (head + lane) & STACK_MASK)
        if lane == 0:
            work.owner[box] = wp.vec2i(pair, size)
        close_mailbox(work.flag, ticket)
        head += size
        wanted -= 1
    return head


@wp.func
def traverse_items(
    output: wp.int32,
    mode: wp.int32,
    for_any: bool,
    visits_max: wp.int32,
    share_mask: wp.int32,
    stack_room: wp.int32,
    items: wp.uint64,
    head: wp.int32,
    end: wp.int32,
    waiting: wp.int32,
    p: wp.int32,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    hits: Hits,
    work: Work,
):
    """Traverse what is on the stack and is not given away; return pairs of boxes compared, and face pair tests."""
    node_tests, turn = wp.int32(0), wp.int32(0)
    tested, hit_count, left_open = wp.int32(0), wp.int32(0), wp.int32(0)
    crossing = wp.int32(0)
    ready = wp.where(for_any, wp.min(FEW_CANDIDATES, warp_size()), warp_size())
    ready_crossing = wp.where(for_any, 1, warp_size())
    while end > head or waiting > 0 or crossing > 0:
        found = False
        tickets, visits = wp.int64(0), wp.int32(0)
        turn += 1
        if (turn & share_mask) == 0:
            tickets = load_tickets(work.counter)
        while visits < visits_max and end > head and waiting < ready:
            # One at a time, depth first, needs little room; more where there is.
            popped = wp.max(1, (stack_room - DEPTH_FIRST_ROOM - (end - head)) >> 2)
            popped = wp.min(popped, wp.min(warp_size(), end - head))
            end -= popped
            end, waiting, compared = expand_items(items, end, popped, end, waiting, states, pose)
            node_tests += compared
            visits += 1
        if waiting >= ready or (end == head and waiting > 0):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            crossing = part_candidates(mode, items, waiting, popped, crossing, models, states, pose)
            tested += popped
        if crossing >= ready_crossing or (end == head and waiting == 0 and crossing > 0):
            popped = wp.min(crossing, warp_size())
            crossing -= popped
            found, left = test_crossing(output, mode, items, crossing, popped, p, models, states, pose, hits)
            hit_count += wp.where(found, 1, 0)
            left_open += wp.where(left, 1, 0)
        hungry = count_hungry(tickets)
        if hungry > 0 and end - head >= 2 * SHARE_LEAST:
            head = give_shares(items, p, head, end, hungry, work)
        if for_any:
            if warp_any(found or hits.any_hit[p] != 0):
                end = head
                waiting = 0
                crossing = 0
    return node_tests, wp.vec3i(hit_count, wp.where(warp_lane() == 0, tested, 0), left_open)


@functools.cache
def warp_traversal(mode: int, for_any: bool):
    """Return the kernel that has warps share the object pairs: FLOAT32, WITHIN, or for both other precisions.

    One for OUTPUT_ANY and one for the other outputs, each with what it takes as constants. What float32 leaves open
    waits for the settling passes.
    """

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, cuda_max_registers=128)
    def traverse_warp_kernel(
        parts_max: wp.int32,
        stack_room: wp.int32,
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        pair_count: wp.array(dtype=wp.int32),
        pair_poses: wp.array(dtype=PairPose),
        hits_inout: Hits,
        work_inout: Work,
    ):
        """Traverse units of work, each a part of one object pair, and shares of them, until there are none."""
        count = wp.min(pair_count[0], pair_poses.shape[0])
        parts = part_count(parts_max, count)
        visits_max = VISITS_A_TURN
        share_mask = keep_value(wp.where(parts >= MANY_PARTS, wp.static(3 if for_any else 0), 1))
        if wp.static(for_any):
            # Where many warps look for one hit of a pair, each asks at every visit whether there is one.
            visits_max = keep_value(wp.where(parts >= MANY_PARTS, 1, VISITS_A_TURN))
        items = warp_stack()
        while True:
            unit = take_unit(work_inout.counter)
            p = unit / parts
            box = wp.int32(-1)
            if unit >= count * parts:
                box = await_share(work_inout.counter, work_inout.flag)
                if box < 0:
                    return
                p = work_inout.owner[box][0]
            pose = pair_poses[p]
            head, waiting, spread = wp.int32(0), wp.int32(0), wp.int32(0)
            if box >= 0:
                end = take_share(items, box, work_inout)
            else:
                head, end, waiting, spread = spread_items(items, unit % parts, parts, states, pose)
            node_tests, tests = traverse_items(
                wp.where(wp.static(for_any), OUTPUT_ANY, output), wp.static(mode), wp.static(for_any),
                visits_max, share_mask, stack_room, items, head, end, waiting, p,
                models, states, pose, hits_inout, work_inout,
            )  # fmt: skip
            add_warp_sum(hits_inout.node_tests, p, node_tests + spread)
            add_warp_sum(hits_inout.count, p, tests[0])
            add_warp_sum(hits_inout.triangle_tests, p, tests[1])
            add_warp_sum(hits_inout.float64_tests, p, tests[2])
            end_unit(work_inout.counter, work_inout.flag)

    return traverse_warp_kernel
