"""The segment that two faces in general position share: no expansions, no arrays.

What this is sure of has the bits of `segment`, which decides the rest: a determinant whose float64 value may err too
much there is the sum of an expansion, off the float64 number next to it by nothing but a tie that double words exclude.
Without double words, `extends` False, it is sure of fewer; as a constant the flag costs nothing.
"""

import warp as wp

from warp_abtree.kernels.arithmetic.double_word import BOUND_DOUBLE, double_orient2d, double_orient3d, round_double
from warp_abtree.kernels.arithmetic.predicates import (
    BOUND_2D,
    BOUND_3D,
    UNCERTAIN,
    drop_axis,
    filter_orient3d,
    plain_sign,
)
from warp_abtree.kernels.triangle.intersect import find_alone, is_one_sided, rotate_triangles
from warp_abtree.kernels.triangle.segment import RELATIVE_ERROR, cross_edge, round_area, round_volume, unit_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func(inline=False)
def extend_volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, size: wp.float64):
    """Return det(a - d, b - d, c - d) rounded once, or NaN. Not inlined: long, and rarely called."""
    return round_double(double_orient3d(a, b, c, d), BOUND_DOUBLE * size)


@wp.func(inline=False)
def extend_area(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, size: wp.float64):
    """Return det(a - c, b - c) rounded once, or NaN."""
    return round_double(double_orient2d(a, b, c), BOUND_DOUBLE * size)


@wp.func
def filter_volume(
    extends: bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d
):
    """Return `signed_volume`, or NaN; u, v and w are a - d, b - d and c - d."""
    value, size = round_volume(u, v, w)
    if BOUND_3D * size > RELATIVE_ERROR * wp.abs(value):
        value = wp.float64(wp.nan)
        if extends:
            value = extend_volume(a, b, c, d, size)
    return value


@wp.func
def filter_area(extends: bool, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return `signed_area`, or NaN."""
    value, size = round_area(a, b, c)
    if BOUND_2D * size > RELATIVE_ERROR * wp.abs(value):
        value = wp.float64(wp.nan)
        if extends:
            value = extend_area(a, b, c, size)
    return value


@wp.func
def filter_normal(extends: bool, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return `face_normal`, and whether it is sure of it."""
    x = filter_area(extends, drop_axis(a, 0), drop_axis(b, 0), drop_axis(c, 0))
    y = filter_area(extends, drop_axis(a, 1), drop_axis(b, 1), drop_axis(c, 1))
    z = filter_area(extends, drop_axis(a, 2), drop_axis(b, 2), drop_axis(c, 2))
    return unit_vector(wp.vec3d(x, y, z)), x == x and y == y and z == z


@wp.func
def filter_volumes(
    extends: bool, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d
):
    """Return the volume of each corner of A and triangle B, then of each of B and A.

    The differences of corners are those of either: the other way round, every rounding is the same.
    """
    d00, d01, d02 = b0 - a0, b1 - a0, b2 - a0
    d10, d11, d12 = b0 - a1, b1 - a1, b2 - a1
    d20, d21, d22 = b0 - a2, b1 - a2, b2 - a2
    u0 = filter_volume(extends, b0, b1, b2, a0, d00, d01, d02)
    u1 = filter_volume(extends, b0, b1, b2, a1, d10, d11, d12)
    u2 = filter_volume(extends, b0, b1, b2, a2, d20, d21, d22)
    v0 = filter_volume(extends, a0, a1, a2, b0, -d00, -d10, -d20)
    v1 = filter_volume(extends, a0, a1, a2, b1, -d01, -d11, -d21)
    v2 = filter_volume(extends, a0, a1, a2, b2, -d02, -d12, -d22)
    return u0, u1, u2, v0, v1, v2


@wp.func
def order_ends(p1: wp.vec3d, e1: wp.vec3d, p2: wp.vec3d, e2: wp.vec3d):
    """Return the sign that orders the ends on edges p1 e1 and p2 e2 along the line of both planes, or UNCERTAIN."""
    sign, _ = filter_orient3d(p1, e1, p2, e2)
    return sign


@wp.func
def filter_segment(
    extends: bool,
    proven: bool,
    a0: wp.vec3d,
    a1: wp.vec3d,
    a2: wp.vec3d,
    b0: wp.vec3d,
    b1: wp.vec3d,
    b2: wp.vec3d,
):
    """Return the ends of `cross_planes`, and whether it is sure of them; `proven` that the triangles intersect.

    Source: as `cross_planes`, whose names these are.
    """
    u0, u1, u2, v0, v1, v2 = filter_volumes(extends, a0, a1, a2, b0, b1, b2)
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
    start = cross_edge(wp.where(first, ap, bp), wp.where(first, aq, br), wp.where(first, up, vp), wp.where(first, uq, vr))
    end = cross_edge(wp.where(last, bp, ap), wp.where(last, bq, ar), wp.where(last, vp, up), wp.where(last, vq, ur))
    back = side_a * side_b < 0
    return wp.where(back, end, start), wp.where(back, start, end), sure
