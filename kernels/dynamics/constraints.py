"""Contact constraints of a step: their set-up, and warm starting from the step before."""

import warp as wp

from warp_abtree.kernels.arrays import LAST_KEY, ObjectPool
from warp_abtree.kernels.contact.manifold import POINTS, Manifolds
from warp_abtree.kernels.dynamics.bodies import DYNAMIC, Bodies
from warp_abtree.kernels.dynamics.graph_coloring import INACTIVE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BAUMGARTE = wp.constant(wp.float64(0.2))
"""Fraction of the penetration that one step corrects."""

MATCH_RADIUS = wp.constant(wp.float64(0.05))
"""Largest distance of a point from its match in the step before, as a fraction of the bounding radius."""


@wp.struct
class Constraints:
    """Contact points of each pair as the solver sees them, shape [pair, POINTS] as `Manifolds`, or [pair]."""

    arm_a: wp.array2d(dtype=wp.vec3d)  # from the centre of mass of the first body
    arm_b: wp.array2d(dtype=wp.vec3d)  # from that of the second
    tangent: wp.array2d(dtype=wp.vec3d)  # the first tangent; the second is normal x tangent
    mass: wp.array2d(dtype=wp.float64)  # effective mass along the normal
    tangent_mass: wp.array2d(dtype=wp.mat22d)  # effective mass along the tangents
    bias: wp.array2d(dtype=wp.float64)  # separation speed that the position correction aims for [world units/s]
    impulse: wp.array2d(dtype=wp.float64)  # accumulated, along the normal
    friction_impulse: wp.array2d(dtype=wp.vec2d)  # accumulated, along the tangents
    pseudo_impulse: wp.array2d(dtype=wp.float64)  # accumulated, of the position correction
    match: wp.array2d(dtype=wp.int32)  # point in `WarmStart`, row * POINTS + column, or -1
    restitution: wp.array(dtype=wp.float64)  # [pair] coefficient
    friction: wp.array(dtype=wp.float64)  # [pair] coefficient
    threshold: wp.array(dtype=wp.float64)  # [pair] approach speed below which nothing bounces [world units/s]
    both_rigid: wp.array(dtype=wp.int32)  # [pair] 1 if both are rigid bodies


@wp.struct
class WarmStart:
    """Impulses of the step before."""

    key: wp.array(dtype=wp.int64)  # pair keys, sorted
    count: wp.array(dtype=wp.int32)  # points of each pair
    point: wp.array2d(dtype=wp.vec3d)  # in the frame of the pair's first object
    impulse: wp.array2d(dtype=wp.float64)  # along the normal
    friction_impulse: wp.array2d(dtype=wp.vec3d)  # across the normal, world frame


@wp.struct
class Point:
    """A contact point, as functions of the solver take it."""

    pair: wp.int32  # row of `Constraints`
    column: wp.int32  # column of `Constraints`
    a: wp.int32  # first object
    b: wp.int32  # second object
    normal: wp.vec3d  # from the first to the second object


@wp.func
def make_point(manifolds: Manifolds, pair: wp.vec2i, p: wp.int32, k: wp.int32):
    """Return point k of pair p."""
    point = Point()
    point.pair = p
    point.column = k
    point.a = pair[0]
    point.b = pair[1]
    point.normal = manifolds.normal[p, k]
    return point


@wp.func
def velocity_at(bodies: Bodies, i: wp.int32, arm: wp.vec3d):
    """Return the velocity of a body at the end of an arm."""
    angular_velocity = bodies.angular_velocity[i] + bodies.inverse_inertia[i] * bodies.momentum[i]
    return bodies.velocity[i] + wp.cross(angular_velocity, arm)


@wp.func
def relative_velocity(constraints: Constraints, bodies: Bodies, c: Point):
    """Return the velocity of the second object relative to the first at a point."""
    velocity = velocity_at(bodies, c.b, constraints.arm_b[c.pair, c.column])
    return velocity - velocity_at(bodies, c.a, constraints.arm_a[c.pair, c.column])


@wp.func
def response(bodies: Bodies, i: wp.int32, arm: wp.vec3d, u: wp.vec3d, v: wp.vec3d):
    """Return the velocity along v at the end of an arm that an impulse of 1 along u gives."""
    if bodies.motion_type[i] != DYNAMIC:
        return wp.float64(0.0)
    angular_velocity = bodies.inverse_inertia[i] * wp.cross(arm, u)
    return bodies.inverse_mass[i] * wp.dot(u, v) + wp.dot(angular_velocity, wp.cross(arm, v))


@wp.func
def perpendicular(n: wp.vec3d):
    """Return a unit vector perpendicular to a unit vector."""
    zero = wp.float64(0.0)
    v = wp.vec3d(-n[2], zero, n[0])
    if wp.abs(n[0]) < wp.abs(n[1]):
        v = wp.vec3d(zero, n[2], -n[1])
    return wp.normalize(v)


