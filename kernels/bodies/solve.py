"""Relaxation of contact constraints: projected Gauss-Seidel (sequential impulses), one color of pairs after another.

A step has substeps, each of which begins with the impulses of the one before, solves for velocities that also take
penetrating points apart, moves the bodies, and relaxes: removes what took points apart from the velocities again.
Points that penetrate are springs, stiff for the length of a substep, so that a stack finds its balance.
Source: Macklin et al. 2019, Small Steps in Physics Simulation; Catto 2024, Solver2D ("soft step").

Pairs of one color share no dynamic body, so one thread for all of them and a thread for each give the same bits.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import block_sync
from warp_abtree.kernels.base.poses import HALF, PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, ONE, ZERO, Bodies
from warp_abtree.kernels.bodies.constraints import Constraints
from warp_abtree.kernels.bodies.graph_coloring import COLOR_COUNT
from warp_abtree.kernels.contacts.manifold import Manifolds

wp.set_module_options(native.options("base/lanes.cuh"))

WARM_START = wp.constant(0)
SOLVE = wp.constant(1)
RELAX = wp.constant(2)
"""Stages, each a pass over the contacts. WARM_START only sums up the impulses that the first substep begins with."""

_FREQUENCY = 1.0  # angle that a point's spring would swing by in a substep [rad]
_RESPONSE = 2.0 * 10.0 + _FREQUENCY  # twice its damping ratio, and that
RECOVERY = wp.constant(wp.float64(_FREQUENCY / _RESPONSE))
"""Part of the penetration that its spring corrects in a substep."""

SOFTNESS = wp.constant(wp.float64(1.0 / (1.0 + _FREQUENCY * _RESPONSE)))
"""Part of the impulse that it gives up."""

VISITS_LEAST, VISITS_MAX = wp.constant(3), wp.constant(64)
"""How often the points of a pair are relaxed before the next pair; more than the least while speeds change much."""

SETTLED = wp.constant(wp.float64(2.0**-6))
SETTLED_IMPACT = wp.constant(wp.float64(2.0**-30))
"""Change of speed that is not much: part of `fast`, or of the speed at which points meet."""


@wp.struct
class Relaxation:
    """Parameters of a pass."""

    stage: wp.int32  # WARM_START, SOLVE or RELAX
    backward: wp.int32  # 1 if it goes from the last pair to the first
    first_color: wp.int32  # first color of the range
    last_color: wp.int32  # last color of the range
    threads: wp.int32  # threads of the launch; one block where there are several colors
    friction: wp.float64  # coefficient of Coulomb's law
    fast: wp.float64  # speed from which on points that meet strike [world units/s]; 0 without gravity
    rest: wp.float64  # depth at which points rest, in slops
    per_substep: wp.float64  # substeps a second
    correction: wp.float64  # part of the penetration that is corrected a second, however deep [1/s]


@wp.struct
class Side:
    """One object of a pair, while its points are relaxed."""

    is_dynamic: wp.bool  # whether impulses move it
    inverse_mass: wp.float64  # [1 / mass]
    inverse_inertia: wp.mat33d  # world frame
    moved: wp.vec3d  # by how much its centre has moved in the step [world units]
    turned: wp.vec3d  # rotation in the step, axis times angle [rad]


@wp.struct
class BodyMotion:
    """Motion of an object, with as much of it as changes in a pass."""

    velocity: wp.vec3d  # of the centre of mass [world units/s]
    angular_velocity: wp.vec3d  # world frame [rad/s]
    momentum: wp.vec3d  # angular momentum, world frame


@wp.func
def load_side(bodies: Bodies, i: wp.int32):
    side = Side()
    side.is_dynamic = bodies.motion_type[i] == DYNAMIC
    side.inverse_mass = bodies.inverse_mass[i]
    side.inverse_inertia = bodies.inverse_inertia[i]
    side.moved = bodies.moved[i]
    side.turned = bodies.turned[i]
    return side


@wp.func
def load_motion(bodies: Bodies, i: wp.int32):
    motion = BodyMotion()
    motion.velocity = bodies.velocity[i]
    motion.momentum = bodies.momentum[i]
    motion.angular_velocity = bodies.inverse_inertia[i] * motion.momentum
    return motion


@wp.func
def store_motion(side: Side, motion: BodyMotion, bodies: Bodies, i: wp.int32):
    if side.is_dynamic:
        bodies.velocity[i] = motion.velocity
        bodies.momentum[i] = motion.momentum


@wp.func
def push(side: Side, motion: BodyMotion, arm: wp.vec3d, impulse: wp.vec3d):
    """Return the motion of an object after an impulse at the end of an arm."""
    if not side.is_dynamic:
        return motion
    moment = wp.cross(arm, impulse)
    after = BodyMotion()
    after.velocity = motion.velocity + side.inverse_mass * impulse
    after.momentum = motion.momentum + moment
    after.angular_velocity = motion.angular_velocity + side.inverse_inertia * moment
    return after


@wp.func
def relative_velocity(motion_a: BodyMotion, motion_b: BodyMotion, arm_a: wp.vec3d, arm_b: wp.vec3d):
    """Return the velocity of the second object relative to the first where their arms end."""
    at_a = motion_a.velocity + wp.cross(motion_a.angular_velocity, arm_a)
    return motion_b.velocity + wp.cross(motion_b.angular_velocity, arm_b) - at_a


@wp.func
def mobility(side: Side, arm: wp.vec3d, direction: wp.vec3d):
    """Return the speed along a direction that a unit impulse along it gives an object where its arm ends."""
    moment = wp.cross(arm, direction)
    return wp.where(side.is_dynamic, side.inverse_mass + wp.dot(moment, side.inverse_inertia * moment), ZERO)


@wp.func
def approach_of(relaxation: Relaxation, corrects: bool, slop: wp.float64, room: wp.float64):
    """Return at what speed a point may approach [world units/s], below 0 if it is to separate.

    Args:
        corrects: Whether points that are too deep are to separate.
        room: How far it may approach [world units], below 0 if it is too deep.
    """
    if room >= ZERO:
        return relaxation.per_substep * room
    if not corrects:
        return ZERO
    return wp.min(RECOVERY * relaxation.per_substep * wp.max(room, -slop), relaxation.correction * room)


@wp.func
def friction_of(
    a: Side, b: Side, arm_a: wp.vec3d, arm_b: wp.vec3d, most: wp.float64, impulse: wp.vec3d, slide: wp.vec3d
):
    """Return the friction impulse of a point that stops its tangential velocity `slide`, cut to `most`."""
    if most <= ZERO:
        return wp.vec3d()
    direction = wp.normalize(slide)
    wanted = impulse - slide / (mobility(a, arm_a, direction) + mobility(b, arm_b, direction))
    length = wp.length(wanted)
    if length > most:
        wanted = wanted * (most / length)
    return wanted


@wp.func
def point_of_turn(i: wp.int32, count: wp.int32, backward: wp.int32):
    return wp.where(backward != 0, count - 1 - i, i)


@wp.func
def relax_pair(
    relaxation: Relaxation, p: wp.int32, pair: wp.vec2i, manifolds: Manifolds, constraints: Constraints, bodies: Bodies
):
    """Relax the points of a pair: the normal velocity, then the tangential one within the friction cone.

    The motion of both objects stays in registers meanwhile. The points are relaxed several times, until they agree.
    An impulse acts on both objects at one place, in the middle of where they have taken the point: no momentum is lost.
    """
    stage, count, slop = relaxation.stage, manifolds.count[p], constraints.slop[p]
    a = load_side(bodies, pair[0])
    b = load_side(bodies, pair[1])
    motion_a = load_motion(bodies, pair[0])
    motion_b = load_motion(bodies, pair[1])
    shift = b.moved - a.moved
    # Without gravity two rigid bodies are not pushed apart, which would add energy.
    corrects = stage == SOLVE and (relaxation.fast > ZERO or not (a.is_dynamic and b.is_dynamic))
    settled = SETTLED * relaxation.fast
    struck = wp.where(stage == RELAX, constraints.is_struck[p], 0)
    visit = wp.int32(0)
    while visit < VISITS_MAX:
        change = wp.float64(0.0)
        for i in range(count):
            k = point_of_turn(i, count, relaxation.backward)
            normal = manifolds.normal[p, k]
            first_a, first_b = constraints.arm_a[p, k], constraints.arm_b[p, k]
            moved = shift + wp.cross(b.turned, first_b) - wp.cross(a.turned, first_a)
            arm_a = first_a + HALF * shift
            arm_b = first_b - HALF * shift
            along = constraints.impulse[p, k]
            across = constraints.friction_impulse[p, k]
            room = relaxation.rest * slop - manifolds.depth[p, k] + wp.dot(normal, moved)
            speed = wp.dot(normal, relative_velocity(motion_a, motion_b, arm_a, arm_b))
            excess = speed + approach_of(relaxation, corrects, slop, room)
            if visit == 0:
                settled = wp.max(settled, -SETTLED_IMPACT * speed)
                struck = wp.where(speed < -relaxation.fast, 1, struck)
            if along > ZERO or excess < ZERO or wp.length_sq(across) > ZERO:
                soft = wp.where(corrects and room < ZERO and struck == 0, SOFTNESS, ZERO)
                mass = ONE / (mobility(a, arm_a, normal) + mobility(b, arm_b, normal))
                after = wp.max(along - soft * along - (ONE - soft) * mass * excess, ZERO)
                change = wp.max(change, wp.abs(after - along) / mass)
                motion_a = push(a, motion_a, arm_a, (along - after) * normal)
                motion_b = push(b, motion_b, arm_b, (after - along) * normal)
                along = after
                # What is still to come near has no friction yet.
                most = wp.where(room > slop, ZERO, relaxation.friction * along)
                slide = relative_velocity(motion_a, motion_b, arm_a, arm_b)
                wanted = friction_of(a, b, arm_a, arm_b, most, across, slide - wp.dot(normal, slide) * normal)
                motion_a = push(a, motion_a, arm_a, across - wanted)
                motion_b = push(b, motion_b, arm_b, wanted - across)
                across = wanted
                constraints.impulse[p, k] = along
                constraints.friction_impulse[p, k] = across
        visit += 1
        if visit >= VISITS_LEAST and change <= settled:
            visit = VISITS_MAX
    constraints.is_struck[p] = struck
    store_motion(a, motion_a, bodies, pair[0])
    store_motion(b, motion_b, bodies, pair[1])


@wp.func
def hand_on_impulses(p: wp.int32, pair: wp.vec2i, manifolds: Manifolds, constraints: Constraints, bodies: Bodies):
    """Add the impulses of a pair's points to what the next substep begins with, but for those that stopped an impact.

    These are not what the next substep needs: little of them may lift a body.
    """
    impulse = wp.vec3d()
    moment_a = wp.vec3d()
    moment_b = wp.vec3d()
    half = HALF * (bodies.moved[pair[1]] - bodies.moved[pair[0]])
    for k in range(manifolds.count[p]):
        if constraints.is_struck[p] != 0:
            constraints.impulse[p, k] = ZERO
            constraints.friction_impulse[p, k] = wp.vec3d()
        of_point = constraints.impulse[p, k] * manifolds.normal[p, k] + constraints.friction_impulse[p, k]
        impulse += of_point
        moment_a += wp.cross(constraints.arm_a[p, k] + half, of_point)
        moment_b += wp.cross(constraints.arm_b[p, k] - half, of_point)
    if bodies.motion_type[pair[0]] == DYNAMIC:
        bodies.impulse[pair[0]] -= impulse
        bodies.moment[pair[0]] -= moment_a
    if bodies.motion_type[pair[1]] == DYNAMIC:
        bodies.impulse[pair[1]] += impulse
        bodies.moment[pair[1]] += moment_b


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

    One thread relaxes the pairs without a color of their own.

    Args:
        color, order: Colors in ascending order, and the pairs that have them.
    """
    if bodies_inout.is_whole[0] == 0:
        return
    room = order.shape[0] // 2
    backward = relaxation.backward
    colors = relaxation.last_color - relaxation.first_color + 1
    for step in range(colors):
        c = relaxation.first_color + point_of_turn(step, colors, backward)
        start = wp.lower_bound(color, 0, room, c)
        end = wp.lower_bound(color, 0, room, c + 1)
        threads = wp.where(c == COLOR_COUNT, 1, relaxation.threads)
        if wp.tid() < threads:
            for turn in range(wp.tid(), end - start, threads):
                p = order[wp.where(backward != 0, end - 1 - turn, start + turn)]
                if relaxation.stage != WARM_START:
                    relax_pair(relaxation, p, batch.pairs[p], manifolds, constraints_inout, bodies_inout)
                if relaxation.stage != SOLVE:
                    hand_on_impulses(p, batch.pairs[p], manifolds, constraints_inout, bodies_inout)
        if colors > 1:
            block_sync()
