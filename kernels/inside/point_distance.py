"""Signed distances of points from objects, the least of each, in the frame of each object.

Points are sorted along a Morton curve. A warp measures neighbours at once, a thread of the CPU a run of points, of
which the nearest face of one is a good bound for the next; a point that lies nearer to the one before than the surface
does lies on the same side. Of others the even-odd ray test tells.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees, no_vector
from warp_abtree.kernels.base.lanes import warp_any, warp_lane, warp_max, warp_size
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.inside.nearest_face import (
    NO_NEAREST,
    Solid,
    nearest_face_within,
    point_features,
    point_weights,
    square_outside,
)
from warp_abtree.kernels.inside.nearest_search import nearest_faces_of_warp
from warp_abtree.kernels.inside.parity import is_inside, load_posed_face
from warp_abtree.kernels.intersect.box_tiles import spread_bits
from warp_abtree.kernels.triangle.distance import largest_coordinate
from warp_abtree.kernels.triangle.triangle_pair import PAIR_ROUNDING

MODULE_OPTIONS = native.options("distance/point_boxes.cuh", "exact/determinant.cuh")
WARP_OPTIONS = native.options(
    "base/lanes.cuh",
    "distance/point_boxes.cuh",
    "exact/determinant.cuh",
    "inside/point_slots.cuh",
    "search/load_balance.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)

# Bits of a Morton code along each axis.
CODE_BITS = wp.constant(10)
# A little over 1: that squares of distances to boxes in float64 may be too large by.
BOX_GROW = wp.constant(wp.float64(1.0 + 2.0**-30))


@wp.kernel(module_options=MODULE_OPTIONS, module="unique")
def bound_point_kernel(
    step: wp.int32, most: wp.float64, points: wp.array(dtype=wp.vec3d), bounds_inout: wp.array(dtype=wp.float64)
):
    """Find the box of points, and the first that is not finite or has a coordinate beyond the most, a part a thread.

    Args:
        step: How many threads there are.
        bounds_inout: Least coordinates, infinite at first; greatest ones, minus infinite; that point, infinite; [7].
    """
    infinite, i = wp.float64(wp.inf), wp.int32(wp.tid())
    lower, bad = wp.vec3d(infinite, infinite, infinite), wp.float64(wp.inf)
    upper = -lower
    while i < points.shape[0]:
        for k in range(3):
            x = points[i][k]
            if not wp.abs(x) <= most:
                bad = wp.min(bad, wp.float64(i))
            lower[k] = wp.min(lower[k], x)
            upper[k] = wp.max(upper[k], x)
        i += step
    for k in range(3):
        wp.atomic_min(bounds_inout, k, lower[k])
        wp.atomic_max(bounds_inout, 3 + k, upper[k])
    wp.atomic_min(bounds_inout, 6, bad)


@wp.kernel(module_options=MODULE_OPTIONS, module="unique")
def code_point_kernel(
    bounds: wp.array(dtype=wp.float64),
    points: wp.array(dtype=wp.vec3d),
    code_out: wp.array(dtype=wp.int32),
    order_out: wp.array(dtype=wp.int32),
):
    """Write the Morton codes of points on a grid of cells over their box; those at its end have the last cell's.

    Args:
        bounds: Of `bound_point_kernel`.
    """
    i = wp.tid()
    code, widest = wp.int32(0), wp.float64(0.0)
    for k in range(3):
        widest = wp.max(widest, bounds[3 + k] - bounds[k])
    cell = wp.where(widest > wp.float64(0.0), widest / wp.float64(1 << CODE_BITS), wp.float64(1.0))
    for k in range(3):
        place = wp.clamp((points[i][k] - bounds[k]) / cell, wp.float64(0.0), wp.float64((1 << CODE_BITS) - 1))
        code |= spread_bits(wp.int32(place)) << k
    code_out[i] = code
    order_out[i] = i


@wp.struct
class PointDistances:
    """What points are given; all arrays of shape [point], but for those that are not asked, which are empty."""

    distance: wp.array(dtype=wp.float64)  # [world units], negative inside
    object: wp.array(dtype=wp.int32)  # -1 for none
    face: wp.array(dtype=wp.int32)  # -1 where it is farther than asked
    nearest: wp.array(dtype=wp.vec3d)  # on that face, or NaN


@wp.struct
class PointAnswer:
    """The least distance of a point so far."""

    least: wp.float64  # [world units], negative inside
    object: wp.int32  # NO_NEAREST for none
    face: wp.int32  # NO_NEAREST where it is farther than asked


@wp.struct
class PlacedPoint:
    """A point in the frame of an object."""

    point: wp.vec3d  # there
    pose: PairPose  # where the object lies, as A of a pair
    solid: Solid  # the object
    outside: wp.float64  # square of the distance from the object's box
    far: wp.float64  # no surface of the object is farther


@wp.struct
class LastPoint:
    """The point before, as the object of its answer sees it."""

    place: wp.int32  # of the object among those asked, -1 for none
    face: wp.int32  # NO_NEAREST for none
    point: wp.vec3d  # in the object's frame
    free: wp.float64  # no surface is as near [model units]
    inside: bool  # the object


@wp.func
def place_point(trees: Trees, o: wp.int32, point: wp.vec3d):
    """Return a point of the world in an object's frame, with the rounding of distances there."""
    state = trees.objects.state[o]
    placed = PlacedPoint()
    placed.pose.node_a = trees.states.node_start[state]
    placed.pose.corner_a = trees.states.face_start[state]
    placed.point = wp.transpose(trees.objects.rotation[o]) * (point - trees.objects.position[o])
    root = load_node(trees.states, placed.pose.node_a + 1)
    size = wp.length(wp.vec3d(root.upper)) + wp.length(wp.vec3d(root.lower))
    solid = Solid()
    solid.node = placed.pose.node_a
    solid.centre = trees.models.centre[trees.states.model[state]]
    solid.slack = PAIR_ROUNDING * (size + largest_coordinate(solid.centre) + largest_coordinate(placed.point))
    solid.margin = wp.float64(2.0) * solid.slack
    solid.grow = BOX_GROW
    placed.solid = solid
    x = placed.point - solid.centre
    placed.outside = square_outside(root, x)
    corner = wp.vec3d()
    for i in range(3):
        corner[i] = wp.max(wp.abs(wp.float64(root.lower[i]) - x[i]), wp.abs(wp.float64(root.upper[i]) - x[i]))
    placed.far = (wp.length(corner) + solid.margin) * solid.grow
    return placed


