"""Rigid bodies: their state, sleeping islands, and the motion of one step.

A body frame has its origin at the centre of mass and its axes along the principal axes of inertia.
"""

import warp as wp

from warp_abtree.kernels.arrays import LAST_KEY, ObjectPool
from warp_abtree.kernels.broad_phase import pair_key
from warp_abtree.kernels.contact.manifold import Manifolds, find_root, unite_roots
from warp_abtree.kernels.poses import rotate_quaternion

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STATIC = wp.constant(0)
ASLEEP = wp.constant(1)
DYNAMIC = wp.constant(2)
KINEMATIC = wp.constant(3)
"""Motion type of an object in this step: at rest for good, a sleeping rigid body, one in motion, prescribed motion."""

HALF = wp.constant(wp.float64(0.5))


@wp.struct
class Bodies:
    """Rigid bodies, one entry an object. Bodies that are not rigid have infinite mass: inverses are 0."""

    # static
    rank: wp.array(dtype=wp.int32)  # rank among the rigid bodies of the same world
    prescribed: wp.array(dtype=wp.int32)  # 1 if the motion is prescribed
    inverse_mass: wp.array(dtype=wp.float64)  # [1 / mass]
    inverse_moment: wp.array(dtype=wp.vec3d)  # of the principal moments of inertia
    centre: wp.array(dtype=wp.vec3d)  # centre of mass, model frame [world units]
    axes: wp.array(dtype=wp.mat33d)  # principal axes as columns, model frame
    restitution: wp.array(dtype=wp.float64)  # coefficient, 0 to 1
    friction: wp.array(dtype=wp.float64)  # coefficient of Coulomb's law
    slop: wp.array(dtype=wp.float64)  # penetration that is not corrected [world units]
    sleep_speed: wp.array(dtype=wp.float64)  # below it a body counts as at rest [world units/s]
    bounding_radius: wp.array(dtype=wp.float64)  # about the centre of mass [world units]
    # state
    motion_type: wp.array(dtype=wp.int32)  # STATIC, ASLEEP, DYNAMIC or KINEMATIC
    position: wp.array(dtype=wp.vec3d)  # of the body frame [world units]
    rotation: wp.array(dtype=wp.vec4d)  # of the body frame, x y z w
    velocity: wp.array(dtype=wp.vec3d)  # of the centre of mass [world units/s]
    momentum: wp.array(dtype=wp.vec3d)  # angular momentum about the centre of mass, world frame
    angular_velocity: wp.array(dtype=wp.vec3d)  # of kinematic objects alone [rad/s]
    rest_time: wp.array(dtype=wp.float64)  # how long the body has been slow [s]
    # of one step
    inverse_inertia: wp.array(dtype=wp.mat33d)  # world frame
    pseudo_velocity: wp.array(dtype=wp.vec3d)  # of the position correction [world units/s]
    pseudo_momentum: wp.array(dtype=wp.vec3d)  # its angular momentum
    island: wp.array(dtype=wp.int32)  # parent in the union-find forest of islands
    island_rest_time: wp.array(dtype=wp.float64)  # at a root: least rest_time of the island [s]
    bid: wp.array(dtype=wp.int64)  # highest bid of the graph coloring


