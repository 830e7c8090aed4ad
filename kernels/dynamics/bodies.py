"""Rigid bodies: which pairs matter, islands and sleep, and motion of one step.

A body's frame has its origin at the centre of mass and its axes along the principal axes of inertia.
"""

import warp as wp

from warp_abtree.kernels.arrays import ObjectPool
from warp_abtree.kernels.contact.manifold import LAST_KEY, Manifolds, find_root, unite_roots
from warp_abtree.kernels.poses import rotate_quaternion

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FIXED = wp.constant(0)
ASLEEP = wp.constant(1)
AWAKE = wp.constant(2)
DRIVEN = wp.constant(3)
"""Roles: what never moves in this step, rigid bodies at rest and in motion, and what moves as it is told."""

HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Bodies:
    """One entry an object.

    Static: rank among the rigid bodies of its world; driven, whether its motion is prescribed; inverse_mass,
    inverse_moment (principal), 0 unless rigid; centre of mass and principal axes (columns) in the model's frame, 0 and
    1 unless rigid; restitution, friction; slop [world units] that contacts may keep; sleep_speed [world units/s]; reach
    from the centre of mass [world units].
    State: role; position [world units] and rotation (x y z w) of the body's frame; velocity [world units/s];
    momentum, angular, about the centre of mass, world frame; spin [rad/s] of driven objects; rest, how long it has been
    slow [s]. Of one step: inverse_inertia, world frame; push and turn, as velocity and momentum but for corrections of
    place; island and island_rest; bid, of the colouring.
    """

    rank: wp.array(dtype=wp.int32)
    driven: wp.array(dtype=wp.int32)
    inverse_mass: wp.array(dtype=wp.float64)
    inverse_moment: wp.array(dtype=wp.vec3d)
    centre: wp.array(dtype=wp.vec3d)
    axes: wp.array(dtype=wp.mat33d)
    restitution: wp.array(dtype=wp.float64)
    friction: wp.array(dtype=wp.float64)
    slop: wp.array(dtype=wp.float64)
    sleep_speed: wp.array(dtype=wp.float64)
    reach: wp.array(dtype=wp.float64)
    role: wp.array(dtype=wp.int32)
    position: wp.array(dtype=wp.vec3d)
    rotation: wp.array(dtype=wp.vec4d)
    velocity: wp.array(dtype=wp.vec3d)
    momentum: wp.array(dtype=wp.vec3d)
    spin: wp.array(dtype=wp.vec3d)
    rest: wp.array(dtype=wp.float64)
    inverse_inertia: wp.array(dtype=wp.mat33d)
    push: wp.array(dtype=wp.vec3d)
    turn: wp.array(dtype=wp.vec3d)
    island: wp.array(dtype=wp.int32)
    island_rest: wp.array(dtype=wp.float64)
    bid: wp.array(dtype=wp.int64)


@wp.func
def pair_matters(roles: wp.array(dtype=wp.int32), i: wp.int32, j: wp.int32):
    """Return whether a contact of two objects can move either of them."""
    if roles.shape[0] == 0:
        return True
    low = wp.min(roles[i], roles[j])
    high = wp.max(roles[i], roles[j])
    return high == AWAKE or low == AWAKE or (high == DRIVEN and low == ASLEEP)