@wp.func
def may_be_nearer(placed: PlacedPoint, least: wp.float64):
    """Return False only where an object neither has the point inside nor is as near."""
    reach = (wp.max(least, wp.float64(0.0)) + placed.solid.margin) * placed.solid.grow
    return placed.outside <= reach * reach


@wp.func
def offer_object(answer: wp.ref[PointAnswer], o: wp.int32, inside: bool, distance: wp.float64, face: wp.int32):
    """Offer an object, and the nearest of its faces, NO_NEAREST for none; return whether it is taken."""
    signed = wp.where(inside, -distance, distance)
    if inside and face == NO_NEAREST:
        signed = -wp.float64(wp.inf)
    better = signed < answer.least or (signed == answer.least and o < answer.object)
    better = better and (inside or face != NO_NEAREST)
    if better:
        answer.least = signed
        answer.object = o
        answer.face = face
    return better


@wp.func
def report_point(trees: Trees, q: wp.int32, point: wp.vec3d, answer: PointAnswer, found: PointDistances):
    """Write what is asked of the answer of a point in the world."""
    o, face = answer.object, answer.face
    found.distance[q] = wp.where(o == NO_NEAREST, wp.float64(wp.inf), answer.least)
    if found.object.shape[0] > 0:
        found.object[q] = wp.where(o == NO_NEAREST, -1, o)
    if found.face.shape[0] > 0:
        found.face[q] = wp.where(face == NO_NEAREST, -1, face)
    if found.nearest.shape[0] > 0:
        near = no_vector()
        if face != NO_NEAREST:
            placed = place_point(trees, o, point)
            a, b, c = load_posed_face(trees, placed.pose, False, face)
            features, _size = point_features(a, b, c, placed.point)
            w = point_weights(features)
            near = trees.objects.rotation[o] * ((w[0] * a + w[1] * b) + w[2] * c) + trees.objects.position[o]
        found.nearest[q] = near


