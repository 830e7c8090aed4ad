"""Nearest face of A or B to a point in A's frame: branch and bound over its tree.

Distances are those of `triangle.triangle_pair` for a face and a point: at most the slack of `Solid` off, whatever the
face. Boxes are compared in their own frame, to which the point is taken by the transpose of the rotation; the margin
of `SearchScale` covers that, a rotation off orthonormal included, along each axis, so twice of it along any line.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.nodes import Node, load_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.distance.frame import SearchScale
from warp_abtree.kernels.inside.parity import STACK_ROOM, load_posed_face
from warp_abtree.kernels.triangle.distance import clamp_unit, divide, scale_triangles
from warp_abtree.kernels.triangle.triangle_pair import Features, cross_exactly, edge_weights, offer, offer_corner

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# The candidate inside a face, after those on its three edges.
INSIDE_FACE = wp.constant(3)
NO_NEAREST = wp.constant(2**31 - 1)


@wp.struct
class Solid:
    """One object of a pair in queries of points' distances from it."""

    of_b: bool  # whether it is B
    node: wp.int32  # where its tree lies in the pool
    centre: wp.vec3d  # of its model
    slack: wp.float64  # that distances to its faces err by [model units]
    margin: wp.float64  # that boxes are wider by for rounding, beside a part of the distance
    grow: wp.float64  # a little over 1: that part


@wp.func
def make_solid(trees: Trees, pose: PairPose, scaling: SearchScale, of_b: bool, state: wp.int32):
    """Return the `Solid` of A or B of a pair."""
    solid = Solid()
    solid.of_b = of_b
    solid.node = wp.where(of_b, pose.node_b, pose.node_a)
    solid.centre = trees.models.centre[trees.states.model[state]]
    solid.slack = scaling.pair_slack
    solid.margin = wp.float64(2.0) * wp.float64(scaling.margin) / scaling.scale64 + scaling.pair_slack
    solid.grow = wp.float64(scaling.grow)
    return solid


@wp.func
def into_frame(pose: PairPose, solid: Solid, point: wp.vec3d):
    """Map a point of A's frame to an object's model frame, about the model's centre."""
    x = point
    if solid.of_b:
        x = wp.transpose(pose.rotation) * (point - pose.translation)
    return x - solid.centre


@wp.func
def square_outside(node: Node, x: wp.vec3d):
    """Return the squared distance of a point from a node's box."""
    total = wp.float64(0.0)
    for i in range(3):
        gap = wp.max(wp.max(wp.float64(node.lower[i]) - x[i], x[i] - wp.float64(node.upper[i])), wp.float64(0.0))
        total += gap * gap
    return wp.where(node.skip < 0, wp.float64(wp.inf), total)


@native.func_native()
def open_node(
    boxes: wp.array(dtype=wp.vec4),
    start: wp.int32,
    node: wp.int32,
    x: wp.vec3d,
    squares: wp.ref[wp.vec2d],
    codes: wp.ref[wp.vec2i],
):
    """Find the squared distances of a point from the boxes of a node's children, and what these stand for.

    On CUDA they are rounded down.

    Args:
        start: Where the tree begins in the pool.
        node: In its tree.
        codes: The node that each stands for, ~face for a leaf.
    """


@wp.func
def offer_edge(best: Features, kind: wp.int32, w: wp.vec3d, u: wp.vec3d, v: wp.vec3d):
    """Offer the point of an edge from u to v that is nearest to w."""
    e = v - u
    s = clamp_unit(divide(wp.dot(w - u, e), wp.dot(e, e)))
    r = (w - u) - s * e
    return offer(best, kind, wp.dot(r, r), s, wp.float64(0.0))


@wp.func
def point_features(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, point: wp.vec3d):
    """Return which point of a face is nearest to a point, scaled, and the scale."""
    t = scale_triangles(a, b, c, point, point, point)
    best = Features()
    best.square = wp.float64(wp.inf)
    zero = wp.vec3d()
    best = offer_edge(best, 0, t.b0, zero, t.a1)
    best = offer_edge(best, 1, t.b0, t.a1, t.a2)
    best = offer_edge(best, 2, t.b0, t.a2, zero)
    return offer_corner(best, INSIDE_FACE, t.b0, t.a1, t.a2, cross_exactly(t.a1, t.a2)), t.size


