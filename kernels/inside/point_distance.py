"""Signed distances of points from the surface of one object, in its model's frame: a thread a run of points.

Points are sorted along a Morton curve, so that the nearest face of one is a good bound for the next. A point that lies
nearer to the one before than the surface does lies on the same side; of others the even-odd ray test tells.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.inside.nearest_face import NO_NEAREST, Solid, nearest_face, point_features, point_weights
from warp_abtree.kernels.inside.parity import is_inside, load_posed_face
from warp_abtree.kernels.intersect.box_tiles import spread_bits
from warp_abtree.kernels.triangle.distance import largest_coordinate
from warp_abtree.kernels.triangle.triangle_pair import PAIR_ROUNDING

MODULE_OPTIONS = native.options("exact/determinant.cuh")
wp.set_module_options(MODULE_OPTIONS)

# Bits of a Morton code along each axis.
CODE_BITS = wp.constant(10)
# A little over 1: that squares of distances to boxes in float64 may be too large by.
BOX_GROW = wp.constant(wp.float64(1.0 + 2.0**-30))


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


@wp.kernel(module_options=MODULE_OPTIONS, module="unique")
def measure_point_kernel(
    run: wp.int32,
    has_inside: bool,
    trees: Trees,
    points: wp.array(dtype=wp.vec3d),
    order: wp.array(dtype=wp.int32),
    distance_out: wp.array(dtype=wp.float64),
    face_out: wp.array(dtype=wp.int32),
    nearest_out: wp.array(dtype=wp.vec3d),
):
    """Write the distances of points from object 0, negative inside, their nearest faces and the points on these.

    Args:
        run: Points of a thread.
        has_inside: Whether the object is a closed surface.
        points: In the model's frame.
        order: Indices of points, neighbours beside each other.
    """
    state = trees.objects.state[0]
    pose = PairPose()
    pose.node_a = trees.states.node_start[state]
    pose.corner_a = trees.states.face_start[state]
    centre = trees.models.centre[trees.states.model[state]]
    hint = wp.int32(NO_NEAREST)
    last = wp.vec3d()
    free = -wp.float64(1.0)
    inside = bool(False)
    for k in range(run):
        i = run * wp.tid() + k
        if i < points.shape[0]:
            q = order[i]
            point = points[q]
            solid = solid_about(trees, pose, centre, point)
            distance, face = nearest_face(trees, pose, solid, point, hint, -wp.float64(1.0))
            hint = face
            if has_inside and not wp.length(point - last) < free:
                inside = is_inside(trees, pose, False, centre, point)
            last = point
            free = distance - solid.slack
            a, b, c = load_posed_face(trees, pose, False, face)
            near, _size = point_features(a, b, c, point)
            w = point_weights(near)
            distance_out[q] = wp.where(inside, -distance, distance)
            face_out[q] = face
            nearest_out[q] = (w[0] * a + w[1] * b) + w[2] * c
