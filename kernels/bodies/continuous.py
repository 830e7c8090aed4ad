"""Continuous collision of rigid bodies: motions of a step cut so that surfaces that are apart stay apart.

Each object has a goal, where the step would take it, and an end of its way there, at first the goal. A round searches
the first contacts of all pairs on these ways, and cuts the ways of both objects of a pair at its time, less a little.
The next round searches the pairs of which an object's way was cut, since it now stands where the other may still come:
that one is cut at the time of contact, then to the same fraction of its motion, on which both were clear. Meanwhile
surfaces count as thicker, where they are not so near yet, since what slides along at no distance is hard to prove
apart. What the last round does not prove clear, end included, holds its whole world where it was. So at the end a path
leads from each object's pose to its new one, on which no two surfaces meet that were apart.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import (
    DYNAMIC,
    FREE,
    ON_TRIAL,
    ONE,
    STATIC,
    STUCK,
    STUCK_AGAIN,
    ZERO,
    Bodies,
    slop_of,
    without_gain,
)
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.motion.face_pair import CLEAR, UNDECIDED
from warp_abtree.kernels.motion.path import Motion, make_path
from warp_abtree.kernels.motion.start import OPEN, FirstContacts
from warp_abtree.kernels.motion.turn import shortest_turn, turn_matrix

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TOUCHING, UNDECIDED_PAIRS, HELD_PAIRS = wp.constant(0), wp.constant(1), wp.constant(2)
"""Entries of `StepMotions.counter`."""

CUT, MATCH, HOLD_BOTH, CERTIFY = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)
"""What a round does with pairs that are not clear: cut ways at the time of contact, cut the larger fraction to the
smaller, cut both at the start, or hold the world."""

TIME_TOLERANCE = wp.constant(wp.float64(2.0**-24))
"""Of times of first contacts, as a fraction of a way."""

NEAR, VERY_NEAR = wp.constant(wp.float64(0.25)), wp.constant(wp.float64(1.0 / 32.0))
EXEMPT, LAST_LEVEL = wp.constant(-1), wp.constant(2)


@wp.struct
class StepMotions:
    """Motions of objects in a step."""

    world: wp.array(dtype=wp.int32)  # number of the world that is held together, shape [object]
    goals: ObjectPool  # poses that the step aims for: rotation and position
    ends: ObjectPool  # poses that it ends at
    fraction: wp.array(dtype=wp.float64)  # of its motion that an object makes, 0 to 1, shape [object]
    cut: wp.array(dtype=wp.float64)  # fraction of its way that the round leaves, shape [object]
    is_changed: wp.array(dtype=wp.int32)  # whether the last round has cut its way, 0 or 1, shape [object]
    is_held: wp.array(dtype=wp.int32)  # of each world, 0 or 1, shape [object]
    level: wp.array(dtype=wp.int32)  # of a pair's margin, 0 to LAST_LEVEL; EXEMPT where not searched, shape [pair]
    is_again: wp.array(dtype=wp.int32)  # whether a pair is searched again at another level, 0 or 1, shape [pair]
    counter: wp.array(dtype=wp.int32)  # touching and undecided pairs, and pairs that held a world, shape [3]


@wp.kernel
def begin_way_kernel(objects: ObjectPool, bodies: Bodies, motions_inout: StepMotions):
    """Let an object's way end at its goal, without its turn where that is half a revolution, which has no way."""
    i = wp.tid()
    if i == 0:
        for k in range(3):
            motions_inout.counter[k] = 0
    motions_inout.fraction[i] = wp.where(bodies.motion_type[i] == STATIC, ZERO, ONE)
    motions_inout.cut[i] = ONE
    motions_inout.is_changed[i] = 1
    motions_inout.is_held[i] = 0
    motions_inout.ends.rotation[i] = objects.rotation[i]
    motions_inout.ends.position[i] = objects.position[i]
    if bodies.is_whole[0] != 0 and bodies.motion_type[i] != STATIC:
        goal = motions_inout.goals.rotation[i]
        _axis, angle, _half = shortest_turn(wp.transpose(objects.rotation[i]) * goal)
        motions_inout.ends.position[i] = motions_inout.goals.position[i]
        if angle >= ZERO:
            motions_inout.ends.rotation[i] = goal


@wp.kernel
def exempt_pair_kernel(batch: PairBatch, hits: Hits, bodies: Bodies, motions_inout: StepMotions):
    """Exempt a pair a thread whose surfaces intersect at first, or neither of which is a rigid body."""
    p = wp.tid()
    if p >= batch.count[0]:
        return
    moves = bodies.motion_type[batch.pairs[p][0]] == DYNAMIC or bodies.motion_type[batch.pairs[p][1]] == DYNAMIC
    touches = hits.any_hit[p] != 0
    motions_inout.level[p] = wp.where(touches or not moves, EXEMPT, 0)
    motions_inout.is_again[p] = 0
    if touches and moves:
        wp.atomic_add(motions_inout.counter, TOUCHING, 1)


