"""Points of a pair while they are relaxed: in float32, about what they were, in units of the pair.

Springs and what they give up are those of a substep. Impulses act on both objects in float64: no momentum is lost.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.poses import HALF
from warp_abtree.kernels.base.quotients import divide32, root32
from warp_abtree.kernels.base.sums import nine_numbers
from warp_abtree.kernels.bodies.bodies import DYNAMIC, ZERO, Bodies, radius_of, slop_of
from warp_abtree.kernels.bodies.constraints import Constraints, velocity_at
from warp_abtree.kernels.contacts.manifold import Manifolds
from warp_abtree.kernels.triangle.distance import inverse_power, largest_coordinate, power_below

wp.set_module_options(native.options("base/lanes.cuh", "base/quotients.cuh", "base/sums.cuh"))

_FREQUENCY = 1.0  # angle that a point's spring would swing by in a substep [rad]
_RESPONSE = 2.0 * 10.0 + _FREQUENCY  # twice its damping ratio, and that
RECOVERY = wp.constant(wp.float64(_FREQUENCY / _RESPONSE))
"""Part of the penetration that its spring corrects in a substep."""

SOFTNESS = wp.constant(wp.float64(1.0 / (1.0 + _FREQUENCY * _RESPONSE)))
"""Part of the impulse that it gives up."""

SHORTFALL = wp.constant(2.0**-22)
"""Part of the impulse that an impact gives up: float32 is no finer, and too much would throw bodies apart."""


@wp.struct
class Relaxation:
    """Parameters of a pass."""

    stage: wp.int32  # WARM_START, SOLVE or RELAX
    backward: wp.int32  # 1 if it goes from the last pair to the first
    passes: wp.int32  # passes of this step before it
    friction: wp.float64  # coefficient of Coulomb's law
    fast: wp.float64  # speed from which on points that meet strike [world units/s]; 0 without gravity
    rest: wp.float64  # depth at which points rest, in slops
    per_substep: wp.float64  # substeps a second
    correction: wp.float64  # part of the penetration that is corrected a second, however deep [1/s]


@wp.struct
class Units:
    """Powers of two that the points of a pair are relaxed in, in float32; impulses are sums in float64."""

    length: wp.float64  # about the smaller bounding radius [world units]
    per_length: wp.float64  # 1 over it
    per_speed: wp.float64  # 1 over the speed of about a slop a substep, or that of both [s/world units]
    mass: wp.float64  # about that of the lighter object
    impulse: wp.float64  # mass times speed


@wp.struct
class Side:
    """What impulses move one object of a pair by, in the pair's units."""

    inverse_mass: wp.float32  # 0 if it is not dynamic
    inverse_inertia: wp.mat33  # world frame, 0 so too


@wp.struct
class Change:
    """How much the motion of an object has changed in a pass, in the pair's units."""

    velocity: wp.vec3  # of the centre of mass
    turning: wp.vec3  # angular velocity, world frame


@wp.struct
class RelaxedPoint:
    """A point of a pair while it is relaxed, in the pair's units."""

    normal: wp.vec3  # from the first object to the second
    arm_a: wp.vec3  # from the centre of mass of the first object to where its impulses act
    arm_b: wp.vec3  # from that of the second
    allowed: wp.float64  # speed at which it may approach [world units/s], below 0 if it is to separate
    velocity: wp.vec3  # of the second object relative to the first where a pass begins
    response: wp.vec3  # velocity that a unit impulse along the normal gives
    mass: wp.float32  # impulse along the normal that a unit of speed along it takes
    approach: wp.float32  # `allowed` in the pair's units
    along: wp.float32  # impulse along the normal
    across: wp.vec3  # across it, world frame
    is_deep: wp.bool  # deeper than it rests
    is_apart: wp.bool  # more than a slop from there: what is still to come near has no friction yet


@wp.struct
class RelaxedPair:
    """A pair while its points are relaxed, in its units."""

    a: Side  # first object
    b: Side  # second object
    change_a: Change  # of the first one's motion
    change_b: Change  # of the second one's
    corrects: wp.bool  # whether points that are too deep are to separate
    struck: wp.int32  # 1 if it has met fast
    settled: wp.float32  # change of speed that is not much


@wp.func
def dynamic_part(bodies: Bodies, i: wp.int32):
    """Return the inverse mass of an object, 0 if impulses do not move it."""
    mass = bodies.inverse_mass[i]
    return wp.where(bodies.motion_type[i] == DYNAMIC, mass, ZERO)


@wp.func
def make_units(pair: wp.vec2i, bodies: Bodies):
    """Return the units of a pair, without those of speed and of impulses."""
    units = Units()
    units.length = power_below(radius_of(bodies, pair))
    units.per_length = inverse_power(units.length)
    lightness = dynamic_part(bodies, pair[0]) + dynamic_part(bodies, pair[1])
    units.mass = HALF * inverse_power(power_below(lightness))
    return units


@wp.func
def speed_unit(per_substep: wp.float64, pair: wp.vec2i, bodies: Bodies):
    fastest = largest_coordinate(bodies.velocity[pair[1]] - bodies.velocity[pair[0]])
    return power_below(wp.max(slop_of(bodies, pair) * per_substep, fastest))


@wp.func
def load_side(units: Units, bodies: Bodies, i: wp.int32):
    # No branch: all loads are under way at once.
    side, inertia = Side(), bodies.inverse_inertia[i]
    side.inverse_mass = wp.float32(dynamic_part(bodies, i) * units.mass)
    scale = wp.where(bodies.motion_type[i] == DYNAMIC, units.mass * units.length * units.length, ZERO)
    for j in range(3):
        for k in range(3):
            side.inverse_inertia[j, k] = wp.float32(inertia[j, k] * scale)
    return side


