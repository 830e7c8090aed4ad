"""Relaxation of contact constraints: projected Gauss-Seidel (sequential impulses), the pairs in order of their color.

A step has substeps, each of which begins with the impulses of the one before, solves for velocities that also take
penetrating points apart, relaxes: removes that from the velocities again, and moves the bodies by both. What moves and
relaxes at one place adds no energy.
Points that penetrate are springs, stiff for the length of a substep, so that a stack finds its balance.
Source: Macklin et al. 2019, Small Steps in Physics Simulation; Catto 2024, Solver2D ("soft step").

A pair waits for those before it in that order that have one of its bodies, and for no other: one warp for all pairs and
a warp for each give the same bits. Warps take turns in this order, so that what they wait for has begun.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import publish_counts, take_together, wait_for_counts
from warp_abtree.kernels.base.lanes import (
    WARP_SIZE,
    count_set_bits,
    lane_in_turn,
    resolve_lane,
    vector_of_lane,
    warp_any,
    warp_max,
    warp_size,
    warp_sync,
)
from warp_abtree.kernels.base.poses import HALF, PairBatch
from warp_abtree.kernels.base.sums import add_nine_in_order, nine_numbers
from warp_abtree.kernels.bodies.bodies import DYNAMIC, ONE, ZERO, Bodies
from warp_abtree.kernels.bodies.constraints import Constraints
from warp_abtree.kernels.bodies.relaxed_points import (
    Relaxation,
    RelaxedPair,
    RelaxedPoint,
    Units,
    act_at_point,
    half_shift,
    load_point,
    load_side,
    make_units,
    push,
    relax_point,
    speed_unit,
    start_point,
    third_of,
)
from warp_abtree.kernels.contacts.manifold import Manifolds
from warp_abtree.kernels.triangle.distance import inverse_power

wp.set_module_options(
    native.options("base/counters.cuh", "base/lanes.cuh", "base/quotients.cuh", "base/sums.cuh")
    | {"block_dim": WARP_SIZE}
)

WARM_START = wp.constant(0)
SOLVE = wp.constant(1)
RELAX = wp.constant(2)
"""Stages, each a pass over the contacts. WARM_START only sums up the impulses that the first substep begins with."""

VISITS_LEAST, VISITS_USUAL, VISITS_MAX = wp.constant(3), wp.constant(5), wp.constant(64)
"""How often a pass relaxes the points of a pair before the next pair: more than the least while speeds change much, at
most as usual, and once more for each doubling of a hard impact."""

SETTLED = wp.constant(wp.float64(2.0**-6))
"""Change of speed that is not much, as a part of `fast`."""

HARD = wp.constant(wp.float64(2.0**-3))
"""Part of the speed of an impact that, if fast, makes it hard."""


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
def visit_points(
    relaxation: Relaxation,
    p: wp.int32,
    count: wp.int32,
    own: wp.ref[RelaxedPair],
    point: wp.ref[RelaxedPoint],
    relaxed: wp.array2d(dtype=RelaxedPoint),
):
    """Relax the points of a pair once, one after the other; return whether any changes much, and whether any does.

    All lanes try their points at once, since most change nothing: the next that does has its turn.
    """
    backward, lanes, turn = relaxation.backward, warp_size(), wp.int32(0)
    much, at_all = bool(False), bool(False)
    while turn < count:
        k = point_of_turn(turn, count, backward)
        if lanes == 1:
            point = relaxed[p, k]
        else:
            k = resolve_lane()
        along, across = relax_point(point, own, wp.float32(relaxation.friction))
        more, slides = along - point.along, across - point.across
        acts = k < count and point_of_turn(k, count, backward) >= turn and (more != 0.0 or wp.norm_l1(slides) != 0.0)
        acting = lane_in_turn(acts, backward != 0)
        turn += lanes
        if acting >= 0:
            at_all = bool(True)
            k = wp.where(lanes == 1, k, acting)
            turn = point_of_turn(k, count, backward) + 1
            impulse = more * point.normal + slides
            moment_a, moment_b = wp.cross(point.arm_a, impulse), wp.cross(point.arm_b, impulse)
            if lanes == 1 or resolve_lane() == k:
                much = much or wp.abs(more) > own.settled * point.mass
                point.along = along
                point.across = across
            if lanes == 1:
                relaxed[p, k] = point
            impulse = vector_of_lane(impulse, k)
            own.change_a = push(own.a, own.change_a, -impulse, -vector_of_lane(moment_a, k))
            own.change_b = push(own.b, own.change_b, impulse, vector_of_lane(moment_b, k))
    return warp_any(much), at_all


@wp.func
def count_turns(relaxation: Relaxation, i: wp.int32, rank: wp.int32, bodies: Bodies):
    """Return how often pairs have been relaxed in this step that have an object, before that of a rank among them.

    -1 if nothing changes its motion.
    """
    pairs = count_set_bits(bodies.colors[i]) + bodies.uncolored[i]
    before = relaxation.passes * pairs + point_of_turn(rank, pairs, relaxation.backward)
    return wp.where(bodies.motion_type[i] == DYNAMIC, before, -1)


@wp.func
def relax_pair(
    relaxation: Relaxation,
    p: wp.int32,
    pair: wp.vec2i,
    turns: wp.vec2i,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
    relaxed: wp.array2d(dtype=RelaxedPoint),
):
    """Relax the points of a pair: the normal velocity, then the tangential one within the friction cone.

    The points are relaxed several times, one after the other; a warp's lanes hold one each. A pair is struck if it
    meets fast where a pass begins. What depends on no speed is done before it waits for its turns.
    """
    stage, count, lanes, own = relaxation.stage, manifolds.count[p], warp_size(), RelaxedPair()
    units = make_units(pair, bodies)
    own.a = load_side(units, bodies, pair[0])
    own.b = load_side(units, bodies, pair[1])
    # Without gravity two rigid bodies are not pushed apart, which would add energy.
    one_moves = not (own.a.inverse_mass > 0.0 and own.b.inverse_mass > 0.0)
    own.corrects = stage == SOLVE and (relaxation.fast > ZERO or one_moves)
    own.struck = wp.where(stage == RELAX, constraints.is_struck[p], 0)
    point = RelaxedPoint()
    for k in range(resolve_lane(), count, lanes):
        point = load_point(relaxation, units, own, p, k, pair, manifolds, constraints, bodies)
        if lanes == 1:
            relaxed[p, k] = point
    wait_for_counts(bodies.relaxed, pair, turns)
    speed = speed_unit(relaxation.per_substep, pair, bodies)
    units.per_speed = inverse_power(speed)
    units.impulse = units.mass * speed
    fastest = wp.float64(0.0)
    for k in range(resolve_lane(), count, lanes):
        if lanes == 1:
            point = relaxed[p, k]
        fastest = wp.max(fastest, start_point(point, units, p, k, pair, manifolds, constraints, bodies))
        if lanes == 1:
            relaxed[p, k] = point
    fastest = warp_max(fastest)
    own.settled = wp.float32(SETTLED * relaxation.fast * units.per_speed)
    own.struck = wp.where(fastest > relaxation.fast, 1, own.struck)
    visit, visits = wp.int32(0), most_visits(relaxation.fast, fastest)
    while visit < visits:
        visit += 1
        much, at_all = visit_points(relaxation, p, count, own, point, relaxed)
        # What changes nothing once never does.
        if not at_all or (visit >= VISITS_LEAST and not much):
            visit = visits
    apply_impulses(units, p, pair, point, manifolds, constraints, bodies, relaxed)
    if resolve_lane() == 0:
        constraints.is_struck[p] = own.struck
        if own.corrects:
            for k in range(2):
                bodies.corrects[pair[k]] = 1
    warp_sync()


@wp.func
def apply_impulses(
    units: Units,
    p: wp.int32,
    pair: wp.vec2i,
    point: RelaxedPoint,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
    relaxed: wp.array2d(dtype=RelaxedPoint),
):
    """Write the impulses of a pair's points, and give both objects what is new of them: no momentum is lost."""
    count, unit = manifolds.count[p], units.impulse
    half = half_shift(pair, bodies)
    total = nine_numbers()
    for first in range(0, count, warp_size()):
        own, k = nine_numbers(), first + resolve_lane()
        if k < count:
            along, across = wp.float64(point.along) * unit, wp.vec3d(point.across) * unit
            if warp_size() == 1:
                along, across = wp.float64(relaxed[p, k].along) * unit, wp.vec3d(relaxed[p, k].across) * unit
            more = (along - constraints.impulse[p, k]) * manifolds.normal[p, k]
            more += across - constraints.friction_impulse[p, k]
            own = act_at_point(p, k, half, more, constraints)
            constraints.impulse[p, k] = along
            constraints.friction_impulse[p, k] = across
        total = add_nine_in_order(total, own, wp.min(count - first, warp_size()))
    if resolve_lane() == 0:
        for k in range(2):
            i, sign = pair[k], wp.where(k == 0, -ONE, ONE)
            if bodies.motion_type[i] == DYNAMIC:
                bodies.velocity[i] = bodies.velocity[i] + sign * (bodies.inverse_mass[i] * third_of(total, 0))
                bodies.momentum[i] = bodies.momentum[i] + sign * third_of(total, 1 + k)


