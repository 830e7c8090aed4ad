"""Branch and bound for the nearest faces of two trees: depth first, nearest children first, by warps that share work.

Node pairs are dropped where their boxes are farther apart than the nearest pair of faces that any warp has found so
far; never where a pair of faces below may be as near, so that the nearest distance, and of equally near faces the
lowest pair, are found whatever the order. With a tolerance other faces are found in another order, within it.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.boxes import ROUNDING_DOWN
from warp_abtree.kernels.base.counters import add_lanes
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
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.search.best_first import BestFirstPolicy, Entry, SearchLists, best_first, start_lists
from warp_abtree.kernels.search.item import first_item, item_first, item_second
from warp_abtree.kernels.search.load_balance import Work, await_donation, receive_items, take_unit
from warp_abtree.kernels.search.mean_slabs import Slabs, has_mean_slabs
from warp_abtree.kernels.search.nearest_stack import (
    NEAREST_MEMORY,
    OPEN_LENGTH,
    nearest_stack,
    push_open,
    write_bound,
)
from warp_abtree.kernels.search.warp_stack import write_item
from warp_abtree.kernels.triangle.corners import load_triangles
from warp_abtree.kernels.triangle.distance_bounds import bound_faces, load_points
from warp_abtree.kernels.triangle.triangle_pair import triangle_distance

MODULE_OPTIONS = native.options(
    "base/counters.cuh",
    "base/lanes.cuh",
    "base/quotients.cuh",
    "distance/bound_faces.cuh",
    "distance/warp_found.cuh",
    "search/load_balance.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)

# Fewer items than the traversal gives away: far more lies below one.
SEARCH_DONATION_LEAST = 4


# Face pairs from which on it is known whether slabs pay, and items for three of them that they leave where they do.
MANY_FACES, FEW_FACES = wp.constant(1024), wp.constant(2)
# Items at once, at most, before any faces are known: more would be looked at in vain.
DIVE_ITEMS = wp.constant(8)


@wp.struct
class NearestGiven:
    """What warps that search for nearest faces share."""

    batch: PairBatch  # the object pairs
    slabs: Slabs  # of their states
    found: NearestFound  # what they have found
    work: Work  # what they give away


@wp.struct
class NearestSearch:
    """Search of a warp for the nearest faces of an object pair."""

    pair: wp.int32  # its number
    pose: PairPose  # of B in A's frame
    scaling: SearchScale  # how boxes are compared
    terms: wp.vec4  # `tolerance_terms`
    has_slabs: wp.bool  # whether there are some of both states
    with_slabs: wp.bool  # whether they count, too
    has_candidate: wp.bool  # whether there are faces at most as far as `upper`
    beyond: wp.float32  # bounds under it are of faces that are as near as is asked
    upper: wp.float32  # scaled distance that the nearest faces are not beyond
    limit: wp.float32  # bound of node pairs and leaf pairs that matter
    seen_items: wp.int32  # by all lanes
    seen_faces: wp.int32  # by all lanes
    nodes: wp.int32  # pairs of boxes that this lane has compared
    faces: wp.int32  # pairs of faces that it has measured


@wp.func
def refresh_limit(given: NearestGiven, search: wp.ref[NearestSearch], lists: wp.ref[SearchLists]):
    """Take the least distance that any warp has found; without any, dive: what is measured first lets others drop."""
    known = load_upper(given.found.upper, search.pair)
    search.upper = known[UPPER]
    search.with_slabs = search.has_slabs and known[SLABS_PAY] > 0.0
    search.has_candidate = search.has_candidate or search.upper < search.beyond
    search.limit = limit_of(search.scaling, search.terms, search.upper, search.has_candidate)
    lists.at_once = wp.where(search.has_candidate, warp_size(), wp.min(DIVE_ITEMS, warp_size()))
    lists.leaf_ready = wp.where(search.has_candidate, warp_size(), 1)


@wp.func
def expand_nearest(trees: Trees, given: NearestGiven, search: wp.ref[NearestSearch], entry: Entry):
    """Bound the children of node pairs, one a lane."""
    search.seen_items += entry.count
    live = wp.where(entry.live and entry.bound <= search.limit, -1, 0)
    emitted = bound_children(
        search.with_slabs, trees.states, given.slabs, search.pose, search.scaling, search.limit, entry.item, live
    )
    search.nodes += emitted.tests
    return emitted


@wp.func
def slabs_pay(faces: wp.int32, items: wp.int32):
    """Return whether slabs leave few face pairs, as counted so far: not for nested parts."""
    return faces < MANY_FACES or faces < FEW_FACES * (items / 3)


@wp.func
def bound_waiting(
    trees: Trees, given: NearestGiven, search: wp.ref[NearestSearch], lists: wp.ref[SearchLists], entry: Entry
):
    """Bound face pairs in float32, one a lane, and keep those that may be nearest."""
    search.seen_faces += entry.count
    if search.with_slabs and not slabs_pay(search.seen_faces, search.seen_items):
        lower_upper(given.found.upper, search.pair, SLABS_PAY, 0.0)
    live = entry.live and entry.bound <= search.limit
    lower, greatest = wp.float32(wp.inf), wp.float32(wp.inf)
    if live:
        face_a, face_b = item_first(entry.item), item_second(entry.item)
        a, b = load_points(trees, search.pose, search.scaling.translation, search.scaling.scale, face_a, face_b)
        bound_faces(search.scaling.error, a, b, lower, greatest)
    least = warp_min32(greatest)
    if least < search.upper:
        lower_upper(given.found.upper, search.pair, UPPER, least)
    push_open(lists.items, lists.opened, live and lower <= wp.min(least, search.upper), entry.item, lower)
    search.faces += wp.where(live, 1, 0)


@wp.func
def decide_open(
    trees: Trees, given: NearestGiven, search: wp.ref[NearestSearch], lists: wp.ref[SearchLists], entry: Entry
):
    """Measure in float64 the face pairs that may still be nearest, one a lane.

    The pose in float64 is loaded here, so that the search need not keep it in registers.
    """
    found, pair = given.found, search.pair
    # All lanes load it together, those without an entry, too.
    upper = load_upper(found.upper, pair)[UPPER]
    live = entry.live and entry.bound <= upper
    if warp_any(live):
        d = wp.float64(wp.inf)
        if live:
            pose = given.batch.poses[pair]
            d = triangle_distance(load_triangles(trees, pose, item_first(entry.item), item_second(entry.item)))
        least = warp_min(d)
        lowest = warp_min_item(wp.where(d == least, entry.item, NO_FACES))
        if least <= load_distance(found.distance, pair):
            offer_nearest(found.distance, found.faces, pair, least, lowest)
            lower_upper(found.upper, pair, UPPER, scaled_up(least, found.scaling[pair]))


search_items_nearest = best_first(
    BestFirstPolicy(
        NEAREST_MEMORY,
        NearestGiven,
        NearestSearch,
        refresh_limit,
        expand_nearest,
        bound_waiting,
        decide_open,
        donates=SEARCH_DONATION_LEAST,
    )
)


@wp.func
def start_nearest(p: wp.int32, tolerances: Tolerances, states: StatePool, given: NearestGiven):
    """Return the search for the nearest faces of an object pair."""
    search = NearestSearch()
    search.pair = p
    search.pose = given.batch.poses[p]
    search.scaling = given.found.scaling[p]
    search.terms = tolerance_terms(tolerances, search.scaling)
    search.has_slabs = has_mean_slabs(states, given.slabs, p)
    search.has_candidate = load_faces(given.found.faces, p) != NO_FACES
    search.beyond = wp.float32(load_distance(given.found.distance, p) * search.scaling.scale64) * ROUNDING_DOWN
    return search


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
    given = NearestGiven()
    given.batch = batch
    given.slabs = slabs_inout
    given.found = found_inout
    given.work = work_inout
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
            search = start_nearest(p, tolerances, trees.states, given)
            lists = start_lists(nearest_stack(), room)
            lists.end = start_search_items(slot, trees.states, search.pose, work_inout)
            lists.open_ready = OPEN_LENGTH - warp_size() + 1
            search_items_nearest(trees, given, search, lists)
            add_lanes(hits_inout.node_tests, p, wp.int64(search.nodes))
            add_lanes(hits_inout.triangle_tests, p, wp.int64(search.faces))
        ended += 1
        p = count
        if slot < 0:
            p = take_unit(work_inout.counter)
