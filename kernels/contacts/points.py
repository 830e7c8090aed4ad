"""Contact reduction: a few points of an object pair, the farthest from one another of its candidates."""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.lanes import warp_any
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.contacts.candidates import (
    CANDIDATES,
    best_of_group,
    find_deepest,
    find_outermost,
    group_lane,
    group_size,
    list_candidates,
    must_measure,
)
from warp_abtree.kernels.contacts.contact import Deferred
from warp_abtree.kernels.contacts.manifold import NO_DEPTH, POINTS, Curves, Manifolds

MODULE_OPTIONS = native.options("base/lanes.cuh", "contacts/groups.cuh")
wp.set_module_options(MODULE_OPTIONS)

LARGE_PAIR = wp.constant(1024)
"""Contacts from which on a block of threads chooses the points of a pair, not a warp."""

LARGE_BLOCK = 512

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


@wp.func
def candidate_point(candidate: wp.int32, curves: Curves):
    return curves.point[candidate / CANDIDATES, candidate % CANDIDATES]


@wp.func
def nearest_squared(r: wp.vec3d, s: wp.vec3d, u: wp.vec3d, v: wp.vec3d, length: wp.float64):
    """Return the squared distance of (r, u) from the segment from 0 to (s, v), whose squared length is given."""
    t = wp.float64(0.0)
    if length > wp.float64(0.0):
        t = wp.clamp((wp.dot(r, s) + wp.dot(u, v)) / length, wp.float64(0.0), wp.float64(1.0))
    d = r - t * s
    e = u - t * v
    return wp.dot(d, d) + wp.dot(e, e)


@wp.func
def distances_squared(i: wp.int32, size: wp.float64, end: wp.int32, chosen: wp.array(dtype=wp.int32), curves: Curves):
    """Return the squared distances of a contact's candidates from the nearest segment that ends at a chosen point.

    Args:
        size: What normals are counted in.
        end: That point. Segments begin at those before it and at itself; from `POINTS` on at itself alone, so that
            many points cost no more than their number.
        chosen: The candidates chosen.
    """
    nearest = wp.vec2d(wp.float64(wp.inf), wp.float64(wp.inf))
    end_point = candidate_point(chosen[end], curves)
    end_normal = curves.normal[chosen[end] / CANDIDATES]
    x, y, normal = curves.point[i, 0], curves.point[i, 1], curves.normal[i]
    j = wp.where(end < POINTS, 0, end)
    while j <= end:
        begin = candidate_point(chosen[j], curves)
        begin_normal = curves.normal[chosen[j] / CANDIDATES]
        u = size * (normal - begin_normal)
        s = end_point - begin
        v = size * (end_normal - begin_normal)
        length = wp.dot(s, s) + wp.dot(v, v)
        nearest[0] = wp.min(nearest[0], nearest_squared(x - begin, s, u, v, length))
        nearest[1] = wp.min(nearest[1], nearest_squared(y - begin, s, u, v, length))
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
    count: wp.int32  # points chosen
    along: wp.vec3d  # side of the pair that is favoured a little


@wp.func
def measure_contact(i: wp.int32, choice: Choice, chosen: wp.array(dtype=wp.int32), curves: Curves):
    """Bring the distances of a contact's candidates from the points chosen up to date.

    Returns them, squared, with the favour of their side; -1 of a candidate that is not looked at now.
    """
    before = wp.where(choice.count > 2, curves.seen[i], 0)
    curves.seen[i] = choice.count
    nearest = wp.vec2d(wp.float64(wp.inf), wp.float64(wp.inf))
    if before > 0:
        nearest = wp.vec2d(curves.nearest[i, 0], curves.nearest[i, 1])
    for end in range(before, choice.count):
        nearest = wp.min(nearest, distances_squared(i, choice.size, end, chosen, curves))
    found = wp.vec2d(wp.float64(-1.0), wp.float64(-1.0))
    for k in range(CANDIDATES):
        if curves.depth[i, k] >= choice.lowest:
            d = nearest[k]
            curves.nearest[i, k] = d
            if choice.size > wp.float64(0.0):
                reach = wp.dot(choice.along, curves.point[i, k] - candidate_point(chosen[0], curves))
                d = d * (wp.float64(1.0) + FAVOUR * reach / choice.size)
            if curves.depth[i, k] >= choice.floor:
                found[k] = d
    return found


