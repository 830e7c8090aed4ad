"""Depth of an object pair by branch and bound: the greatest of samples of one surface inside the other, a solid.

A motion shorter than the depth of a sample (`inside.samples`) leaves it inside, so the greatest depth is a lower bound
of any motion that frees the two. Nodes of the tree whose samples are looked at are dropped where, by the distance of
their middle from the surface, nothing below can be inside, or deeper than what is known; never where it may be as deep,
so that the deepest sample, the lowest of several, is found in any order.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import round_up
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.lanes import warp_lane, warp_max, warp_min_item, warp_size, warp_sync
from warp_abtree.kernels.base.nodes import Node, load_node
from warp_abtree.kernels.base.poses import HALF, PairBatch, PairPose, pose_point
from warp_abtree.kernels.distance.frame import SearchScale, make_scale, slack_of
from warp_abtree.kernels.distance.report import Distances, blend_corners, write_nearest
from warp_abtree.kernels.inside.components import Solids
from warp_abtree.kernels.inside.nearest_face import (
    NO_NEAREST,
    Solid,
    into_frame,
    make_solid,
    nearest_face,
    point_features,
    point_weights,
    square_outside,
)
from warp_abtree.kernels.inside.parity import is_inside, load_posed_face
from warp_abtree.kernels.inside.samples import (
    KNOWN,
    NO_SAMPLE,
    SAMPLES,
    Deepest,
    Sampling,
    is_avoided,
    measure_samples,
    sample_weights,
)
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.search.best_first import BestFirstPolicy, Entry, SearchLists, best_first, start_lists
from warp_abtree.kernels.search.item import FACES, NODES, Emitted, item_first, item_second, pack_item
from warp_abtree.kernels.search.nearest_stack import NEAREST_MEMORY, nearest_stack, write_bound
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, write_item

MODULE_OPTIONS = native.options(
    "base/lanes.cuh",
    "distance/point_boxes.cuh",
    "exact/determinant.cuh",
    "search/load_balance.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)


@wp.struct
class DepthSearch:
    """Search for the deepest sample of one object inside the other."""

    pose: PairPose  # of B in A's frame
    inner: Solid  # whose samples are looked at
    outer: Solid  # what they are inside
    sampling: Sampling  # which of them count
    best: Deepest  # so far, the same in all lanes


@wp.func
def bound_depth(trees: Trees, search: DepthSearch, node: Node, hint: wp.int32):
    """Return an upper bound of the depth below a node, negative only if less than what is known, and a face.

    With the node's middle at a distance d from the surface, and points within r of it, an inside point is no deeper
    than d + r, and no deeper than r - d where the middle is outside: the surface lies between them.
    """
    pose, inner, outer, known = search.pose, search.inner, search.outer, search.best.depth
    none = -wp.float64(1.0)
    if node.skip < 0:
        return none, hint
    lower, upper = wp.vec3d(node.lower), wp.vec3d(node.upper)
    middle = HALF * (lower + upper) + inner.centre
    if inner.of_b:
        middle = pose_point(pose.rotation, pose.translation, middle)
    reach = wp.length(HALF * (upper - lower)) * outer.grow + outer.margin
    if is_avoided(search.sampling, middle, reach):
        return none, hint
    # What is inside lies within the root's box, and no deeper than its nearest side.
    root = load_node(trees.states, outer.node + 1)
    x = into_frame(pose, outer, middle)
    if square_outside(root, x) > reach * reach:
        return none, hint
    for i in range(3):
        side = wp.min(x[i] - wp.float64(root.lower[i]), wp.float64(root.upper[i]) - x[i])
        if side + reach < known:
            return none, hint
    distance, near = nearest_face(trees, pose, outer, middle, hint, known - reach)
    if distance + reach < known:
        return none, near
    if reach - distance < known or distance > reach:
        centre = wp.where(inner.of_b, outer.centre, inner.centre)
        if not is_inside(trees, pose, outer.of_b, centre, middle):
            return none, near
    return distance + reach, near


@wp.func
def expand_node(trees: Trees, given: wp.int32, search: wp.ref[DepthSearch], entry: Entry):
    """Bound the samples below both children of a node; its item names the outer face that was nearest above it, too."""
    emitted = Emitted()
    live = entry.live and wp.float64(-entry.bound) >= search.best.depth
    emitted.tests = wp.where(live, 2, 0)
    for k in range(2):
        child = load_node(trees.states, search.inner.node + wp.where(live, 2 * item_first(entry.item) + k, 1))
        if live:
            bound, near = bound_depth(trees, search, child, item_second(entry.item))
            if bound >= wp.float64(0.0):
                emitted.kinds[k] = wp.where(child.face >= 0, FACES, NODES)
                emitted.items[k] = pack_item(wp.where(child.face >= 0, child.face, child.skip), near)
                emitted.bounds[k] = -round_up(bound)
    return emitted


@wp.func
def measure_face(
    trees: Trees,
    given: wp.int32,
    search: wp.ref[DepthSearch],
    lists: wp.ref[SearchLists],
    entry: Entry,
):
    """Measure the samples of a face, one a lane, and take the deepest of all lanes, the lowest of several."""
    best = search.best
    if entry.live and wp.float64(-entry.bound) >= best.depth:
        face, near = item_first(entry.item), item_second(entry.item)
        best = measure_samples(trees, search.pose, search.inner, search.outer, face, near, best, search.sampling)
    warp_sync()
    search.best.depth = warp_max(best.depth)
    search.best.item = warp_min_item(wp.where(best.depth == search.best.depth, best.item, NO_SAMPLE))


search_depth = best_first(
    BestFirstPolicy(NEAREST_MEMORY, wp.int32, DepthSearch, None, expand_node, measure_face, measure_face, shift=1)
)


@wp.func
def find_deepest_sample(trees: Trees, room: wp.int32, search: wp.ref[DepthSearch]):
    """Find the deepest of a known sample and all samples of one object inside the other, the same in all lanes."""
    lists = start_lists(nearest_stack(), room)
    root = load_node(trees.states, search.inner.node + 1)
    # A single face waits at once.
    lists.waiting = wp.where(root.face >= 0, 1, 0)
    lists.end = 1 - lists.waiting
    if warp_lane() == 0:
        at = STACK_LENGTH * lists.waiting
        write_item(lists.items, at, pack_item(wp.where(root.face >= 0, root.face, root.skip), NO_NEAREST))
        write_bound(lists.items, at, -wp.float32(wp.inf))
    warp_sync()
    search_depth(trees, 0, search, lists)


@wp.func
def deepest_of_both(trees: Trees, solids: Solids, pair: wp.vec2i, room: wp.int32, both: DepthSearch):
    """Return the deepest of a known sample and all samples of either object inside the other, where that is a solid."""
    search = both
    if solids.is_solid[wp.max(pair[0], pair[1])] != 0:
        find_deepest_sample(trees, room, search)
    best = search.best
    if solids.is_solid[wp.min(pair[0], pair[1])] != 0:
        search.inner = both.outer
        search.outer = both.inner
        search.best.item = KNOWN
        find_deepest_sample(trees, room, search)
        if search.best.item != KNOWN:
            best = search.best
            best.of_b = True
    return best


@wp.func
def deepest_points(trees: Trees, pose: PairPose, pair: wp.vec2i, best: Deepest):
    """Return the deepest sample of a pair, in A's frame and posed, and the nearest point of the other's surface, posed.

    Then the face of the sample, and that of the nearest point.
    """
    face = wp.int32(best.item >> wp.int64(33))
    weights = sample_weights(wp.int32((best.item >> wp.int64(30)) & wp.int64(7)))
    nearest = wp.int32(best.item & wp.int64(0x3FFFFFFF))
    a, b = wp.min(pair[0], pair[1]), wp.max(pair[0], pair[1])
    inner, outer = wp.where(best.of_b, b, a), wp.where(best.of_b, a, b)
    u, v, w = load_posed_face(trees, pose, best.of_b, face)
    point = (weights[0] * u + weights[1] * v) + weights[2] * w
    u, v, w = load_posed_face(trees, pose, not best.of_b, nearest)
    near, _size = point_features(u, v, w, point)
    ids = trees.states.face_corner[trees.states.face_start[trees.objects.state[outer]] + nearest]
    foot = blend_corners(trees.models, ids, point_weights(near))
    foot = pose_point(trees.objects.rotation[outer], trees.objects.position[outer], foot)
    ids = trees.states.face_corner[trees.states.face_start[trees.objects.state[inner]] + face]
    sample = blend_corners(trees.models, ids, weights)
    sample = pose_point(trees.objects.rotation[inner], trees.objects.position[inner], sample)
    return point, sample, foot, face, nearest


@wp.func
def report_deepest(
    trees: Trees, pose: PairPose, scaling: SearchScale, pair: wp.vec2i, best: Deepest, p: wp.int32, distances: Distances
):
    """Write the deepest sample of a pair, the point of the other's surface that is nearest, and their faces."""
    _point, sample, foot, face, nearest = deepest_points(trees, pose, pair, best)
    d = best.depth
    slack = slack_of(scaling, d)
    least = wp.max((d - slack) / scaling.stretch, wp.float64(0.0))
    distances.distance[p] = -d
    distances.bracket[p] = wp.vec2d(-(d * scaling.stretch + slack), -least)
    if best.of_b:
        write_nearest(p, pose.swapped, nearest, face, foot, sample, distances)
    else:
        write_nearest(p, pose.swapped, face, nearest, sample, foot, distances)


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def find_depth_kernel(
    room: wp.int32,
    trees: Trees,
    solids: Solids,
    batch: PairBatch,
    hits: Hits,
    distances_inout: Distances,
):
    """Find the depth of the object pairs that intersect and have samples of one in the other, a solid; a warp a pair.

    Others keep the rows that they have.
    """
    p = wp.tid() / warp_size()
    if p >= batch.count[0] or p >= batch.pairs.shape[0] or batch.launched[0] == STALE:
        return
    if hits.any_hit[p] == 0:
        return
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    if solids.is_solid[a] == 0 and solids.is_solid[b] == 0:
        return
    pose = batch.poses[p]
    scaling = make_scale(trees, pose, a, b)
    search = DepthSearch()
    search.pose = pose
    search.inner = make_solid(trees, pose, scaling, False, trees.objects.state[a])
    search.outer = make_solid(trees, pose, scaling, True, trees.objects.state[b])
    search.best.item = KNOWN
    search.sampling.samples = SAMPLES
    best = deepest_of_both(trees, solids, batch.pairs[p], room, search)
    if best.item != KNOWN and warp_lane() == 0:
        report_deepest(trees, pose, scaling, batch.pairs[p], best, p, distances_inout)
