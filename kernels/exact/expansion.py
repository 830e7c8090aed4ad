"""Determinants by floating-point expansions: sums of float64 components that do not overlap, smallest first.

Source: Shewchuk 1997, Adaptive precision floating-point arithmetic and fast robust geometric predicates.
Every product is either exact by `fuse_multiply` or written with a separate sum, and modules that use it compile without
contraction (`fuse_fp` off on CUDA; Warp's CPU backend does not contract), so no compiler changes a rounding.
"""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Threads of a block that have room for an expansion of their own in 3D, one another's in the order of their lanes.
EXPANSION_LANES = wp.constant(native.constant("EXPANSION_LANES"))


@wp.func_native("""return fma(a, b, c);""")
def fuse_multiply(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64: ...


@wp.func
def two_product(a: wp.float64, b: wp.float64):
    """Return a b as (rounded product, rounding error)."""
    x = a * b
    return x, fuse_multiply(a, b, -x)


@native.func_native()
def expand_volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d) -> wp.float64:
    """Return det(a - d, b - d, c - d) to a few roundings; on CUDA for the first EXPANSION_LANES lanes of a warp."""


@native.func_native()
def expand_area(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d) -> wp.float64:
    """Return det(a - c, b - c) to a few roundings."""
