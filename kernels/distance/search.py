"""The search of two trees for their nearest faces, a warp an object pair: depth first, the nearest children first.

Node pairs are dropped where their boxes are farther apart than the nearest pair of faces found so far; never where a
pair of faces below may be as near, so that the nearest distance, and of equally near faces the lowest pair, are found
whatever the order. With a tolerance other faces are found in another order, within it.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.distance.frame import NO_FACES, Found, Frame, Nearest, Tolerances, load_triangles
from warp_abtree.kernels.distance.node_pair import bound_children, limit_of
from warp_abtree.kernels.distance.triangle_pair import triangle_distance
from warp_abtree.kernels.generation import STALE
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.face_pairs import Hits
from warp_abtree.kernels.traversal.node_pair import first_item, four_items, item_first, item_second
from warp_abtree.kernels.traversal.warp_stack import (
    STACK_LENGTH,
    add_warp_sum,
    read_item,
    warp_lane,
    warp_size,
    warp_sync,
    write_item,
)

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# As in `traversal.dual_tree`.
DEPTH_FIRST_ROOM = wp.constant(128)

FIRST_TOLERANCE = wp.constant(wp.float64(0.25))

stack_code = functools.partial(native.body, "nearest_stack.cuh")


@wp.func_native(stack_code("nearest_stack"))
def nearest_stack() -> wp.uint64:
    """Return where this warp's lists lie, an address in shared memory on CUDA: node pairs, face pairs, their bounds."""


@wp.func_native(stack_code("read_bound"))
def read_bound(items: wp.uint64, i: wp.int32) -> wp.float32: ...


@wp.func_native(stack_code("write_bound"))
def write_bound(items: wp.uint64, i: wp.int32, bound: wp.float32): ...


@wp.func_native(stack_code("push_nearest"))
def push_nearest(
    items: wp.uint64, end: wp.int32, leaf_end: wp.int32, kinds: wp.vec4i, children: four_items, bounds: wp.vec4
) -> wp.int64:
    """Append node pairs to the stack, the nearest of each lane last, and face pairs to theirs.

    Returns both ends as an item, that of the face pairs first.
    """


@wp.func_native(stack_code("warp_min"))
def warp_min(x: wp.float64) -> wp.float64: ...


@wp.func_native(stack_code("warp_min_item"))
def warp_min_item(x: wp.int64) -> wp.int64: ...


@wp.func
def measure_faces(
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    limit: wp.float32,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    before: Nearest,
):
    """Measure the face pairs first to first + popped, one a lane; return the nearest, and how many this lane took."""
    nearest = before
    at = STACK_LENGTH + first + wp.min(warp_lane(), popped - 1)
    item = read_item(items, at)
    live = warp_lane() < popped and read_bound(items, at) <= limit
    warp_sync()
    d = wp.float64(wp.inf)
    if live:
        d = triangle_distance(load_triangles(models, states, pose, item_first(item), item_second(item)))
    least = warp_min(d)
    if least <= nearest.distance:
        lowest = warp_min_item(wp.where(d == least, item, NO_FACES))
        if least < nearest.distance or lowest < nearest.faces:
            nearest.distance = least
            nearest.faces = lowest
    return nearest, wp.where(live, 1, 0)


@wp.func
def search_pair(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    frame: Frame,
    tolerances: Tolerances,
    room: wp.int32,
    start: Nearest,
):
    """Return the nearest faces of an object pair, and what this lane compared: boxes and faces."""
    nearest = start
    items = nearest_stack()
    if warp_lane() == 0:
        write_item(items, 0, first_item(states, pose))
        write_bound(items, 0, wp.float32(0.0))
    warp_sync()
    limit = limit_of(frame, tolerances, nearest)
    end, waiting = wp.int32(1), wp.int32(0)
    tests = wp.vec2i()
    while end > 0 or waiting > 0:
        if end > 0 and waiting < warp_size():
            # One at a time, depth first, needs little room; more where there is.
            popped = wp.max(1, (room - DEPTH_FIRST_ROOM - end) >> 2)
            popped = wp.min(popped, wp.min(warp_size(), end))
            end -= popped
            at = end + wp.min(warp_lane(), popped - 1)
            item = read_item(items, at)
            live = wp.where(warp_lane() < popped and read_bound(items, at) <= limit, -1, 0)
            warp_sync()
            children, kinds, bounds, compared = bound_children(states, pose, frame, limit, item, live)
            ends = push_nearest(items, end, waiting, kinds, children, bounds)
            warp_sync()
            end = item_second(ends)
            waiting = item_first(ends)
            tests[0] += compared
        # The first face pairs are measured at once: until then, nothing is dropped.
        if waiting >= warp_size() or (waiting > 0 and (end == 0 or nearest.faces == NO_FACES)):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            nearest, measured = measure_faces(items, waiting, popped, limit, models, states, pose, nearest)
            limit = limit_of(frame, tolerances, nearest)
            tests[1] += measured
    return nearest, tests


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def search_warp_kernel(
    room: wp.int32,
    tolerances: Tolerances,
    models: ModelPool,
    states: StatePool,
    pair_count: wp.array(dtype=wp.int32),
    pair_poses: wp.array(dtype=PairPose),
    found_inout: Found,
    hits_inout: Hits,
):
    """Search the object pairs that do not intersect, a warp a pair."""
    p = wp.tid() / warp_size()
    if p >= pair_count[0] or found_inout.launched[0] == STALE:
        return
    if hits_inout.any_hit[p] != 0:
        return
    nearest = Nearest()
    nearest.distance = found_inout.distance[p]
    nearest.faces = found_inout.faces[p]
    pose = pair_poses[p]
    # Without faces to start from, what is found within a wide tolerance is: far fewer are looked at in vain.
    turn = wp.where(nearest.faces == NO_FACES, 0, 1)
    tests = wp.vec2i()
    while turn < 2:
        asked = tolerances
        if turn == 0:
            asked.relative = wp.max(tolerances.relative, FIRST_TOLERANCE)
        nearest, more = search_pair(models, states, pose, found_inout.frame[p], asked, room, nearest)
        tests += more
        turn += 1
    if warp_lane() == 0:
        found_inout.distance[p] = nearest.distance
        found_inout.faces[p] = nearest.faces
    add_warp_sum(hits_inout.node_tests, p, tests[0])
    add_warp_sum(hits_inout.triangle_tests, p, tests[1])