@wp.kernel
def choose_pair_kernel(batch: PairBatch, motions: StepMotions, hits_inout: Hits):
    """Choose a pair a thread for the next round: the search leaves out those that are marked as intersecting."""
    p = wp.tid()
    if p >= batch.count[0]:
        return
    a, b = batch.pairs[p][0], batch.pairs[p][1]
    changed = (
        motions.is_changed[a] + motions.is_changed[b] + motions.is_again[p] > 0
        and motions.fraction[a] + motions.fraction[b] > ZERO
    )
    hits_inout.any_hit[p] = wp.where(changed and motions.level[p] != EXEMPT, 0, 1)


@wp.kernel
def widen_motion_kernel(
    batch: PairBatch,
    contacts: FirstContacts,
    bodies: Bodies,
    motions: StepMotions,
    motion_inout: wp.array(dtype=Motion),
):
    """Thicken the surfaces of a pair a thread where they are near: by a quarter of a slop, or 1/32 of that."""
    p = wp.tid()
    if p >= batch.count[0] or contacts.end[p] != OPEN or motions.level[p] >= LAST_LEVEL:
        return
    margin = slop_of(bodies, batch.pairs[p]) * wp.where(motions.level[p] == 0, NEAR, NEAR * VERY_NEAR)
    motion = motion_inout[p]
    motion.slack = motion.slack + margin
    motion.margin = motion.margin + wp.float32(margin * motion.scale)
    motion_inout[p] = motion


@wp.func
def way_length(objects: ObjectPool, motions: StepMotions, bodies: Bodies, i: wp.int32):
    """Estimate the length of the path of a body's surface, 0 for others."""
    if bodies.motion_type[i] != DYNAMIC:
        return wp.length(motions.ends.position[i] - objects.position[i])
    turn = motions.ends.rotation[i] - objects.rotation[i]
    side = wp.sqrt(wp.ddot(turn, turn)) * bodies.bounding_radius[i]
    return wp.length(motions.ends.position[i] - objects.position[i]) + side


@wp.kernel
def cut_way_kernel(
    mode: wp.int32,
    batch: PairBatch,
    objects: ObjectPool,
    hits: Hits,
    contacts: FirstContacts,
    bodies: Bodies,
    motions_inout: StepMotions,
):
    """Cut the ways of both objects of a pair a thread that is not proved clear, or hold their worlds."""
    p = wp.tid()
    if p >= batch.count[0] or hits.any_hit[p] != 0:
        return
    motions_inout.is_again[p] = 0
    if contacts.end[p] == CLEAR:
        return
    a, b = batch.pairs[p][0], batch.pairs[p][1]
    length = way_length(objects, motions_inout, bodies, a) + way_length(objects, motions_inout, bodies, b)
    back = NEAR * slop_of(bodies, batch.pairs[p])
    is_early = contacts.end[p] != UNDECIDED and contacts.time[p] <= TIME_TOLERANCE
    if mode <= MATCH and is_early and TIME_TOLERANCE * length > back:
        # Too long a way to tell where on it they meet: the next round searches the part that they meet on.
        wp.atomic_min(motions_inout.cut, a, wp.float64(2.0) * TIME_TOLERANCE)
        wp.atomic_min(motions_inout.cut, b, wp.float64(2.0) * TIME_TOLERANCE)
        return
    if mode <= MATCH and contacts.time[p] == ZERO and motions_inout.level[p] < LAST_LEVEL:
        motions_inout.level[p] = motions_inout.level[p] + 1
        motions_inout.is_again[p] = 1
        return
    if contacts.end[p] == UNDECIDED:
        wp.atomic_add(motions_inout.counter, UNDECIDED_PAIRS, 1)
    if mode == CERTIFY:
        wp.atomic_add(motions_inout.counter, HELD_PAIRS, 1)
        for k in range(2):
            if bodies.motion_type[batch.pairs[p][k]] != STATIC:
                wp.atomic_max(motions_inout.is_held, motions_inout.world[batch.pairs[p][k]], 1)
        return
    if mode == HOLD_BOTH:
        wp.atomic_min(motions_inout.cut, a, ZERO)
        wp.atomic_min(motions_inout.cut, b, ZERO)
        return
    # A quarter of a slop before the contact, where contacts ahead find it.
    fraction = wp.max(contacts.time[p] - back / wp.max(length, back), ZERO)
    fraction_a, fraction_b = motions_inout.fraction[a], motions_inout.fraction[b]
    less, more = wp.min(fraction_a, fraction_b), wp.max(fraction_a, fraction_b)
    static = bodies.motion_type[a] == STATIC or bodies.motion_type[b] == STATIC
    if static or less == more:
        wp.atomic_min(motions_inout.cut, a, fraction)
        wp.atomic_min(motions_inout.cut, b, fraction)
        return
    shorter = less / more
    if mode == CUT:
        shorter = wp.max(shorter, fraction)
    wp.atomic_min(motions_inout.cut, wp.where(fraction_a == more, a, b), shorter)


