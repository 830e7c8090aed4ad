"""Signs in double-word arithmetic: twice the digits of float64 with a proven bound, for signs uncertain in float64.

A double word is the sum of two float64 numbers, the second at most half a unit in the last place of the first. With
u = 2^-53 a product below errs by at most 5 u^2 of itself and a sum by 3 u^2 + 13 u^3 (Joldes, Muller and Popescu 2017,
Tight and rigorous error bounds for basic building blocks of double-word arithmetic, algorithms 11 and 6). Differences
of float64 numbers are double words exactly. So a determinant in 3D, three products deep with a difference between and
two sums after, errs by less than 20 u^2 P, and in 2D by less than 9 u^2 P, P as in `predicates`; 64 u^2 P is taken,
which has room for the rounding of P and the low word. Underflow changes nothing, for the reason given there.
"""

import warp as wp

from warp_abtree.kernels.exact.expansion import fuse_multiply, two_product, two_sum

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BOUND_DOUBLE = wp.constant(wp.float64(2.0**-100))


@wp.func
def add_fast(a: wp.float64, b: wp.float64):
    """Return a + b as a double word, |a| >= |b|."""
    x = a + b
    return wp.vec2d(x, b - (x - a))


@wp.func
def subtract_exactly(a: wp.float64, b: wp.float64):
    high, low = two_sum(a, -b)
    return wp.vec2d(high, low)


@wp.func
def multiply_double(a: wp.vec2d, b: wp.vec2d):
    high, low = two_product(a[0], b[0])
    return add_fast(high, low + fuse_multiply(a[1], b[0], a[0] * b[1]))


@wp.func
def add_double(a: wp.vec2d, b: wp.vec2d):
    high, low = two_sum(a[0], b[0])
    high_low, low_low = two_sum(a[1], b[1])
    part = add_fast(high, low + high_low)
    return add_fast(part[0], low_low + part[1])


@wp.func
def minor_double(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, d: wp.vec2d):
    """Return a b - c d."""
    return add_double(multiply_double(a, b), multiply_double(-c, d))


@wp.func
def double_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return det(a - d, b - d, c - d) to about 2^-104 of its sum of magnitudes."""
    u0, u1, u2 = subtract_exactly(a[0], d[0]), subtract_exactly(a[1], d[1]), subtract_exactly(a[2], d[2])
    v0, v1, v2 = subtract_exactly(b[0], d[0]), subtract_exactly(b[1], d[1]), subtract_exactly(b[2], d[2])
    w0, w1, w2 = subtract_exactly(c[0], d[0]), subtract_exactly(c[1], d[1]), subtract_exactly(c[2], d[2])
    x = multiply_double(u0, minor_double(v1, w2, v2, w1))
    y = multiply_double(v0, minor_double(w1, u2, w2, u1))
    z = multiply_double(w0, minor_double(u1, v2, u2, v1))
    return add_double(add_double(x, y), z)


@wp.func
def double_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return det(a - c, b - c) to about 2^-104 of its sum of magnitudes."""
    u0, u1 = subtract_exactly(a[0], c[0]), subtract_exactly(a[1], c[1])
    v0, v1 = subtract_exactly(b[0], c[0]), subtract_exactly(b[1], c[1])
    return minor_double(u0, v1, u1, v0)


@wp.func
def round_double(value: wp.vec2d, bound: wp.float64):
    """Round a double word within a bound of its value to float64; NaN where the bound leaves two numbers."""
    # Twice the bound, for the rounding of these sums.
    above = value[0] + (value[1] + wp.float64(2.0) * bound)
    below = value[0] + (value[1] - wp.float64(2.0) * bound)
    return wp.where(above == value[0] and below == value[0], value[0], wp.float64(wp.nan))
