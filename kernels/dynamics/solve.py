"""Relaxation of contact constraints: projected Gauss-Seidel (sequential impulses), one color of pairs after another.

Pairs of one color share no dynamic body, so one thread for all of them and a thread for each give the same bits.
"""

import warp as wp

from warp_abtree.kernels.contact.manifold import POINTS, Manifolds
from warp_abtree.kernels.dynamics.bodies import DYNAMIC, Bodies
from warp_abtree.kernels.dynamics.constraints import Constraints, Point, WarmStart, make_point, relative_velocity

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

RESTITUTION = wp.constant(0)
WARM_START = wp.constant(1)
VELOCITY = wp.constant(2)
POSITION = wp.constant(3)
"""Stages of a step: bounces, impulses of the step before, velocities, and the position correction."""

RESTITUTION_ROUNDS = wp.constant(12)
"""Rounds over the points of a pair that find the direction of a bounce."""


@wp.struct
class Relaxation:
    """What one launch relaxes."""

    stage: wp.int32  # RESTITUTION, WARM_START, VELOCITY or POSITION
    backward: wp.int32  # 1 if the first round goes from the last pair to the first
    first_color: wp.int32  # first color of the range
    last_color: wp.int32  # last color of the range
    rounds: wp.int32  # rounds over the range; more than 1 needs a single thread
    threads: wp.int32  # threads of the launch


@wp.func
def normal_velocity(constraints: Constraints, bodies: Bodies, c: Point):
    """Return the separation speed at a point."""
    return wp.dot(c.normal, relative_velocity(constraints, bodies, c))


@wp.func
def pseudo_velocity_at(bodies: Bodies, i: wp.int32, arm: wp.vec3d):
    """Return the pseudo-velocity of a body at the end of an arm."""
    return bodies.pseudo_velocity[i] + wp.cross(bodies.inverse_inertia[i] * bodies.pseudo_momentum[i], arm)


@wp.func
def normal_pseudo_velocity(constraints: Constraints, bodies: Bodies, c: Point):
    """Return the separation speed that the pseudo-velocities have at a point."""
    velocity = pseudo_velocity_at(bodies, c.b, constraints.arm_b[c.pair, c.column])
    return wp.dot(c.normal, velocity - pseudo_velocity_at(bodies, c.a, constraints.arm_a[c.pair, c.column]))


@wp.func
def apply_impulse(
    velocity: wp.array(dtype=wp.vec3d),
    momentum: wp.array(dtype=wp.vec3d),
    constraints: Constraints,
    bodies: Bodies,
    c: Point,
    impulse: wp.vec3d,
):
    """Apply an impulse to the second object of a point and its opposite to the first: to velocities, or pseudo ones."""
    if bodies.motion_type[c.a] == DYNAMIC:
        velocity[c.a] -= bodies.inverse_mass[c.a] * impulse
        momentum[c.a] -= wp.cross(constraints.arm_a[c.pair, c.column], impulse)
    if bodies.motion_type[c.b] == DYNAMIC:
        velocity[c.b] += bodies.inverse_mass[c.b] * impulse
        momentum[c.b] += wp.cross(constraints.arm_b[c.pair, c.column], impulse)


@wp.func
def solve_friction(constraints: Constraints, bodies: Bodies, c: Point, limit: wp.float64):
    """Stop the tangential velocity of a point, with an accumulated impulse of at most `limit`."""
    if constraints.friction[c.pair] == wp.float64(0.0):
        return
    t = constraints.tangent[c.pair, c.column]
    s = wp.cross(c.normal, t)
    velocity = relative_velocity(constraints, bodies, c)
    old = constraints.friction_impulse[c.pair, c.column]
    tangential = wp.vec2d(wp.dot(t, velocity), wp.dot(s, velocity))
    new = old - constraints.tangent_mass[c.pair, c.column] * tangential
    length = wp.length(new)
    if length > limit:
        new = new * (limit / length)
    constraints.friction_impulse[c.pair, c.column] = new
    apply_impulse(
        bodies.velocity, bodies.momentum, constraints, bodies, c, (new[0] - old[0]) * t + (new[1] - old[1]) * s
    )


