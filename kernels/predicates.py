"""Orientation signs: a float64 determinant with a proven error bound; where it leaves the sign open, the same in double
words, and at last expansions.

Bounds. With e = 2^-53 and no overflow, the determinants below err by at most (7 + 56 e) e P in 3D and (3 + 16 e) e P in
2D, P the same sum with every product and difference of products replaced by the sum of magnitudes, computed in the same
arithmetic (Shewchuk 1997, sections 4.3 and 4.4, bounds A). Underflow: coordinates are 0 or at least 2^-290, hence
differences are multiples of 2^-342 and products of three of 2^-1026: what falls below float64's normal range lies on
its grid of 2^-1074 and is not rounded at all. So P is 0 only where every product has a factor 0, and the sign is 0.
"""

from typing import Any

import warp as wp

from warp_abtree.kernels.double_word import BOUND_DOUBLE, double_orient2d, double_orient3d
from warp_abtree.kernels.expansion import exact_orient2d, exact_orient3d

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# How signs are made. FILTER answers UNSURE where the bound leaves the sign open; EXACT goes on.
FILTER = wp.constant(0)
FLOAT64 = wp.constant(1)
FLOAT32 = wp.constant(2)
EXACT = wp.constant(3)
# So large that no sum of three signs with one of these among them is 3 or -3.
UNSURE = wp.constant(8)

BOUND_3D = wp.constant(wp.float64((7.0 + 56.0 * 2.0**-53) * 2.0**-53))
BOUND_2D = wp.constant(wp.float64((3.0 + 16.0 * 2.0**-53) * 2.0**-53))


@wp.func
def plain_sign(x: wp.float64):
    zero = wp.float64(0.0)
    return wp.where(x > zero, 1, wp.where(x < zero, -1, 0))


@wp.func
def filtered_sign(x: Any, bound: Any):
    """Return the sign of a value that errs by at most a bound, or UNSURE; a bound of 0 makes 0 a sure sign."""
    # Without branches: which sign it is cannot be predicted.
    open = wp.where(bound == type(bound)(0.0), 0, UNSURE)
    return wp.where(x > bound, 1, wp.where(x < -bound, -1, open))


@wp.func
def orient3d_float32(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Return the sign of a float32 determinant, unguarded."""
    return plain_sign(wp.float64(wp.dot(a, wp.cross(b, c))))


@wp.func(inline=False)
def resolve_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, size: wp.float64):
    """Return a sign that float64 leaves open, `size` the sum of magnitudes. Not inlined: long, and rarely called."""
    sign = filtered_sign(double_orient3d(a, b, c, d), BOUND_DOUBLE * size)
    if sign == UNSURE:
        sign = exact_orient3d(a, b, c, d)
    return sign


@wp.func(inline=False)
def resolve_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, size: wp.float64):
    """Return a sign that float64 leaves open, as `resolve_orient3d`."""
    sign = filtered_sign(double_orient2d(a, b, c), BOUND_DOUBLE * size)
    if sign == UNSURE:
        sign = exact_orient2d(a, b, c)
    return sign


@wp.func
def orient3d(mode: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return on which side of plane (a, b, c) point d lies: 1 below, -1 above, 0 on it, or UNSURE.

    Seen from above, a, b and c turn counterclockwise.
    """
    u = a - d
    v = b - d
    w = c - d
    if mode == FLOAT32:
        return orient3d_float32(wp.vec3(u), wp.vec3(v), wp.vec3(w))
    v1w2 = v[1] * w[2]
    v2w1 = v[2] * w[1]
    w1u2 = w[1] * u[2]
    w2u1 = w[2] * u[1]
    u1v2 = u[1] * v[2]
    u2v1 = u[2] * v[1]
    value = (u[0] * (v1w2 - v2w1) + v[0] * (w1u2 - w2u1)) + w[0] * (u1v2 - u2v1)
    if mode == FLOAT64:
        return plain_sign(value)
    size = wp.abs(u[0]) * (wp.abs(v1w2) + wp.abs(v2w1)) + wp.abs(v[0]) * (wp.abs(w1u2) + wp.abs(w2u1))
    size = size + wp.abs(w[0]) * (wp.abs(u1v2) + wp.abs(u2v1))
    sign = filtered_sign(value, BOUND_3D * size)
    if sign == UNSURE:
        # Meshes laid on one another share points: a determinant of 0, which no bound above 0 tells.
        if a == b or a == c or a == d or b == c or b == d or c == d:
            sign = 0
        elif mode == EXACT:
            sign = resolve_orient3d(a, b, c, d, size)
    return sign


@wp.func
def orient2d(mode: wp.int32, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return 1 where a, b, c turn counterclockwise, -1 clockwise, 0 where they are collinear, or UNSURE."""
    left = (a[0] - c[0]) * (b[1] - c[1])
    right = (a[1] - c[1]) * (b[0] - c[0])
    if mode == FLOAT64 or mode == FLOAT32:
        return plain_sign(left - right)
    size = wp.abs(left) + wp.abs(right)
    sign = filtered_sign(left - right, BOUND_2D * size)
    if sign == UNSURE:
        if a == b or a == c or b == c:
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
