"""The few points that stand for an object pair, chosen of the candidates of its contacts."""

import functools

import warp as wp

from warp_abtree.kernels.arrays import ObjectPool
from warp_abtree.kernels.contact.manifold import NO_DEPTH, POINTS, Curves, Manifolds
from warp_abtree.kernels.small_trees.tiles import rank_flag
from warp_abtree.kernels.traversal.warp_stack import warp_lane, warp_max, warp_size, warp_sync

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

# Squared part of the spread within which a point adds nothing to others.
NEAREST_POINT = wp.constant(wp.float64(2.0**-9))
# By which part of its distance a point is favoured at the far end of the spread.
FAVOUR = wp.constant(wp.float64(2.0**-5))
# More than that favour makes of a squared distance, at most.
WIDEST = wp.constant(wp.float64(1.0625))
# Part of the spread by which points may be less deep than the deepest, and apart, to be chosen before others.
FIRST_PART = wp.constant(wp.float64(2.0**-9))
# The deepest point is among those chosen if this part of its depth is more than theirs.
DEEPER = wp.constant(wp.float64(0.9))


CANDIDATES = wp.constant(2)  # of each contact, numbered on from contact to contact


@wp.func
def best_of_warp(value: wp.float64, candidate: wp.int32):
    """Return the greatest value of all lanes and the candidate that has it, the first of several."""
    greatest = warp_max(value)
    return wp.int32(-warp_max(wp.where(value == greatest, -wp.float64(candidate), -wp.float64(wp.inf)))), greatest


@wp.func
def list_candidates(first: wp.int32, end: wp.int32, curves: Curves):
    """List the contacts of a pair that have candidates, in their order, where its contacts start; return its end.

    Of faces that are apart a fifth has some, which every choice looks at.
    """
    listed, next = wp.int32(first), wp.int32(first)
    while next < end:
        i = next + warp_lane()
        has = i < end
        if has:
            has = curves.depth[i, 0] == curves.depth[i, 0] or curves.depth[i, 1] == curves.depth[i, 1]
        rank = rank_flag(has)
        if has:
            curves.listed[listed + (rank & 0xFFFF)] = i
        listed += rank >> 16
        next += warp_size()
    warp_sync()
    return listed


@wp.func
def find_deepest(first: wp.int32, end: wp.int32, curves: Curves):
    """Return the deepest candidate of those listed and its depth, NO_DEPTH where there is none."""
    deepest = NO_DEPTH
    best = CANDIDATES * first
    at = first + warp_lane()
    while at < end:
        i = curves.listed[at]
        for k in range(CANDIDATES):
            if curves.depth[i, k] > deepest:
                deepest = curves.depth[i, k]
                best = CANDIDATES * i + k
        at += warp_size()
    return best_of_warp(deepest, best)


@wp.func
def find_outermost(first: wp.int32, end: wp.int32, least: wp.float64, along: wp.vec3d, curves: Curves):
    """Return the candidate that reaches farthest along a direction, of those of a least depth, and how far."""
    origin = curves.point[first, 0]
    farthest = -wp.float64(wp.inf)
    best = CANDIDATES * first
    at = first + warp_lane()
    while at < end:
        i = curves.listed[at]
        for k in range(CANDIDATES):
            reach = wp.dot(along, curves.point[i, k] - origin)
            if curves.depth[i, k] >= least and reach > farthest:
                farthest = reach
                best = CANDIDATES * i + k
        at += warp_size()
    return best_of_warp(farthest, best)


