"""Rigid bodies: their state, and the motion of one step.

A body frame has its origin at the centre of mass and its axes along the principal axes of inertia.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.poses import HALF, PairBatch
from warp_abtree.kernels.intersect.face_pairs import Hits, is_whole
from warp_abtree.kernels.motion.turn import shortest_turn

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STATIC = wp.constant(0)
KINEMATIC = wp.constant(1)
DYNAMIC = wp.constant(2)
"""Motion type of an object: it stands, its motion is prescribed, or it is a rigid body."""

ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))

PART, PARTS_MAX, TURN_MAX = (wp.constant(wp.float64(x)) for x in (0.5, 32.0, 2.0**20))
"""A turn is integrated in parts of so many radians at most, while these are no more; largest tangent of a part."""

ITERATIONS_MAX, CONVERGED = wp.constant(8), wp.constant(wp.float64(2.0**-80))
"""Steps of Newton's method at most, and square of the last one."""

FREE, STUCK, ON_TRIAL, STUCK_AGAIN = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
"""Whether a body's last motion was cut to next to nothing, and what came of it; the odd ones move out of contact."""

LOOKAHEAD_LEAST, LOOKAHEAD_MAX = wp.constant(wp.float64(2.0**-8)), wp.constant(wp.float64(0.25))
"""How far ahead of a body contacts are looked for, beside its motion in a step, and motion at most, in its radii."""


@wp.struct
class Bodies:
    """Bodies, one entry an object. Those that are not DYNAMIC have infinite mass: inverses are 0."""

    motion_type: wp.array(dtype=wp.int32)  # STATIC, KINEMATIC or DYNAMIC
    rank: wp.array(dtype=wp.int32)  # rank among the rigid bodies of the same world
    inverse_mass: wp.array(dtype=wp.float64)  # [1 / mass]
    inverse_moment: wp.array(dtype=wp.vec3d)  # of the principal moments of inertia
    centre: wp.array(dtype=wp.vec3d)  # centre of mass, model frame [world units]
    axes: wp.array(dtype=wp.mat33d)  # principal axes as columns, model frame
    bounding_radius: wp.array(dtype=wp.float64)  # about the centre of mass [world units]
    slop: wp.array(dtype=wp.float64)  # penetration that matters little [world units]
    position: wp.array(dtype=wp.vec3d)  # of the body frame [world units]
    rotation: wp.array(dtype=wp.quatd)  # of the body frame, x y z w
    velocity: wp.array(dtype=wp.vec3d)  # of the centre of mass [world units/s]
    momentum: wp.array(dtype=wp.vec3d)  # angular momentum, world frame; of kinematic objects angular velocity [rad/s]
    reach: wp.array(dtype=wp.vec4d)  # motion in a step, and reach beside it, for contacts ahead [world units]
    stuck: wp.array(dtype=wp.int32)  # FREE, STUCK, ON_TRIAL or STUCK_AGAIN
    # of one step
    inverse_inertia: wp.array(dtype=wp.mat33d)  # world frame; of kinematic objects the identity
    moved: wp.array(dtype=wp.vec3d)  # by how much the centre has moved [world units]
    turned: wp.array(dtype=wp.vec3d)  # rotation so far, sum of axis times angle [rad]
    impulse: wp.array(dtype=wp.vec3d)  # sum of the impulses that the next substep begins with
    moment: wp.array(dtype=wp.vec3d)  # sum of their moments about the centre of mass
    solved: wp.array(dtype=wp.vec3d)  # velocity that also takes it out of contact
    solved_momentum: wp.array(dtype=wp.vec3d)  # its angular momentum
    corrects: wp.array(dtype=wp.int32)  # whether a pair of it takes deep points apart, 0 or 1
    bid: wp.array(dtype=wp.int64)  # highest bid of the graph coloring
    colors: wp.array(dtype=wp.int32)  # bit mask of the colors that its pairs have
    uncolored: wp.array(dtype=wp.int32)  # how many of its pairs have none of their own
    relaxed: wp.array(dtype=wp.int32)  # how often its pairs have been relaxed
    is_whole: wp.array(dtype=wp.int32)  # entry 0: whether all contacts are known, 0 or 1; else bodies keep their state


@wp.func
def rotation_by(v: wp.vec3d):
    """Return the quaternion of a rotation vector, axis times twice the tangent of half the angle."""
    return wp.normalize(wp.quatd(HALF * v[0], HALF * v[1], HALF * v[2], ONE))


