"""Steps in which surfaces that are apart stay apart: how much of its motion each body makes.

Each object has a goal, where the step would take it, and an end of its way there, at first the goal. A round searches
the first contacts of all pairs on these ways, and cuts the ways of both objects of a pair at its time, less a little.
The next round searches the pairs of which an object's way was cut, since it now stands where the other may still come.
What the last round does not prove clear, end included, holds its whole world where it was. So at the end a path leads
from each object's pose to its new one, on which no two surfaces meet that were apart.
"""

import warp as wp

from warp_abtree.kernels.arrays import ObjectPool
from warp_abtree.kernels.dynamics.bodies import DYNAMIC, STATIC, Bodies
from warp_abtree.kernels.dynamics.constraints import SLOP
from warp_abtree.kernels.motion.face_pair import CLEAR, UNDECIDED
from warp_abtree.kernels.motion.path import make_path
from warp_abtree.kernels.motion.start import Contacts
from warp_abtree.kernels.motion.turn import shortest_turn, turn_matrix
from warp_abtree.kernels.traversal.face_pairs import Hits

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TOUCHING, UNDECIDED_PAIRS, HELD = wp.constant(0), wp.constant(1), wp.constant(2)
"""Entries of `Ways.counter`."""

CUT, HOLD, CERTIFY = wp.constant(0), wp.constant(1), wp.constant(2)
"""What a round does with pairs that are not clear: cut at the time of contact, at the start, or hold the world."""

ZERO, ONE, HALF = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0)), wp.constant(wp.float64(0.5))


@wp.struct
class Ways:
    """Ways of objects in a step."""

    # static
    world: wp.array(dtype=wp.int32)  # number of the world that is held together, shape [object]
    # state
    goals: ObjectPool  # poses that the step aims for: rotation and position
    ends: ObjectPool  # poses that it ends at
    part: wp.array(dtype=wp.float64)  # of its motion that an object makes, 0 to 1, shape [object]
    cut: wp.array(dtype=wp.float64)  # part of its way that the round leaves, shape [object]
    is_changed: wp.array(dtype=wp.int32)  # whether the last round has cut its way, 0 or 1, shape [object]
    is_held: wp.array(dtype=wp.int32)  # of each world, 0 or 1, shape [object]
    is_exempt: wp.array(dtype=wp.int32)  # whether the ways of a pair do not matter, 0 or 1, shape [pair]
    counter: wp.array(dtype=wp.int32)  # touching and undecided pairs, and pairs that held a world, shape [3]


@wp.kernel
def begin_way_kernel(objects: ObjectPool, bodies: Bodies, ways_inout: Ways):
    """Let an object's way end at its goal, without its turn where that is half a revolution, which has no way."""
    i = wp.tid()
    if i == 0:
        for k in range(3):
            ways_inout.counter[k] = 0
    ways_inout.part[i] = wp.where(bodies.motion_type[i] == STATIC, ZERO, ONE)
    ways_inout.cut[i] = ONE
    ways_inout.is_changed[i] = 1
    ways_inout.is_held[i] = 0
    ways_inout.ends.rotation[i] = objects.rotation[i]
    ways_inout.ends.position[i] = objects.position[i]
    if bodies.is_whole[0] != 0 and bodies.motion_type[i] != STATIC:
        goal = ways_inout.goals.rotation[i]
        _axis, angle, _half = shortest_turn(wp.transpose(objects.rotation[i]) * goal)
        ways_inout.ends.position[i] = ways_inout.goals.position[i]
        if angle >= ZERO:
            ways_inout.ends.rotation[i] = goal


@wp.kernel
def exempt_pair_kernel(
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    hits: Hits,
    bodies: Bodies,
    ways_inout: Ways,
):
    """Exempt a pair a thread whose surfaces intersect at first, or neither of which is a rigid body."""
    p = wp.tid()
    if p >= pair_count[0]:
        return
    moves = bodies.motion_type[pairs[p][0]] == DYNAMIC or bodies.motion_type[pairs[p][1]] == DYNAMIC
    touches = hits.any_hit[p] != 0
    ways_inout.is_exempt[p] = wp.where(touches or not moves, 1, 0)
    if touches and moves:
        wp.atomic_add(ways_inout.counter, TOUCHING, 1)


@wp.kernel
def choose_pair_kernel(
    pair_count: wp.array(dtype=wp.int32), pairs: wp.array(dtype=wp.vec2i), ways: Ways, hits_inout: Hits
):
    """Choose a pair a thread for the next round: the search leaves out those that are marked as intersecting."""
    p = wp.tid()
    if p >= pair_count[0]:
        return
    a, b = pairs[p][0], pairs[p][1]
    changed = ways.is_changed[a] + ways.is_changed[b] > 0 and ways.part[a] + ways.part[b] > ZERO
    hits_inout.any_hit[p] = wp.where(changed and ways.is_exempt[p] == 0, 0, 1)


@wp.func
def way_length(objects: ObjectPool, ways: Ways, bodies: Bodies, i: wp.int32):
    """Return about how far a body's surface moves, 0 for others."""
    if bodies.motion_type[i] != DYNAMIC:
        return wp.length(ways.ends.position[i] - objects.position[i])
    turn = ways.ends.rotation[i] - objects.rotation[i]
    side = wp.sqrt(wp.ddot(turn, turn)) * bodies.bounding_radius[i]
    return wp.length(ways.ends.position[i] - objects.position[i]) + side


