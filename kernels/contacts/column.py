"""Columns of faces along a direction: what lies of another face within one, its corners and their depths."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_face_pair
from warp_abtree.kernels.triangle.distance import largest_coordinate

wp.set_module_options(native.options())

# A face seen at a smaller cosine along a direction says nothing about depth in that direction.
FACING = wp.constant(wp.float64(0.1))
# By which part of a face's size its column is wider, so that walls that stand on its rim are inside.
COLUMN_SLACK = wp.constant(wp.float64(2.0**-36))
# Part of the size of faces that depths in a column err by.
COLUMN_ROUNDING = wp.constant(wp.float64(2.0**-46))
# Corners of a triangle within the column of another, at most.
COLUMN_CORNERS = wp.constant(6)
# Places where there may be one: ends of three edges, and three piercing edges of the column.
POSSIBLE_CORNERS = wp.constant(9)
# Depth of a column that holds no corner.
NO_DEPTH = wp.constant(wp.float64(-wp.inf))


@wp.struct
class FacePair:
    """The faces of a contact, A's frame."""

    a0: wp.vec3d  # corners of that of the pair's first object
    a1: wp.vec3d  # the second
    a2: wp.vec3d  # the third
    b0: wp.vec3d  # corners of that of its second object
    b1: wp.vec3d  # the second
    b2: wp.vec3d  # the third


@wp.func
def load_pair(trees: Trees, pose: PairPose, faces: wp.vec3i):
    """Return the faces of a contact, of which `faces` names the pair, and those of the first and the second object."""
    a = load_corner_ids(trees.states, pose.corner_a + faces[1 + pose.swapped])
    b = load_corner_ids(trees.states, pose.corner_b + faces[2 - pose.swapped])
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    pair, back = FacePair(), pose.swapped != 0
    pair.a0 = wp.where(back, b0, a0)
    pair.a1 = wp.where(back, b1, a1)
    pair.a2 = wp.where(back, b2, a2)
    pair.b0 = wp.where(back, a0, b0)
    pair.b1 = wp.where(back, a1, b1)
    pair.b2 = wp.where(back, a2, b2)
    return pair


@wp.func
def column_slack(pair: FacePair):
    """Return what depths in a column err by at most: a part of the size of both faces."""
    size = wp.max(largest_coordinate(pair.a1 - pair.a0), largest_coordinate(pair.a2 - pair.a0))
    size = wp.max(size, wp.max(largest_coordinate(pair.b0 - pair.a0), largest_coordinate(pair.b1 - pair.a0)))
    return COLUMN_ROUNDING * wp.max(size, largest_coordinate(pair.b2 - pair.a0))


@wp.struct
class Column:
    """The column of one face along a normal, and the face that it cuts.

    The corners of what lies of that within it are the ends of its edges, clipped, and where the column's edges pierce
    it: nine at most, each of them once.
    """

    normal: wp.vec3d  # unit, from the pair's first object to its second
    depth: wp.float64  # how deep the deepest corner is behind the face, or NO_DEPTH
    plane: wp.vec3d  # the face's normal over its cosine with the column's
    u0: wp.vec3d  # corners of the face
    u1: wp.vec3d  # the second
    u2: wp.vec3d  # the third
    v0: wp.vec3d  # corners of the other one
    v1: wp.vec3d  # the second
    v2: wp.vec3d  # the third
    side0: wp.vec3d  # normals of the column's sides, inwards, of any length
    side1: wp.vec3d  # the second
    side2: wp.vec3d  # the third
    slack: wp.vec3d  # by which each side is wider, times that length


@wp.func
def sum_magnitudes(v: wp.vec3d):
    return (wp.abs(v[0]) + wp.abs(v[1])) + wp.abs(v[2])


@wp.func
def make_side(n: wp.vec3d, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d):
    """Return the inward normal of the side of a column over the edge from u to v, w the third corner, and its slack."""
    edge, across = v - u, w - u
    inward = wp.cross(edge, n)
    if wp.dot(inward, across) < wp.float64(0.0):
        inward = -inward
    return inward, COLUMN_SLACK * (sum_magnitudes(edge) + sum_magnitudes(across)) * sum_magnitudes(inward)


@wp.func
def height_over(side: wp.vec3d, u: wp.vec3d, slack: wp.float64, p: wp.vec3d):
    return wp.dot(side, p - u) + slack


@wp.func
def clip_range(range: wp.vec2d, at_p: wp.float64, at_q: wp.float64):
    """Return the part of a range of an edge's parameter where a linear function is not negative; [2, 1] for none."""
    zero = wp.float64(0.0)
    if at_p < zero and at_q < zero:
        return wp.vec2d(wp.float64(2.0), wp.float64(1.0))
    if at_p < zero:
        range[0] = wp.max(range[0], at_p / (at_p - at_q))
    if at_q < zero:
        range[1] = wp.min(range[1], at_p / (at_p - at_q))
    return range


@wp.func
def clip_edge(column: Column, p: wp.vec3d, q: wp.vec3d):
    """Return between which parameters an edge from p to q lies within a column, the first more where it does not."""
    range = wp.vec2d(wp.float64(0.0), wp.float64(1.0))
    s = column.slack
    range = clip_range(
        range, height_over(column.side0, column.u0, s[0], p), height_over(column.side0, column.u0, s[0], q)
    )
    range = clip_range(
        range, height_over(column.side1, column.u1, s[1], p), height_over(column.side1, column.u1, s[1], q)
    )
    return clip_range(
        range, height_over(column.side2, column.u2, s[2], p), height_over(column.side2, column.u2, s[2], q)
    )


