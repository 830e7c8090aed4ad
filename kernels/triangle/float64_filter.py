"""Second of three stages: triangle against triangle in float64, with a proven bound on the error of each sign.

It comes in two parts, as the first: planes, and edges of straddling pairs.
Source: as `intersect_triangles`. `simd.simd_float64_filter` does the same for 8 pairs at a time; tests compare them.
"""

import warp as wp

from warp_abtree.kernels.exact.predicates import FILTER, UNCERTAIN, filter_rows, orient_edges
from warp_abtree.kernels.triangle.intersect import intersect_triangles
from warp_abtree.kernels.triangle.signs import SEPARATED, is_one_sided, pack_signs, rotate_corners

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Beside the signs of `plane_signs`: no plane decides, and corners coincide.
PLANES_UNDECIDED, SHARED_CORNER = wp.constant(-2), wp.constant(1 << 12)


@wp.func
def side_of(u: wp.vec3d, v: wp.vec3d, w: wp.vec3d):
    """Return the sign of det(u, v, w) or UNCERTAIN."""
    sign, _ = filter_rows(u, v, w)
    return sign


@wp.func
def is_zero(d: wp.vec3d):
    return (wp.abs(d[0]) + wp.abs(d[1])) + wp.abs(d[2]) == wp.float64(0.0)


@wp.func
def negate_sign(sign: wp.int32):
    return wp.where(sign == UNCERTAIN, UNCERTAIN, -sign)


@wp.func
def filter_planes(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return SEPARATED where one triangle lies on one side of the other's plane, else all signs, as `plane_signs`.

    PLANES_UNDECIDED where a sign is uncertain, or a plane is shared or not defined, and SHARED_CORNER where such
    triangles have a corner in common, as the faces of coincident meshes do.
    """
    # `orient3d` for corners of A over B. From B to A the differences are the same with the other sign, so every
    # rounding is the same.
    d00, d01, d02 = b0 - a0, b1 - a0, b2 - a0
    d10, d11, d12 = b0 - a1, b1 - a1, b2 - a1
    d20, d21, d22 = b0 - a2, b1 - a2, b2 - a2
    sa0, sa1, sa2 = side_of(d00, d01, d02), side_of(d10, d11, d12), side_of(d20, d21, d22)
    sb0 = negate_sign(side_of(d00, d10, d20))
    sb1 = negate_sign(side_of(d01, d11, d21))
    sb2 = negate_sign(side_of(d02, d12, d22))
    if is_one_sided(sa0, sa1, sa2) or is_one_sided(sb0, sb1, sb2):
        return SEPARATED
    uncertain = wp.max(wp.max(sa0, wp.max(sa1, sa2)), wp.max(sb0, wp.max(sb1, sb2))) == UNCERTAIN
    if uncertain or (sa0 == 0 and sa1 == 0 and sa2 == 0) or (sb0 == 0 and sb1 == 0 and sb2 == 0):
        shared = is_zero(d00) or is_zero(d01) or is_zero(d02) or is_zero(d10) or is_zero(d11) or is_zero(d12)
        return wp.where(shared or is_zero(d20) or is_zero(d21) or is_zero(d22), SHARED_CORNER, PLANES_UNDECIDED)
    return (pack_signs(sa0, sa1, sa2) << 6) | pack_signs(sb0, sb1, sb2)


@wp.func
def filter_straddling(p1: wp.vec3d, q1: wp.vec3d, r1: wp.vec3d, p2: wp.vec3d, q2: wp.vec3d, r2: wp.vec3d):
    """Return whether straddling triangles meet, their corners rotated: 1, 0 or UNCERTAIN."""
    first = orient_edges(FILTER, p1, q1, p2, q2)
    second = orient_edges(FILTER, p1, r1, r2, p2)
    meet = wp.where(first == UNCERTAIN or second == UNCERTAIN, UNCERTAIN, 1)
    return wp.where(first == 1 or second == 1, 0, meet)


@wp.func
def float64_filter_triangles(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return 1 where two closed triangles meet, 0 where not, UNCERTAIN where float64 cannot tell: both parts."""
    signs = filter_planes(a0, a1, a2, b0, b1, b2)
    if signs == SEPARATED:
        return 0
    if signs == PLANES_UNDECIDED:
        return UNCERTAIN
    if signs == SHARED_CORNER:
        return 1
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, wp.matrix_from_rows(a0, a1, a2), wp.matrix_from_rows(b0, b1, b2))
    return filter_straddling(p1, q1, r1, p2, q2, r2)


@wp.func
def decide_triangles(
    mode: wp.int32, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d
):
    """Return whether two closed triangles meet by signs of a kind: 1, 0, or UNCERTAIN where a FILTER cannot tell."""
    if mode == FILTER:
        return float64_filter_triangles(a0, a1, a2, b0, b1, b2)
    return intersect_triangles(mode, a0, a1, a2, b0, b1, b2)
