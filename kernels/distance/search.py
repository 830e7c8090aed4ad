"""Branch and bound for the nearest faces of two trees: depth first, nearest children first, by warps that share work.

Node pairs are dropped where their boxes are farther apart than the nearest pair of faces that any warp has found so
far; never where a pair of faces below may be as near, so that the nearest distance, and of equally near faces the
lowest pair, are found whatever the order. With a tolerance other faces are found in another order, within it.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.boxes import ROUNDING_DOWN
from warp_abtree.kernels.base.counters import add_warp_sum
from warp_abtree.kernels.base.lanes import (
    warp_any,
    warp_lane,
    warp_min,
    warp_min32,
    warp_min_item,
    warp_size,
    warp_sync,
)
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.distance.frame import (
    NO_FACES,
    NearestFound,
    SearchScale,
    Tolerances,
    scaled_up,
    tolerance_terms,
)
from warp_abtree.kernels.distance.node_pair import bound_children, limit_of
from warp_abtree.kernels.distance.warp_found import (
    SLABS_PAY,
    UPPER,
    load_distance,
    load_faces,
    load_upper,
    lower_upper,
    offer_nearest,
)
from warp_abtree.kernels.intersect.face_pairs import Hits, PairTests
from warp_abtree.kernels.search.item import first_item, item_first, item_second
from warp_abtree.kernels.search.load_balance import (
    DEPTH_FIRST_ROOM,
    STACK_MASK,
    Work,
    await_donation,
    count_idle,
    donate_items,
    load_tickets,
    receive_items,
    take_unit,
)
from warp_abtree.kernels.search.mean_slabs import Slabs, has_mean_slabs
from warp_abtree.kernels.search.nearest_stack import (
    OPEN_LENGTH,
    OPEN_START,
    nearest_stack,
    push_nearest,
    push_open,
    read_bound,
    write_bound,
)
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, read_item, write_item
from warp_abtree.kernels.triangle.corners import load_triangles
from warp_abtree.kernels.triangle.distance_bounds import bound_faces, load_points
from warp_abtree.kernels.triangle.triangle_pair import triangle_distance

MODULE_OPTIONS = native.options(
    "base/counters.cuh",
    "base/lanes.cuh",
    "distance/bound_faces.cuh",
    "distance/warp_found.cuh",
    "search/load_balance.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)

# Fewer items than the traversal gives away: far more lies below one.
SEARCH_DONATION_LEAST = wp.constant(4)


# Face pairs from which on it is known whether slabs pay, and items for three of them that they leave where they do.
MANY_FACES, FEW_FACES = wp.constant(1024), wp.constant(2)
# Items at once, at most, before any faces are known: more would be looked at in vain.
DIVE_ITEMS = wp.constant(8)


@wp.struct
class Search:
    """Search of a warp for the nearest faces of an object pair."""

    pair: wp.int32  # its number
    pose: PairPose  # of B in A's frame
    scaling: SearchScale  # how boxes are compared
    tolerances: Tolerances  # when they are near enough
    room: wp.int32  # items that the stack takes, STACK_LENGTH at most
    slabs: wp.bool  # whether there are some of both states


@wp.func
def bound_waiting(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    opened: wp.ref[wp.int32],
    limit: wp.float32,
    upper: wp.float32,
    search: Search,
    trees: Trees,
    found: NearestFound,
):
    """Bound face pairs in float32, one a lane, and keep those that may be nearest; return this lane's tests."""
    at = STACK_LENGTH + first + wp.min(warp_lane(), popped - 1)
    item = read_item(items, at)
    live = warp_lane() < popped and read_bound(items, at) <= limit
    warp_sync()
    lower, greatest = wp.float32(wp.inf), wp.float32(wp.inf)
    if live:
        pose, scaling = search.pose, search.scaling
        face_a, face_b = item_first(item), item_second(item)
        a, b = load_points(trees, pose, scaling.translation, scaling.scale, face_a, face_b)
        bound_faces(search.scaling.error, a, b, lower, greatest)
    least = warp_min32(greatest)
    if least < upper:
        lower_upper(found.upper, search.pair, UPPER, least)
    push_open(items, opened, live and lower <= wp.min(least, upper), item, lower)
    warp_sync()
    return wp.where(live, 1, 0)


@wp.func
def decide_open(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    upper: wp.float32,
    pair: wp.int32,
    trees: Trees,
    pair_poses: wp.array(dtype=PairPose),
    found: NearestFound,
):
    """Measure in float64 the face pairs that may still be nearest, one a lane.

    The pose in float64 is loaded here, so that the search need not keep it in registers.
    """
    at = OPEN_START + first + wp.min(warp_lane(), popped - 1)
    item = read_item(items, at)
    live = warp_lane() < popped and read_bound(items, at) <= upper
    warp_sync()
    if warp_any(live):
        d = wp.float64(wp.inf)
        if live:
            d = triangle_distance(load_triangles(trees, pair_poses[pair], item_first(item), item_second(item)))
        least = warp_min(d)
        lowest = warp_min_item(wp.where(d == least, item, NO_FACES))
        if least <= load_distance(found.distance, pair):
            offer_nearest(found.distance, found.faces, pair, least, lowest)
            lower_upper(found.upper, pair, UPPER, scaled_up(least, found.scaling[pair]))


