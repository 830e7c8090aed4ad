"""Signed distances of points from objects, the least of each, in the frame of each object: a thread a run of points.

Points are sorted along a Morton curve, so that the nearest face of one is a good bound for the next. A point that lies
nearer to the one before than the surface does lies on the same side; of others the even-odd ray test tells.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees, no_vector
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
from warp_abtree.kernels.inside.parity import is_inside, load_posed_face
from warp_abtree.kernels.intersect.box_tiles import spread_bits
from warp_abtree.kernels.triangle.distance import largest_coordinate
from warp_abtree.kernels.triangle.triangle_pair import PAIR_ROUNDING

MODULE_OPTIONS = native.options("distance/point_boxes.cuh", "exact/determinant.cuh")
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
    lower: wp.vec3d,
    cell: wp.float64,
    points: wp.array(dtype=wp.vec3d),
    code_out: wp.array(dtype=wp.int32),
    order_out: wp.array(dtype=wp.int32),
):
    """Write the Morton codes of points on a grid of cells from a corner on; those beyond it have the last cell's."""
    i = wp.tid()
    code = wp.int32(0)
    for k in range(3):
        place = wp.clamp((points[i][k] - lower[k]) / cell, wp.float64(0.0), wp.float64((1 << CODE_BITS) - 1))
        code |= spread_bits(wp.int32(place)) << k
    code_out[i] = code
    order_out[i] = i


@wp.func
def solid_about(trees: Trees, pose: PairPose, centre: wp.vec3d, point: wp.vec3d):
    """Return the `Solid` of an object in its own frame, with the rounding of distances from a point."""
    root = load_node(trees.states, pose.node_a + 1)
    size = wp.length(wp.vec3d(root.upper)) + wp.length(wp.vec3d(root.lower))
    solid = Solid()
    solid.node = pose.node_a
    solid.centre = centre
    solid.slack = PAIR_ROUNDING * (size + largest_coordinate(centre) + largest_coordinate(point))
    solid.margin = wp.float64(2.0) * solid.slack
    solid.grow = BOX_GROW
    return solid


@wp.struct
class PointDistances:
    """What points are given; all arrays of shape [point]."""

    distance: wp.array(dtype=wp.float64)  # [world units], negative inside
    object: wp.array(dtype=wp.int32)  # -1 for none
    face: wp.array(dtype=wp.int32)  # -1 where it is farther than asked
    nearest: wp.array(dtype=wp.vec3d)  # on that face, or NaN


@wp.struct
class LastPoint:
    """The point before, as the object of its answer sees it."""

    place: wp.int32  # of the object among those asked, -1 for none
    face: wp.int32  # NO_NEAREST for none
    point: wp.vec3d  # in the object's frame
    free: wp.float64  # no surface is as near [model units]
    inside: bool  # the object


@wp.func
def place_on_face(trees: Trees, pose: PairPose, o: wp.int32, face: wp.int32, point: wp.vec3d):
    """Return the point of an object's face that is nearest to a point of its frame, world frame; NaN without a face."""
    if face == NO_NEAREST:
        return no_vector()
    a, b, c = load_posed_face(trees, pose, False, face)
    features, _size = point_features(a, b, c, point)
    w = point_weights(features)
    return trees.objects.rotation[o] * ((w[0] * a + w[1] * b) + w[2] * c) + trees.objects.position[o]


@wp.func
def pose_alone(trees: Trees, o: wp.int32):
    """Return where the arrays of an object's state lie, as those of A of a pair."""
    state = trees.objects.state[o]
    pose = PairPose()
    pose.node_a = trees.states.node_start[state]
    pose.corner_a = trees.states.face_start[state]
    return pose


@wp.kernel(module_options=MODULE_OPTIONS, module="unique")
def measure_point_kernel(
    run: wp.int32,
    within: wp.float64,
    trees: Trees,
    asked: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    found_out: PointDistances,
):
    """Write the least distances of points from some objects, negative inside, and where they are nearest.

    Args:
        run: Points of a thread.
        within: Surfaces farther away are not looked for: distances are infinite.
        asked: Objects, rising, and whether they have an inside.
        order: Indices of points, neighbours beside each other.
    """
    last = LastPoint()
    last.place = -1
    for k in range(run):
        i = run * wp.tid() + k
        if i < points.shape[0]:
            q = order[i]
            first = last.place
            least, object, nearest = wp.float64(within), wp.int32(NO_NEAREST), wp.int32(NO_NEAREST)
            near = no_vector()
            # The object of the point before comes first.
            for j in range(-1, asked.shape[0]):
                place = wp.where(j < 0, first, j)
                if place >= 0 and (j < 0 or place != first):
                    o = asked[place][0]
                    pose = pose_alone(trees, o)
                    centre = trees.models.centre[trees.states.model[trees.objects.state[o]]]
                    point = wp.transpose(trees.objects.rotation[o]) * (points[q] - trees.objects.position[o])
                    solid = solid_about(trees, pose, centre, point)
                    reach = (wp.max(least, wp.float64(0.0)) + solid.margin) * solid.grow
                    root = load_node(trees.states, pose.node_a + 1)
                    meets = square_outside(root, point - centre) <= reach * reach
                    inside = bool(False)
                    if meets and asked[place][1] != 0:
                        inside = last.inside
                        if place != last.place or not wp.length(point - last.point) < last.free:
                            inside = is_inside(trees, pose, False, centre, point)
                    if meets and (inside or least >= wp.float64(0.0)):
                        hint = wp.where(place == last.place, last.face, NO_NEAREST)
                        most = wp.where(inside, within, least)
                        enough = -wp.float64(1.0)
                        distance, face = nearest_face_within(trees, pose, solid, point, hint, enough, most)
                        signed = wp.where(inside, -distance, distance)
                        if inside and face == NO_NEAREST:
                            signed = -wp.float64(wp.inf)
                        better = signed < least or (signed == least and o < object)
                        better = better and (inside or face != NO_NEAREST)
                        if better:
                            least = signed
                            object = o
                            nearest = face
                            near = place_on_face(trees, pose, o, face, point)
                        if better or last.place < 0 or place == last.place:
                            last.place = place
                            last.face = face
                            last.point = point
                            last.free = distance - solid.slack
                            last.inside = inside
            found_out.distance[q] = wp.where(object == NO_NEAREST, wp.float64(wp.inf), least)
            found_out.object[q] = wp.where(object == NO_NEAREST, -1, object)
            found_out.face[q] = wp.where(nearest == NO_NEAREST, -1, nearest)
            found_out.nearest[q] = near
