"""The segment that two faces in general position share: no expansions, no arrays.

What this is sure of has the bits of `segment`, which decides the rest: a determinant whose float64 value may err too
much there is the sum of an expansion, off the float64 number next to it by nothing but a tie that double words exclude.
Each thread of a warp takes its own next of them, so that threads need not wait for one another.
"""

import warp as wp

from warp_abtree.kernels.base.lanes import lowest_bit
from warp_abtree.kernels.exact.double_word import BOUND_DOUBLE, double_orient2d, double_orient3d, round_double
from warp_abtree.kernels.exact.predicates import BOUND_2D, BOUND_3D, UNCERTAIN, drop_axis, filter_orient3d, plain_sign
from warp_abtree.kernels.triangle.intersect import find_alone, is_one_sided, pick_corners, rotate_triangles
from warp_abtree.kernels.triangle.segment import RELATIVE_ERROR, cross_edge, round_area, round_volume, unit_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func(inline=False)
def extend_volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return det(a - d, b - d, c - d) rounded once, or NaN. Not inlined: long, and rarely called."""
    _, size = round_volume(a - d, b - d, c - d)
    return round_double(double_orient3d(a, b, c, d), BOUND_DOUBLE * size)


@wp.func(inline=False)
def extend_area(axis: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return det(a - c, b - c) along an axis rounded once, or NaN."""
    a2, b2, c2 = drop_axis(a, axis), drop_axis(b, axis), drop_axis(c, axis)
    _, size = round_area(a2, b2, c2)
    return round_double(double_orient2d(a2, b2, c2), BOUND_DOUBLE * size)


@wp.func
def plain_volume(k: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return det(a - d, b - d, c - d) as float64 has it, and bit k where that may err too much."""
    value, size = round_volume(a - d, b - d, c - d)
    return value, wp.where(BOUND_3D * size > RELATIVE_ERROR * wp.abs(value), 1 << k, 0)


@wp.func
def filter_volumes(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return `signed_volume` of triangle B and each corner of A, then of A and each of B, or NaN."""
    u0, pending0 = plain_volume(0, b0, b1, b2, a0)
    u1, pending1 = plain_volume(1, b0, b1, b2, a1)
    u2, pending2 = plain_volume(2, b0, b1, b2, a2)
    v0, pending3 = plain_volume(3, a0, a1, a2, b0)
    v1, pending4 = plain_volume(4, a0, a1, a2, b1)
    v2, pending5 = plain_volume(5, a0, a1, a2, b2)
    pending = pending0 | pending1 | pending2 | pending3 | pending4 | pending5
    while pending != 0:
        k = lowest_bit(pending)
        pending &= pending - 1
        a, b, c, d = pick_corners(k, a0, a1, a2, b0, b1, b2)
        value = extend_volume(a, b, c, d)
        u0, u1, u2 = wp.where(k == 0, value, u0), wp.where(k == 1, value, u1), wp.where(k == 2, value, u2)
        v0, v1, v2 = wp.where(k == 3, value, v0), wp.where(k == 4, value, v1), wp.where(k == 5, value, v2)
    return u0, u1, u2, v0, v1, v2


@wp.func
def plain_area(k: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return det(a - c, b - c) along axis k as float64 has it, and bit k where that may err too much."""
    value, size = round_area(drop_axis(a, k), drop_axis(b, k), drop_axis(c, k))
    return value, wp.where(BOUND_2D * size > RELATIVE_ERROR * wp.abs(value), 1 << k, 0)


@wp.func
def filter_normal(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return `face_normal`, and whether it is certain."""
    x, pending0 = plain_area(0, a, b, c)
    y, pending1 = plain_area(1, a, b, c)
    z, pending2 = plain_area(2, a, b, c)
    pending = pending0 | pending1 | pending2
    while pending != 0:
        k = lowest_bit(pending)
        pending &= pending - 1
        value = extend_area(k, a, b, c)
        x, y, z = wp.where(k == 0, value, x), wp.where(k == 1, value, y), wp.where(k == 2, value, z)
    return unit_vector(wp.vec3d(x, y, z)), x == x and y == y and z == z


@wp.func
def order_ends(p1: wp.vec3d, e1: wp.vec3d, p2: wp.vec3d, e2: wp.vec3d):
    """Return the sign that orders the ends on edges p1 e1 and p2 e2 along the line of both planes, or UNCERTAIN."""
    sign, _ = filter_orient3d(p1, e1, p2, e2)
    return sign


@wp.func
def filter_segment(proven: bool, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return the ends of `cross_planes`, and whether they are certain; `proven` that the triangles intersect.

    Source: as `cross_planes`, whose names these are.
    """
    u0, u1, u2, v0, v1, v2 = filter_volumes(a0, a1, a2, b0, b1, b2)
    sa = wp.vec3i(plain_sign(u0), plain_sign(u1), plain_sign(u2))
    sb = wp.vec3i(plain_sign(v0), plain_sign(v1), plain_sign(v2))
    # NaN has no sign.
    sure = sa[0] * sa[1] * sa[2] * sb[0] * sb[1] * sb[2] != 0
    sure = sure and not is_one_sided(sa[0], sa[1], sa[2]) and not is_one_sided(sb[0], sb[1], sb[2])
    _, side_a = find_alone(sa[0], sa[1], sa[2])
    _, side_b = find_alone(sb[0], sb[1], sb[2])
    ap, aq, ar, bp, bq, br = rotate_triangles(sa, sb, a0, a1, a2, b0, b1, b2)
    up, uq, ur, vp, vq, vr = rotate_triangles(sa, sb, u0, u1, u2, v0, v1, v2)
    # Of X(q), X(r) on A's edges against Y(q), Y(r) on B's; that the other two are in order is why triangles intersect.
    rq = order_ends(ap, ar, bp, bq)
    qr = order_ends(ap, aq, bp, br)
    sure = sure and rq != UNCERTAIN and qr != UNCERTAIN
    if not proven:
        qq = order_ends(ap, aq, bp, bq)
        rr = order_ends(ap, ar, bp, br)
        sure = sure and qq <= 0 and rr >= 0 and rr != UNCERTAIN
    first, last = qr > 0, rq > 0
    start = cross_edge(
        wp.where(first, ap, bp), wp.where(first, aq, br), wp.where(first, up, vp), wp.where(first, uq, vr)
    )
    end = cross_edge(wp.where(last, bp, ap), wp.where(last, bq, ar), wp.where(last, vp, up), wp.where(last, vq, ur))
    back = side_a * side_b < 0
    return wp.where(back, end, start), wp.where(back, start, end), sure
