"""First crossing faces of object pairs that intersect, by depth-first search, and a point of both.

Which pair is first does not depend on how many a warp looks at together, nor on the bounds of boxes: nodes and faces
lie on one stack in their order, a hit drops what comes after it, and the search goes on with what comes before.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.lanes import warp_lane, warp_min_item, warp_size, warp_sync
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.distance.frame import NO_FACES, NearestFound, SearchScale
from warp_abtree.kernels.distance.node_pair import bound_children
from warp_abtree.kernels.distance.report import Distances, write_nearest
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import Hits, test_faces
from warp_abtree.kernels.search.item import DROPPED, FACES, NODES, first_item, four_items, item_first, item_second
from warp_abtree.kernels.search.load_balance import DEPTH_FIRST_ROOM, count_to_pop
from warp_abtree.kernels.search.mean_slabs import Slabs
from warp_abtree.kernels.search.nearest_stack import nearest_stack, read_bound, write_bound
from warp_abtree.kernels.search.warp_stack import read_item, write_item
from warp_abtree.kernels.triangle.corners import load_corners
from warp_abtree.kernels.triangle.segment import intersect_faces

MODULE_OPTIONS = native.options(
    "base/lanes.cuh",
    "base/quotients.cuh",
    "exact/determinant.cuh",
    "exact/expansion.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)


@native.func_native()
def push_in_order(items: wp.uint64, end: wp.ref[wp.int32], kinds: wp.vec4i, children: four_items):
    """Push the items that are not dropped, the first child of the first lane last."""


@wp.func
def search_crossing(trees: Trees, pose: PairPose, scaling: SearchScale, room: wp.int32):
    """Return the first faces of an object pair that intersect, NO_FACES where none do."""
    items = nearest_stack()
    if warp_lane() == 0:
        write_item(items, 0, first_item(trees.states, pose))
        write_bound(items, 0, wp.float32(NODES))
    warp_sync()
    found = NO_FACES
    end = wp.int32(1)
    while end > 0:
        popped = count_to_pop(room - DEPTH_FIRST_ROOM - end, 2, end)
        # The first of the stack's top to the first lane.
        at = end - 1 - wp.min(warp_lane(), popped - 1)
        end -= popped
        item = read_item(items, at)
        kind = wp.where(warp_lane() < popped, wp.int32(read_bound(items, at)), DROPPED)
        warp_sync()
        crosses = False
        if kind == FACES:
            crosses = test_faces(EXACT, trees, pose, item_first(item), item_second(item)) == 1
        first = wp.int32(warp_min_item(wp.where(crosses, wp.int64(warp_lane()), wp.int64(popped))))
        if first < popped:
            end = 0
            found = warp_min_item(wp.where(first == warp_lane(), item, NO_FACES))
        live = wp.where(kind == NODES and warp_lane() < first, -1, 0)
        if kind != NODES:
            item = first_item(trees.states, pose)
        emitted = bound_children(False, trees.states, Slabs(), pose, scaling, wp.float32(0.0), item, live)
        push_in_order(items, end, emitted.kinds, emitted.items)
        warp_sync()
    return found


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def search_crossing_kernel(room: wp.int32, trees: Trees, batch: PairBatch, hits: Hits, found_inout: NearestFound):
    """Find the first crossing faces of the object pairs that intersect, a warp a pair."""
    p = wp.tid() / warp_size()
    if p >= batch.count[0] or batch.launched[0] == STALE:
        return
    if hits.any_hit[p] != 1:
        return
    faces = search_crossing(trees, batch.poses[p], found_inout.scaling[p], room)
    if warp_lane() == 0:
        found_inout.faces[p] = faces


@wp.kernel
def report_crossing_kernel(trees: Trees, batch: PairBatch, found: NearestFound, hits: Hits, distances_out: Distances):
    """Report the faces of an object pair that intersects, and the middle of what they share, a thread a pair."""
    p = wp.tid()
    if p >= batch.count[0] or batch.launched[0] == STALE:
        return
    if hits.any_hit[p] != 1 or found.faces[p] == NO_FACES:
        return
    pose = batch.poses[p]
    face_a, face_b = item_first(found.faces[p]), item_second(found.faces[p])
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, pose, face_a, face_b, corner)
    p0, p1, _ = intersect_faces(pose.scale, corner)
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    middle = wp.float64(0.5) * (p0 + p1)
    point = pose_point(trees.objects.rotation[a], trees.objects.position[a], middle)
    write_nearest(p, pose.swapped, face_a, face_b, point, point, distances_out)