@wp.func
def distance_squared(
    x: wp.vec3d,
    normal: wp.vec3d,
    size: wp.float64,
    end: wp.int32,
    point: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
):
    """Return how far a candidate lies from the nearest segment that ends at a chosen point, normals counted in sizes.

    Args:
        end: That point. Segments begin at those before it and at itself; from `POINTS` on at itself alone, so that
            many points cost no more than their number.
    """
    nearest = wp.float64(wp.inf)
    j = wp.where(end < POINTS, 0, end)
    while j <= end:
        r = x - point[j]
        u = size * (normal - normals[j])
        s = point[end] - point[j]
        v = size * (normals[end] - normals[j])
        along = wp.dot(r, s) + wp.dot(u, v)
        length = wp.dot(s, s) + wp.dot(v, v)
        t = wp.float64(0.0)
        if length > wp.float64(0.0):
            t = wp.clamp(along / length, wp.float64(0.0), wp.float64(1.0))
        d = r - t * s
        e = u - t * v
        nearest = wp.min(nearest, wp.dot(d, d) + wp.dot(e, e))
        j += 1
    return nearest


@wp.struct
class Choice:
    """How the points of a pair are chosen."""

    lowest: wp.float64  # least depth of candidates
    floor: wp.float64  # least depth of those looked at now
    first_floor: wp.float64  # of those looked at first, but for a part of the spread
    size: wp.float64  # spread of the candidates, 0 before it is known
    least: wp.float64  # squared distance from the chosen points that is none


@wp.func
def find_farthest(
    ends: wp.vec2i,
    choice: Choice,
    along: wp.vec3d,
    count: wp.int32,
    point: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    curves: Curves,
):
    """Return the candidate of a least depth that is farthest from the points chosen, and how far, squared.

    Those on one side are favoured a little, so that noise does not choose between two that are as far.

    Args:
        ends: Where the list of the pair's contacts begins and ends.
        count: Points chosen. From the second on a candidate keeps its distance from those seen before, which bounds
            that from all: only candidates that may be the farthest yet look at the points chosen since.
    """
    farthest = wp.float64(-1.0)
    best = CANDIDATES * ends[0]
    at = ends[0] + warp_lane()
    while at < ends[1]:
        i = curves.listed[at]
        before = wp.where(count > 2, curves.seen[i], 0)
        stale = before == 0
        for k in range(CANDIDATES):
            if curves.depth[i, k] >= choice.floor and WIDEST * curves.nearest[i, k] > farthest:
                stale = True
        if stale:
            curves.seen[i] = count
            for k in range(CANDIDATES):
                if curves.depth[i, k] >= choice.lowest:
                    x = curves.point[i, k]
                    d = wp.where(before == 0, wp.float64(wp.inf), curves.nearest[i, k])
                    for end in range(before, count):
                        d = wp.min(d, distance_squared(x, curves.normal[i], choice.size, end, point, normals))
                    curves.nearest[i, k] = d
                    if choice.size > wp.float64(0.0):
                        d = d * (wp.float64(1.0) + FAVOUR * wp.dot(along, x - point[0]) / choice.size)
                    if d > farthest and curves.depth[i, k] >= choice.floor:
                        farthest = d
                        best = CANDIDATES * i + k
        at += warp_size()
    return best_of_warp(farthest, best)


@wp.func
def find_next(
    ends: wp.vec2i,
    before: Choice,
    along: wp.vec3d,
    count: wp.int32,
    point: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    curves: Curves,
):
    """Return the next candidate, how far it is, squared, and the choice after it.

    Those that touch, or nearly so for their spread, come before what is farther apart within the gap.
    """
    choice = before
    best, farthest = find_farthest(ends, choice, along, count, point, normals, curves)
    if count == 1:
        choice.size = wp.sqrt(wp.max(farthest, wp.float64(0.0)))
        choice.least = NEAREST_POINT * farthest
        choice.floor = wp.max(choice.first_floor - FIRST_PART * choice.size, choice.lowest)
        if choice.floor > choice.lowest:
            best, farthest = find_farthest(ends, choice, along, count, point, normals, curves)
    if farthest <= choice.least and choice.floor > choice.lowest:
        choice.floor = choice.lowest
        best, farthest = find_farthest(ends, choice, along, count, point, normals, curves)
    return best, farthest, choice


@wp.func
def order_direction(rotation: wp.mat33d):
    """Return the direction along which the points of a pair are in order, of its lower object's rotation."""
    return rotation * wp.vec3d(wp.float64(0.6134), wp.float64(0.5327), wp.float64(0.5831))


