"""Quadric error metric: the sum of squared distances to weighted planes, as a function of position.

A quadric is (A, b, c) with Q(y) = y.A y + 2 b.y + c, y relative to the position of its own node: planes through the
node then need A alone, and no digits are lost to the distance from the origin.
Source: Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

Quadric = wp.types.vector(length=10, dtype=wp.float64)  # xx xy xz yy yz zz, b, c

MIN_PIVOT = wp.constant(wp.float64(1.0e-13))  # of the trace; the point quadric keeps honest pivots near 1e-9


@wp.func
def quadric_apply(q: Quadric, y: wp.vec3d):
    """Return A y."""
    return wp.vec3d(
        q[0] * y[0] + q[1] * y[1] + q[2] * y[2],
        q[1] * y[0] + q[3] * y[1] + q[4] * y[2],
        q[2] * y[0] + q[4] * y[1] + q[5] * y[2],
    )


@wp.func
def quadric_moved(q: Quadric, d: wp.vec3d):
    """Return the same quadric relative to a point that lies d further."""
    ad = quadric_apply(q, d)
    r = q
    r[6] = q[6] + ad[0]
    r[7] = q[7] + ad[1]
    r[8] = q[8] + ad[2]
    r[9] = q[9] + wp.float64(2.0) * (q[6] * d[0] + q[7] * d[1] + q[8] * d[2]) + wp.dot(d, ad)
    return r


@wp.func
def quadric_error(q: Quadric, y: wp.vec3d):
    e = wp.dot(y, quadric_apply(q, y)) + wp.float64(2.0) * (q[6] * y[0] + q[7] * y[1] + q[8] * y[2]) + q[9]
    return wp.max(e, wp.float64(0.0))


@wp.func
def quadric_plane(n: wp.vec3d, weight: wp.float64):
    """Return the quadric of a plane through the node itself."""
    q = Quadric()
    q[0] = weight * n[0] * n[0]
    q[1] = weight * n[0] * n[1]
    q[2] = weight * n[0] * n[2]
    q[3] = weight * n[1] * n[1]
    q[4] = weight * n[1] * n[2]
    q[5] = weight * n[2] * n[2]
    return q


@wp.func
def quadric_minimum(q: Quadric, reach: wp.float64):
    """Return where q is least; (inf, inf, inf) if A is near singular or the place is beyond `reach`. LDL^T."""
    far = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
    floor = MIN_PIVOT * (q[0] + q[3] + q[5])
    if not (q[0] > floor):
        return far
    l1 = q[1] / q[0]
    l2 = q[2] / q[0]
    d1 = q[3] - l1 * q[1]
    if not (d1 > floor):
        return far
    u = q[4] - l1 * q[2]
    l3 = u / d1
    d2 = q[5] - l2 * q[2] - l3 * u
    if not (d2 > floor):
        return far
    s0 = -q[6]
    s1 = -q[7] - l1 * s0
    s2 = -q[8] - l2 * s0 - l3 * s1
    z = s2 / d2
    y = s1 / d1 - l3 * z
    x = s0 / q[0] - l1 * y - l2 * z
    if x * x + y * y + z * z <= reach * reach:
        return wp.vec3d(x, y, z)
    return far
