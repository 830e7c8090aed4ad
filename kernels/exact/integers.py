"""Exact signs of determinants in integers, made word by word or in 128 bits that wrap: no arrays.

A difference of float64 numbers is two of them exactly, so a determinant in 3D is a sum of 48 products of three:
integers of 159 bits at as many places, of each of which a word is taken at a time.

Most often those that are left are 0, or small: a determinant is a whole multiple of G, the product over its rows of the
lowest bit set in any number of a row. Computed modulo 2^128 it is right to the bit once it is known to lie within
2^126 G: docs/exactness.md, bound 6.
"""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@native.func_native()
def integer_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, bound: wp.float64) -> wp.int32:
    """Return the sign of det(a - d, b - d, c - d), within 4 times a bound, or UNCERTAIN where 128 bits are too few."""


@native.func_native()
def integer_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, bound: wp.float64) -> wp.int32:
    """Return the sign of det(a - c, b - c), within 4 times a bound, or UNCERTAIN where 128 bits are too few."""


@native.func_native()
def exact_volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Return det(a - d, b - d, c - d), rounded once."""


@wp.func(inline=False)
def exact_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return the sign of det(a - d, b - d, c - d), exactly."""
    zero = wp.float64(0.0)
    value = exact_volume(a, b, c, d)
    return wp.where(value > zero, 1, wp.where(value < zero, -1, 0))


@wp.func
def exact_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return the sign of det(a - c, b - c), exactly: that of a determinant in 3D whose last row is (0, 0, 1)."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    last = wp.vec3d(c[0], c[1], zero)
    return exact_orient3d(wp.vec3d(a[0], a[1], zero), wp.vec3d(b[0], b[1], zero), wp.vec3d(c[0], c[1], one), last)