@wp.kernel
def make_body_pair_key_kernel(
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    motion_type: wp.array(dtype=wp.int32),
    # out
    order_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Make the key first * 2^32 + second of each pair whose contact can move a body; others sort behind all of them."""
    p = wp.tid()
    order_out[p] = p
    key_out[p] = LAST_KEY
    if p >= pair_count[0]:
        return
    low = wp.min(motion_type[pairs[p][0]], motion_type[pairs[p][1]])
    high = wp.max(motion_type[pairs[p][0]], motion_type[pairs[p][1]])
    if high == DYNAMIC or low == DYNAMIC or (high == KINEMATIC and low == ASLEEP):
        key_out[p] = pair_key(pairs[p])


@wp.func
def multiply_quaternion(p: wp.vec4d, q: wp.vec4d):
    """Return the rotation q followed by p, x y z w."""
    u = wp.vec3d(p[0], p[1], p[2])
    v = wp.vec3d(q[0], q[1], q[2])
    w = p[3] * v + q[3] * u + wp.cross(u, v)
    return wp.vec4d(w[0], w[1], w[2], p[3] * q[3] - wp.dot(u, v))


@wp.func
def quaternion_exp(v: wp.vec3d):
    """Return the quaternion of a rotation vector, axis times angle [rad]."""
    angle = wp.length(v)
    scale = HALF
    if angle > wp.float64(1.0e-8):
        scale = wp.sin(HALF * angle) / angle
    return wp.vec4d(scale * v[0], scale * v[1], scale * v[2], wp.cos(HALF * angle))


@wp.func
def rotate_about_axis(axis: wp.int32, angle: wp.float64, q: wp.vec4d, momentum: wp.vec3d):
    """Rotate a body about one of its own axes; its momentum in the body frame rotates the other way."""
    v = wp.vec3d()
    v[axis] = angle
    j = (axis + 1) % 3
    k = (axis + 2) % 3
    c = wp.cos(angle)
    s = wp.sin(angle)
    rotated = momentum
    rotated[j] = c * momentum[j] + s * momentum[k]
    rotated[k] = c * momentum[k] - s * momentum[j]
    return multiply_quaternion(q, quaternion_exp(v)), rotated


@wp.func
def integrate_rotation(q: wp.vec4d, momentum: wp.vec3d, inverse_moment: wp.vec3d, dt: wp.float64):
    """Return the rotation of a free body after a time; its angular momentum [world frame] is constant.

    The kinetic energy is split into that of the three axes, each of which gives a plain rotation. Their symmetric
    product is symplectic: the energy oscillates and does not drift.
    Source: McLachlan 1993, Explicit Lie-Poisson integration and the Euler equations; Reich 1994.
    """
    m = wp.transpose(rotate_quaternion(q)) * momentum
    for k in range(5):
        axis = wp.where(k < 3, k, 4 - k)
        part = wp.where(k == 2, dt, HALF * dt)
        q, m = rotate_about_axis(axis, part * m[axis] * inverse_moment[axis], q, m)
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
    # state
    bodies_inout: Bodies,
):
    """Initialise a step; kinematic objects get the velocity that takes them to their targets."""
    i = wp.tid()
    bodies_inout.pseudo_velocity[i] = wp.vec3d()
    bodies_inout.pseudo_momentum[i] = wp.vec3d()
    bodies_inout.island[i] = i
    bodies_inout.island_rest_time[i] = wp.float64(wp.inf)
    bodies_inout.bid[i] = wp.int64(0)
    if bodies_inout.inverse_mass[i] > wp.float64(0.0):
        r = rotate_quaternion(bodies_inout.rotation[i])
        bodies_inout.inverse_inertia[i] = r * wp.diag(bodies_inout.inverse_moment[i]) * wp.transpose(r)
        return
    bodies_inout.position[i] = objects.position[i]
    bodies_inout.velocity[i] = wp.vec3d()
    bodies_inout.angular_velocity[i] = wp.vec3d()
    bodies_inout.motion_type[i] = STATIC
    if bodies_inout.prescribed[i] != 0 and target_position.shape[0] > 0:
        velocity = (target_position[i] - objects.position[i]) / dt
        angular_velocity = rotation_vector(target_rotation[i] * wp.transpose(objects.rotation[i])) / dt
        bodies_inout.velocity[i] = velocity
        bodies_inout.angular_velocity[i] = angular_velocity
        if wp.length(velocity) + wp.length(angular_velocity) > wp.float64(0.0):
            bodies_inout.motion_type[i] = KINEMATIC


@wp.kernel
def unite_islands_kernel(
    pair_count: wp.array(dtype=wp.int32), pairs: wp.array(dtype=wp.vec2i), manifolds: Manifolds, bodies_inout: Bodies
):
    """Unite the islands of two rigid bodies in contact; contact with a moving kinematic object resets the rest time."""
    p = wp.tid()
    if p >= pair_count[0] or manifolds.count[p] == 0:
        return
    i = pairs[p][0]
    j = pairs[p][1]
    zero = wp.float64(0.0)
    if bodies_inout.motion_type[i] == KINEMATIC:
        bodies_inout.rest_time[j] = zero
    if bodies_inout.motion_type[j] == KINEMATIC:
        bodies_inout.rest_time[i] = zero
    if bodies_inout.inverse_mass[i] > zero and bodies_inout.inverse_mass[j] > zero:
        unite_roots(bodies_inout.island, i, j)


@wp.kernel
def measure_island_rest_kernel(bodies_inout: Bodies):
    """Find the rest time of each island: the least of its bodies' times."""
    i = wp.tid()
    if bodies_inout.inverse_mass[i] > wp.float64(0.0):
        wp.atomic_min(bodies_inout.island_rest_time, find_root(bodies_inout.island, i), bodies_inout.rest_time[i])


@wp.kernel
def update_sleep_kernel(sleep_time: wp.float64, bodies_inout: Bodies):
    """Put islands that have rested for `sleep_time` to sleep, and wake all others."""
    i = wp.tid()
    if bodies_inout.inverse_mass[i] == wp.float64(0.0):
        return
    if bodies_inout.island_rest_time[find_root(bodies_inout.island, i)] >= sleep_time:
        bodies_inout.motion_type[i] = ASLEEP
        bodies_inout.velocity[i] = wp.vec3d()
        bodies_inout.momentum[i] = wp.vec3d()
        return
    bodies_inout.motion_type[i] = DYNAMIC


@wp.kernel
def apply_gravity_kernel(velocity_change: wp.vec3d, bodies_inout: Bodies):
    """Add the velocity change of a step under gravity to every dynamic body."""
    i = wp.tid()
    if bodies_inout.motion_type[i] == DYNAMIC:
        bodies_inout.velocity[i] += velocity_change


@wp.kernel
def integrate_kernel(
    dt: wp.float64,
    target_rotation: wp.array(dtype=wp.mat33d),
    target_position: wp.array(dtype=wp.vec3d),
    # state
    bodies_inout: Bodies,
    objects_inout: ObjectPool,
):
    """Move each body by its velocity and its position correction, pose its object, and update its rest time."""
    i = wp.tid()
    if bodies_inout.motion_type[i] == KINEMATIC:
        objects_inout.rotation[i] = target_rotation[i]
        objects_inout.position[i] = target_position[i]
    if bodies_inout.motion_type[i] != DYNAMIC:
        return
    angular_velocity = bodies_inout.inverse_inertia[i] * bodies_inout.momentum[i]
    speed = wp.length(bodies_inout.velocity[i]) + bodies_inout.bounding_radius[i] * wp.length(angular_velocity)
    at_rest = speed < bodies_inout.sleep_speed[i]
    bodies_inout.rest_time[i] = wp.where(at_rest, bodies_inout.rest_time[i] + dt, wp.float64(0.0))
    bodies_inout.position[i] += dt * (bodies_inout.velocity[i] + bodies_inout.pseudo_velocity[i])
    q = integrate_rotation(bodies_inout.rotation[i], bodies_inout.momentum[i], bodies_inout.inverse_moment[i], dt)
    pseudo_angular_velocity = bodies_inout.inverse_inertia[i] * bodies_inout.pseudo_momentum[i]
    if wp.dot(pseudo_angular_velocity, pseudo_angular_velocity) > wp.float64(0.0):
        correction = quaternion_exp(dt * pseudo_angular_velocity)
        q = multiply_quaternion(correction, q)
        q = q / wp.length(q)
        # The momentum rotates along, otherwise the kinetic energy would change.
        bodies_inout.momentum[i] = rotate_quaternion(correction) * bodies_inout.momentum[i]
    bodies_inout.rotation[i] = q
    rotation = rotate_quaternion(q) * wp.transpose(bodies_inout.axes[i])
    objects_inout.rotation[i] = rotation
    objects_inout.position[i] = bodies_inout.position[i] - rotation * bodies_inout.centre[i]
