"""Exact signs by floating-point expansions: sums of float64 components that do not overlap, smallest first.

Source: Shewchuk 1997, Adaptive precision floating-point arithmetic and fast robust geometric predicates.
Loops count by hand, since Warp unrolls those over a constant range. Signs are not inlined: one array serves them all.
Every product below is either exact by `fuse_multiply` or written with a separate sum, and modules that use it compile
without contraction (`fuse_fp` off on CUDA; Warp's CPU backend does not contract), so no compiler changes a rounding.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# In 3D 6 products of three differences, each difference two components, each product of three components four; in 2D
# 2 products of two differences, each product of two components two.
LENGTH_3D = 192
LENGTH_2D = 16


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
    low_high, low_low = two_product(low, c)
    high_high, high_low = two_product(high, c)
    part = wp.int32(0)
    while part < 4:
        x = wp.where(part < 2, wp.where(part == 0, low_low, low_high), wp.where(part == 2, high_low, high_high))
        length = grow_expansion(sum, length, x)
        part += 1
    return length


@wp.func
def leading_sign(sum: wp.array(dtype=wp.float64), length: wp.int32):
    """Return the sign of an expansion: that of its largest component."""
    if length == 0:
        return 0
    return wp.where(sum[length - 1] > wp.float64(0.0), 1, -1)


@wp.func
def sum_expansion(sum: wp.array(dtype=wp.float64), length: wp.int32):
    """Return the value of an expansion, smallest components first: a few roundings of relative size 2^-53."""
    value = wp.float64(0.0)
    for i in range(length):
        value += sum[i]
    return value


@wp.func
def expand_orient3d(sum: wp.array(dtype=wp.float64), a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Fill an expansion with det(a - d, b - d, c - d), exactly; return its length."""
    u, u_low = two_sum(a, -d)
    v, v_low = two_sum(b, -d)
    w, w_low = two_sum(c, -d)
    length = wp.int32(0)
    term = wp.int32(0)
    # Bits of a term: the components, then whether the permutation is odd, then the axis of u.
    while term < 48:
        i = term >> 4
        odd = (term >> 3) & 1
        j = (i + 1 + odd) % 3
        k = (i + 2 - odd) % 3
        x = wp.where((term & 1) != 0, u_low[i], u[i])
        y = wp.where((term & 2) != 0, v_low[j], v[j])
        z = wp.where((term & 4) != 0, w_low[k], w[k])
        length = add_product(sum, length, wp.where(odd != 0, -x, x), y, z)
        term += 1
    return length


@wp.func
def expand_orient2d(sum: wp.array(dtype=wp.float64), a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Fill an expansion with det(a - c, b - c), exactly; return its length."""
    one = wp.float64(1.0)
    u, u_low = two_sum(a, -c)
    v, v_low = two_sum(b, -c)
    length = wp.int32(0)
    term = wp.int32(0)
    while term < 8:
        i = term >> 2
        x = wp.where((term & 1) != 0, u_low[i], u[i])
        y = wp.where((term & 2) != 0, v_low[1 - i], v[1 - i])
        length = add_product(sum, length, wp.where(i != 0, -x, x), y, one)
        term += 1
    return length


@wp.func(inline=False)
def exact_orient3d(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return the sign of det(a - d, b - d, c - d), exactly."""
    sum = wp.zeros(shape=(LENGTH_3D,), dtype=wp.float64)
    length = expand_orient3d(sum, a, b, c, d)
    return leading_sign(sum, length)


@wp.func(inline=False)
def exact_orient2d(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return the sign of det(a - c, b - c), exactly."""
    sum = wp.zeros(shape=(LENGTH_2D,), dtype=wp.float64)
    length = expand_orient2d(sum, a, b, c)
    return leading_sign(sum, length)
