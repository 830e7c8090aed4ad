"""Turns about an axis, with sines of our own: the same bits on every device, where libraries differ.

u = 2^-53. Sine and cosine are Taylor sums on [0, pi/4], which end below 2^-56, and doubled angles: within 8 u.
"""

import math

import warp as wp

from warp_abtree.kernels.base.poses import unit_quaternion_matrix

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Turns by more than half a revolution less about 1e-6 rad have no shortest way: a quaternion's least real part.
REAL_LEAST = wp.constant(wp.float64(2.0**-21))
NEWTON_STEPS = wp.constant(2)


# Factors of the sums, the last first. A literal inside a kernel would be a float32.
SINES = wp.constant(wp.types.vector(8, wp.float64)(*[(-1) ** k / math.factorial(2 * k + 1) for k in range(8, 0, -1)]))
COSINES = wp.constant(wp.types.vector(8, wp.float64)(*[(-1) ** k / math.factorial(2 * k) for k in range(8, 0, -1)]))
QUARTER_TURN = wp.constant(wp.float64(math.pi / 2))


@wp.func
def sin_cos_quarter(x: wp.float64):
    """Return sine and cosine of an angle in [0, pi/4]."""
    z = x * x
    s, c = SINES[0], COSINES[0]
    for k in range(1, 8):
        s = SINES[k] + z * s
        c = COSINES[k] + z * c
    return x + x * (z * s), wp.float64(1.0) + z * c


@wp.func
def sin_cos_half(angle: wp.float64):
    """Return sine and cosine of half an angle in [0, pi]."""
    s, c = sin_cos_quarter(wp.float64(0.25) * angle)
    return wp.float64(2.0) * (s * c), wp.float64(1.0) - wp.float64(2.0) * (s * s)


@wp.func
def turn_matrix(axis: wp.vec3d, angle: wp.float64):
    """Return the rotation by an angle in [0, pi] about a unit axis."""
    s, w = sin_cos_half(angle)
    return unit_quaternion_matrix(axis[0] * s, axis[1] * s, axis[2] * s, w)


@wp.func
def angle_of(s: wp.float64, c: wp.float64):
    """Return twice the angle whose sine and cosine these are, both from 0 to 1.

    r / (1 + 0.28 r^2) is within 0.005 of it, and a step leaves e - sin e < e^3 / 6 of an error e: 2^-25, then 2^-79
    (docs/exactness.md, bound 20).
    """
    least, most = wp.min(s, c), wp.max(s, c)
    r = least / most
    x = r / (wp.float64(1.0) + wp.float64(0.28) * r * r)
    if s > c:
        x = QUARTER_TURN - x
    i = wp.int32(0)
    while i < NEWTON_STEPS:
        sx, cx = sin_cos_half(wp.float64(2.0) * x)
        x = wp.max(x + (s * cx - c * sx), wp.float64(0.0))
        i += 1
    return wp.float64(2.0) * x


@wp.func
def quaternion_of(m: wp.mat33d):
    """Return the unit quaternion x y z w, w not negative, of a rotation matrix."""
    one = wp.float64(1.0)
    trace = (m[0, 0] + m[1, 1]) + m[2, 2]
    q = wp.vec4d(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], one + trace)
    if trace < wp.float64(0.0):
        if m[0, 0] >= m[1, 1] and m[0, 0] >= m[2, 2]:
            q = wp.vec4d(((one + m[0, 0]) - m[1, 1]) - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2])
        elif m[1, 1] >= m[2, 2]:
            q = wp.vec4d(m[0, 1] + m[1, 0], ((one - m[0, 0]) + m[1, 1]) - m[2, 2], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0])
        else:
            q = wp.vec4d(m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], ((one - m[0, 0]) - m[1, 1]) + m[2, 2], m[1, 0] - m[0, 1])
    norm = wp.sqrt(((q[0] * q[0] + q[1] * q[1]) + q[2] * q[2]) + q[3] * q[3])
    return q / wp.where(q[3] < wp.float64(0.0), -norm, norm)


@wp.func
def shortest_turn(m: wp.mat33d):
    """Return the axis of a rotation matrix, its angle in [0, pi], and sine and cosine of half of that.

    The angle is -1 where half a revolution has no shortest way.
    """
    q = quaternion_of(m)
    v = wp.vec3d(q[0], q[1], q[2])
    s = wp.sqrt((v[0] * v[0] + v[1] * v[1]) + v[2] * v[2])
    zero = wp.float64(0.0)
    if s == zero:
        return wp.vec3d(zero, zero, wp.float64(1.0)), zero, wp.vec2d(zero, wp.float64(1.0))
    angle = wp.float64(-1.0)
    if q[3] >= REAL_LEAST:
        angle = angle_of(s, q[3])
    return v / s, angle, wp.vec2d(s, q[3])


@wp.func
def cross_matrix(w: wp.vec3d):
    """Return the matrix of w x."""
    o = wp.float64(0.0)
    return wp.mat33d(o, -w[2], w[1], w[2], o, -w[0], -w[1], w[0], o)