@wp.kernel
def cut_way_kernel(
    mode: wp.int32,
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    objects: ObjectPool,
    hits: Hits,
    contacts: Contacts,
    bodies: Bodies,
    ways_inout: Ways,
):
    """Cut the ways of both objects of a pair a thread that is not proved clear, or hold their worlds."""
    p = wp.tid()
    if p >= pair_count[0] or hits.any_hit[p] != 0 or contacts.end[p] == CLEAR:
        return
    a, b = pairs[p][0], pairs[p][1]
    if contacts.end[p] == UNDECIDED:
        wp.atomic_add(ways_inout.counter, UNDECIDED_PAIRS, 1)
    if mode == CERTIFY:
        wp.atomic_add(ways_inout.counter, HELD, 1)
        for k in range(2):
            if bodies.motion_type[pairs[p][k]] != STATIC:
                wp.atomic_max(ways_inout.is_held, ways_inout.world[pairs[p][k]], 1)
        return
    part = ZERO
    if mode == CUT:
        # A quarter of a slop before the contact, where contacts ahead find it; at least half the way to it.
        time = contacts.time[p]
        length = way_length(objects, ways_inout, bodies, a) + way_length(objects, ways_inout, bodies, b)
        back = wp.float64(0.25) * SLOP * wp.min(bodies.bounding_radius[a], bodies.bounding_radius[b])
        part = wp.max(HALF * time, time - back / wp.max(length, back))
    for k in range(2):
        wp.atomic_min(ways_inout.cut, pairs[p][k], part)


@wp.kernel
def apply_cut_kernel(objects: ObjectPool, bodies: Bodies, ways_inout: Ways):
    """End an object's way where the round has cut it."""
    i = wp.tid()
    part = ways_inout.cut[i]
    ways_inout.cut[i] = ONE
    changed = part < ONE and ways_inout.part[i] > ZERO
    ways_inout.is_changed[i] = wp.where(changed, 1, 0)
    if not changed:
        return
    ways_inout.part[i] = part * ways_inout.part[i]
    if part == ZERO:
        ways_inout.ends.rotation[i] = objects.rotation[i]
        ways_inout.ends.position[i] = objects.position[i]
        return
    path = make_path(False, objects, ways_inout.ends, i)
    rotation = objects.rotation[i] * turn_matrix(path.axis, part * path.angle)
    if bodies.motion_type[i] == DYNAMIC:
        # By way of a quaternion, so that it stays a rotation, cut after cut.
        axes = bodies.axes[i]
        rotation = wp.quat_to_matrix(wp.normalize(wp.quat_from_matrix(rotation * axes))) * wp.transpose(axes)
    ways_inout.ends.rotation[i] = rotation
    ways_inout.ends.position[i] = objects.position[i] + part * path.travel


@wp.func
def spin_energy(rotation: wp.quatd, momentum: wp.vec3d, inverse_moment: wp.vec3d):
    """Return twice the energy of rotation."""
    m = wp.quat_rotate_inv(rotation, momentum)
    return wp.dot(m, wp.cw_mul(inverse_moment, m))


@wp.kernel
def end_way_kernel(
    velocity_change: wp.vec3d,
    launched: wp.array(dtype=wp.int32),
    pair_count: wp.array(dtype=wp.int32),
    hits: Hits,
    ways: Ways,
    bodies_inout: Bodies,
    objects_inout: ObjectPool,
):
    """Pose an object where its way ends, unless not all pairs were found.

    Gravity acts on a body for the part of the step that it moves, and a turn that is cut short adds no energy.
    """
    i = wp.tid()
    if bodies_inout.is_whole[0] == 0 or bodies_inout.motion_type[i] == STATIC:
        return
    whole = launched[0] >= 0 and wp.uint32(pair_count[0]) <= wp.uint32(ways.is_exempt.shape[0])
    if hits.uncertain.shape[0] > 0:
        whole = whole and wp.uint32(hits.uncertain_total[0]) <= wp.uint32(hits.uncertain.shape[0])
    if not whole:
        return
    part = ways.part[i]
    if ways.is_held[ways.world[i]] != 0:
        part = ZERO
    else:
        objects_inout.rotation[i] = ways.ends.rotation[i]
        objects_inout.position[i] = ways.ends.position[i]
    ways.part[i] = part
    if bodies_inout.motion_type[i] != DYNAMIC or part == ONE:
        return
    rotation = objects_inout.rotation[i]
    bodies_inout.position[i] = objects_inout.position[i] + rotation * bodies_inout.centre[i]
    q = wp.normalize(wp.quat_from_matrix(rotation * bodies_inout.axes[i]))
    momentum, inverse = bodies_inout.momentum[i], bodies_inout.inverse_moment[i]
    before = spin_energy(bodies_inout.rotation[i], momentum, inverse)
    after = spin_energy(q, momentum, inverse)
    bodies_inout.rotation[i] = q
    if after > before:
        bodies_inout.momentum[i] = wp.sqrt(before / after) * momentum
    down = wp.normalize(velocity_change)
    speed = wp.max(wp.dot(bodies_inout.velocity[i], down), ZERO)
    bodies_inout.velocity[i] -= wp.min((ONE - part) * wp.length(velocity_change), speed) * down
