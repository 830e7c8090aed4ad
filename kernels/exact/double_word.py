"""Signs in double-word arithmetic: twice the digits of float64 with a proven bound, for signs uncertain in float64.

With the bounds of `native/exact/double_word.cuh` a determinant in 3D, three products deep with a difference between and
two sums after, errs by less than 20 u^2 P, and in 2D by less than 9 u^2 P, P as in `predicates`; 64 u^2 P is taken
(docs/exactness.md, bound 5), which has room for the rounding of P and the low word. Underflow changes nothing, for the
reason given there.
"""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BOUND_DOUBLE = wp.constant(wp.float64(2.0**-100))


@native.func_native()
def add_double(a: wp.vec2d, b: wp.vec2d) -> wp.vec2d: ...


@native.func_native()
def double_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.vec2d:
    """Return det(a - d, b - d, c - d) to about 2^-104 of its sum of magnitudes."""


@native.func_native()
def double_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d) -> wp.vec2d:
    """Return det(a - c, b - c) to about 2^-104 of its sum of magnitudes."""
