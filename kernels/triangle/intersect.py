"""Triangle against triangle as closed sets: touching and coplanar overlap count, zero-area faces are segments."""

from typing import Any

import warp as wp

from warp_abtree.kernels.base.lanes import lowest_bit
from warp_abtree.kernels.exact.predicates import EXACT, FILTER, UNCERTAIN, orient3d, orient_edges
from warp_abtree.kernels.triangle.coplanar import intersect_coplanar, intersect_degenerate, widest_axis

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def find_alone(s0: wp.int32, s1: wp.int32, s2: wp.int32):
    """Return the corner of a triangle that is alone on its closed side of a plane it crosses or touches, and that side.

    The others lie on the other closed side. Where one corner touches and two lie on one side, it is alone on the other.
    """
    positive = wp.where(s0 > 0, 1, 0) + wp.where(s1 > 0, 1, 0) + wp.where(s2 > 0, 1, 0)
    negative = wp.where(s0 < 0, 1, 0) + wp.where(s1 < 0, 1, 0) + wp.where(s2 < 0, 1, 0)
    # 1, -1 or 0: the sign of which there is one, or none of which is alone but that of a corner that touches.
    kind = wp.where(positive == 1, 1, wp.where(negative == 1, -1, 0))
    alone = wp.where(s0 == kind, 0, wp.where(s1 == kind, 1, 2))
    return alone, wp.where(kind != 0, kind, wp.where(positive == 2, -1, 1))


@wp.func
def rotate_first(i: wp.int32, a: Any, b: Any, c: Any):
    """Return the corners rotated so that corner i comes first."""
    first = wp.where(i == 0, a, wp.where(i == 1, b, c))
    second = wp.where(i == 0, b, wp.where(i == 1, c, a))
    third = wp.where(i == 0, c, wp.where(i == 1, a, b))
    return first, second, third


@wp.func
def rotate_triangles(sa: wp.vec3i, sb: wp.vec3i, a0: Any, a1: Any, a2: Any, b0: Any, b1: Any, b2: Any):
    """Return both triangles, each with the corner first that is alone on its side of the other's plane.

    Each is rotated so that the other's lone corner lies on the positive side of its plane. The planes meet in a line;
    on it the triangles are the intervals between edges p q and p r, and two more signs order the ends: they meet unless
    orient_edges(p1, q1, p2, q2) or orient_edges(p1, r1, r2, p2) is 1.
    """
    alone_a, side_a = find_alone(sa[0], sa[1], sa[2])
    alone_b, side_b = find_alone(sb[0], sb[1], sb[2])
    p1, q1, r1 = rotate_first(alone_a, a0, a1, a2)
    p2, q2, r2 = rotate_first(alone_b, b0, b1, b2)
    back_a = side_a < 0
    back_b = side_b < 0
    return (
        p1,
        wp.where(back_b, r1, q1),
        wp.where(back_b, q1, r1),
        p2,
        wp.where(back_a, r2, q2),
        wp.where(back_a, q2, r2),
    )


@wp.func
def is_one_sided(s0: wp.int32, s1: wp.int32, s2: wp.int32):
    return wp.abs(s0 + s1 + s2) == 3


@wp.func(inline=False)
def intersect_special(
    mode: wp.int32, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d
):
    """Decide faces whose plane is shared, or not defined."""
    axis_a = widest_axis(mode, a0, a1, a2)
    axis_b = widest_axis(mode, b0, b1, b2)
    if axis_a < 0 or axis_b < 0:
        return intersect_degenerate(mode, axis_a, axis_b, a0, a1, a2, b0, b1, b2)
    return intersect_coplanar(mode, axis_a, a0, a1, a2, b0, b1, b2)


@wp.func
def pick_corners(k: wp.int32, a0: Any, a1: Any, a2: Any, b0: Any, b1: Any, b2: Any):
    """Return the corners whose sign is the k-th of `intersect_triangles`: a face and a corner of the other."""
    of_a = k < 3
    d = wp.where(of_a, a0, b0)
    if k % 3 == 1:
        d = wp.where(of_a, a1, b1)
    if k % 3 == 2:
        d = wp.where(of_a, a2, b2)
    return wp.where(of_a, b0, a0), wp.where(of_a, b1, a1), wp.where(of_a, b2, a2), d


@wp.func
def unpack_sign(signs: wp.int32, k: wp.int32):
    return ((signs >> (2 * k)) & 3) - 1