@wp.kernel
def apply_cut_kernel(objects: ObjectPool, bodies: Bodies, motions_inout: StepMotions):
    """End an object's way where the round has cut it."""
    i = wp.tid()
    fraction = motions_inout.cut[i]
    motions_inout.cut[i] = ONE
    changed = fraction < ONE and motions_inout.fraction[i] > ZERO
    motions_inout.is_changed[i] = wp.where(changed, 1, 0)
    if not changed:
        return
    motions_inout.fraction[i] = fraction * motions_inout.fraction[i]
    if fraction == ZERO:
        motions_inout.ends.rotation[i] = objects.rotation[i]
        motions_inout.ends.position[i] = objects.position[i]
        return
    path = make_path(False, objects, motions_inout.ends, i)
    rotation = objects.rotation[i] * turn_matrix(path.axis, fraction * path.angle)
    if bodies.motion_type[i] == DYNAMIC:
        # By way of a quaternion, so that it stays a rotation, cut after cut.
        axes = bodies.axes[i]
        rotation = wp.quat_to_matrix(wp.normalize(wp.quat_from_matrix(rotation * axes))) * wp.transpose(axes)
    motions_inout.ends.rotation[i] = rotation
    motions_inout.ends.position[i] = objects.position[i] + fraction * path.travel


@wp.kernel
def end_way_kernel(
    velocity_change: wp.vec3d,
    batch: PairBatch,
    hits: Hits,
    motions: StepMotions,
    bodies_inout: Bodies,
    objects_inout: ObjectPool,
):
    """Pose an object where its way ends, unless not all pairs were found.

    Gravity acts on a body for the fraction of the step that it moves, and a turn that is cut short adds no energy. What
    is stuck stops turning, and moves by its position correction alone in the next step: else it would ask for the
    same motion for ever. Stuck again it stops.
    """
    i = wp.tid()
    if bodies_inout.is_whole[0] == 0 or bodies_inout.motion_type[i] == STATIC:
        return
    whole = batch.launched[0] >= 0 and wp.uint32(batch.count[0]) <= wp.uint32(motions.level.shape[0])
    if hits.uncertain.shape[0] > 0:
        whole = whole and wp.uint32(hits.uncertain_total[0]) <= wp.uint32(hits.uncertain.shape[0])
    if not whole:
        return
    fraction = motions.fraction[i]
    near = NEAR * bodies_inout.slop[i]
    stuck = fraction < ONE and way_length(objects_inout, motions, bodies_inout, i) < near
    if motions.is_held[motions.world[i]] != 0:
        fraction = ZERO
    else:
        objects_inout.rotation[i] = motions.ends.rotation[i]
        objects_inout.position[i] = motions.ends.position[i]
    motions.fraction[i] = fraction
    before_stuck = bodies_inout.stuck[i]
    was_stuck = (before_stuck & 1) != 0
    now = wp.where(before_stuck == STUCK, ON_TRIAL, FREE)
    if stuck:
        now = wp.where(before_stuck == FREE, STUCK, STUCK_AGAIN)
    bodies_inout.stuck[i] = now
    if bodies_inout.motion_type[i] != DYNAMIC or (fraction == ONE and not was_stuck):
        return
    rotation = objects_inout.rotation[i]
    bodies_inout.position[i] = objects_inout.position[i] + rotation * bodies_inout.centre[i]
    q = wp.normalize(wp.quat_from_matrix(rotation * bodies_inout.axes[i]))
    momentum = bodies_inout.momentum[i]
    scale = without_gain(bodies_inout.rotation[i], q, momentum, bodies_inout.inverse_moment[i])
    bodies_inout.rotation[i] = q
    bodies_inout.momentum[i] = wp.where(stuck, ZERO, scale) * momentum
    down = wp.normalize(velocity_change)
    speed = wp.max(wp.dot(bodies_inout.velocity[i], down), ZERO)
    taken = wp.min(wp.where(was_stuck, ONE, ONE - fraction) * wp.length(velocity_change), speed)
    bodies_inout.velocity[i] = wp.where(now == STUCK_AGAIN, ZERO, ONE) * (bodies_inout.velocity[i] - taken * down)
