"""The segment that two faces in general position share, where float64 alone is sure of it: no expansions, no arrays.

What it is sure of has the bits of `segment`, which decides the rest.
"""

import warp as wp

from warp_abtree.kernels.arithmetic.predicates import UNCERTAIN, drop_axis, filter_orient3d, plain_sign
from warp_abtree.kernels.triangle.intersect import find_alone, is_one_sided, rotate_triangles
from warp_abtree.kernels.triangle.segment import cross_edge, round_area, round_volume, unit_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def filter_normal(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return `face_normal` and whether it is that."""
    x, sure_x = round_area(drop_axis(a, 0), drop_axis(b, 0), drop_axis(c, 0))
    y, sure_y = round_area(drop_axis(a, 1), drop_axis(b, 1), drop_axis(c, 1))
    z, sure_z = round_area(drop_axis(a, 2), drop_axis(b, 2), drop_axis(c, 2))
    return unit_vector(wp.vec3d(x, y, z)), sure_x and sure_y and sure_z


@wp.func
def order_ends(p1: wp.vec3d, e1: wp.vec3d, p2: wp.vec3d, e2: wp.vec3d):
    """Return the sign that orders the ends on edges p1 e1 and p2 e2 along the line of both planes, or UNCERTAIN."""
    sign, _ = filter_orient3d(p1, e1, p2, e2)
    return sign


@wp.func
def filter_segment(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return the ends of `cross_planes`, and whether it is sure of them.

    Source: as `cross_planes`, whose names these are.
    """
    u0, sure_u0 = round_volume(b0, b1, b2, a0)
    u1, sure_u1 = round_volume(b0, b1, b2, a1)
    u2, sure_u2 = round_volume(b0, b1, b2, a2)
    v0, sure_v0 = round_volume(a0, a1, a2, b0)
    v1, sure_v1 = round_volume(a0, a1, a2, b1)
    v2, sure_v2 = round_volume(a0, a1, a2, b2)
    sure = sure_u0 and sure_u1 and sure_u2 and sure_v0 and sure_v1 and sure_v2
    sa = wp.vec3i(plain_sign(u0), plain_sign(u1), plain_sign(u2))
    sb = wp.vec3i(plain_sign(v0), plain_sign(v1), plain_sign(v2))
    sure = sure and sa[0] * sa[1] * sa[2] * sb[0] * sb[1] * sb[2] != 0
    sure = sure and not is_one_sided(sa[0], sa[1], sa[2]) and not is_one_sided(sb[0], sb[1], sb[2])
    _, side_a = find_alone(sa[0], sa[1], sa[2])
    _, side_b = find_alone(sb[0], sb[1], sb[2])
    ap, aq, ar, bp, bq, br = rotate_triangles(sa, sb, a0, a1, a2, b0, b1, b2)
    up, uq, ur, vp, vq, vr = rotate_triangles(sa, sb, u0, u1, u2, v0, v1, v2)
    # Of X(q), X(r) on A's edges against Y(q), Y(r) on B's.
    qq = order_ends(ap, aq, bp, bq)
    rq = order_ends(ap, ar, bp, bq)
    qr = order_ends(ap, aq, bp, br)
    rr = order_ends(ap, ar, bp, br)
    sure = sure and qq != UNCERTAIN and rq != UNCERTAIN and qr != UNCERTAIN and rr != UNCERTAIN
    sure = sure and qq <= 0 and rr >= 0
    start = cross_edge(bp, br, vp, vr)
    if qr > 0:
        start = cross_edge(ap, aq, up, uq)
    end = cross_edge(ap, ar, up, ur)
    if rq > 0:
        end = cross_edge(bp, bq, vp, vq)
    if side_a * side_b < 0:
        return end, start, sure
    return start, end, sure
