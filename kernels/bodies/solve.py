"""Relaxation of contact constraints: projected Gauss-Seidel (sequential impulses), one color of pairs after another.

Pairs of one color share no dynamic body, so one thread for all of them and a thread for each give the same bits.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import block_sync
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies
from warp_abtree.kernels.bodies.constraints import Constraints, point_velocity
from warp_abtree.kernels.bodies.graph_coloring import COLOR_COUNT
from warp_abtree.kernels.contacts.manifold import Manifolds

wp.set_module_options(native.options("base/lanes.cuh"))

WARM_START = wp.constant(0)
VELOCITY = wp.constant(1)
POSITION = wp.constant(2)
"""Stages of a step: impulses of the step before, velocities, and the position correction."""


@wp.struct
class Relaxation:
    """Parameters of one relaxation launch."""

    stage: wp.int32  # WARM_START, VELOCITY or POSITION
    backward: wp.int32  # 1 if the first round goes from the last pair to the first
    first_color: wp.int32  # first color of the range
    last_color: wp.int32  # last color of the range
    rounds: wp.int32  # rounds over the range
    threads: wp.int32  # threads of the launch; one block where there are several colors or rounds
    friction: wp.float64  # coefficient of Coulomb's law
    fast: wp.float64  # separation speed of points whose position is not corrected [world units/s]; 0 without gravity


@wp.struct
class Side:
    """Constants of a pair's object while its points are relaxed."""

    is_dynamic: wp.bool  # whether impulses move it
    inverse_mass: wp.float64  # [1 / mass]
    inverse_inertia: wp.mat33d  # world frame


@wp.func
def load_side(bodies: Bodies, i: wp.int32):
    side = Side()
    side.is_dynamic = bodies.motion_type[i] == DYNAMIC
    side.inverse_mass = bodies.inverse_mass[i]
    side.inverse_inertia = bodies.inverse_inertia[i]
    return side


@wp.func
def push_velocity(side: Side, velocity: wp.vec3d, impulse: wp.vec3d):
    """Return the velocity of the centre of mass after an impulse."""
    if side.is_dynamic:
        return velocity + side.inverse_mass * impulse
    return velocity


@wp.func
def push_momentum(side: Side, momentum: wp.vec3d, arm: wp.vec3d, impulse: wp.vec3d):
    """Return the angular momentum after an impulse at the end of an arm."""
    if side.is_dynamic:
        return momentum + wp.cross(arm, impulse)
    return momentum


@wp.func
def point_of_turn(i: wp.int32, count: wp.int32, backward: wp.int32):
    return wp.where(backward != 0, count - 1 - i, i)


@wp.func
def apply_warm_start(p: wp.int32, pair: wp.vec2i, manifolds: Manifolds, constraints: Constraints, bodies: Bodies):
    """Apply the impulses that the points of a pair have from the step before."""
    a = load_side(bodies, pair[0])
    b = load_side(bodies, pair[1])
    velocity_a = bodies.velocity[pair[0]]
    velocity_b = bodies.velocity[pair[1]]
    momentum_a = bodies.momentum[pair[0]]
    momentum_b = bodies.momentum[pair[1]]
    for k in range(manifolds.count[p]):
        impulse = constraints.impulse[p, k] * manifolds.normal[p, k] + constraints.friction_impulse[p, k]
        velocity_a = push_velocity(a, velocity_a, -impulse)
        momentum_a = push_momentum(a, momentum_a, constraints.arm_a[p, k], -impulse)
        velocity_b = push_velocity(b, velocity_b, impulse)
        momentum_b = push_momentum(b, momentum_b, constraints.arm_b[p, k], impulse)
    store_motion(a, pair[0], velocity_a, momentum_a, bodies.velocity, bodies.momentum)
    store_motion(b, pair[1], velocity_b, momentum_b, bodies.velocity, bodies.momentum)


@wp.func
def store_motion(
    side: Side,
    i: wp.int32,
    velocity: wp.vec3d,
    momentum: wp.vec3d,
    velocity_out: wp.array(dtype=wp.vec3d),
    momentum_out: wp.array(dtype=wp.vec3d),
):
    if side.is_dynamic:
        velocity_out[i] = velocity
        momentum_out[i] = momentum


@wp.struct
class VelocityContact:
    """A contact point while the velocities of its pair are relaxed."""

    normal: wp.vec3d  # from the first to the second object
    arm_a: wp.vec3d  # from the centre of mass of the first body
    arm_b: wp.vec3d  # from that of the second
    mass: wp.float64  # effective mass along the normal
    tangent_mass: wp.mat33d  # effective mass across it, world frame
    approach: wp.float64  # speed at which its points may approach [world units/s]
    impulse: wp.float64  # accumulated, along the normal
    friction_impulse: wp.vec3d  # accumulated, across it