@wp.func
def integrate_rotation(q: wp.quatd, momentum: wp.vec3d, inverse_moment: wp.vec3d, dt: wp.float64):
    """Return the rotation of a free body after a time; its angular momentum [world frame] and energy are constant.

    In the body frame the implicit midpoint rule keeps all quadratic invariants of the momentum m. Where Newton's method
    fails, for turns by more than a radian, a turn about m keeps them as well.
    Source: Austin, Krishnaprasad and Wang 1993, Almost Poisson Integration of Rigid Body Systems.
    """
    size = wp.length(momentum)
    if size == ZERO or size == wp.float64(wp.inf):
        return q
    whole, direction = dt * size * inverse_moment, momentum / size
    angle = wp.length(wp.cw_mul(whole, wp.quat_rotate_inv(q, direction)))
    parts = wp.int32(wp.clamp(ONE + angle / PART, ONE, PARTS_MAX))
    part = wp.min(angle / wp.float64(parts), ONE)
    turn = ((ONE + part * part / wp.float64(12.0)) / wp.float64(parts)) * whole  # a tangent, see `rotation_by`
    change = HALF * wp.vec3d(turn[2] - turn[1], turn[0] - turn[2], turn[1] - turn[0])
    for _ in range(parts):
        m = wp.quat_rotate_inv(q, direction)
        x, iteration, left = wp.vec3d(m), wp.int32(0), wp.float64(1.0)
        while iteration < ITERATIONS_MAX and left > CONVERGED:
            u, v, w = change[0] * x, change[1] * x, change[2] * x
            slope = wp.mat33d(ONE, -u[2], -u[1], -v[2], ONE, -v[0], -w[1], -w[0], ONE)
            step = wp.inverse(slope) * (m + wp.vec3d(u[1] * x[2], v[2] * x[0], w[0] * x[1]) - x)
            x += step
            left = wp.dot(step, step)
            iteration += 1
        about = wp.cw_mul(turn, x)
        if not left <= CONVERGED:
            about = wp.min(wp.dot(wp.cw_mul(turn, m), m), TURN_MAX) * m
        q = q * rotation_by(about)
    return wp.normalize(q)


@wp.func
def world_inertia(q: wp.quatd, inverse_moment: wp.vec3d):
    """Return the inverse inertia of a body in the world frame."""
    r = wp.quat_to_matrix(q)
    return r * wp.diag(inverse_moment) * wp.transpose(r)


@wp.kernel
def judge_contacts_kernel(batch: PairBatch, hits: Hits, bodies_out: Bodies):
    """Note whether a query found all contacts within its capacity; one thread."""
    bodies_out.is_whole[0] = wp.where(is_whole(batch, hits), 1, 0)


@wp.kernel
def begin_step_kernel(dt: wp.float64, targets: ObjectPool, objects: ObjectPool, bodies_inout: Bodies):
    """Initialise a step: kinematic objects get velocities that take them to their targets."""
    i = wp.tid()
    if bodies_inout.is_whole[0] == 0:
        return
    bodies_inout.moved[i] = wp.vec3d()
    bodies_inout.turned[i] = wp.vec3d()
    bodies_inout.impulse[i] = wp.vec3d()
    bodies_inout.moment[i] = wp.vec3d()
    bodies_inout.bid[i] = wp.int64(0)
    bodies_inout.corrects[i] = 0
    bodies_inout.colors[i] = 0
    bodies_inout.uncolored[i] = 0
    bodies_inout.relaxed[i] = 0
    if bodies_inout.motion_type[i] == DYNAMIC:
        bodies_inout.inverse_inertia[i] = world_inertia(bodies_inout.rotation[i], bodies_inout.inverse_moment[i])
        return
    bodies_inout.position[i] = objects.position[i]
    if bodies_inout.motion_type[i] == KINEMATIC:
        axis, angle, _half = shortest_turn(targets.rotation[i] * wp.transpose(objects.rotation[i]))
        bodies_inout.velocity[i] = (targets.position[i] - objects.position[i]) / dt
        bodies_inout.momentum[i] = (wp.max(angle, ZERO) / dt) * axis
        bodies_inout.inverse_inertia[i] = wp.identity(n=3, dtype=wp.float64)


@wp.kernel
def keep_solved_kernel(bodies_inout: Bodies):
    """Keep the velocities of a body, solved and not relaxed yet."""
    i = wp.tid()
    bodies_inout.solved[i] = bodies_inout.velocity[i]
    bodies_inout.solved_momentum[i] = bodies_inout.momentum[i]


@wp.func
def without_gain(before: wp.quatd, after: wp.quatd, momentum: wp.vec3d, inverse_moment: wp.vec3d):
    """Return by what to scale a body's angular momentum after a turn that is not its own, to add no energy."""
    m, n = wp.quat_rotate_inv(before, momentum), wp.quat_rotate_inv(after, momentum)
    had, has = wp.dot(m, wp.cw_mul(inverse_moment, m)), wp.dot(n, wp.cw_mul(inverse_moment, n))
    return wp.where(has > had, wp.sqrt(had / has), ONE)


