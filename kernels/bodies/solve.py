"""Relaxation of contact constraints: projected Gauss-Seidel (sequential impulses), one color of pairs after another.

A step has substeps, each of which begins with the impulses of the one before, solves for velocities that also take
penetrating points apart, moves the bodies, and relaxes: removes what took points apart from the velocities again.
Points that penetrate are springs, stiff for the length of a substep, so that a stack finds its balance.
Source: Macklin et al. 2019, Small Steps in Physics Simulation; Catto 2024, Solver2D ("soft step").

Pairs of one color share no dynamic body, so one thread for all of them and a thread for each give the same bits.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import (
    block_sync,
    resolve_lane,
    vector64_of_lane,
    warp_any,
    warp_max,
    warp_size,
    warp_sync,
)
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

VISITS_LEAST, VISITS_USUAL, VISITS_MAX = wp.constant(3), wp.constant(5), wp.constant(64)
"""How often a pass relaxes the points of a pair before the next pair: more than the least while speeds change much, at
most as usual, and once more for each doubling of a hard impact."""

SETTLED = wp.constant(wp.float64(2.0**-6))
"""Change of speed that is not much, as a part of `fast`."""

HARD = wp.constant(wp.float64(2.0**-3))
"""Part of the speed of an impact that, if fast, makes it hard."""


@wp.struct
class Relaxation:
    """Parameters of a pass."""

    stage: wp.int32  # WARM_START, SOLVE or RELAX
    backward: wp.int32  # 1 if it goes from the last pair to the first
    first_color: wp.int32  # first color of the range
    last_color: wp.int32  # last color of the range
    warps: wp.int32  # warps of the launch; one block where there are several colors
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


@wp.struct
class RelaxedPoint:
    """A point of a pair while it is relaxed."""

    normal: wp.vec3d  # from the first object to the second
    arm_a: wp.vec3d  # from the centre of mass of the first object to where its impulses act
    arm_b: wp.vec3d  # from that of the second
    response: wp.vec3d  # velocity that a unit impulse along the normal gives
    mass: wp.float64  # impulse along the normal that a unit of speed along it takes
    room: wp.float64  # how far it may approach [world units], below 0 if it is too deep
    along: wp.float64  # impulse along the normal
    across: wp.vec3d  # across it, world frame


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
def push(side: Side, motion: BodyMotion, impulse: wp.vec3d, moment: wp.vec3d):
    """Return the motion of an object after an impulse, and its moment about the centre of mass."""
    if not side.is_dynamic:
        return motion
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
def response_of(side: Side, arm: wp.vec3d, impulse: wp.vec3d):
    """Return the velocity that an impulse gives an object where its arm ends."""
    if not side.is_dynamic:
        return wp.vec3d()
    return side.inverse_mass * impulse + wp.cross(side.inverse_inertia * wp.cross(arm, impulse), arm)


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
def friction_of(a: Side, b: Side, point: RelaxedPoint, most: wp.float64, slide: wp.vec3d):
    """Return the friction impulse of a point that stops its tangential velocity `slide`, cut to `most`."""
    if most <= ZERO:
        return wp.vec3d()
    response = wp.dot(slide, response_of(a, point.arm_a, slide) + response_of(b, point.arm_b, slide))
    wanted = wp.vec3d(point.across)
    if response > ZERO:
        wanted -= (wp.dot(slide, slide) / response) * slide
    square = wp.dot(wanted, wanted)
    if square > most * most:
        wanted = (most / wp.sqrt(square)) * wanted
    return wanted


@wp.func
def load_point(
    rest: wp.float64, p: wp.int32, k: wp.int32, a: Side, b: Side, manifolds: Manifolds, constraints: Constraints
):
    """Return the k-th point of a pair, whose impulses act in the middle of where both objects have taken it.

    Args:
        rest: Depth at which it rests [world units].
    """
    point = RelaxedPoint()
    n, first_a, first_b = manifolds.normal[p, k], constraints.arm_a[p, k], constraints.arm_b[p, k]
    shift = b.moved - a.moved
    point.normal = n
    point.arm_a = first_a + HALF * shift
    point.arm_b = first_b - HALF * shift
    moved = shift + wp.cross(b.turned, first_b) - wp.cross(a.turned, first_a)
    point.room = rest - manifolds.depth[p, k] + wp.dot(n, moved)
    point.response = response_of(a, point.arm_a, n) + response_of(b, point.arm_b, n)
    point.mass = ONE / wp.dot(n, point.response)
    point.along = constraints.impulse[p, k]
    point.across = constraints.friction_impulse[p, k]
    return point


@wp.func
def point_of_turn(i: wp.int32, count: wp.int32, backward: wp.int32):
    return wp.where(backward != 0, count - 1 - i, i)


@wp.func
def most_visits(fast: wp.float64, speed: wp.float64):
    """Return how often the points of a pair that meet at a speed are relaxed at most."""
    visits, left = wp.int32(VISITS_USUAL), HARD * speed
    while left > fast and visits < VISITS_MAX:
        visits += 1
        left *= HALF
    return visits


@wp.func
def relax_pair(
    relaxation: Relaxation, p: wp.int32, pair: wp.vec2i, manifolds: Manifolds, constraints: Constraints, bodies: Bodies
):
    """Relax the points of a pair: the normal velocity, then the tangential one within the friction cone.

    The points are relaxed several times, one after the other: each by the lane of a warp that holds it, while all lanes
    hold the motion of both objects. An impulse acts on both at one place: no momentum is lost. A pair is struck if it
    meets fast where a pass begins.
    """
    stage, count, slop = relaxation.stage, manifolds.count[p], constraints.slop[p]
    rest = relaxation.rest * slop
    a, b = load_side(bodies, pair[0]), load_side(bodies, pair[1])
    motion_a, motion_b = load_motion(bodies, pair[0]), load_motion(bodies, pair[1])
    # Without gravity two rigid bodies are not pushed apart, which would add energy.
    corrects = stage == SOLVE and (relaxation.fast > ZERO or not (a.is_dynamic and b.is_dynamic))
    point = RelaxedPoint()
    fastest = wp.float64(0.0)
    for k in range(resolve_lane(), count, warp_size()):
        point = load_point(rest, p, k, a, b, manifolds, constraints)
        speed = wp.dot(point.normal, relative_velocity(motion_a, motion_b, point.arm_a, point.arm_b))
        fastest = wp.max(fastest, -speed)
    fastest = warp_max(fastest)
    settled = SETTLED * relaxation.fast
    struck = wp.where(stage == RELAX, constraints.is_struck[p], 0)
    struck = wp.where(fastest > relaxation.fast, 1, struck)
    visit, visits = wp.int32(0), most_visits(relaxation.fast, fastest)
    while visit < visits:
        visit += 1
        changes = bool(False)
        for i in range(count):
            k = point_of_turn(i, count, relaxation.backward)
            impulse, moment_a, moment_b = wp.vec3d(), wp.vec3d(), wp.vec3d()
            if warp_size() == 1 or resolve_lane() == k:
                if warp_size() == 1:
                    point = load_point(rest, p, k, a, b, manifolds, constraints)
                n = point.normal
                velocity = relative_velocity(motion_a, motion_b, point.arm_a, point.arm_b)
                excess = wp.dot(n, velocity) + approach_of(relaxation, corrects, slop, point.room)
                soft = wp.where(corrects and point.room < ZERO and struck == 0, SOFTNESS, ZERO)
                after = wp.max((ONE - soft) * (point.along - point.mass * excess), ZERO)
                more = after - point.along
                velocity += more * point.response
                # What is still to come near has no friction yet.
                most = wp.where(point.room > slop, ZERO, relaxation.friction * after)
                wanted = friction_of(a, b, point, most, velocity - wp.dot(n, velocity) * n)
                changes = changes or wp.abs(more) > settled * point.mass
                impulse = more * n + (wanted - point.across)
                moment_a = wp.cross(point.arm_a, impulse)
                moment_b = wp.cross(point.arm_b, impulse)
                point.along = after
                point.across = wanted
                constraints.impulse[p, k] = after
                constraints.friction_impulse[p, k] = wanted
            impulse = vector64_of_lane(impulse, k)
            motion_a = push(a, motion_a, -impulse, -vector64_of_lane(moment_a, k))
            motion_b = push(b, motion_b, impulse, vector64_of_lane(moment_b, k))
        if visit >= VISITS_LEAST and not warp_any(changes):
            visit = visits
    if resolve_lane() == 0:
        constraints.is_struck[p] = struck
        store_motion(a, motion_a, bodies, pair[0])
        store_motion(b, motion_b, bodies, pair[1])
    warp_sync()


@wp.func
def hand_on_impulses(p: wp.int32, pair: wp.vec2i, manifolds: Manifolds, constraints: Constraints, bodies: Bodies):
    """Add the impulses of a pair's points to what the next substep begins with, but for those that stopped an impact.

    These are not what the next substep needs: little of them may lift a body.
    """
    count, struck = manifolds.count[p], constraints.is_struck[p]
    half = HALF * (bodies.moved[pair[1]] - bodies.moved[pair[0]])
    impulse = wp.vec3d()
    moment_a = wp.vec3d()
    moment_b = wp.vec3d()
    for first in range(0, count, warp_size()):
        of_point = wp.vec3d()
        of_a = wp.vec3d()
        of_b = wp.vec3d()
        k = first + resolve_lane()
        if k < count:
            if struck != 0:
                constraints.impulse[p, k] = ZERO
                constraints.friction_impulse[p, k] = wp.vec3d()
            of_point = constraints.impulse[p, k] * manifolds.normal[p, k] + constraints.friction_impulse[p, k]
            of_a = wp.cross(constraints.arm_a[p, k] + half, of_point)
            of_b = wp.cross(constraints.arm_b[p, k] - half, of_point)
        for lane in range(wp.min(count - first, warp_size())):
            impulse += vector64_of_lane(of_point, lane)
            moment_a += vector64_of_lane(of_a, lane)
            moment_b += vector64_of_lane(of_b, lane)
    if resolve_lane() == 0:
        if bodies.motion_type[pair[0]] == DYNAMIC:
            bodies.impulse[pair[0]] -= impulse
            bodies.moment[pair[0]] -= moment_a
        if bodies.motion_type[pair[1]] == DYNAMIC:
            bodies.impulse[pair[1]] += impulse
            bodies.moment[pair[1]] += moment_b
    warp_sync()


@wp.kernel
def relax_kernel(
    relaxation: Relaxation,
    order: wp.array(dtype=wp.int32),
    color_start: wp.array(dtype=wp.int32),
    batch: PairBatch,
    manifolds: Manifolds,
    constraints_inout: Constraints,
    bodies_inout: Bodies,
):
    """Relax the pairs of a range of colors, color by color; the warps of the launch share those of a color.

    One warp relaxes the pairs without a color of their own.

    Args:
        order, color_start: Pairs sorted by color, and where those of each color begin.
    """
    if bodies_inout.is_whole[0] == 0:
        return
    backward = relaxation.backward
    colors = relaxation.last_color - relaxation.first_color + 1
    warp = wp.tid() / warp_size()
    for step in range(colors):
        c = relaxation.first_color + point_of_turn(step, colors, backward)
        start, end = color_start[c], color_start[c + 1]
        warps = wp.where(c == COLOR_COUNT, 1, relaxation.warps)
        if warp < warps:
            for turn in range(warp, end - start, warps):
                p = order[wp.where(backward != 0, end - 1 - turn, start + turn)]
                if relaxation.stage != WARM_START:
                    relax_pair(relaxation, p, batch.pairs[p], manifolds, constraints_inout, bodies_inout)
                if relaxation.stage != SOLVE:
                    hand_on_impulses(p, batch.pairs[p], manifolds, constraints_inout, bodies_inout)
        if colors > 1:
            block_sync()