@wp.func
def find_signs(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return the six exact signs of `intersect_triangles`, 1 added, two bits each; for a coplanar A not all of B's.

    Threads of a warp have different signs open: each takes its own next, so that they need not wait for one another.
    """
    signs = wp.int32(0)
    pending = wp.int32(0)
    for k in range(6):
        a, b, c, d = pick_corners(k, a0, a1, a2, b0, b1, b2)
        sign = orient3d(FILTER, a, b, c, d)
        if sign == UNCERTAIN:
            pending |= 1 << k
        else:
            signs |= (sign + 1) << (2 * k)
    while pending != 0:
        k = lowest_bit(pending)
        pending &= pending - 1
        a, b, c, d = pick_corners(k, a0, a1, a2, b0, b1, b2)
        signs |= (orient3d(EXACT, a, b, c, d) + 1) << (2 * k)
        if (pending & 7) == 0 and (signs & 63) == 21:
            pending = 0  # zeros take longest: not three more of them
    return signs


@wp.func
def intersect_exactly(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return what `intersect_triangles` does by exact signs, the same for neighbouring threads at the same time."""
    signs = find_signs(a0, a1, a2, b0, b1, b2)
    sa0, sa1, sa2 = unpack_sign(signs, 0), unpack_sign(signs, 1), unpack_sign(signs, 2)
    sb0, sb1, sb2 = unpack_sign(signs, 3), unpack_sign(signs, 4), unpack_sign(signs, 5)
    coplanar_a = sa0 == 0 and sa1 == 0 and sa2 == 0
    if is_one_sided(sa0, sa1, sa2) or (not coplanar_a and is_one_sided(sb0, sb1, sb2)):
        return 0
    if coplanar_a or (sb0 == 0 and sb1 == 0 and sb2 == 0):
        return wp.where(intersect_special(EXACT, a0, a1, a2, b0, b1, b2), 1, 0)
    p1, q1, r1, p2, q2, r2 = rotate_triangles(wp.vec3i(sa0, sa1, sa2), wp.vec3i(sb0, sb1, sb2), a0, a1, a2, b0, b1, b2)
    first = orient_edges(FILTER, p1, q1, p2, q2)
    second = orient_edges(FILTER, p1, r1, r2, p2)
    while first != 1 and second != 1 and wp.max(first, second) == UNCERTAIN:
        one = first == UNCERTAIN
        sign = orient3d(EXACT, p1, wp.where(one, q1, r1), wp.where(one, p2, r2), wp.where(one, q2, p2))
        first = wp.where(one, sign, first)
        second = wp.where(one, second, sign)
    return wp.where(first == 1 or second == 1, 0, 1)


@wp.func
def intersect_triangles(
    mode: wp.int32, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d
):
    """Return whether two closed triangles meet, 1 or 0, by exact signs or rounded ones.

    Source: Guigue and Devillers 2003, Fast and robust triangle-triangle overlap test using orientation predicates.
    """
    if mode == EXACT:
        return intersect_exactly(a0, a1, a2, b0, b1, b2)
    sa0 = orient3d(mode, b0, b1, b2, a0)
    sa1 = orient3d(mode, b0, b1, b2, a1)
    sa2 = orient3d(mode, b0, b1, b2, a2)
    if is_one_sided(sa0, sa1, sa2):
        return 0
    sb0 = orient3d(mode, a0, a1, a2, b0)
    sb1 = orient3d(mode, a0, a1, a2, b1)
    sb2 = orient3d(mode, a0, a1, a2, b2)
    if is_one_sided(sb0, sb1, sb2):
        return 0
    # A zero-area face sees every corner of the other on its "plane".
    special = (sa0 == 0 and sa1 == 0 and sa2 == 0) or (sb0 == 0 and sb1 == 0 and sb2 == 0)
    if special:
        return wp.where(intersect_special(mode, a0, a1, a2, b0, b1, b2), 1, 0)
    p1, q1, r1, p2, q2, r2 = rotate_triangles(wp.vec3i(sa0, sa1, sa2), wp.vec3i(sb0, sb1, sb2), a0, a1, a2, b0, b1, b2)
    first = orient_edges(mode, p1, q1, p2, q2)
    second = orient_edges(mode, p1, r1, r2, p2)
    return wp.where(first == 1 or second == 1, 0, 1)
