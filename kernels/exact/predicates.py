"""Orientation signs: a float64 determinant with a proven error bound; where it leaves the sign open, the same in double
words, then in wrapping integers, and at last in integers as long as it takes.

With e = 2^-53 the determinants below err by at most (8 + 128 e) e P in 3D and (3 + 16 e) e P in 2D, P the same sum with
every product and difference of products replaced by the sum of magnitudes, computed in the same arithmetic. Coordinates
are 0 or at least 2^-290, so underflow rounds nothing, and where P is 0 the sign is 0. Proofs:
docs/exactness.md, bounds 3 and 4.
"""

from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.exact.double_word import BOUND_DOUBLE, double_orient2d, double_orient3d
from warp_abtree.kernels.exact.integers import (
    exact_orient2d,
    exact_orient3d,
    integer_orient2d,
    integer_orient3d,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# How signs are made. FILTER answers UNCERTAIN where the bound leaves the sign open; EXACT goes on.
FILTER = wp.constant(0)
FLOAT32 = wp.constant(1)
EXACT = wp.constant(2)
# So large that no sum of three signs with one of these among them is 3 or -3.
UNCERTAIN = wp.constant(8)

BOUND_3D = wp.constant(wp.float64((8.0 + 128.0 * 2.0**-53) * 2.0**-53))
BOUND_2D = wp.constant(wp.float64((3.0 + 16.0 * 2.0**-53) * 2.0**-53))


@wp.func
def plain_sign(x: wp.float64):
    zero = wp.float64(0.0)
    return wp.where(x > zero, 1, wp.where(x < zero, -1, 0))


@wp.func
def filtered_sign(x: Any, bound: Any):
    """Return the sign of a value that errs by at most a bound, or UNCERTAIN; a bound of 0 makes 0 a sure sign."""
    # Without branches: which sign it is cannot be predicted.
    open = wp.where(bound == type(bound)(0.0), 0, UNCERTAIN)
    return wp.where(x > bound, 1, wp.where(x < -bound, -1, open))


@wp.func(inline=False)
def resolve_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, size: wp.float64):
    """Return a sign uncertain in float64, `size` the sum of magnitudes. Not inlined: long, and rarely called."""
    bound = BOUND_DOUBLE * size
    sign = filtered_sign(double_orient3d(a, b, c, d)[0], bound)
    if sign == UNCERTAIN:
        sign = integer_orient3d(a, b, c, d, bound)
    if sign == UNCERTAIN:
        sign = exact_orient3d(a, b, c, d)
    return sign


@wp.func(inline=False)
def resolve_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, size: wp.float64):
    """Return a sign that is uncertain in float64, as `resolve_orient3d`."""
    bound = BOUND_DOUBLE * size
    sign = filtered_sign(double_orient2d(a, b, c)[0], bound)
    if sign == UNCERTAIN:
        sign = integer_orient2d(a, b, c, bound)
    if sign == UNCERTAIN:
        sign = exact_orient2d(a, b, c)
    return sign


@native.func_native()
def rows_determinant(u: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.vec2d:
    """Return det(u, v, w) of three differences, and the sum of magnitudes."""


@native.func_native()
def edges_determinant(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec2d:
    """Return `rows_determinant` of the ends of two edges, a b and c d, of the rows that err less."""


@wp.func
def filter_rows(u: wp.vec3d, v: wp.vec3d, w: wp.vec3d):
    """Return the sign of det(u, v, w) of three differences or UNCERTAIN, and the sum of magnitudes."""
    value = rows_determinant(u, v, w)
    return filtered_sign(value[0], BOUND_3D * value[1]), value[1]


@wp.func
def plain_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return the sign of `orient3d` of a determinant rounded to float32, unguarded."""
    u = a - d
    v = b - d
    w = c - d
    return plain_sign(wp.float64(wp.dot(wp.vec3(u), wp.cross(wp.vec3(v), wp.vec3(w)))))


@wp.func
def orient3d(mode: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return on which side of plane (a, b, c) point d lies: 1 below, -1 above, 0 on it, or UNCERTAIN.

    Seen from above, a, b and c turn counterclockwise.
    """
    if mode == FLOAT32:
        return plain_orient3d(a, b, c, d)
    sign, size = filter_rows(a - d, b - d, c - d)
    if mode == EXACT and sign == UNCERTAIN:
        sign = resolve_orient3d(a, b, c, d, size)
    return sign


@wp.func
def orient_edges(mode: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return `orient3d` of the ends of two edges, a b and c d."""
    if mode == FLOAT32:
        return plain_orient3d(a, b, c, d)
    value = edges_determinant(a, b, c, d)
    sign = filtered_sign(value[0], BOUND_3D * value[1])
    if mode == EXACT and sign == UNCERTAIN:
        sign = orient3d(EXACT, a, b, c, d)
    return sign


@wp.func
def orient2d(mode: wp.int32, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return 1 where a, b, c turn counterclockwise, -1 clockwise, 0 where they are collinear, or UNCERTAIN."""
    left = (a[0] - c[0]) * (b[1] - c[1])
    right = (a[1] - c[1]) * (b[0] - c[0])
    if mode == FLOAT32:
        return plain_sign(left - right)
    size = wp.abs(left) + wp.abs(right)
    sign = filtered_sign(left - right, BOUND_2D * size)
    if sign == UNCERTAIN:
        if a == b:  # of others that coincide both products are 0
            sign = 0
        elif mode == EXACT:
            sign = resolve_orient2d(a, b, c, size)
    return sign


@wp.func
def drop_axis(p: wp.vec3d, axis: wp.int32):
    """Project along an axis; the others keep their cyclic order."""
    if axis == 0:
        return wp.vec2d(p[1], p[2])
    if axis == 1:
        return wp.vec2d(p[2], p[0])
    return wp.vec2d(p[0], p[1])
