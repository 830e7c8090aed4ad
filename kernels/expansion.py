"""Exact signs by floating-point expansions: sums of float64 components that do not overlap, smallest first.

Source: Shewchuk 1997, Adaptive precision floating-point arithmetic and fast robust geometric predicates.
Every product below is either exact by `fuse_multiply` or written with a separate sum, and modules that use it compile
without contraction (`fuse_fp` off on CUDA; Warp's CPU backend does not contract), so no compiler changes a rounding.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# 6 products of three differences, each difference two components, each product of three components four.
EXPANSION_LENGTH = 192


@wp.func_native("""return fma(a, b, c);""")
def fuse_multiply(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64: ...


@wp.func
def two_sum(a: Any, b: Any):
    """Return a + b as (rounded sum, rounding error), of numbers or of vectors. Source: Shewchuk, theorem 7 (Knuth)."""
    x = a + b
    virtual_b = x - a
    virtual_a = x - virtual_b
    return x, (a - virtual_a) + (b - virtual_b)


@wp.func
def two_product(a: wp.float64, b: wp.float64):
    """Return a b as (rounded product, rounding error)."""
    x = a * b
    return x, fuse_multiply(a, b, -x)


@wp.func
def grow_expansion(sum: wp.array(dtype=wp.float64), length: wp.int32, b: wp.float64):
    """Add b to an expansion in place, dropping zeros; return the new length. Source: Shewchuk, theorem 10."""
    carry = b
    kept = wp.int32(0)
    for i in range(length):
        carry, tail = two_sum(carry, sum[i])
        if tail != wp.float64(0.0):
            sum[kept] = tail
            kept += 1
    if carry != wp.float64(0.0):
        sum[kept] = carry
        kept += 1
    return kept


@wp.func
def add_product(sum: wp.array(dtype=wp.float64), length: wp.int32, a: wp.float64, b: wp.float64, c: wp.float64):
    """Add a b c to an expansion, exactly."""
    if a == wp.float64(0.0) or b == wp.float64(0.0) or c == wp.float64(0.0):
        return length
    high, low = two_product(a, b)
    for i in range(2):
        x, y = two_product(wp.where(i == 0, low, high), c)
        length = grow_expansion(sum, length, y)
        length = grow_expansion(sum, length, x)
    return length


@wp.func
def leading_sign(sum: wp.array(dtype=wp.float64), length: wp.int32):
    """Return the sign of an expansion: that of its largest component."""
    if length == 0:
        return 0
    return wp.where(sum[length - 1] > wp.float64(0.0), 1, -1)


@wp.func
def exact_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return the sign of det(a - d, b - d, c - d), exactly."""
    u, u_low = two_sum(a, -d)
    v, v_low = two_sum(b, -d)
    w, w_low = two_sum(c, -d)
    sum = wp.zeros(shape=(EXPANSION_LENGTH,), dtype=wp.float64)
    length = wp.int32(0)
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        for part in range(8):
            x = wp.where((part & 1) != 0, u_low, u)
            y = wp.where((part & 2) != 0, v_low, v)
            z = wp.where((part & 4) != 0, w_low, w)
            length = add_product(sum, length, x[i], y[j], z[k])
            length = add_product(sum, length, -x[i], y[k], z[j])
    return leading_sign(sum, length)


@wp.func
def exact_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return the sign of det(a - c, b - c), exactly."""
    one = wp.float64(1.0)
    u, u_low = two_sum(a, -c)
    v, v_low = two_sum(b, -c)
    sum = wp.zeros(shape=(EXPANSION_LENGTH,), dtype=wp.float64)
    length = wp.int32(0)
    for part in range(4):
        x = wp.where((part & 1) != 0, u_low, u)
        y = wp.where((part & 2) != 0, v_low, v)
        length = add_product(sum, length, x[0], y[1], one)
        length = add_product(sum, length, -x[1], y[0], one)
    return leading_sign(sum, length)
