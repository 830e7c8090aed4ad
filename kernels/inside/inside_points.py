"""Contact points of what lies inside a solid, beyond the reach of faces that cross or are near.

A contact knows depth as far as its two faces reach, and a gap as far as the gap. What has gone under farther, or lies
inside whole, has samples (`inside.depth`) deeper than any point of its pair; the deepest of these, far from one
another, become points: depth is the distance from the other's surface, the normal the way there. They take the
places of the nearest other points where there is no room.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.lanes import warp_lane, warp_size
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import HALF, PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.manifold import Manifolds
from warp_abtree.kernels.contacts.points import order_direction
from warp_abtree.kernels.distance.frame import make_scale
from warp_abtree.kernels.inside.components import Solids
from warp_abtree.kernels.inside.containment import FIRST_INSIDE, SECOND_INSIDE
from warp_abtree.kernels.inside.depth import MODULE_OPTIONS, DepthSearch, deepest_of_both, deepest_points
from warp_abtree.kernels.inside.nearest_face import NO_NEAREST, Solid, make_solid, nearest_face
from warp_abtree.kernels.inside.parity import is_inside
from warp_abtree.kernels.inside.samples import AVOIDED_MAX, KNOWN, Deepest, Sampling, way_out
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.triangle.segment import unit_vector

wp.set_module_options(MODULE_OPTIONS)

# Part of the smaller object's size by which a sample must be deeper than all points of its pair; and under which the
# points of a pair that has some tell that nothing is deep.
DEPTH_STEP = wp.constant(wp.float64(2.0**-12))
# Part of that size by which samples lie apart, and of the first one's depth that others have at least.
SAMPLE_SPACING, LESS = wp.constant(wp.float64(0.25)), wp.constant(wp.float64(0.5))


@wp.func
def size_of(states: StatePool, solid: Solid):
    """Return the diagonal of a root's box."""
    root = load_node(states, solid.node + 1)
    return wp.float64(wp.length(root.upper - root.lower))


@wp.func
def known_points(manifolds: Manifolds, p: wp.int32):
    """Return the greatest depth of the points of a pair, 0 without, and the sum of their normals."""
    deepest, way = wp.float64(0.0), wp.vec3d()
    for k in range(manifolds.count[p]):
        deepest = wp.max(deepest, manifolds.depth[p, k])
        way += manifolds.normal[p, k]
    return deepest, way


@wp.func
def way_of_middle(trees: Trees, pose: PairPose, inner: Solid, outer: Solid):
    """Return the way out of the middle of the inner object's box, in A's frame."""
    root = load_node(trees.states, inner.node + 1)
    middle = HALF * (wp.vec3d(root.lower) + wp.vec3d(root.upper)) + inner.centre
    if inner.of_b:
        middle = pose_point(pose.rotation, pose.translation, middle)
    _, face = nearest_face(trees, pose, outer, middle, NO_NEAREST, wp.float64(0.0))
    way = way_out(trees, pose, outer, face, middle)
    if not is_inside(trees, pose, outer.of_b, wp.where(inner.of_b, outer.centre, inner.centre), middle):
        way = -way
    return way


@wp.func
def way_of_second(trees: Trees, pose: PairPose, first: Solid, second: Solid, which: wp.int32, normals: wp.vec3d):
    """Return the way on which B comes free, in A's frame.

    Args:
        which: What of the pair is inside, `Hits.any_hit`.
        normals: Sum of the normals of its points, in the order of the pair.
    """
    if which == FIRST_INSIDE:
        return -way_of_middle(trees, pose, first, second)
    if which == SECOND_INSIDE:
        return way_of_middle(trees, pose, second, first)
    return wp.where(pose.swapped != 0, -normals, normals)


@wp.func
def avoid_point(before: Sampling, point: wp.vec3d):
    """Return a sampling that avoids one more point."""
    sampling = before
    if before.count == 0:
        sampling.first = point
    elif before.count == 1:
        sampling.second = point
    else:
        sampling.third = point
    sampling.count += 1
    return sampling


