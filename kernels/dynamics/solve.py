"""Relaxation of contact constraints: projected Gauss-Seidel (sequential impulses), one color of pairs after another.

Pairs of one color share no dynamic body, so one thread for all of them and a thread for each give the same bits.
"""

import warp as wp

from warp_abtree.kernels.contact.manifold import Manifolds
from warp_abtree.kernels.dynamics.bodies import DYNAMIC, Bodies
from warp_abtree.kernels.dynamics.constraints import Constraints, Point, make_point, relative_velocity

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WARM_START = wp.constant(0)
VELOCITY = wp.constant(1)
POSITION = wp.constant(2)
"""Stages of a step: impulses of the step before, velocities, and the position correction."""


@wp.struct
class Relaxation:
    """What one launch relaxes."""

    stage: wp.int32  # WARM_START, VELOCITY or POSITION
    backward: wp.int32  # 1 if the first round goes from the last pair to the first
    first_color: wp.int32  # first color of the range
    last_color: wp.int32  # last color of the range
    rounds: wp.int32  # rounds over the range; more than 1 needs a single thread
    threads: wp.int32  # threads of the launch
    friction: wp.float64  # coefficient of Coulomb's law
    fast: wp.float64  # separation speed of points whose position is not corrected [world units/s]; 0 without gravity


@wp.func
def normal_velocity(constraints: Constraints, bodies: Bodies, c: Point):
    """Return the separation speed at a point."""
    return wp.dot(c.normal, relative_velocity(bodies.velocity, bodies.momentum, constraints, bodies, c))


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
def apply_warm_start(constraints: Constraints, bodies: Bodies, c: Point):
    """Apply the impulses that a point has from the step before."""
    impulse = constraints.impulse[c.pair, c.column] * c.normal + constraints.friction_impulse[c.pair, c.column]
    apply_impulse(bodies.velocity, bodies.momentum, constraints, bodies, c, impulse)


@wp.func
def relax_velocity(constraints: Constraints, bodies: Bodies, c: Point, friction: wp.float64):
    """Relax a point: the tangential velocity within the friction cone, then the normal velocity."""
    before = constraints.impulse[c.pair, c.column]
    velocity = relative_velocity(bodies.velocity, bodies.momentum, constraints, bodies, c)
    old = constraints.friction_impulse[c.pair, c.column]
    new = old - constraints.tangent_mass[c.pair, c.column] * velocity
    length = wp.length(new)
    if length > friction * before:
        new = new * (friction * before / length)
    constraints.friction_impulse[c.pair, c.column] = new
    apply_impulse(bodies.velocity, bodies.momentum, constraints, bodies, c, new - old)
    correction = constraints.mass[c.pair, c.column] * normal_velocity(constraints, bodies, c)
    after = wp.max(before - correction, wp.float64(0.0))
    constraints.impulse[c.pair, c.column] = after
    apply_impulse(bodies.velocity, bodies.momentum, constraints, bodies, c, (after - before) * c.normal)


@wp.func
def relax_position(constraints: Constraints, bodies: Bodies, c: Point, fast: wp.float64):
    """Position correction (split impulse): apply a pseudo-velocity for the penetration that the velocity leaves.

    Without gravity two rigid bodies are not corrected, since that changes their angular momentum. Under gravity points
    that separate fast are not corrected, since lifting them adds energy.
    """
    zero = wp.float64(0.0)
    speed = normal_velocity(constraints, bodies, c)
    both_rigid = bodies.motion_type[c.a] == DYNAMIC and bodies.motion_type[c.b] == DYNAMIC
    if (fast > zero and speed >= fast) or (fast == zero and both_rigid):
        return
    before = constraints.pseudo_impulse[c.pair, c.column]
    mass = constraints.mass[c.pair, c.column]
    bias = constraints.bias[c.pair, c.column]
    pseudo = relative_velocity(bodies.pseudo_velocity, bodies.pseudo_momentum, constraints, bodies, c)
    separation = wp.dot(c.normal, pseudo) + wp.max(speed, zero)
    after = before - mass * (separation - bias)
    # Resting contacts sink to the slop, where rounding does not break them; other points are never pulled.
    if fast == zero or constraints.impulse[c.pair, c.column] <= zero:
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
    constraints_inout: Constraints,
    bodies_inout: Bodies,
):
    """Relax the pairs of a range of colors, color by color; the threads of the launch share them.

    A single thread may take several colors and rounds. Velocity rounds alternate in direction, so that impulses travel
    through a stack both ways; all other stages go forward.

    Args:
        color, order: Colors in ascending order, and the pairs that have them.
    """
    if bodies_inout.is_whole[0] == 0:
        return
    room = order.shape[0] // 2
    stage = relaxation.stage
    start = wp.lower_bound(color, 0, room, relaxation.first_color)
    end = wp.lower_bound(color, 0, room, relaxation.last_color + 1)
    for round in range(relaxation.rounds):
        backward = wp.where(stage == VELOCITY, (relaxation.backward + round) % 2, 0)
        for turn in range(wp.tid(), end - start, relaxation.threads):
            p = order[wp.where(backward != 0, end - 1 - turn, start + turn)]
            for i in range(manifolds.count[p]):
                k = wp.where(backward != 0, manifolds.count[p] - 1 - i, i)
                c = make_point(manifolds, pairs[p], p, k)
                if stage == WARM_START:
                    apply_warm_start(constraints_inout, bodies_inout, c)
                elif stage == VELOCITY:
                    relax_velocity(constraints_inout, bodies_inout, c, relaxation.friction)
                else:
                    relax_position(constraints_inout, bodies_inout, c, relaxation.fast)