@wp.func
def set_effective_mass(bodies: Bodies, constraints: Constraints, c: Point):
    """Set the tangent of a point, and the effective masses along the normal and both tangents."""
    n = c.normal
    t = perpendicular(n)
    s = wp.cross(n, t)
    arm_a = constraints.arm_a[c.pair, c.column]
    arm_b = constraints.arm_b[c.pair, c.column]
    nn = response(bodies, c.a, arm_a, n, n) + response(bodies, c.b, arm_b, n, n)
    tt = response(bodies, c.a, arm_a, t, t) + response(bodies, c.b, arm_b, t, t)
    ts = response(bodies, c.a, arm_a, t, s) + response(bodies, c.b, arm_b, t, s)
    ss = response(bodies, c.a, arm_a, s, s) + response(bodies, c.b, arm_b, s, s)
    det = tt * ss - ts * ts
    constraints.tangent[c.pair, c.column] = t
    constraints.mass[c.pair, c.column] = wp.float64(1.0) / nn
    constraints.tangent_mass[c.pair, c.column] = wp.mat22d(ss / det, -ts / det, -ts / det, tt / det)


@wp.func
def find_match(warm_start: WarmStart, row: wp.int32, radius: wp.float64, point: wp.vec3d, used: wp.int32):
    """Return the nearest unused point of a pair of the step before within a radius, or -1."""
    best = wp.int32(-1)
    nearest = radius * radius
    for k in range(warm_start.count[row]):
        r = warm_start.point[row, k] - point
        if ((used >> k) & 1) == 0 and wp.dot(r, r) <= nearest:
            nearest = wp.dot(r, r)
            best = k
    return best


@wp.kernel
def prepare_constraints_kernel(
    # static
    dt: wp.float64,
    threshold: wp.float64,
    # state
    key: wp.array(dtype=wp.int64),
    pairs: wp.array(dtype=wp.vec2i),
    pair_color: wp.array(dtype=wp.int32),
    objects: ObjectPool,
    manifolds: Manifolds,
    warm_start: WarmStart,
    bodies: Bodies,
    # out
    constraints_out: Constraints,
):
    """Set up the constraints of one pair a thread, before gravity; slow points are matched with the step before.

    Args:
        threshold: Approach speed below which nothing bounces [world units/s].
    """
    p = wp.tid()
    if pair_color[p] == INACTIVE:
        return
    a = pairs[p][0]
    b = pairs[p][1]
    zero = wp.float64(0.0)
    constraints_out.threshold[p] = threshold
    constraints_out.both_rigid[p] = wp.where(bodies.inverse_mass[a] > zero and bodies.inverse_mass[b] > zero, 1, 0)
    constraints_out.restitution[p] = wp.max(bodies.restitution[a], bodies.restitution[b])
    constraints_out.friction[p] = wp.sqrt(bodies.friction[a] * bodies.friction[b])
    slop = wp.min(bodies.slop[a], bodies.slop[b])
    radius = MATCH_RADIUS * wp.min(bodies.bounding_radius[a], bodies.bounding_radius[b])
    row = wp.lower_bound(warm_start.key, key[p])
    known = bool(False)
    if row < warm_start.key.shape[0]:
        known = warm_start.key[row] == key[p]
    used = wp.int32(0)
    for k in range(manifolds.count[p]):
        x = manifolds.point[p, k]
        c = make_point(manifolds, pairs[p], p, k)
        constraints_out.arm_a[p, k] = x - bodies.position[a]
        constraints_out.arm_b[p, k] = x - bodies.position[b]
        set_effective_mass(bodies, constraints_out, c)
        constraints_out.bias[p, k] = BAUMGARTE * (manifolds.depth[p, k] - slop) / dt
        constraints_out.friction_impulse[p, k] = wp.vec2d()
        constraints_out.pseudo_impulse[p, k] = zero
        constraints_out.match[p, k] = -1
        if known and wp.abs(wp.dot(c.normal, relative_velocity(constraints_out, bodies, c))) <= threshold:
            local = wp.transpose(objects.rotation[a]) * (x - objects.position[a])
            match = find_match(warm_start, row, radius, local, used)
            if match >= 0:
                used = used | (1 << match)
                constraints_out.match[p, k] = row * POINTS + match


@wp.kernel
def save_impulses_kernel(
    # state
    pair_count: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int64),
    pairs: wp.array(dtype=wp.vec2i),
    pair_color: wp.array(dtype=wp.int32),
    objects: ObjectPool,
    manifolds: Manifolds,
    constraints: Constraints,
    # out
    warm_start_out: WarmStart,
):
    """Save the impulses of one pair a thread for the next step, with points relative to the first object."""
    p = wp.tid()
    warm_start_out.key[p] = LAST_KEY
    warm_start_out.count[p] = 0
    if p >= pair_count[0]:
        return
    warm_start_out.key[p] = key[p]
    if pair_color[p] == INACTIVE:
        return
    warm_start_out.count[p] = manifolds.count[p]
    a = pairs[p][0]
    to_local = wp.transpose(objects.rotation[a])
    for k in range(manifolds.count[p]):
        t = constraints.tangent[p, k]
        v = constraints.friction_impulse[p, k]
        warm_start_out.point[p, k] = to_local * (manifolds.point[p, k] - objects.position[a])
        warm_start_out.impulse[p, k] = constraints.impulse[p, k]
        warm_start_out.friction_impulse[p, k] = v[0] * t + v[1] * wp.cross(manifolds.normal[p, k], t)