@wp.func
def hand_on_impulses(p: wp.int32, pair: wp.vec2i, manifolds: Manifolds, constraints: Constraints, bodies: Bodies):
    """Add the impulses of a pair's points to what the next substep begins with, but for those that stopped an impact.

    These are not what the next substep needs: little of them may lift a body.
    """
    count, struck = manifolds.count[p], constraints.is_struck[p]
    half = half_shift(pair, bodies)
    total = nine_numbers()
    for first in range(0, count, warp_size()):
        own, k = nine_numbers(), first + resolve_lane()
        if k < count:
            if struck != 0:
                constraints.impulse[p, k] = ZERO
                constraints.friction_impulse[p, k] = wp.vec3d()
            impulse = constraints.impulse[p, k] * manifolds.normal[p, k] + constraints.friction_impulse[p, k]
            own = act_at_point(p, k, half, impulse, constraints)
        total = add_nine_in_order(total, own, wp.min(count - first, warp_size()))
    if resolve_lane() == 0:
        for k in range(2):
            i, sign = pair[k], wp.where(k == 0, -ONE, ONE)
            if bodies.motion_type[i] == DYNAMIC:
                bodies.impulse[i] = bodies.impulse[i] + sign * third_of(total, 0)
                bodies.moment[i] = bodies.moment[i] + sign * third_of(total, 1 + k)
    warp_sync()