@wp.func
def point_weights(near: Features):
    """Return the weights of a face's corners at its nearest point."""
    if near.kind == INSIDE_FACE:
        return wp.vec3d((wp.float64(1.0) - near.x) - near.y, near.x, near.y)
    return edge_weights(near.kind, near.x)


@wp.func
def distance_from_face(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, point: wp.vec3d):
    """Return the distance of a point from a face."""
    near, size = point_features(a, b, c, point)
    return wp.sqrt(near.square) * size


@wp.func
def point_distance(trees: Trees, pose: PairPose, solid: Solid, face: wp.int32, point: wp.vec3d):
    """Return the distance of a point in A's frame from an active face of an object."""
    a, b, c = load_posed_face(trees, pose, solid.of_b, face)
    return distance_from_face(a, b, c, point)


@wp.func
def bound_face(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, point: wp.vec3d):
    """Return how far a face lies from a point along the way to its middle, times the length of that; and its square.

    The first is 0 where it lies on both sides. No point of the face is nearer (docs/exactness.md, bound 25).
    """
    u, v, w = a - point, b - point, c - point
    g = (u + v) + w
    along = wp.min(wp.min(wp.dot(g, u), wp.dot(g, v)), wp.dot(g, w))
    return wp.max(along, wp.float64(0.0)), wp.dot(g, g)


@wp.func
def nearest_face(trees: Trees, pose: PairPose, solid: Solid, point: wp.vec3d, hint: wp.int32, enough: wp.float64):
    """Return `nearest_face_within` any distance."""
    return nearest_face_within(trees, pose, solid, point, hint, enough, wp.float64(wp.inf))


@wp.func
def nearest_face_within(
    trees: Trees, pose: PairPose, solid: Solid, point: wp.vec3d, hint: wp.int32, enough: wp.float64, most: wp.float64
):
    """Return the least distance of a point from the faces of an object, and the lowest face that has it.

    Args:
        point: In A's frame.
        hint: A face that may be near, or NO_NEAREST.
        enough: The search ends with the first face that is nearer.
        most: Where all faces are farther, it is returned, and NO_NEAREST.
    """
    x = into_frame(pose, solid, point)
    least, face = wp.float64(most), wp.int32(NO_NEAREST)
    if hint != NO_NEAREST:
        d = point_distance(trees, pose, solid, hint, point)
        if d <= most:
            least = d
            face = hint
            if least < enough:
                return least, face
    limit = (least + solid.margin) * solid.grow
    limit = limit * limit
    stack = wp.zeros(shape=(STACK_ROOM,), dtype=wp.int32)
    bound = wp.zeros(shape=(STACK_ROOM,), dtype=wp.float64)
    root = load_node(trees.states, solid.node + 1)
    stack[0] = wp.where(root.face >= 0, ~root.face, root.skip)
    bound[0] = square_outside(root, x)
    end = wp.int32(1)
    while end > 0:
        end -= 1
        below = stack[end]
        # Infinite where nothing is active.
        live = bound[end] <= limit and bound[end] < wp.float64(wp.inf)
        if live and below >= 0:
            squares, codes = wp.vec2d(), wp.vec2i()
            open_node(trees.states.node_box, solid.node, below, x, squares, codes)
            # The nearer one on top.
            turn = wp.where(squares[0] < squares[1], 1, 0)
            stack[end] = codes[turn]
            bound[end] = squares[turn]
            stack[end + 1] = codes[1 - turn]
            bound[end + 1] = squares[1 - turn]
            end += 2
        elif live:
            a, b, c = load_posed_face(trees, pose, solid.of_b, ~below)
            along, square = bound_face(a, b, c, point)
            d = wp.float64(wp.inf)
            if not along * along > limit * square:
                d = distance_from_face(a, b, c, point)
            if d < least or (d == least and ~below < face):
                face = ~below
                if d < least:
                    least = d
                    limit = (d + solid.margin) * solid.grow
                    limit = limit * limit
                if d < enough:
                    end = 0
    return least, face