@wp.func
def find_stopping_impulses(manifolds: Manifolds, constraints: Constraints, bodies: Bodies, pair: wp.vec2i, p: wp.int32):
    """Relax the impulses that stop the approach of a pair, and return the scale that makes them a reflection.

    The velocities stay: the change of velocity is accumulated as pseudo-velocity, which is zero before and after.
    """
    zero = wp.float64(0.0)
    round = wp.int32(0)
    while round < RESTITUTION_ROUNDS:
        for k in range(manifolds.count[p]):
            c = make_point(manifolds, pair, p, k)
            speed = normal_velocity(constraints, bodies, c) + normal_pseudo_velocity(constraints, bodies, c)
            before = constraints.impulse[p, k]
            constraints.impulse[p, k] = wp.max(before - constraints.mass[p, k] * speed, zero)
            change = (constraints.impulse[p, k] - before) * c.normal
            apply_impulse(bodies.pseudo_velocity, bodies.pseudo_momentum, constraints, bodies, c, change)
        round += 1
    approach = zero
    response = zero
    for k in range(manifolds.count[p]):
        c = make_point(manifolds, pair, p, k)
        approach -= constraints.impulse[p, k] * normal_velocity(constraints, bodies, c)
        response += constraints.impulse[p, k] * normal_pseudo_velocity(constraints, bodies, c)
    for side in range(2):
        if bodies.motion_type[pair[side]] == DYNAMIC:
            bodies.pseudo_velocity[pair[side]] = wp.vec3d()
            bodies.pseudo_momentum[pair[side]] = wp.vec3d()
    if response > zero:
        return (wp.float64(1.0) + constraints.restitution[p]) * wp.max(approach, zero) / response
    return zero


@wp.func
def apply_restitution(manifolds: Manifolds, constraints: Constraints, bodies: Bodies, pair: wp.vec2i, p: wp.int32):
    """Reflect the velocities of a pair that approaches faster than the threshold.

    The impulses that would stop the approach give the direction of the reflection. Their accuracy depends on the
    rounds, but a reflection in any direction, (1 + e) times the impulse that stops the motion along it, conserves
    energy for e = 1 and loses some for less. Friction acts afterwards on the sliding velocity, and loses some.
    Source: Smith et al. 2012, Reflections on Simultaneous Impact (generalized reflections), a pair at a time.
    """
    fastest = wp.float64(0.0)
    for k in range(manifolds.count[p]):
        fastest = wp.min(fastest, normal_velocity(constraints, bodies, make_point(manifolds, pair, p, k)))
        constraints.impulse[p, k] = wp.float64(0.0)
    if not (fastest < -constraints.threshold[p]):
        return
    scale = find_stopping_impulses(manifolds, constraints, bodies, pair, p)
    for k in range(manifolds.count[p]):
        c = make_point(manifolds, pair, p, k)
        apply_impulse(
            bodies.velocity, bodies.momentum, constraints, bodies, c, scale * constraints.impulse[p, k] * c.normal
        )
    for k in range(manifolds.count[p]):
        c = make_point(manifolds, pair, p, k)
        constraints.friction_impulse[p, k] = wp.vec2d()
        solve_friction(constraints, bodies, c, constraints.friction[p] * scale * constraints.impulse[p, k])


@wp.func
def apply_warm_start(warm_start: WarmStart, constraints: Constraints, bodies: Bodies, c: Point):
    """Apply the impulses of the point's match in the step before."""
    constraints.impulse[c.pair, c.column] = wp.float64(0.0)
    constraints.friction_impulse[c.pair, c.column] = wp.vec2d()
    match = constraints.match[c.pair, c.column]
    if match < 0:
        return
    row = match // POINTS
    column = match % POINTS
    t = constraints.tangent[c.pair, c.column]
    s = wp.cross(c.normal, t)
    impulse = warm_start.impulse[row, column]
    friction = warm_start.friction_impulse[row, column]
    v = wp.vec2d(wp.dot(friction, t), wp.dot(friction, s))
    constraints.impulse[c.pair, c.column] = impulse
    constraints.friction_impulse[c.pair, c.column] = v
    apply_impulse(bodies.velocity, bodies.momentum, constraints, bodies, c, impulse * c.normal + v[0] * t + v[1] * s)