@wp.func
def write_in_order(
    p: wp.int32,
    count: wp.int32,
    along: wp.vec3d,
    point: wp.array(dtype=wp.vec3d),
    normals: wp.array(dtype=wp.vec3d),
    depth: wp.array(dtype=wp.float64),
    manifolds: Manifolds,
):
    """Write the points of a pair in the order in which they lie along a direction of its lower object.

    So points that stay keep their order from step to step, whichever was found first, and whatever face they are on.
    """
    k = warp_lane()
    while k < count:
        place = wp.int32(0)
        for j in range(count):
            ahead = wp.dot(along, point[k] - point[j])
            if ahead > wp.float64(0.0) or (ahead == wp.float64(0.0) and j < k):
                place += 1
        manifolds.point[p, place] = point[k]
        manifolds.normal[p, place] = normals[k]
        manifolds.depth[p, place] = depth[k]
        k += warp_size()
    if warp_lane() == 0:
        manifolds.count[p] = count


@wp.func
def begin_choice(deepest: wp.float64, shell: wp.float64):
    """Return how the points of a pair are chosen whose deepest candidate and gap are known."""
    choice = Choice()
    choice.lowest = wp.where(deepest == NO_DEPTH, NO_DEPTH, -shell)
    choice.floor = choice.lowest
    choice.first_floor = wp.where(shell > wp.float64(0.0), wp.min(deepest, wp.float64(0.0)), choice.lowest)
    return choice


@functools.cache
def point_spreader(most: int):
    """Return the kernel that chooses the points of each pair, so many at most."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def spread_point_kernel(
        objects: ObjectPool,
        pairs: wp.array(dtype=wp.vec2i),
        gap: wp.array(dtype=wp.float64),
        start: wp.array(dtype=wp.int32),
        curves_inout: Curves,
        manifolds_out: Manifolds,
    ):
        """Choose the points of one pair a warp: an outermost one, those farthest from those before, the deepest.

        Distance counts places, and normals in sizes of the pair's contact; depth counts from the gap on. Where no face
        of the pair looks along its contact's normal, the middles of the contacts serve, with depth 0. All lanes know
        the points chosen.
        """
        p = wp.tid() / warp_size()
        first = start[p]
        end = start[p + 1]
        if first >= end:
            manifolds_out.count[p] = 0
            return
        zero = wp.float64(0.0)
        shell = zero
        if gap.shape[0] > 0:
            shell = gap[p]
        along = order_direction(objects.rotation[wp.min(pairs[p][0], pairs[p][1])])
        end = list_candidates(first, end, curves_inout)
        deepest_at, deepest = find_deepest(first, end, curves_inout)
        half = wp.float64(0.5) * (deepest + shell) - shell
        best, reach = find_outermost(first, end, half, along, curves_inout)
        if reach == -wp.float64(wp.inf):
            manifolds_out.count[p] = 0
            return
        choice = begin_choice(deepest, shell)
        point = wp.zeros(shape=(wp.static(most),), dtype=wp.vec3d)
        normals = wp.zeros(shape=(wp.static(most),), dtype=wp.vec3d)
        depth = wp.zeros(shape=(wp.static(most),), dtype=wp.float64)
        count = wp.int32(0)
        deep = -shell
        searching = bool(True)
        while searching:
            i = best / CANDIDATES
            found = curves_inout.depth[i, best % CANDIDATES]
            point[count] = curves_inout.point[i, best % CANDIDATES]
            normals[count] = curves_inout.normal[i]
            depth[count] = wp.where(found == NO_DEPTH, zero, found)
            deep = wp.max(deep, depth[count])
            count += 1
            best, farthest, choice = find_next(wp.vec2i(first, end), choice, along, count, point, normals, curves_inout)
            if farthest <= choice.least or count == wp.static(most - 1):
                best = deepest_at
                searching = DEEPER * (deepest + shell) > deep + shell
            searching = searching and count < wp.static(most)
        write_in_order(p, count, along, point, normals, depth, manifolds_out)

    return spread_point_kernel