@wp.func
def find_farthest(ends: wp.vec2i, choice: Choice, chosen: wp.array(dtype=wp.int32), curves: Curves):
    """Return the candidate of a least depth that is farthest from the points chosen, and its squared distance.

    Those on one side are favoured a little, so that noise does not choose between two that are as far. From the second
    point on a candidate keeps its distance from those seen before, which bounds that from all: on a CPU only candidates
    that may be the farthest yet look at the points chosen since. On a GPU all do: a warp would wait for those that are
    late, and the vote keeps its lanes in step.

    Args:
        ends: Where the list of the pair's contacts begins and ends.
    """
    farthest = wp.float64(-1.0)
    best = CANDIDATES * ends[0]
    base = wp.int32(ends[0])
    while base < ends[1]:
        i = wp.int32(-1)
        stale = must_measure(choice.count)
        if base + group_lane() < ends[1]:
            i = curves.listed[base + group_lane()]
            for k in range(CANDIDATES):
                if curves.depth[i, k] >= choice.floor and WIDEST * curves.nearest[i, k] > farthest:
                    stale = True
        if warp_any(stale) and i >= 0:
            found = measure_contact(i, choice, chosen, curves)
            for k in range(CANDIDATES):
                if found[k] > farthest:
                    farthest = found[k]
                    best = CANDIDATES * i + k
        base += group_size()
    return best_of_group(farthest, best)


@wp.func
def find_next(ends: wp.vec2i, before: Choice, chosen: wp.array(dtype=wp.int32), curves: Curves):
    """Return the next candidate, its squared distance, and the choice after it.

    Those that touch, or nearly so for their spread, come before what is farther apart within the gap.
    """
    choice = before
    best, farthest = wp.int32(0), wp.float64(0.0)
    unsized = choice.count == 1
    looking = bool(True)
    while looking:
        best, farthest = find_farthest(ends, choice, chosen, curves)
        looking = False
        if unsized:
            unsized = False
            choice.size = wp.sqrt(wp.max(farthest, wp.float64(0.0)))
            choice.least = NEAREST_POINT * farthest
            choice.floor = wp.max(choice.first_floor - FIRST_PART * choice.size, choice.lowest)
            looking = choice.floor > choice.lowest
        elif farthest <= choice.least and choice.floor > choice.lowest:
            choice.floor = choice.lowest
            looking = True
    return best, farthest, choice


@wp.func
def order_direction(rotation: wp.mat33d):
    """Return the direction along which the points of a pair are in order, of its lower object's rotation."""
    return rotation * wp.vec3d(wp.float64(0.6134), wp.float64(0.5327), wp.float64(0.5831))


@wp.func
def read_depth(candidate: wp.int32, curves: Curves):
    """Return the depth of a chosen candidate, 0 for the middle of a contact."""
    depth = curves.depth[candidate / CANDIDATES, candidate % CANDIDATES]
    return wp.where(depth == NO_DEPTH, wp.float64(0.0), depth)


@wp.func
def write_in_order(p: wp.int32, choice: Choice, chosen: wp.array(dtype=wp.int32), curves: Curves, manifolds: Manifolds):
    """Write the points of a pair in the order in which they lie along a direction of its lower object.

    So points that stay keep their order from step to step, whichever was found first, and whatever face they are on.
    """
    k = group_lane()
    while k < choice.count:
        point = candidate_point(chosen[k], curves)
        place = wp.int32(0)
        for j in range(choice.count):
            ahead = wp.dot(choice.along, point - candidate_point(chosen[j], curves))
            if ahead > wp.float64(0.0) or (ahead == wp.float64(0.0) and j < k):
                place += 1
        manifolds.point[p, place] = point
        manifolds.normal[p, place] = curves.normal[chosen[k] / CANDIDATES]
        manifolds.depth[p, place] = read_depth(chosen[k], curves)
        k += group_size()
    if group_lane() == 0:
        manifolds.count[p] = choice.count