@wp.func
def pierce_cut(column: Column, u: wp.vec3d):
    """Return where the edge of a column at a corner of its face pierces the other face, and whether it does."""
    zero = wp.float64(0.0)
    m = wp.cross(column.v1 - column.v0, column.v2 - column.v0)
    along = wp.dot(column.normal, m)
    if along == zero:
        return u, False
    p = u + column.normal * (wp.dot(column.v0 - u, m) / along)
    inside = wp.dot(wp.cross(column.v1 - column.v0, p - column.v0), m) > zero
    inside = inside and wp.dot(wp.cross(column.v2 - column.v1, p - column.v1), m) > zero
    return p, inside and wp.dot(wp.cross(column.v0 - column.v2, p - column.v2), m) > zero


@wp.func
def cut_edge(column: Column, i: wp.int32):
    """Return edge i of what a column cuts, from corner to corner, and between which parameters it lies within."""
    p = wp.where(i == 0, column.v0, wp.where(i == 1, column.v1, column.v2))
    q = wp.where(i == 0, column.v1, wp.where(i == 1, column.v2, column.v0))
    return p, q, clip_edge(column, p, q)


@wp.func
def ends_before(range: wp.vec2d):
    """Return whether an edge leaves a column before its end, which is where the next one starts."""
    return range[1] < wp.float64(1.0) and range[0] < range[1]


@wp.func
def depth_of(column: Column, point: wp.vec3d):
    return wp.dot(column.u0 - point, column.plane)


@wp.func
def column_corner(column: Column, k: wp.int32):
    """Return the k-th corner of what a column cuts, its depth, and whether there is one, k = 0 .. 8."""
    point, exists = wp.vec3d(), False
    if k < 6:
        p, q, range = cut_edge(column, k / 2)
        exists = range[0] <= range[1] and (k % 2 == 0 or ends_before(range))
        t = range[k % 2]
        point = p
        if t > wp.float64(0.0):
            point = p + (q - p) * t
    else:
        point, exists = pierce_cut(column, wp.where(k == 6, column.u0, wp.where(k == 7, column.u1, column.u2)))
    return point, depth_of(column, point), exists


@wp.func
def raise_depth(depth: wp.float64, least: wp.float64, exists: bool, of_corner: wp.float64):
    return wp.where(exists and of_corner >= least, wp.max(depth, of_corner), depth)


@wp.func
def deepest_corner(column: Column, least: wp.float64):
    """Return how deep the deepest corner is that is deep enough, NO_DEPTH where there is none."""
    depth, i = wp.float64(NO_DEPTH), wp.int32(0)
    while i < 3:
        p, q, range = cut_edge(column, i)
        # Depth is linear along the edge.
        at_p, at_q = depth_of(column, p), depth_of(column, q)
        exists = range[0] <= range[1]
        depth = raise_depth(depth, least, exists, at_p + (at_q - at_p) * range[0])
        depth = raise_depth(depth, least, exists and ends_before(range), at_p + (at_q - at_p) * range[1])
        point, pierces = pierce_cut(column, wp.where(i == 0, column.u0, wp.where(i == 1, column.u1, column.u2)))
        depth = raise_depth(depth, least, pierces, depth_of(column, point))
        i += 1
    return depth


@wp.func
def make_column(pair: FacePair, n: wp.vec3d, normal_a: wp.vec3d, normal_b: wp.vec3d):
    """Return the column of one face along n, of that which looks more along it, with NO_DEPTH; whether it looks."""
    column = Column()
    column.normal = n
    column.depth = NO_DEPTH
    facing_a, facing_b = wp.dot(n, normal_a), -wp.dot(n, normal_b)
    other, facing = facing_b > facing_a, wp.max(facing_a, facing_b)
    if facing < FACING:
        return column, False
    column.plane = wp.where(other, normal_b, normal_a) / facing
    column.u0 = wp.where(other, pair.b0, pair.a0)
    column.u1 = wp.where(other, pair.b1, pair.a1)
    column.u2 = wp.where(other, pair.b2, pair.a2)
    column.v0 = wp.where(other, pair.a0, pair.b0)
    column.v1 = wp.where(other, pair.a1, pair.b1)
    column.v2 = wp.where(other, pair.a2, pair.b2)
    side0, s0 = make_side(n, column.u0, column.u1, column.u2)
    side1, s1 = make_side(n, column.u1, column.u2, column.u0)
    side2, s2 = make_side(n, column.u2, column.u0, column.u1)
    column.side0 = side0
    column.side1 = side1
    column.side2 = side2
    column.slack = wp.vec3d(s0, s1, s2)
    return column, True


@wp.func
def measure_column(pair: FacePair, n: wp.vec3d, normal_a: wp.vec3d, normal_b: wp.vec3d, least: wp.float64):
    """Return the column of one face along n, as `make_column`, and how deep the other is within it.

    Args:
        least: Depth from which on corners count: 0, or minus the gap.
    """
    column, looks = make_column(pair, n, normal_a, normal_b)
    if looks:
        column.depth = deepest_corner(column, least)
    return column
