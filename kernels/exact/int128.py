"""Exact signs of determinants known to be small, in 128-bit integers that wrap: most often those that are 0.

A determinant is a whole multiple of G, the product over its rows of the lowest bit set in any number of a row. Computed
modulo 2^128 it is right to the bit once it is known to lie within 2^126 G: docs/exactness.md, bound 6.
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
