"""Nearest faces of an object to the points of a warp, one a lane: a policy of the best-first search.

Nodes and faces of all points share the lists, so that lanes have work while some points take long.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import round_down
from warp_abtree.kernels.base.lanes import next_place, warp_lane, warp_sync
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.inside.nearest_face import (
    NO_NEAREST,
    Solid,
    bound_face,
    into_frame,
    point_distance,
    square_outside,
)
from warp_abtree.kernels.inside.parity import load_posed_face
from warp_abtree.kernels.search.best_first import BestFirstPolicy, Entry, SearchLists, best_first, start_lists
from warp_abtree.kernels.search.item import FACES, NODES, Emitted, item_first, item_second, pack_item
from warp_abtree.kernels.search.nearest_stack import NEAREST_MEMORY, nearest_stack, push_open, write_bounded
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class PointsSearch:
    """Search for the faces of an object that are nearest to points; items are a node or face, and a point's slot."""

    pose: PairPose  # the object as A or B of it
    solid: Solid  # the object


@native.func_native()
def put_point(slot: wp.int32, point: wp.vec3d, x: wp.vec3d, most: wp.float64, none: wp.int32):
    """Put a point into a slot, in A's frame and as boxes see it, with the most that faces count at, and no face."""


@native.func_native()
def point_of_slot(slot: wp.int32) -> wp.vec3d: ...


@native.func_native()
def least_of_slot(slot: wp.int32) -> wp.float64: ...


@native.func_native()
def face_of_slot(slot: wp.int32) -> wp.int32: ...


@native.func_native()
def bound_children_of_slot(
    boxes: wp.array(dtype=wp.vec4),
    start: wp.int32,
    node: wp.int32,
    slot: wp.int32,
    x: wp.vec3d,
    bounds: wp.ref[wp.vec2],
    codes: wp.ref[wp.vec2i],
):
    """Find what `open_node` does of a slot's point x, rounded down."""


@native.func_native()
def offer_point_face(live: bool, slot: wp.int32, distance: wp.float64, face: wp.int32, none: wp.int32):
    """Offer a face a lane to a slot, which keeps the nearest, the lowest of several. For all lanes.

    No face stands for one at most as far away, which is offered later.
    """


@wp.func
def square_limit(solid: Solid, slot: wp.int32):
    """Return the square of the distance of boxes that may hold a face as near as the nearest of a slot."""
    limit = (least_of_slot(slot) + solid.margin) * solid.grow
    return limit * limit


@wp.func
def open_nodes_of_points(trees: Trees, given: wp.int32, search: wp.ref[PointsSearch], entry: Entry):
    """Emit those children of a node that may hold a face as near."""
    emitted = Emitted()
    slot = item_second(entry.item)
    limit = square_limit(search.solid, slot)
    if entry.live and wp.float64(entry.bound) <= limit:
        bounds, codes = wp.vec2(), wp.vec2i()
        x = into_frame(search.pose, search.solid, point_of_slot(slot))
        bound_children_of_slot(trees.states.node_box, search.solid.node, item_first(entry.item), slot, x, bounds, codes)
        emitted.tests = 2
        for k in range(2):
            # Infinite where nothing is active.
            if wp.float64(bounds[k]) <= limit and bounds[k] < wp.inf:
                emitted.kinds[k] = wp.where(codes[k] < 0, FACES, NODES)
                emitted.items[k] = pack_item(wp.where(codes[k] < 0, ~codes[k], codes[k]), slot)
                emitted.bounds[k] = bounds[k]
    return emitted


@wp.func
def bound_faces_of_points(
    trees: Trees, given: wp.int32, search: wp.ref[PointsSearch], lists: wp.ref[SearchLists], entry: Entry
):
    """Bound a face a lane from both sides: one that may be nearest waits, and the nearest corner bounds the slot."""
    face, slot, solid = item_first(entry.item), item_second(entry.item), search.solid
    live = entry.live and wp.float64(entry.bound) <= square_limit(solid, slot)
    point, most, least = point_of_slot(slot), wp.float64(0.0), wp.float64(0.0)
    if live:
        a, b, c = load_posed_face(trees, search.pose, solid.of_b, face)
        along, square = bound_face(a, b, c, point)
        least = wp.where(square > wp.float64(0.0), along / square * along, wp.float64(0.0))
        corner = wp.min(wp.min(wp.length_sq(a - point), wp.length_sq(b - point)), wp.length_sq(c - point))
        most = (wp.sqrt(corner) + solid.margin) * solid.grow
    offer_point_face(live, slot, most, NO_NEAREST, NO_NEAREST)
    live = live and not least > square_limit(solid, slot)
    push_open(lists.items, lists.opened, live, entry.item, round_down(least))


@wp.func
def measure_faces_of_points(
    trees: Trees, given: wp.int32, search: wp.ref[PointsSearch], lists: wp.ref[SearchLists], entry: Entry
):
    """Measure a face a lane."""
    face, slot = item_first(entry.item), item_second(entry.item)
    live = entry.live and wp.float64(entry.bound) <= square_limit(search.solid, slot)
    distance = wp.float64(0.0)
    if live:
        distance = point_distance(trees, search.pose, search.solid, face, point_of_slot(slot))
    offer_point_face(live, slot, distance, face, NO_NEAREST)


search_points = best_first(
    BestFirstPolicy(
        NEAREST_MEMORY,
        wp.int32,
        PointsSearch,
        None,
        open_nodes_of_points,
        bound_faces_of_points,
        measure_faces_of_points,
        shift=1,
    )
)


@wp.func
def nearest_faces_of_warp(trees: Trees, pose: PairPose, solid: Solid, asks: bool, point: wp.vec3d, most: wp.float64):
    """Return what `nearest_face_within` does of the point of each lane that asks. For all lanes."""
    search = PointsSearch()
    search.pose = pose
    search.solid = solid
    x = into_frame(pose, solid, point)
    put_point(warp_lane(), point, x, most, NO_NEAREST)
    lists = start_lists(nearest_stack(), STACK_LENGTH)
    root = load_node(trees.states, solid.node + 1)
    square = square_outside(root, x)
    starts = asks and square <= square_limit(solid, warp_lane()) and square < wp.float64(wp.inf)
    # A single face waits at once.
    place = STACK_LENGTH + next_place(lists.waiting, starts and root.face >= 0)
    if root.face < 0:
        place = next_place(lists.end, starts)
    if starts:
        item = pack_item(wp.where(root.face >= 0, root.face, root.skip), warp_lane())
        write_bounded(lists.items, place, item, round_down(square), 0)
    warp_sync()
    search_points(trees, 0, search, lists)
    return least_of_slot(warp_lane()), face_of_slot(warp_lane())