@wp.kernel
def relax_kernel(
    relaxation: Relaxation,
    order: wp.array(dtype=wp.int32),
    batch: PairBatch,
    manifolds: Manifolds,
    relaxed: wp.array2d(dtype=RelaxedPoint),
    turns_inout: wp.array(dtype=wp.int32),
    constraints_inout: Constraints,
    bodies_inout: Bodies,
):
    """Relax the pairs in contact, each by a warp.

    Args:
        order: Pairs sorted by color.
        relaxed: Scratch where a warp is one thread, [pair, point].
        turns_inout: How many pairs are in contact; then of each pass how many turns are taken.
    """
    end = wp.where(bodies_inout.is_whole[0] != 0, turns_inout[0], 0)
    turn = take_together(turns_inout, relaxation.passes + 1, 1)
    while turn < end:
        p = order[point_of_turn(turn, end, relaxation.backward)]
        pair, rank = batch.pairs[p], constraints_inout.rank[p]
        before_a = count_turns(relaxation, pair[0], rank[0], bodies_inout)
        before_b = count_turns(relaxation, pair[1], rank[1], bodies_inout)
        before = wp.vec2i(before_a, before_b)
        if relaxation.stage == WARM_START:
            wait_for_counts(bodies_inout.relaxed, pair, before)
        else:
            relax_pair(relaxation, p, pair, before, manifolds, constraints_inout, bodies_inout, relaxed)
        if relaxation.stage != SOLVE:
            hand_on_impulses(p, pair, manifolds, constraints_inout, bodies_inout)
        publish_counts(bodies_inout.relaxed, pair, before + wp.vec2i(1, 1))
        turn = take_together(turns_inout, relaxation.passes + 1, 1)
