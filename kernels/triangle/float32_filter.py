"""First of three stages: triangle against triangle in float32, with a proven bound on the error of each sign.

It comes in two parts: planes separate most face pairs; only of those that straddle both planes, edges are compared.
Source: as `intersect_triangles`.

Coordinates are about A's centre, scaled to about unit size; differences of corners are off by less than `error`, and
the arithmetic of a determinant by `unit` of its size. docs/exactness.md proves the bound. With both 0 every sign is the
computed one.

`simd.simd_float32_filter` is the same for 16 pairs at a time: what changes here changes there, and tests compare them.

The word of six signs, two bits each, + where the sign is positive and - where it is negative, or -1 for SEPARATED:

    11 10 9  8  7  6  5  4  3  2  1  0
    [+|-][+|-][+|-][+|-][+|-][+|-]
     a0   a1   a2   b0   b1   b2      a corner of A against B's plane, then of B against A's
"""

from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.boxes import fuse32
from warp_abtree.kernels.exact.predicates import UNCERTAIN, filtered_sign
from warp_abtree.kernels.triangle.intersect import rotate_first

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FLOAT32_UNIT = wp.constant(9.0 * 2.0**-24)
# For the rounding of `gap_signs`; sums of magnitudes over the least have squares.
WIDE, SQUARE_MIN = wp.constant(1.0 + 2.0**-18), wp.constant(2.0**-50)

SEPARATED = wp.constant(-1)
SIGNS_OF_A, SIGNS_OF_B, POSITIVE = wp.constant(0xFC0), wp.constant(0x3F), wp.constant(0xAAA)


@wp.func
def dot32(u: wp.vec3, v: wp.vec3):
    return fuse32(u[0], v[0], fuse32(u[1], v[1], u[2] * v[2]))


@wp.func
def cross32(u: wp.vec3, v: wp.vec3):
    return wp.vec3(
        fuse32(u[1], v[2], -(u[2] * v[1])), fuse32(u[2], v[0], -(u[0] * v[2])), fuse32(u[0], v[1], -(u[1] * v[0]))
    )


@wp.func
def sum_sizes(v: wp.vec3):
    return (wp.abs(v[0]) + wp.abs(v[1])) + wp.abs(v[2])


@native.func_native()
def largest(x: wp.float32, y: wp.float32, z: wp.float32) -> wp.float32:
    """Return the largest of three; on the CPU without the branches that `wp.max` has for NaN, which may pass by."""


@wp.func
def bound_error(error: wp.float32, unit: wp.float32, u: wp.float32, v: wp.float32, w: wp.float32):
    """Bound the error of a determinant whose rows have these sums of magnitudes."""
    p = u + 2.0 * error
    q = v + 2.0 * error
    r = w + 2.0 * error
    return error * (p * q + r * (p + q)) + unit * (p * q * r)


@wp.func
def heights_over_plane(
    error: wp.float32, unit: wp.float32, u: wp.vec3, v: wp.vec3, w0: wp.vec3, w1: wp.vec3, w2: wp.vec3
):
    """Return the determinants of `orient3d` for a plane and three points, and one bound on their errors.

    u, v: from a corner on the plane to the two others. w0, w1, w2: from the points to that corner.
    """
    normal = cross32(u, v)
    far = largest(sum_sizes(w0), sum_sizes(w1), sum_sizes(w2))
    bound = bound_error(error, unit, sum_sizes(u), sum_sizes(v), far)
    return wp.vec3(dot32(w0, normal), dot32(w1, normal), dot32(w2, normal)), bound


@native.func_native()
def one_sided(x: wp.vec3, bound: wp.float32) -> wp.int32:
    """Return a negative number where three numbers that err by at most a bound have the same sign, not 0."""


@native.func_native()
def add_signs(signs: wp.int32, x: wp.vec3, bound: wp.float32) -> wp.int32:
    """Return signs with those of three more numbers after them."""


@wp.func
def side_of_plane(error: wp.float32, unit: wp.float32, a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3):
    u = a - d
    v = b - d
    w = c - d
    return filtered_sign(dot32(u, cross32(v, w)), bound_error(error, unit, sum_sizes(u), sum_sizes(v), sum_sizes(w)))


@wp.func
def plane_signs(
    error: wp.float32,
    unit: wp.float32,
    a0: wp.vec3,
    a1: wp.vec3,
    a2: wp.vec3,
    b0: wp.vec3,
    b1: wp.vec3,
    b2: wp.vec3,
):
    """Return SEPARATED where one triangle lies on one side of the other's plane, else all signs. No branches."""
    w = b0 - a0
    of_a, bound_a = heights_over_plane(error, unit, b1 - b0, b2 - b0, w, b0 - a1, b0 - a2)
    of_b, bound_b = heights_over_plane(error, unit, a1 - a0, a2 - a0, -w, a0 - b1, a0 - b2)
    signs = add_signs(add_signs(0, of_a, bound_a), of_b, bound_b)
    return wp.where((one_sided(of_a, bound_a) | one_sided(of_b, bound_b)) < 0, SEPARATED, signs)


@wp.func
def length_bound(error: wp.float32, unit: wp.float32, u: wp.vec3, v: wp.vec3):
    """Bound the length of the cross product of two differences of corners; docs/exactness.md."""
    normal = cross32(u, v)
    p = sum_sizes(u) + 2.0 * error
    q = sum_sizes(v) + 2.0 * error
    # Squares may underflow.
    most = sum_sizes(normal)
    length = wp.where(most > SQUARE_MIN, wp.sqrt(dot32(normal, normal)), most)
    return length + 2.0 * (error * (p + q) + unit * (p * q))