@wp.func
def move_object(i: wp.int32, h: wp.float64, bodies_inout: Bodies):
    """Move an object for a substep: by its velocity, unless it is a stuck body, and out of contact, without energy."""
    is_body = bodies_inout.motion_type[i] == DYNAMIC
    own = wp.where(is_body and (bodies_inout.stuck[i] & 1) != 0, ZERO, h)
    velocity, momentum, inertia = bodies_inout.velocity[i], bodies_inout.momentum[i], bodies_inout.inverse_inertia[i]
    step, turn = own * velocity, own * (inertia * momentum)
    if is_body:
        q, inverse = bodies_inout.rotation[i], bodies_inout.inverse_moment[i]
        after = integrate_rotation(q, momentum, inverse, own)
        if bodies_inout.corrects[i] != 0:
            more = h * (inertia * (bodies_inout.solved_momentum[i] - momentum))
            step += h * (bodies_inout.solved[i] - velocity)
            turn += more
            after = wp.normalize(rotation_by(more) * after)
            bodies_inout.momentum[i] = without_gain(q, after, momentum, inverse) * momentum
        bodies_inout.position[i] = bodies_inout.position[i] + step
        bodies_inout.rotation[i] = after
        bodies_inout.inverse_inertia[i] = world_inertia(after, inverse)
    bodies_inout.moved[i] = bodies_inout.moved[i] + step
    bodies_inout.turned[i] = bodies_inout.turned[i] + turn


@wp.kernel
def move_bodies_kernel(h: wp.float64, begins: wp.int32, velocity_change: wp.vec3d, bodies_inout: Bodies):
    """End a substep and begin the next: move objects, then change velocities by gravity and by the impulses summed up.

    Args:
        h: Length of the substep that ends, 0 where a step begins.
        begins: 1, or 0 where the step ends.
    """
    i = wp.tid()
    if bodies_inout.is_whole[0] == 0 or bodies_inout.motion_type[i] == STATIC:
        return
    if h > ZERO:
        move_object(i, h, bodies_inout)
    if begins != 0 and bodies_inout.motion_type[i] == DYNAMIC:
        change = velocity_change + bodies_inout.inverse_mass[i] * bodies_inout.impulse[i]
        bodies_inout.velocity[i] = bodies_inout.velocity[i] + change
        bodies_inout.momentum[i] = bodies_inout.momentum[i] + bodies_inout.moment[i]
        bodies_inout.impulse[i] = wp.vec3d()
        bodies_inout.moment[i] = wp.vec3d()


@wp.func
def slop_of(bodies: Bodies, pair: wp.vec2i):
    return wp.min(bodies.slop[pair[0]], bodies.slop[pair[1]])


@wp.func
def radius_of(bodies: Bodies, pair: wp.vec2i):
    """Return the smaller bounding radius of two bodies [world units]."""
    return wp.min(bodies.bounding_radius[pair[0]], bodies.bounding_radius[pair[1]])


@wp.func
def reach_of(bodies: Bodies, i: wp.int32, dt: wp.float64):
    """Return the motion of an object's centre in a step, and a bound on its surface's motion relative to that."""
    motion = dt * bodies.velocity[i]
    if bodies.motion_type[i] != DYNAMIC:
        return wp.vec4d(motion[0], motion[1], motion[2], ZERO)
    radius = bodies.bounding_radius[i]
    most = LOOKAHEAD_MAX * radius
    motion = motion * wp.min(most / wp.max(wp.length(motion), most), ONE)
    turn = dt * wp.length(bodies.inverse_inertia[i] * bodies.momentum[i]) * radius
    return wp.vec4d(motion[0], motion[1], motion[2], wp.min(turn, most) + LOOKAHEAD_LEAST * radius)


@wp.kernel
def pose_objects_kernel(dt: wp.float64, targets: ObjectPool, bodies_inout: Bodies, objects_inout: ObjectPool):
    """End a step: pose each body's object, or its goal."""
    i = wp.tid()
    if bodies_inout.is_whole[0] == 0:
        return
    bodies_inout.reach[i] = reach_of(bodies_inout, i, dt)
    if bodies_inout.motion_type[i] == KINEMATIC:
        objects_inout.rotation[i] = targets.rotation[i]
        objects_inout.position[i] = targets.position[i]
    if bodies_inout.motion_type[i] != DYNAMIC:
        return
    rotation = wp.quat_to_matrix(bodies_inout.rotation[i]) * wp.transpose(bodies_inout.axes[i])
    objects_inout.rotation[i] = rotation
    objects_inout.position[i] = bodies_inout.position[i] - rotation * bodies_inout.centre[i]