@wp.func
def load_contact(manifolds: Manifolds, constraints: Constraints, p: wp.int32, k: wp.int32):
    c = VelocityContact()
    c.normal = manifolds.normal[p, k]
    c.arm_a = constraints.arm_a[p, k]
    c.arm_b = constraints.arm_b[p, k]
    c.mass = constraints.mass[p, k]
    c.tangent_mass = constraints.tangent_mass[p, k]
    c.approach = constraints.approach[p, k]
    c.impulse = constraints.impulse[p, k]
    c.friction_impulse = constraints.friction_impulse[p, k]
    return c


@wp.func
def relax_velocities(
    relaxation: Relaxation,
    p: wp.int32,
    pair: wp.vec2i,
    backward: wp.int32,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
):
    """Relax the points of a pair: the tangential velocity within the friction cone, then the normal velocity.

    The motion of both objects stays in registers meanwhile, and each point is loaded while the one before is relaxed.
    """
    a = load_side(bodies, pair[0])
    b = load_side(bodies, pair[1])
    velocity_a = bodies.velocity[pair[0]]
    velocity_b = bodies.velocity[pair[1]]
    momentum_a = bodies.momentum[pair[0]]
    momentum_b = bodies.momentum[pair[1]]
    count = manifolds.count[p]
    following = load_contact(manifolds, constraints, p, point_of_turn(0, count, backward))
    for i in range(count):
        k = point_of_turn(i, count, backward)
        c = following
        following = load_contact(manifolds, constraints, p, point_of_turn(wp.min(i + 1, count - 1), count, backward))
        at_a = point_velocity(a.inverse_inertia, velocity_a, momentum_a, c.arm_a)
        at_b = point_velocity(b.inverse_inertia, velocity_b, momentum_b, c.arm_b)
        new = c.friction_impulse - c.tangent_mass * (at_b - at_a)
        length = wp.length(new)
        if length > relaxation.friction * c.impulse:
            new = new * (relaxation.friction * c.impulse / length)
        constraints.friction_impulse[p, k] = new
        impulse = new - c.friction_impulse
        velocity_a = push_velocity(a, velocity_a, -impulse)
        momentum_a = push_momentum(a, momentum_a, c.arm_a, -impulse)
        velocity_b = push_velocity(b, velocity_b, impulse)
        momentum_b = push_momentum(b, momentum_b, c.arm_b, impulse)
        at_a = point_velocity(a.inverse_inertia, velocity_a, momentum_a, c.arm_a)
        at_b = point_velocity(b.inverse_inertia, velocity_b, momentum_b, c.arm_b)
        after = wp.max(c.impulse - c.mass * (wp.dot(c.normal, at_b - at_a) + c.approach), wp.float64(0.0))
        constraints.impulse[p, k] = after
        impulse = (after - c.impulse) * c.normal
        velocity_a = push_velocity(a, velocity_a, -impulse)
        momentum_a = push_momentum(a, momentum_a, c.arm_a, -impulse)
        velocity_b = push_velocity(b, velocity_b, impulse)
        momentum_b = push_momentum(b, momentum_b, c.arm_b, impulse)
    store_motion(a, pair[0], velocity_a, momentum_a, bodies.velocity, bodies.momentum)
    store_motion(b, pair[1], velocity_b, momentum_b, bodies.velocity, bodies.momentum)


@wp.struct
class Overlap:
    """A contact point while the positions of its pair are corrected."""

    normal: wp.vec3d  # from the first to the second object
    arm_a: wp.vec3d  # from the centre of mass of the first body
    arm_b: wp.vec3d  # from that of the second
    mass: wp.float64  # effective mass along the normal
    bias: wp.float64  # separation speed aimed for [world units/s]
    approach: wp.float64  # speed at which its points may approach [world units/s]
    pseudo_impulse: wp.float64  # accumulated, of the correction


@wp.func
def load_overlap(manifolds: Manifolds, constraints: Constraints, p: wp.int32, k: wp.int32):
    c = Overlap()
    c.normal = manifolds.normal[p, k]
    c.arm_a = constraints.arm_a[p, k]
    c.arm_b = constraints.arm_b[p, k]
    c.mass = constraints.mass[p, k]
    c.bias = constraints.bias[p, k]
    c.approach = constraints.approach[p, k]
    c.pseudo_impulse = constraints.pseudo_impulse[p, k]
    return c


