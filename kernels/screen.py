"""The first of three stages: triangle against triangle in float32, with a proven bound on the error of each sign.

Coordinates are about A's centre, scaled to about unit size, each off the exact one by less than half of `error`, so
that differences of corners are off by less than `error`. With |x| the sum of a vector's magnitudes, that moves a
determinant of rows u, v, w by at most error (|u||v| + |v||w| + |w||u|), where rows are taken 2 error longer for the
terms of higher order. Its own arithmetic, u . (v x w), adds eight roundings: 8 2^-24 |u||v||w| to first order, for
which `unit` is 9 2^-24. docs/exactness.md has the terms. With error and unit 0 every sign is the computed one.

`vector.screen_waiting` is the same for 16 pairs at a time: what changes here changes there, and tests compare them.
"""

import warp as wp

from warp_abtree.kernels.boxes import fuse32
from warp_abtree.kernels.predicates import UNSURE, filtered_sign
from warp_abtree.kernels.triangle import is_one_sided, turn_triangles

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SCREEN_UNIT = wp.constant(9.0 * 2.0**-24)


@wp.func
def dot32(u: wp.vec3, v: wp.vec3):
    return fuse32(u[0], v[0], fuse32(u[1], v[1], u[2] * v[2]))


@wp.func
def cross32(u: wp.vec3, v: wp.vec3):
    return wp.vec3(
        fuse32(u[1], v[2], -(u[2] * v[1])), fuse32(u[2], v[0], -(u[0] * v[2])), fuse32(u[0], v[1], -(u[1] * v[0]))
    )


@wp.func
def sum_sizes(v: wp.vec3):
    return (wp.abs(v[0]) + wp.abs(v[1])) + wp.abs(v[2])


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return wp::max(x, wp::max(y, z));
#else
    const wp::float32 m = y > z ? y : z;
    return x > m ? x : m;
#endif
""")
def largest(x: wp.float32, y: wp.float32, z: wp.float32) -> wp.float32:
    """Return the largest of three; on the CPU without the branches that `wp.max` has for NaN, which may pass by."""
    ...


@wp.func
def bound_error(error: wp.float32, unit: wp.float32, u: wp.float32, v: wp.float32, w: wp.float32):
    """Return how far a determinant can err whose rows have these sums of magnitudes."""
    p = u + 2.0 * error
    q = v + 2.0 * error
    r = w + 2.0 * error
    return error * (p * q + r * (p + q)) + unit * (p * q * r)


@wp.func
def sides_of_plane(
    error: wp.float32,
    unit: wp.float32,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    d0: wp.vec3,
    d1: wp.vec3,
    d2: wp.vec3,
):
    """Return on which side of plane (a, b, c) three points lie, as `orient3d`; one normal and one bound for all."""
    u = b - a
    v = c - a
    w0 = a - d0
    w1 = a - d1
    w2 = a - d2
    normal = cross32(u, v)
    far = largest(sum_sizes(w0), sum_sizes(w1), sum_sizes(w2))
    bound = bound_error(error, unit, sum_sizes(u), sum_sizes(v), far)
    s0 = filtered_sign(dot32(w0, normal), bound)
    s1 = filtered_sign(dot32(w1, normal), bound)
    s2 = filtered_sign(dot32(w2, normal), bound)
    return s0, s1, s2


@wp.func
def side_of_plane(error: wp.float32, unit: wp.float32, a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3):
    u = a - d
    v = b - d
    w = c - d
    return filtered_sign(dot32(u, cross32(v, w)), bound_error(error, unit, sum_sizes(u), sum_sizes(v), sum_sizes(w)))


@wp.func
def screen_triangles(
    error: wp.float32,
    unit: wp.float32,
    a0: wp.vec3,
    a1: wp.vec3,
    a2: wp.vec3,
    b0: wp.vec3,
    b1: wp.vec3,
    b2: wp.vec3,
):
    """Return 1 where two closed triangles meet, 0 where they do not, UNSURE where float32 cannot tell.

    A shared plane and faces without one are left to the next stage. Source: as `intersect_triangles`.
    """
    sa0, sa1, sa2 = sides_of_plane(error, unit, b0, b1, b2, a0, a1, a2)
    if is_one_sided(sa0, sa1, sa2):
        return 0
    sb0, sb1, sb2 = sides_of_plane(error, unit, a0, a1, a2, b0, b1, b2)
    if is_one_sided(sb0, sb1, sb2):
        return 0
    if (sa0 == 0 and sa1 == 0 and sa2 == 0) or (sb0 == 0 and sb1 == 0 and sb2 == 0):
        return UNSURE
    if wp.max(wp.max(sa0, wp.max(sa1, sa2)), wp.max(sb0, wp.max(sb1, sb2))) == UNSURE:
        return UNSURE
    p1, q1, r1, p2, q2, r2 = turn_triangles(sa0, sa1, sa2, sb0, sb1, sb2, a0, a1, a2, b0, b1, b2)
    first = side_of_plane(error, unit, p1, q1, p2, q2)
    second = side_of_plane(error, unit, p1, r1, r2, p2)
    if first == 1 or second == 1:
        return 0
    return wp.where(first == UNSURE or second == UNSURE, UNSURE, 1)
