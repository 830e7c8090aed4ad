"""Triangle against triangle as closed sets: touching and coplanar overlap count, zero-area faces are segments."""

import warp as wp

from warp_abtree.kernels.flat import intersect_coplanar, intersect_degenerate, widest_axis
from warp_abtree.kernels.predicates import orient3d

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def find_alone(s0: wp.float64, s1: wp.float64, s2: wp.float64):
    """Return which corner of a triangle that crosses or touches a plane is alone on its closed side, and that side.

    The others lie on the other closed side. Where one corner touches and two lie above, it is alone below.
    """
    zero = wp.float64(0.0)
    above = wp.where(s0 > zero, 1, 0) + wp.where(s1 > zero, 1, 0) + wp.where(s2 > zero, 1, 0)
    below = wp.where(s0 < zero, 1, 0) + wp.where(s1 < zero, 1, 0) + wp.where(s2 < zero, 1, 0)
    if above == 1:
        return wp.where(s0 > zero, 0, wp.where(s1 > zero, 1, 2)), 1
    if below == 1:
        return wp.where(s0 < zero, 0, wp.where(s1 < zero, 1, 2)), -1
    alone = wp.where(s0 == zero, 0, wp.where(s1 == zero, 1, 2))
    return alone, wp.where(above == 2, -1, 1)


@wp.func
def rotate_first(i: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the corners turned so that corner i comes first."""
    if i == 1:
        return b, c, a
    if i == 2:
        return c, a, b
    return a, b, c


@wp.func
def is_one_sided(s0: wp.float64, s1: wp.float64, s2: wp.float64):
    zero = wp.float64(0.0)
    return (s0 > zero and s1 > zero and s2 > zero) or (s0 < zero and s1 < zero and s2 < zero)


@wp.func
def intersect_special(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Decide faces whose plane is shared, or not defined."""
    axis_a = widest_axis(a0, a1, a2)
    axis_b = widest_axis(b0, b1, b2)
    if axis_a < 0 or axis_b < 0:
        return intersect_degenerate(axis_a, axis_b, a0, a1, a2, b0, b1, b2)
    return intersect_coplanar(axis_a, a0, a1, a2, b0, b1, b2)


@wp.func
def intersect_triangles(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return whether two closed triangles meet.

    Source: Guigue and Devillers 2003, Fast and robust triangle-triangle overlap test using orientation predicates.
    """
    zero = wp.float64(0.0)
    sa0 = orient3d(b0, b1, b2, a0)
    sa1 = orient3d(b0, b1, b2, a1)
    sa2 = orient3d(b0, b1, b2, a2)
    if is_one_sided(sa0, sa1, sa2):
        return False
    sb0 = orient3d(a0, a1, a2, b0)
    sb1 = orient3d(a0, a1, a2, b1)
    sb2 = orient3d(a0, a1, a2, b2)
    if is_one_sided(sb0, sb1, sb2):
        return False
    # A zero-area face sees every corner of the other on its "plane".
    if (sa0 == zero and sa1 == zero and sa2 == zero) or (sb0 == zero and sb1 == zero and sb2 == zero):
        return intersect_special(a0, a1, a2, b0, b1, b2)
    alone_a, side_a = find_alone(sa0, sa1, sa2)
    alone_b, side_b = find_alone(sb0, sb1, sb2)
    p1, q1, r1 = rotate_first(alone_a, a0, a1, a2)
    p2, q2, r2 = rotate_first(alone_b, b0, b1, b2)
    # Turn each triangle so that the other's lone corner lies above its plane. The planes meet in a line; on it the
    # triangles are the intervals between edges p q and p r, and two more signs order the ends.
    if side_a < 0:
        t = q2
        q2 = r2
        r2 = t
    if side_b < 0:
        t = q1
        q1 = r1
        r1 = t
    return orient3d(p1, q1, p2, q2) <= zero and orient3d(p1, r1, r2, p2) <= zero