@wp.func
def begin_choice(deepest: wp.float64, shell: wp.float64, along: wp.vec3d):
    """Begin the choice of the points of a pair whose deepest candidate and gap are known."""
    choice = Choice()
    choice.lowest = wp.where(deepest == NO_DEPTH, NO_DEPTH, -shell)
    choice.floor = choice.lowest
    choice.first_floor = wp.where(shell > wp.float64(0.0), wp.min(deepest, wp.float64(0.0)), choice.lowest)
    choice.along = along
    return choice


@functools.cache
def point_chooser(most: int):
    """Return the function that chooses the points of a pair, so many at most."""

    @wp.func
    def spread_points(
        p: wp.int32,
        along: wp.vec3d,
        gap: wp.array(dtype=wp.float64),
        start: wp.array(dtype=wp.int32),
        curves: Curves,
        manifolds: Manifolds,
    ):
        """Choose the points of one pair: an outermost one, those farthest from those before, the deepest.

        Distance counts places, and normals in sizes of the pair's contact; depth counts from the gap on. Where no face
        of the pair looks along its contact's normal, the middles of the contacts serve, with depth 0. All threads know
        the points chosen.
        """
        shell = wp.float64(0.0)
        if gap.shape[0] > 0:
            shell = gap[p]
        first = start[p]
        end = list_candidates(first, start[p + 1], curves)
        deepest_at, deepest = find_deepest(first, end, curves)
        half = wp.float64(0.5) * (deepest + shell) - shell
        best, reach = find_outermost(first, end, half, along, curves)
        choice = begin_choice(deepest, shell, along)
        chosen = wp.zeros(shape=(wp.static(most),), dtype=wp.int32)
        deep = -shell
        searching = reach > -wp.float64(wp.inf)
        while searching:
            chosen[choice.count] = best
            deep = wp.max(deep, read_depth(best, curves))
            choice.count += 1
            best, farthest, choice = find_next(wp.vec2i(first, end), choice, chosen, curves)
            if farthest <= choice.least or choice.count == wp.static(most - 1):
                best = deepest_at
                searching = DEEPER * (deepest + shell) > deep + shell
            searching = searching and choice.count < wp.static(most)
        write_in_order(p, choice, chosen, curves, manifolds)

    return spread_points


@functools.cache
def point_spreader(most: int):
    """Return the kernel that chooses the points of each pair, so many at most, by a warp a pair."""
    spread_points = point_chooser(most)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def spread_point_kernel(
        largest: wp.int32,
        objects: ObjectPool,
        batch: PairBatch,
        gap: wp.array(dtype=wp.float64),
        start: wp.array(dtype=wp.int32),
        curves_inout: Curves,
        large_inout: Deferred,
        manifolds_out: Manifolds,
    ):
        """Choose the points of one pair a warp; list those of more contacts than `largest`."""
        p = wp.tid() / group_size()
        contacts = start[p + 1] - start[p]
        if contacts > largest:
            if group_lane() == 0:
                large_inout.place[wp.atomic_add(large_inout.total, 0, 1)] = p
            return
        if contacts <= 0:
            manifolds_out.count[p] = 0
            return
        along = order_direction(objects.rotation[wp.min(batch.pairs[p][0], batch.pairs[p][1])])
        spread_points(p, along, gap, start, curves_inout, manifolds_out)

    return spread_point_kernel


@functools.cache
def large_point_spreader(most: int):
    """Return the kernel that chooses the points of pairs with many contacts, so many at most, by a block a pair."""
    spread_points = point_chooser(most)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS, launch_bounds=(LARGE_BLOCK, 1))
    def spread_large_point_kernel(
        blocks: wp.int32,
        objects: ObjectPool,
        batch: PairBatch,
        gap: wp.array(dtype=wp.float64),
        start: wp.array(dtype=wp.int32),
        large: Deferred,
        curves_inout: Curves,
        manifolds_out: Manifolds,
    ):
        """Choose the points of listed pairs, one a block at a time."""
        k = wp.tid() / group_size()
        while k < large.total[0]:
            p = large.place[k]
            along = order_direction(objects.rotation[wp.min(batch.pairs[p][0], batch.pairs[p][1])])
            spread_points(p, along, gap, start, curves_inout, manifolds_out)
            k += blocks

    return spread_large_point_kernel