@wp.func
def push(side: Side, change: Change, impulse: wp.vec3, moment: wp.vec3):
    """Return the change of an object's motion after an impulse, and its moment about the centre of mass."""
    after = Change()
    after.velocity = change.velocity + side.inverse_mass * impulse
    after.turning = change.turning + side.inverse_inertia * moment
    return after


@wp.func
def response_of(side: Side, arm: wp.vec3, impulse: wp.vec3):
    """Return the velocity that an impulse gives an object where its arm ends."""
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
def friction_of(a: Side, b: Side, point: RelaxedPoint, most: wp.float32, slide: wp.vec3):
    """Return the friction impulse of a point that stops its tangential velocity `slide`, cut to `most`."""
    if most <= 0.0:
        return wp.vec3()
    response = wp.dot(slide, response_of(a, point.arm_a, slide) + response_of(b, point.arm_b, slide))
    wanted = wp.vec3(point.across)
    wanted -= divide32(wp.dot(slide, slide), response) * slide
    square = wp.dot(wanted, wanted)
    if square > most * most:
        wanted = divide32(most, root32(square)) * wanted
    return wanted


@wp.func
def half_shift(pair: wp.vec2i, bodies: Bodies):
    """Return half of how far the second object of a pair has moved more than the first, cut to the bounding radius.

    So no impulse acts far off bodies that a step takes far.
    """
    shift, most = HALF * (bodies.moved[pair[1]] - bodies.moved[pair[0]]), radius_of(bodies, pair)
    if not wp.length_sq(shift) <= most * most:
        shift = (most / wp.length(shift)) * shift
    return shift


@wp.func
def load_point(
    relaxation: Relaxation,
    units: Units,
    own: RelaxedPair,
    p: wp.int32,
    k: wp.int32,
    pair: wp.vec2i,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
):
    """Return the k-th point of a pair without what depends on speeds.

    Its impulses act in the middle of where both objects have taken it.
    """
    a, b, slop = pair[0], pair[1], slop_of(bodies, pair)
    n, first_a, first_b = manifolds.normal[p, k], constraints.arm_a[p, k], constraints.arm_b[p, k]
    half = half_shift(pair, bodies)
    moved = bodies.moved[b] - bodies.moved[a]
    moved += wp.cross(bodies.turned[b], first_b) - wp.cross(bodies.turned[a], first_a)
    room = relaxation.rest * slop - manifolds.depth[p, k] + wp.dot(n, moved)
    point = RelaxedPoint()
    point.normal = wp.vec3(n)
    point.arm_a = wp.vec3((first_a + half) * units.per_length)
    point.arm_b = wp.vec3((first_b - half) * units.per_length)
    point.response = response_of(own.a, point.arm_a, point.normal) + response_of(own.b, point.arm_b, point.normal)
    point.mass = divide32(1.0, wp.dot(point.normal, point.response))
    point.allowed = approach_of(relaxation, own.corrects, slop, room)
    point.is_deep = room < ZERO
    point.is_apart = room > slop
    return point


@wp.func
def start_point(
    point: wp.ref[RelaxedPoint],
    units: Units,
    p: wp.int32,
    k: wp.int32,
    pair: wp.vec2i,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
):
    """Give a point the speeds and impulses that a pass begins with; return how fast it approaches.

    That is in world units/s.
    """
    half, per_impulse = half_shift(pair, bodies), inverse_power(units.impulse)
    velocity = velocity_at(bodies, pair[1], constraints.arm_b[p, k] - half)
    velocity -= velocity_at(bodies, pair[0], constraints.arm_a[p, k] + half)
    point.velocity = wp.vec3(velocity * units.per_speed)
    point.approach = wp.float32(point.allowed * units.per_speed)
    point.along = wp.float32(constraints.impulse[p, k] * per_impulse)
    point.across = wp.vec3(constraints.friction_impulse[p, k] * per_impulse)
    return -wp.dot(manifolds.normal[p, k], velocity)


@wp.func
def relax_point(point: RelaxedPoint, own: RelaxedPair, friction: wp.float32):
    """Return the impulses along and across the normal that relax a point."""
    n, before = point.normal, point.along
    at_a = own.change_a.velocity + wp.cross(own.change_a.turning, point.arm_a)
    velocity = point.velocity + (own.change_b.velocity + wp.cross(own.change_b.turning, point.arm_b) - at_a)
    excess = wp.dot(n, velocity) + point.approach
    soft = wp.where(own.struck != 0, SHORTFALL, wp.where(own.corrects and point.is_deep, wp.float32(SOFTNESS), 0.0))
    after = wp.max((1.0 - soft) * (before - point.mass * excess), 0.0)
    velocity += (after - before) * point.response
    most = wp.where(point.is_apart, 0.0, friction * after)
    return after, friction_of(own.a, own.b, point, most, velocity - wp.dot(n, velocity) * n)


@wp.func
def act_at_point(p: wp.int32, k: wp.int32, half: wp.vec3d, impulse: wp.vec3d, constraints: Constraints):
    """Return an impulse at the k-th point of a pair, and its moments about both centres of mass.

    Args:
        half: Half of how far the second object has moved more than the first.
    """
    a = wp.cross(constraints.arm_a[p, k] + half, impulse)
    b = wp.cross(constraints.arm_b[p, k] - half, impulse)
    return nine_numbers(impulse[0], impulse[1], impulse[2], a[0], a[1], a[2], b[0], b[1], b[2])


@wp.func
def third_of(numbers: nine_numbers, k: wp.int32):
    """Return the k-th three of nine numbers: an impulse, or its moment about the first or the second object."""
    return wp.vec3d(numbers[3 * k], numbers[3 * k + 1], numbers[3 * k + 2])