@wp.func
def gap_signs(
    error: wp.float32,
    unit: wp.float32,
    gap: wp.float32,
    a0: wp.vec3,
    a1: wp.vec3,
    a2: wp.vec3,
    b0: wp.vec3,
    b1: wp.vec3,
    b2: wp.vec3,
):
    """Return what `plane_signs` does, SEPARATED only where more than a gap lies between a triangle and a plane."""
    w = b0 - a0
    of_a, bound_a = heights_over_plane(error, unit, b1 - b0, b2 - b0, w, b0 - a1, b0 - a2)
    of_b, bound_b = heights_over_plane(error, unit, a1 - a0, a2 - a0, -w, a0 - b1, a0 - b2)
    signs = add_signs(add_signs(0, of_a, bound_a), of_b, bound_b)
    wide_a = (bound_a + gap * length_bound(error, unit, b1 - b0, b2 - b0)) * WIDE
    wide_b = (bound_b + gap * length_bound(error, unit, a1 - a0, a2 - a0)) * WIDE
    return wp.where((one_sided(of_a, wide_a) | one_sided(of_b, wide_b)) < 0, SEPARATED, signs)


@wp.func
def have_one_side(signs: wp.int32):
    """Return whether the signs say that one triangle lies on one side of the other's plane."""
    over, under = signs & POSITIVE, (signs << 1) & POSITIVE
    one_of_a = (over & SIGNS_OF_A) == (POSITIVE & SIGNS_OF_A) or (under & SIGNS_OF_A) == (POSITIVE & SIGNS_OF_A)
    one_of_b = (over & SIGNS_OF_B) == (POSITIVE & SIGNS_OF_B) or (under & SIGNS_OF_B) == (POSITIVE & SIGNS_OF_B)
    return one_of_a or one_of_b


@wp.func
def are_uncertain(unit: wp.float32, signs: wp.int32):
    """Return whether signs of straddling triangles leave it to the next stage: a shared plane, or a sign unknown.

    A sign that is neither positive nor negative is unknown, or 0 where there are no errors.
    """
    known = ((signs >> 1) | signs) & (POSITIVE >> 1)
    coplanar = (known & SIGNS_OF_A) == 0 or (known & SIGNS_OF_B) == 0
    return coplanar or (known != (POSITIVE >> 1) and unit != 0.0)


@wp.func
def find_alone_in(signs: wp.int32):
    """Return which corner is alone on its side, as `find_alone` of three signs, and whether it is the negative one."""
    over = signs & 42
    under = (signs & 21) << 1
    one_over = wp.bit_count(over) == 1
    one_under = wp.bit_count(under) == 1
    alone = wp.where(one_over, over, wp.where(one_under, under, 42 ^ (over | under)))
    corner = wp.where(alone == 32, 0, wp.where(alone == 8, 1, 2))
    return corner, wp.where(one_over, False, wp.where(one_under, True, over != 0))


@wp.func
def rotate_corners(signs: wp.int32, a0: Any, a1: Any, a2: Any, b0: Any, b1: Any, b2: Any):
    """Return both triangles' corners, or their ids, as `rotate_triangles`; in any order where these are coplanar."""
    alone_a, back_a = find_alone_in(signs >> 6)
    alone_b, back_b = find_alone_in(signs)
    p1, q1, r1 = rotate_first(alone_a, a0, a1, a2)
    p2, q2, r2 = rotate_first(alone_b, b0, b1, b2)
    return (
        p1,
        wp.where(back_b, r1, q1),
        wp.where(back_b, q1, r1),
        p2,
        wp.where(back_a, r2, q2),
        wp.where(back_a, q2, r2),
    )


@wp.func
def intersect_straddling(
    error: wp.float32,
    unit: wp.float32,
    p1: wp.vec3,
    q1: wp.vec3,
    r1: wp.vec3,
    p2: wp.vec3,
    q2: wp.vec3,
    r2: wp.vec3,
):
    """Return 1 where two closed triangles meet whose planes tell all signs, 0 where not, UNCERTAIN where it is open.

    The corners come rotated.
    """
    first = side_of_plane(error, unit, p1, q1, p2, q2)
    second = side_of_plane(error, unit, p1, r1, r2, p2)
    meet = wp.where(first == UNCERTAIN or second == UNCERTAIN, UNCERTAIN, 1)
    return wp.where(first == 1 or second == 1, 0, meet)


@wp.func
def float32_filter_triangles(
    error: wp.float32,
    unit: wp.float32,
    a0: wp.vec3,
    a1: wp.vec3,
    a2: wp.vec3,
    b0: wp.vec3,
    b1: wp.vec3,
    b2: wp.vec3,
):
    """Return 1 where two closed triangles meet, 0 where not, UNCERTAIN where float32 cannot tell: both parts."""
    signs = plane_signs(error, unit, a0, a1, a2, b0, b1, b2)
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a0, a1, a2, b0, b1, b2)
    meet = wp.where(are_uncertain(unit, signs), UNCERTAIN, intersect_straddling(error, unit, p1, q1, r1, p2, q2, r2))
    return wp.where(signs == SEPARATED, 0, meet)
