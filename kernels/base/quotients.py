"""Quotients, roots and unit vectors in float32 without branches, the same bits on every device.

IEEE's have a branch each for numbers that are not normal, which keep a GPU's compiler from moving what is around them.
"""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options(native.options("base/quotients.cuh"))


@native.func_native()
def divide32(a: wp.float32, b: wp.float32) -> wp.float32:
    """Return a / b, 0 where b is not between 2^-126 and 2^125."""


@native.func_native()
def root32(x: wp.float32) -> wp.float32: ...


@native.func_native()
def normalize32(v: wp.vec3) -> wp.vec3:
    """Return the unit vector, within 3 units in the last place; 0 of what is shorter than 2^-63."""
