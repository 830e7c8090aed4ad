"""First of three stages: triangle against triangle in float32, with a proven bound on the error of each sign.

It comes in two parts: planes separate most face pairs; only of those that straddle both planes, edges are compared.
Source: as `intersect_triangles`.

Coordinates are about A's centre, scaled to about unit size; differences of corners are off by less than `error`, and
the arithmetic of a determinant by `unit` of its size. docs/exactness.md proves the bound. With both 0 every sign is the
computed one.

`native/triangle/float32_filter.cuh` has the determinants, of one pair or, for `simd.simd_float32_filter`, of 16.

The word of six signs, two bits each, + where the sign is positive and - where it is negative, or -1 for SEPARATED:

    11 10 9  8  7  6  5  4  3  2  1  0
    [+|-][+|-][+|-][+|-][+|-][+|-]
     a0   a1   a2   b0   b1   b2      a corner of A against B's plane, then of B against A's
"""

from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.exact.predicates import UNCERTAIN
from warp_abtree.kernels.triangle.intersect import rotate_first

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FLOAT32_UNIT = wp.constant(9.0 * 2.0**-24)
SEPARATED = wp.constant(-1)
SIGNS_OF_A, SIGNS_OF_B, POSITIVE = wp.constant(0xFC0), wp.constant(0x3F), wp.constant(0xAAA)


@native.func_native()
def plane_signs(error: wp.float32, unit: wp.float32, a: wp.mat33, b: wp.mat33) -> wp.int32:
    """Return SEPARATED where one triangle lies on one side of the other's plane, else all signs. No branches.

    Args:
        a, b: Corners, a row each.
    """


@native.func_native()
def gap_signs(error: wp.float32, unit: wp.float32, gap: wp.float32, a: wp.mat33, b: wp.mat33) -> wp.int32:
    """Return what `plane_signs` does, SEPARATED only where more than a gap lies between a triangle and a plane."""


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
def rotate_corners(signs: wp.int32, a: Any, b: Any):
    """Return both triangles' corners, or their ids, as `rotate_triangles`; in any order where these are coplanar."""
    alone_a, back_a = find_alone_in(signs >> 6)
    alone_b, back_b = find_alone_in(signs)
    p1, q1, r1 = rotate_first(alone_a, a[0], a[1], a[2])
    p2, q2, r2 = rotate_first(alone_b, b[0], b[1], b[2])
    return (
        p1,
        wp.where(back_b, r1, q1),
        wp.where(back_b, q1, r1),
        p2,
        wp.where(back_a, r2, q2),
        wp.where(back_a, q2, r2),
    )


@native.func_native()
def side_of_plane(error: wp.float32, unit: wp.float32, plane: wp.mat33, d: wp.vec3) -> wp.int32:
    """Return on which side of a plane a point lies, as `orient3d`, or UNCERTAIN; as `intersect_straddling` finds it."""


@native.func_native()
def intersect_straddling(error: wp.float32, unit: wp.float32, a: wp.mat33, b: wp.mat33) -> wp.int32:
    """Return 1 where two closed triangles meet whose planes tell all signs, 0 where not, UNCERTAIN where it is open.

    The corners come rotated.
    """


@wp.func
def float32_filter_triangles(error: wp.float32, unit: wp.float32, a: wp.mat33, b: wp.mat33):
    """Return 1 where two closed triangles meet, 0 where not, UNCERTAIN where float32 cannot tell: both parts."""
    signs = plane_signs(error, unit, a, b)
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a, b)
    meet = intersect_straddling(error, unit, wp.matrix_from_rows(p1, q1, r1), wp.matrix_from_rows(p2, q2, r2))
    return wp.where(signs == SEPARATED, 0, wp.where(are_uncertain(unit, signs), UNCERTAIN, meet))