@wp.kernel
def make_pair_key_kernel(
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    roles: wp.array(dtype=wp.int32),
    order_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Make the key first * 2^32 + second of each pair that matters; others go behind them all."""
    p = wp.tid()
    order_out[p] = p
    key_out[p] = LAST_KEY
    if p < pair_count[0] and pair_matters(roles, pairs[p][0], pairs[p][1]):
        key_out[p] = (wp.int64(pairs[p][0]) << wp.int64(32)) | wp.int64(pairs[p][1])


@wp.kernel
def place_pair_kernel(
    key: wp.array(dtype=wp.int64), pair_count_inout: wp.array(dtype=wp.int32), pairs_out: wp.array(dtype=wp.vec2i)
):
    """Put the pairs in the order of their keys and count them; a count beyond the room stays, as the demand."""
    p = wp.tid()
    room = pairs_out.shape[0]
    if p < room and key[p] != LAST_KEY:
        pairs_out[p] = wp.vec2i(wp.int32(key[p] >> wp.int64(32)), wp.int32(key[p] & wp.int64(0x7FFFFFFF)))
    before = bool(True)
    if p > 0:
        before = key[p - 1] != LAST_KEY
    after = bool(True)
    if p < room:
        after = key[p] == LAST_KEY
    # One thread alone stands where the pairs end, whatever the count is.
    if before and after and pair_count_inout[0] <= room and pair_count_inout[0] >= 0:
        pair_count_inout[0] = p


@wp.func
def multiply_quaternion(p: wp.vec4d, q: wp.vec4d):
    """Return the rotation q followed by p, x y z w."""
    u = wp.vec3d(p[0], p[1], p[2])
    v = wp.vec3d(q[0], q[1], q[2])
    w = p[3] * v + q[3] * u + wp.cross(u, v)
    return wp.vec4d(w[0], w[1], w[2], p[3] * q[3] - wp.dot(u, v))


@wp.func
def turn_quaternion(v: wp.vec3d):
    """Return the rotation by a vector, axis times angle [rad]."""
    angle = wp.length(v)
    scale = HALF
    if angle > wp.float64(1.0e-8):
        scale = wp.sin(HALF * angle) / angle
    return wp.vec4d(scale * v[0], scale * v[1], scale * v[2], wp.cos(HALF * angle))


@wp.func
def turn_axis(axis: wp.int32, angle: wp.float64, q: wp.vec4d, momentum: wp.vec3d):
    """Turn a body about one of its own axes; its momentum in its own frame turns the other way."""
    v = wp.vec3d()
    v[axis] = angle
    j = (axis + 1) % 3
    k = (axis + 2) % 3
    c = wp.cos(angle)
    s = wp.sin(angle)
    turned = momentum
    turned[j] = c * momentum[j] + s * momentum[k]
    turned[k] = c * momentum[k] - s * momentum[j]
    return multiply_quaternion(q, turn_quaternion(v)), turned


@wp.func
def rotate_free(q: wp.vec4d, momentum: wp.vec3d, inverse_moment: wp.vec3d, dt: wp.float64):
    """Return where a free body turns within a time, its angular momentum [world frame] kept.

    The kinetic energy is split into that of the three axes, about each of which the motion is a plain rotation; a
    symmetric product of them is symplectic, so that the energy swings and does not drift.
    Source: McLachlan 1993, Explicit Lie-Poisson integration and the Euler equations; Reich 1994.
    """
    m = wp.transpose(rotate_quaternion(q)) * momentum
    for k in range(5):
        axis = wp.where(k < 3, k, 4 - k)
        part = wp.where(k == 2, dt, HALF * dt)
        q, m = turn_axis(axis, part * m[axis] * inverse_moment[axis], q, m)
    return q / wp.length(q)


@wp.func
def rotation_vector(r: wp.mat33d):
    """Return axis times angle [rad] of a rotation by less than half a turn."""
    v = HALF * wp.vec3d(r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    sine = wp.length(v)
    angle = wp.atan2(sine, HALF * (r[0, 0] + r[1, 1] + r[2, 2] - wp.float64(1.0)))
    if sine > wp.float64(0.0):
        v = v * (angle / sine)
    return v


@wp.kernel
def begin_step_kernel(
    dt: wp.float64,
    target_rotation: wp.array(dtype=wp.mat33d),
    target_position: wp.array(dtype=wp.vec3d),
    objects: ObjectPool,
    bodies_inout: Bodies,
):
    """Set what one step starts from; driven objects get the velocity that takes them to their targets."""
    i = wp.tid()
    bodies_inout.push[i] = wp.vec3d()
    bodies_inout.turn[i] = wp.vec3d()
    bodies_inout.island[i] = i
    bodies_inout.island_rest[i] = wp.float64(wp.inf)
    bodies_inout.bid[i] = wp.int64(0)
    if bodies_inout.inverse_mass[i] > wp.float64(0.0):
        r = rotate_quaternion(bodies_inout.rotation[i])
        bodies_inout.inverse_inertia[i] = r * wp.diag(bodies_inout.inverse_moment[i]) * wp.transpose(r)
        return
    bodies_inout.position[i] = objects.position[i]
    bodies_inout.velocity[i] = wp.vec3d()
    bodies_inout.spin[i] = wp.vec3d()
    bodies_inout.role[i] = FIXED
    if bodies_inout.driven[i] != 0 and target_position.shape[0] > 0:
        velocity = (target_position[i] - objects.position[i]) / dt
        spin = rotation_vector(target_rotation[i] * wp.transpose(objects.rotation[i])) / dt
        bodies_inout.velocity[i] = velocity
        bodies_inout.spin[i] = spin
        if wp.length(velocity) + wp.length(spin) > wp.float64(0.0):
            bodies_inout.role[i] = DRIVEN


@wp.kernel
def unite_island_kernel(
    pair_count: wp.array(dtype=wp.int32), pairs: wp.array(dtype=wp.vec2i), manifolds: Manifolds, bodies_inout: Bodies
):
    """Unite the islands of two rigid bodies that touch; what a driven object touches is not at rest."""
    p = wp.tid()
    if p >= pair_count[0] or manifolds.count[p] == 0:
        return
    i = pairs[p][0]
    j = pairs[p][1]
    zero = wp.float64(0.0)
    if bodies_inout.role[i] == DRIVEN:
        bodies_inout.rest[j] = zero
    if bodies_inout.role[j] == DRIVEN:
        bodies_inout.rest[i] = zero
    if bodies_inout.inverse_mass[i] > zero and bodies_inout.inverse_mass[j] > zero:
        unite_roots(bodies_inout.island, i, j)


@wp.kernel
def rest_island_kernel(bodies_inout: Bodies):
    """Find how long each island has been slow: the least of its bodies' times."""
    i = wp.tid()
    if bodies_inout.inverse_mass[i] > wp.float64(0.0):
        wp.atomic_min(bodies_inout.island_rest, find_root(bodies_inout.island, i), bodies_inout.rest[i])


@wp.kernel
def wake_body_kernel(sleep_time: wp.float64, bodies_inout: Bodies):
    """Put islands that have been slow for long to sleep, wake all others."""
    i = wp.tid()
    if bodies_inout.inverse_mass[i] == wp.float64(0.0):
        return
    if bodies_inout.island_rest[find_root(bodies_inout.island, i)] >= sleep_time:
        bodies_inout.role[i] = ASLEEP
        bodies_inout.velocity[i] = wp.vec3d()
        bodies_inout.momentum[i] = wp.vec3d()
        return
    bodies_inout.role[i] = AWAKE


@wp.kernel
def accelerate_body_kernel(change: wp.vec3d, bodies_inout: Bodies):
    """Change the velocity of each body that is awake by what gravity adds in a step."""
    i = wp.tid()
    if bodies_inout.role[i] == AWAKE:
        bodies_inout.velocity[i] += change


@wp.func
def pose_body(bodies: Bodies, objects: ObjectPool, i: wp.int32):
    """Put an object where its body is."""
    rotation = rotate_quaternion(bodies.rotation[i]) * wp.transpose(bodies.axes[i])
    objects.rotation[i] = rotation
    objects.position[i] = bodies.position[i] - rotation * bodies.centre[i]


@wp.kernel
def move_body_kernel(
    dt: wp.float64,
    target_rotation: wp.array(dtype=wp.mat33d),
    target_position: wp.array(dtype=wp.vec3d),
    bodies_inout: Bodies,
    objects_inout: ObjectPool,
):
    """Move each body with its new velocity and the correction of its place, and time how long it has been slow."""
    i = wp.tid()
    if bodies_inout.role[i] == DRIVEN:
        objects_inout.rotation[i] = target_rotation[i]
        objects_inout.position[i] = target_position[i]
    if bodies_inout.role[i] != AWAKE:
        return
    spin = bodies_inout.inverse_inertia[i] * bodies_inout.momentum[i]
    speed = wp.length(bodies_inout.velocity[i]) + bodies_inout.reach[i] * wp.length(spin)
    bodies_inout.rest[i] = wp.where(speed < bodies_inout.sleep_speed[i], bodies_inout.rest[i] + dt, wp.float64(0.0))
    bodies_inout.position[i] += dt * (bodies_inout.velocity[i] + bodies_inout.push[i])
    q = rotate_free(bodies_inout.rotation[i], bodies_inout.momentum[i], bodies_inout.inverse_moment[i], dt)
    turn = bodies_inout.inverse_inertia[i] * bodies_inout.turn[i]
    if wp.dot(turn, turn) > wp.float64(0.0):
        correction = turn_quaternion(dt * turn)
        q = multiply_quaternion(correction, q)
        q = q / wp.length(q)
        # Momentum turns along, or the kinetic energy would change.
        bodies_inout.momentum[i] = rotate_quaternion(correction) * bodies_inout.momentum[i]
    bodies_inout.rotation[i] = q
    pose_body(bodies_inout, objects_inout, i)
