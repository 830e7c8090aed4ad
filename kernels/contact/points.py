"""The few points that stand for an object pair, chosen of the candidates of its contacts."""

import warp as wp

from warp_abtree.kernels.arrays import ObjectPool
from warp_abtree.kernels.contact.manifold import POINTS, Curves, Manifolds

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Squared part of the spread within which a point adds nothing to others.
NEAREST_POINT = wp.constant(wp.float64(2.0**-9))
# By which part of its distance a point is favoured at the far end of the spread.
FAVOUR = wp.constant(wp.float64(2.0**-5))
# The deepest point is among those chosen if this part of its depth is more than theirs.
DEEPER = wp.constant(wp.float64(0.9))


@wp.func
def find_deepest(first: wp.int32, end: wp.int32, curves: Curves):
    """Return the deepest candidate of a pair, contact and number, and its depth, -1 where there is none."""
    deepest = wp.float64(-1.0)
    best = wp.vec2i(first, 0)
    i = first
    while i < end:
        for k in range(2):
            if curves.depth[i, k] > deepest:
                deepest = curves.depth[i, k]
                best = wp.vec2i(i, k)
        i += 1
    return best, deepest


@wp.func
def find_outermost(first: wp.int32, end: wp.int32, least: wp.float64, along: wp.vec3d, curves: Curves):
    """Return the candidate that reaches farthest along a direction, of those of a least depth."""
    origin = curves.point[first, 0]
    farthest = -wp.float64(wp.inf)
    best = wp.vec2i(first, 0)
    i = first
    while i < end:
        for k in range(2):
            reach = wp.dot(along, curves.point[i, k] - origin)
            if curves.depth[i, k] >= least and reach > farthest:
                farthest = reach
                best = wp.vec2i(i, k)
        i += 1
    return best


@wp.func
def distance_squared(
    point: wp.vec3d, normal: wp.vec3d, size: wp.float64, p: wp.int32, count: wp.int32, manifolds: Manifolds
):
    """Return how far a candidate lies from the nearest segment between points chosen, normals counted in sizes."""
    nearest = wp.float64(wp.inf)
    j = wp.int32(0)
    while j < count:
        x = manifolds.point[p, j]
        m = manifolds.normal[p, j]
        r = point - x
        u = size * (normal - m)
        other = j
        while other < count:
            s = manifolds.point[p, other] - x
            v = size * (manifolds.normal[p, other] - m)
            along = wp.dot(r, s) + wp.dot(u, v)
            length = wp.dot(s, s) + wp.dot(v, v)
            t = wp.float64(0.0)
            if length > wp.float64(0.0):
                t = wp.clamp(along / length, wp.float64(0.0), wp.float64(1.0))
            d = r - t * s
            e = u - t * v
            nearest = wp.min(nearest, wp.dot(d, d) + wp.dot(e, e))
            other += 1
        j += 1
    return nearest


@wp.func
def find_farthest(
    first: wp.int32,
    end: wp.int32,
    least: wp.float64,
    size: wp.float64,
    along: wp.vec3d,
    p: wp.int32,
    count: wp.int32,
    curves: Curves,
    manifolds: Manifolds,
):
    """Return the candidate of a least depth that is farthest from the points chosen, and how far, squared.

    Those on one side are favoured a little, so that noise does not choose between two that are as far.
    """
    farthest = wp.float64(-1.0)
    best = wp.vec2i(first, 0)
    i = first
    while i < end:
        for k in range(2):
            if curves.depth[i, k] >= least:
                x = curves.point[i, k]
                d = distance_squared(x, curves.normal[i], size, p, count, manifolds)
                if size > wp.float64(0.0):
                    d = d * (wp.float64(1.0) + FAVOUR * wp.dot(along, x - manifolds.point[p, 0]) / size)
                if d > farthest:
                    farthest = d
                    best = wp.vec2i(i, k)
        i += 1
    return best, farthest


@wp.kernel
def spread_point_kernel(
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    start: wp.array(dtype=wp.int32),
    curves: Curves,
    manifolds_out: Manifolds,
):
    """Choose the points of one pair a thread: an outermost one, those farthest from those before, the deepest.

    Distance counts places, and normals in sizes of the pair's contact. Where no face of the pair looks along its
    contact's normal, the middles of the contacts serve, with depth 0.
    """
    p = wp.tid()
    first = start[p]
    end = start[p + 1]
    manifolds_out.count[p] = 0
    if first >= end:
        return
    zero = wp.float64(0.0)
    along = objects.rotation[wp.min(pairs[p][0], pairs[p][1])] * wp.vec3d(
        wp.float64(0.6134), wp.float64(0.5327), wp.float64(0.5831)
    )
    deepest_at, deepest = find_deepest(first, end, curves)
    best = find_outermost(first, end, wp.float64(0.5) * deepest, along, curves)
    count = wp.int32(0)
    size = zero
    least = zero
    deep = zero
    searching = bool(True)
    while searching:
        depth = wp.max(curves.depth[best[0], best[1]], zero)
        manifolds_out.point[p, count] = curves.point[best[0], best[1]]
        manifolds_out.normal[p, count] = curves.normal[best[0]]
        manifolds_out.depth[p, count] = depth
        deep = wp.max(deep, depth)
        count += 1
        best, farthest = find_farthest(first, end, wp.min(deepest, zero), size, along, p, count, curves, manifolds_out)
        if count == 1:
            size = wp.sqrt(wp.max(farthest, zero))
            least = NEAREST_POINT * farthest
        if farthest <= least or count == POINTS - 1:
            best = deepest_at
            searching = DEEPER * deepest > deep
        searching = searching and count < POINTS
    manifolds_out.count[p] = count