@wp.func
def no_answer(within: wp.float64):
    answer = PointAnswer()
    answer.least = within
    answer.object = NO_NEAREST
    answer.face = NO_NEAREST
    return answer


@wp.kernel(module_options=MODULE_OPTIONS, module="unique")
def measure_point_kernel(
    run: wp.int32,
    within: wp.float64,
    trees: Trees,
    asked: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    bounds: wp.array(dtype=wp.float64),
    found_out: PointDistances,
):
    """Write the least distances of points from some objects, negative inside, and where they are nearest.

    Args:
        run: Points of a thread.
        within: Surfaces farther away are not looked for: distances are infinite.
        asked: Objects, rising, and whether they have an inside.
        order: Indices of points, neighbours beside each other.
        bounds: Of `bound_point_kernel`; where a point is bad, nothing is written.
    """
    if bounds[6] < wp.float64(wp.inf):
        return
    last = LastPoint()
    last.place = -1
    for k in range(run):
        i = run * wp.tid() + k
        if i < points.shape[0]:
            q = order[i]
            first = last.place
            answer = no_answer(within)
            # The object of the point before comes first.
            for j in range(-1, asked.shape[0]):
                place = wp.where(j < 0, first, j)
                if place >= 0 and (j < 0 or place != first):
                    o = asked[place][0]
                    placed = place_point(trees, o, points[q])
                    meets = may_be_nearer(placed, answer.least)
                    inside = bool(False)
                    if meets and asked[place][1] != 0:
                        inside = last.inside
                        if place != last.place or not wp.length(placed.point - last.point) < last.free:
                            inside = is_inside(trees, placed.pose, False, placed.solid.centre, placed.point)
                    if meets and (inside or answer.least >= wp.float64(0.0)):
                        hint = wp.where(place == last.place, last.face, NO_NEAREST)
                        most = wp.where(inside, within, answer.least)
                        distance, face = nearest_face_within(
                            trees, placed.pose, placed.solid, placed.point, hint, -wp.float64(1.0), most
                        )
                        better = offer_object(answer, o, inside, distance, face)
                        if better or last.place < 0 or place == last.place:
                            last.place = place
                            last.face = face
                            last.point = placed.point
                            last.free = distance - placed.solid.slack
                            last.inside = inside
            report_point(trees, q, points[q], answer, found_out)


@wp.kernel(module_options=WARP_OPTIONS, module="unique", cuda_max_registers=128)
def measure_points_of_warp_kernel(
    at_once: wp.int32,
    within: wp.float64,
    trees: Trees,
    asked: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    bounds: wp.array(dtype=wp.float64),
    found_out: PointDistances,
):
    """Write what `measure_point_kernel` does, some points a warp, one in each of its first lanes."""
    if bounds[6] < wp.float64(wp.inf):
        return
    place = warp_lane()
    i = wp.tid() / warp_size() * at_once + place
    is_mine = place < at_once and i < points.shape[0]
    q = order[wp.min(i, points.shape[0] - 1)]
    answer = no_answer(within)
    most = wp.float64(within)
    for j in range(asked.shape[0]):
        placed = place_point(trees, asked[j][0], points[q])
        most = wp.min(most, placed.far)
    for j in range(asked.shape[0]):
        o = asked[j][0]
        placed = place_point(trees, o, points[q])
        placed.solid.margin = warp_max(placed.solid.margin)
        meets = is_mine and may_be_nearer(placed, wp.min(answer.least, most))
        inside = bool(False)
        if meets and asked[j][1] != 0:
            inside = is_inside(trees, placed.pose, False, placed.solid.centre, placed.point)
        asks = meets and (inside or answer.least >= wp.float64(0.0))
        if warp_any(asks):
            limit = wp.where(inside, within, wp.min(answer.least, most))
            distance, face = nearest_faces_of_warp(trees, placed.pose, placed.solid, asks, placed.point, limit)
            if asks:
                offer_object(answer, o, inside, distance, face)
    if is_mine:
        report_point(trees, q, points[q], answer, found_out)