@wp.func
def expand_nearest(
    items: wp.uint64,
    popped: wp.int32,
    end: wp.ref[wp.int32],
    waiting: wp.ref[wp.int32],
    limit: wp.float32,
    with_slabs: wp.bool,
    states: StatePool,
    slabs: Slabs,
    search: Search,
):
    """Expand so many items from the top of the stack, one a lane; return how many pairs of boxes were compared."""
    end -= popped
    at = (end + wp.min(warp_lane(), popped - 1)) & STACK_MASK
    item = read_item(items, at)
    live = wp.where(warp_lane() < popped and read_bound(items, at) <= limit, -1, 0)
    warp_sync()
    emitted = bound_children(with_slabs, states, slabs, search.pose, search.scaling, limit, item, live)
    push_nearest(items, end, waiting, emitted.kinds, emitted.items, emitted.bounds)
    warp_sync()
    return emitted.tests


@wp.func
def slabs_pay(faces: wp.int32, items: wp.int32):
    """Return whether slabs leave few face pairs, as counted so far: not for nested parts."""
    return faces < MANY_FACES or faces < FEW_FACES * (items / 3)


@wp.func
def search_items(
    search: Search,
    count: wp.int32,
    trees: Trees,
    pair_poses: wp.array(dtype=PairPose),
    slabs: Slabs,
    found: NearestFound,
    work: Work,
):
    """Search so many items of the stack, less those donated; return this lane's tests of boxes and of faces."""
    items, pair, scaling = nearest_stack(), search.pair, search.scaling
    head, end, waiting, opened = wp.int32(0), wp.int32(count), wp.int32(0), wp.int32(0)
    tests, seen_items, seen_faces = PairTests(), wp.int32(0), wp.int32(0)
    has_candidate = load_faces(found.faces, pair) != NO_FACES
    # Bounds under it are of faces that are as near as is asked.
    beyond = wp.float32(load_distance(found.distance, pair) * scaling.scale64) * ROUNDING_DOWN
    terms = tolerance_terms(search.tolerances, scaling)
    while end > head or waiting > 0 or opened > 0:
        tickets = load_tickets(work.counter)
        known = load_upper(found.upper, pair)
        upper, with_slabs = known[UPPER], search.slabs and known[SLABS_PAY] > 0.0
        has_candidate = has_candidate or upper < beyond
        limit = limit_of(scaling, terms, upper, has_candidate)
        if end > head and waiting < warp_size():
            # One at a time, depth first, needs little room; more where there is.
            popped = wp.max(1, (search.room - DEPTH_FIRST_ROOM - (end - head)) >> 2)
            popped = wp.min(
                popped, wp.min(wp.where(has_candidate, warp_size(), wp.min(DIVE_ITEMS, warp_size())), end - head)
            )
            seen_items += popped
            tests.nodes += expand_nearest(items, popped, end, waiting, limit, with_slabs, trees.states, slabs, search)
        # The first face pairs are measured at once: until then, nothing is dropped.
        if waiting >= warp_size() or (waiting > 0 and (end == head or not has_candidate)):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            seen_faces += popped
            if with_slabs and not slabs_pay(seen_faces, seen_items):
                lower_upper(found.upper, pair, SLABS_PAY, 0.0)
            tests.faces += bound_waiting(items, waiting, popped, opened, limit, upper, search, trees, found)
        if opened > OPEN_LENGTH - warp_size() or (opened > 0 and end == head and waiting == 0):
            popped = wp.min(opened, warp_size())
            opened -= popped
            upper = load_upper(found.upper, pair)[UPPER]
            decide_open(items, opened, popped, upper, pair, trees, pair_poses, found)
        idle = count_idle(tickets)
        if idle > 0 and end - head >= 2 * SEARCH_DONATION_LEAST:
            head = donate_items(SEARCH_DONATION_LEAST, pair, idle, items, head, end, work)
    return tests


@wp.func
def start_search_items(slot: wp.int32, states: StatePool, pose: PairPose, work: Work):
    """Push both roots, or the donated items of a slot, 0 or more, on the empty stack; return how many items."""
    items = nearest_stack()
    size = wp.int32(1)
    if slot >= 0:
        size = receive_items(items, slot, work)
    elif warp_lane() == 0:
        write_item(items, 0, first_item(states, pose))
    if warp_lane() < size:
        write_bound(items, warp_lane(), wp.float32(0.0))
    warp_sync()
    return size


@wp.kernel(module="unique", module_options=MODULE_OPTIONS, launch_bounds=(32, 12))
def search_warp_kernel(
    room: wp.int32,
    tolerances: Tolerances,
    trees: Trees,
    batch: PairBatch,
    slabs_inout: Slabs,
    found_inout: NearestFound,
    hits_inout: Hits,
    work_inout: Work,
):
    """Search the object pairs that do not intersect: units of work, a pair each, and donated items.

    The slabs that were due have been made.
    """
    count = wp.min(batch.count[0], batch.poses.shape[0])
    search = Search()
    search.room = room
    search.tolerances = tolerances
    if wp.tid() == 0:
        slabs_inout.due_count[0] = 0
    p = take_unit(work_inout.counter)
    ended = wp.int32(0)
    while True:
        slot = wp.int32(-1)
        if p >= count:
            slot = await_donation(work_inout.counter, work_inout.flag, ended)
            if slot < 0:
                return
            ended = 0
            p = work_inout.owner[slot][0]
        if hits_inout.any_hit[p] == 0:
            search.pair = p
            search.pose = batch.poses[p]
            search.scaling = found_inout.scaling[p]
            search.slabs = has_mean_slabs(trees.states, slabs_inout, p)
            size = start_search_items(slot, trees.states, search.pose, work_inout)
            tests = search_items(search, size, trees, batch.poses, slabs_inout, found_inout, work_inout)
            add_warp_sum(hits_inout.node_tests, p, tests.nodes)
            add_warp_sum(hits_inout.triangle_tests, p, tests.faces)
        ended += 1
        p = count
        if slot < 0:
            p = take_unit(work_inout.counter)