@wp.func
def relax_velocity(constraints: Constraints, bodies: Bodies, c: Point):
    """Relax a point: the tangential velocity within the friction cone, then the normal velocity."""
    before = constraints.impulse[c.pair, c.column]
    solve_friction(constraints, bodies, c, constraints.friction[c.pair] * before)
    correction = constraints.mass[c.pair, c.column] * normal_velocity(constraints, bodies, c)
    after = wp.max(before - correction, wp.float64(0.0))
    constraints.impulse[c.pair, c.column] = after
    apply_impulse(bodies.velocity, bodies.momentum, constraints, bodies, c, (after - before) * c.normal)


@wp.func
def relax_position(constraints: Constraints, bodies: Bodies, c: Point):
    """Position correction (split impulse): apply a pseudo-velocity for the penetration that the velocity leaves.

    Without gravity two rigid bodies are not corrected, since that changes their angular momentum. Under gravity points
    that separate fast are not corrected, since lifting them adds energy.
    """
    zero = wp.float64(0.0)
    speed = normal_velocity(constraints, bodies, c)
    threshold = constraints.threshold[c.pair]
    if wp.where(threshold > zero, speed >= threshold, constraints.both_rigid[c.pair] != 0):
        return
    before = constraints.pseudo_impulse[c.pair, c.column]
    mass = constraints.mass[c.pair, c.column]
    bias = constraints.bias[c.pair, c.column]
    separation = normal_pseudo_velocity(constraints, bodies, c) + wp.max(speed, zero)
    after = before - mass * (separation - bias)
    # Resting contacts sink to the slop, where rounding does not break them; other points are never pulled.
    if threshold == zero or constraints.impulse[c.pair, c.column] <= zero:
        after = wp.max(before - mass * (separation - wp.max(bias, zero)), zero)
    constraints.pseudo_impulse[c.pair, c.column] = after
    change = (after - before) * c.normal
    apply_impulse(bodies.pseudo_velocity, bodies.pseudo_momentum, constraints, bodies, c, change)


@wp.kernel
def relax_kernel(
    # static
    relaxation: Relaxation,
    order: wp.array(dtype=wp.int32),
    color: wp.array(dtype=wp.int32),
    # state
    pairs: wp.array(dtype=wp.vec2i),
    manifolds: Manifolds,
    warm_start: WarmStart,
    constraints_inout: Constraints,
    bodies_inout: Bodies,
):
    """Relax the pairs of a range of colors, color by color; the threads of the launch share them.

    A single thread may take several colors and rounds. Velocity rounds alternate in direction, so that impulses travel
    through a stack both ways; all other stages go forward.

    Args:
        color, order: Colors in ascending order, and the pairs that have them.
    """
    room = order.shape[0] // 2
    stage = relaxation.stage
    start = wp.lower_bound(color, 0, room, relaxation.first_color)
    end = wp.lower_bound(color, 0, room, relaxation.last_color + 1)
    for round in range(relaxation.rounds):
        backward = wp.where(stage == VELOCITY, (relaxation.backward + round) % 2, 0)
        for turn in range(wp.tid(), end - start, relaxation.threads):
            p = order[wp.where(backward != 0, end - 1 - turn, start + turn)]
            if stage == RESTITUTION:
                apply_restitution(manifolds, constraints_inout, bodies_inout, pairs[p], p)
            else:
                for i in range(manifolds.count[p]):
                    k = wp.where(backward != 0, manifolds.count[p] - 1 - i, i)
                    c = make_point(manifolds, pairs[p], p, k)
                    if stage == WARM_START:
                        apply_warm_start(warm_start, constraints_inout, bodies_inout, c)
                    elif stage == VELOCITY:
                        relax_velocity(constraints_inout, bodies_inout, c)
                    else:
                        relax_position(constraints_inout, bodies_inout, c)