@wp.func
def remove_nearest(p: wp.int32, x: wp.vec3d, limit: wp.float64, manifolds: Manifolds):
    """Remove the point of a full pair that is nearest to x, of those less deep than a limit."""
    count = manifolds.count[p]
    place = wp.int32(count)
    nearest = wp.float64(wp.inf)
    for k in range(count):
        v = manifolds.point[p, k] - x
        if manifolds.depth[p, k] < limit and wp.dot(v, v) < nearest:
            nearest = wp.dot(v, v)
            place = k
    for k in range(place + 1, count):
        manifolds.point[p, k - 1] = manifolds.point[p, k]
        manifolds.normal[p, k - 1] = manifolds.normal[p, k]
        manifolds.depth[p, k - 1] = manifolds.depth[p, k]
    manifolds.count[p] = wp.min(count, manifolds.point.shape[1] - 1)


@wp.func
def insert_point(p: wp.int32, along: wp.vec3d, x: wp.vec3d, normal: wp.vec3d, depth: wp.float64, manifolds: Manifolds):
    """Insert a point where it lies in the order of `contact.points`."""
    k = wp.int32(manifolds.count[p])
    manifolds.count[p] = k + 1
    while k > 0 and wp.dot(along, manifolds.point[p, wp.max(k, 1) - 1] - x) > wp.float64(0.0):
        manifolds.point[p, k] = manifolds.point[p, k - 1]
        manifolds.normal[p, k] = manifolds.normal[p, k - 1]
        manifolds.depth[p, k] = manifolds.depth[p, k - 1]
        k -= 1
    manifolds.point[p, k] = x
    manifolds.normal[p, k] = normal
    manifolds.depth[p, k] = depth


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def add_inside_point_kernel(
    room: wp.int32,
    trees: Trees,
    solids: Solids,
    batch: PairBatch,
    hits: Hits,
    manifolds_inout: Manifolds,
):
    """Add points of what is inside to those of the pairs that intersect, of which one is a solid; a warp a pair.

    Pairs that the traversal passed over, as their `within` says, are passed over here too.
    """
    p = wp.tid() / warp_size()
    if p >= batch.count[0] or p >= batch.pairs.shape[0] or batch.launched[0] == STALE:
        return
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    pose = batch.poses[p]
    if hits.any_hit[p] == 0 or pose.within < wp.float64(0.0) or (solids.is_solid[a] == 0 and solids.is_solid[b] == 0):
        return
    scaling = make_scale(trees, pose, a, b)
    first = make_solid(trees, pose, scaling, False, trees.objects.state[a])
    second = make_solid(trees, pose, scaling, True, trees.objects.state[b])
    size = wp.min(size_of(trees.states, first), size_of(trees.states, second))
    deep, normals = known_points(manifolds_inout, p)
    if manifolds_inout.count[p] > 0 and deep < DEPTH_STEP * size:
        return
    deep += DEPTH_STEP * size
    least = wp.float64(deep)
    sampling = Sampling()
    most = manifolds_inout.point.shape[1]
    sampling.samples = 3
    sampling.radius = SAMPLE_SPACING * size
    normals = wp.transpose(trees.objects.rotation[a]) * normals
    sampling.way = way_of_second(trees, pose, first, second, hits.any_hit[p], normals)
    along = order_direction(trees.objects.rotation[a])
    search = DepthSearch()
    search.pose = pose
    search.inner = first
    search.outer = second
    searching = bool(True)
    while searching:
        search.best = Deepest()
        search.best.item = KNOWN
        search.best.depth = least
        search.sampling = sampling
        best = deepest_of_both(trees, solids, batch.pairs[p], room, search)
        searching = best.item != KNOWN
        if searching:
            point, sample, foot, _face, _nearest = deepest_points(trees, pose, batch.pairs[p], best)
            if warp_lane() == 0:
                # The way out of what is inside, of the higher object, or of the lower one turned.
                normal = unit_vector(wp.where(best.of_b != (pose.swapped != 0), foot - sample, sample - foot))
                if manifolds_inout.count[p] == most:
                    remove_nearest(p, sample, deep, manifolds_inout)
                insert_point(p, along, sample, normal, best.depth, manifolds_inout)
            if sampling.count == 0:
                least = wp.max(deep, LESS * best.depth)
            sampling = avoid_point(sampling, point)
            searching = sampling.count <= AVOIDED_MAX and sampling.count < most