@wp.func
def relax_positions(
    relaxation: Relaxation,
    p: wp.int32,
    pair: wp.vec2i,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
):
    """Position correction (split impulse): apply a pseudo-velocity for the penetration that the velocity leaves.

    Without gravity two rigid bodies are not corrected, since that changes their angular momentum. Under gravity points
    that separate fast are not corrected, since lifting them adds energy.
    """
    zero = wp.float64(0.0)
    fast = relaxation.fast
    a = load_side(bodies, pair[0])
    b = load_side(bodies, pair[1])
    if fast == zero and a.is_dynamic and b.is_dynamic:
        return
    # Of these the stage changes nothing.
    velocity_a = bodies.velocity[pair[0]]
    velocity_b = bodies.velocity[pair[1]]
    momentum_a = bodies.momentum[pair[0]]
    momentum_b = bodies.momentum[pair[1]]
    pseudo_a = bodies.pseudo_velocity[pair[0]]
    pseudo_b = bodies.pseudo_velocity[pair[1]]
    angular_a = bodies.pseudo_momentum[pair[0]]
    angular_b = bodies.pseudo_momentum[pair[1]]
    count = manifolds.count[p]
    following = load_overlap(manifolds, constraints, p, 0)
    for k in range(count):
        c = following
        following = load_overlap(manifolds, constraints, p, wp.min(k + 1, count - 1))
        at_a = point_velocity(a.inverse_inertia, velocity_a, momentum_a, c.arm_a)
        at_b = point_velocity(b.inverse_inertia, velocity_b, momentum_b, c.arm_b)
        speed = wp.dot(c.normal, at_b - at_a)
        if not (fast > zero and speed >= fast):
            at_a = point_velocity(a.inverse_inertia, pseudo_a, angular_a, c.arm_a)
            at_b = point_velocity(b.inverse_inertia, pseudo_b, angular_b, c.arm_b)
            separation = wp.dot(c.normal, at_b - at_a) + wp.max(speed, zero)
            wanted = wp.max(c.bias, zero) - c.approach
            after = wp.max(c.pseudo_impulse - c.mass * (separation - wanted), zero)
            constraints.pseudo_impulse[p, k] = after
            impulse = (after - c.pseudo_impulse) * c.normal
            pseudo_a = push_velocity(a, pseudo_a, -impulse)
            angular_a = push_momentum(a, angular_a, c.arm_a, -impulse)
            pseudo_b = push_velocity(b, pseudo_b, impulse)
            angular_b = push_momentum(b, angular_b, c.arm_b, impulse)
    store_motion(a, pair[0], pseudo_a, angular_a, bodies.pseudo_velocity, bodies.pseudo_momentum)
    store_motion(b, pair[1], pseudo_b, angular_b, bodies.pseudo_velocity, bodies.pseudo_momentum)


@wp.kernel
def relax_kernel(
    relaxation: Relaxation,
    order: wp.array(dtype=wp.int32),
    color: wp.array(dtype=wp.int32),
    batch: PairBatch,
    manifolds: Manifolds,
    constraints_inout: Constraints,
    bodies_inout: Bodies,
):
    """Relax the pairs of a range of colors, color by color; the threads of the launch share those of a color.

    Velocity rounds alternate in direction, so that impulses travel through a stack both ways; all other stages go
    forward. One thread relaxes the pairs without a color of their own.

    Args:
        color, order: Colors in ascending order, and the pairs that have them.
    """
    if bodies_inout.is_whole[0] == 0:
        return
    room = order.shape[0] // 2
    stage = relaxation.stage
    colors = relaxation.last_color - relaxation.first_color + 1
    for step in range(relaxation.rounds * colors):
        backward = wp.where(stage == VELOCITY, (relaxation.backward + step / colors) % 2, 0)
        c = relaxation.first_color + point_of_turn(step % colors, colors, backward)
        start = wp.lower_bound(color, 0, room, c)
        end = wp.lower_bound(color, 0, room, c + 1)
        threads = wp.where(c == COLOR_COUNT, 1, relaxation.threads)
        if wp.tid() < threads:
            for turn in range(wp.tid(), end - start, threads):
                p = order[wp.where(backward != 0, end - 1 - turn, start + turn)]
                if stage == WARM_START:
                    apply_warm_start(p, batch.pairs[p], manifolds, constraints_inout, bodies_inout)
                elif stage == VELOCITY:
                    relax_velocities(
                        relaxation, p, batch.pairs[p], backward, manifolds, constraints_inout, bodies_inout
                    )
                else:
                    relax_positions(relaxation, p, batch.pairs[p], manifolds, constraints_inout, bodies_inout)
        if colors > 1:
            block_sync()
