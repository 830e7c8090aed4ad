"""Impulses at contact points, relaxed colour by colour: no body is in two pairs of a colour.

What a pair does is the same whichever kernel does it, and pairs of one colour share no body that moves: so all colours
in turn by one thread, and each colour at once by many, give the same bits.
"""

import warp as wp

from warp_abtree.kernels.arrays import ObjectPool
from warp_abtree.kernels.contact.manifold import LAST_KEY, POINTS, Manifolds
from warp_abtree.kernels.dynamics.bodies import AWAKE, Bodies
from warp_abtree.kernels.dynamics.graph_coloring import NO_COLOUR

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BOUNCE = wp.constant(0)
START = wp.constant(1)
VELOCITY = wp.constant(2)
PLACE = wp.constant(3)
"""What is relaxed: fast approach, impulses of the step before put in force, velocities, corrections of place."""

# Times that the points of a pair are relaxed for one bounce.
BOUNCE_ROUNDS = wp.constant(12)

# Part of the way out that one step goes.
PULL = wp.constant(wp.float64(0.2))
# Part of a body's reach within which a point is the one of the step before.
MATCH = wp.constant(wp.float64(0.05))


@wp.struct
class Rows:
    """Points of each pair, as `Manifolds`: arms from the centres of mass; tangent, one of two; masses that the pair
    has along the normal and across it; bias, the velocity of corrections [world units/s]; impulses along the normal
    and the tangents, and push, that of corrections; match, the point in memory, row * POINTS + number, or -1.
    Shape [pair]: restitution, friction, threshold, the normal speed below which nothing bounces [world units/s], and
    free, whether both are rigid bodies.
    """

    arm_a: wp.array2d(dtype=wp.vec3d)
    arm_b: wp.array2d(dtype=wp.vec3d)
    tangent: wp.array2d(dtype=wp.vec3d)
    mass: wp.array2d(dtype=wp.float64)
    mass_across: wp.array2d(dtype=wp.mat22d)
    bias: wp.array2d(dtype=wp.float64)
    impulse: wp.array2d(dtype=wp.float64)
    impulse_across: wp.array2d(dtype=wp.vec2d)
    push: wp.array2d(dtype=wp.float64)
    match: wp.array2d(dtype=wp.int32)
    restitution: wp.array(dtype=wp.float64)
    friction: wp.array(dtype=wp.float64)
    threshold: wp.array(dtype=wp.float64)
    free: wp.array(dtype=wp.int32)


@wp.struct
class Memory:
    """Impulses of the step before by pair key, sorted: point in the frame of the pair's first object, impulse along the
    normal, and across it in the world."""

    key: wp.array(dtype=wp.int64)
    count: wp.array(dtype=wp.int32)
    point: wp.array2d(dtype=wp.vec3d)
    impulse: wp.array2d(dtype=wp.float64)
    across: wp.array2d(dtype=wp.vec3d)


@wp.func
def velocity_at(bodies: Bodies, i: wp.int32, arm: wp.vec3d):
    spin = bodies.spin[i] + bodies.inverse_inertia[i] * bodies.momentum[i]
    return bodies.velocity[i] + wp.cross(spin, arm)


@wp.func
def push_at(bodies: Bodies, i: wp.int32, arm: wp.vec3d):
    return bodies.push[i] + wp.cross(bodies.inverse_inertia[i] * bodies.turn[i], arm)


@wp.func
def apply_impulse(bodies: Bodies, i: wp.int32, arm: wp.vec3d, impulse: wp.vec3d):
    if bodies.role[i] == AWAKE:
        bodies.velocity[i] += bodies.inverse_mass[i] * impulse
        bodies.momentum[i] += wp.cross(arm, impulse)


@wp.func
def apply_push(bodies: Bodies, i: wp.int32, arm: wp.vec3d, impulse: wp.vec3d):
    if bodies.role[i] == AWAKE:
        bodies.push[i] += bodies.inverse_mass[i] * impulse
        bodies.turn[i] += wp.cross(arm, impulse)


@wp.func
def response(bodies: Bodies, i: wp.int32, arm: wp.vec3d, u: wp.vec3d, v: wp.vec3d):
    """Return how fast the point at the end of an arm moves along v for an impulse of 1 along u."""
    if bodies.role[i] != AWAKE:
        return wp.float64(0.0)
    turned = bodies.inverse_inertia[i] * wp.cross(arm, u)
    return bodies.inverse_mass[i] * wp.dot(u, v) + wp.dot(turned, wp.cross(arm, v))


@wp.func
def across_normal(n: wp.vec3d):
    """Return a unit vector across a unit vector."""
    zero = wp.float64(0.0)
    v = wp.vec3d(-n[2], zero, n[0])
    if wp.abs(n[0]) < wp.abs(n[1]):
        v = wp.vec3d(zero, n[2], -n[1])
    return wp.normalize(v)


@wp.func
def recall_impulse(memory: Memory, row: wp.int32, radius: wp.float64, point: wp.vec3d, used: wp.int32):
    """Return which unused point of a pair in memory lies nearest within a radius, -1 for none."""
    best = wp.int32(-1)
    nearest = radius * radius
    k = wp.int32(0)
    while k < memory.count[row]:
        r = memory.point[row, k] - point
        if ((used >> k) & 1) == 0 and wp.dot(r, r) <= nearest:
            nearest = wp.dot(r, r)
            best = k
        k += 1
    return best


@wp.func
def set_masses(bodies: Bodies, rows: Rows, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32, n: wp.vec3d):
    """Set the masses and the tangent of a point."""
    arm_a = rows.arm_a[p, k]
    arm_b = rows.arm_b[p, k]
    t = across_normal(n)
    s = wp.cross(n, t)
    rows.tangent[p, k] = t
    rows.mass[p, k] = wp.float64(1.0) / (response(bodies, a, arm_a, n, n) + response(bodies, b, arm_b, n, n))
    tt = response(bodies, a, arm_a, t, t) + response(bodies, b, arm_b, t, t)
    ts = response(bodies, a, arm_a, t, s) + response(bodies, b, arm_b, t, s)
    ss = response(bodies, a, arm_a, s, s) + response(bodies, b, arm_b, s, s)
    det = tt * ss - ts * ts
    rows.mass_across[p, k] = wp.mat22d(ss / det, -ts / det, -ts / det, tt / det)


@wp.kernel
def prepare_row_kernel(
    dt: wp.float64,
    threshold: wp.float64,
    key: wp.array(dtype=wp.int64),
    pairs: wp.array(dtype=wp.vec2i),
    pair_colour: wp.array(dtype=wp.int32),
    objects: ObjectPool,
    manifolds: Manifolds,
    memory: Memory,
    bodies: Bodies,
    rows_out: Rows,
):
    """Make the rows of one pair a thread, from velocities before gravity; slow points recall their last impulses.

    Args:
        threshold: Normal speed below which nothing bounces [world units/s].
    """
    p = wp.tid()
    if pair_colour[p] == NO_COLOUR:
        return
    a = pairs[p][0]
    b = pairs[p][1]
    zero = wp.float64(0.0)
    rows_out.threshold[p] = threshold
    rows_out.free[p] = wp.where(bodies.inverse_mass[a] > zero and bodies.inverse_mass[b] > zero, 1, 0)
    rows_out.restitution[p] = wp.max(bodies.restitution[a], bodies.restitution[b])
    rows_out.friction[p] = wp.sqrt(bodies.friction[a] * bodies.friction[b])
    slop = wp.min(bodies.slop[a], bodies.slop[b])
    row = wp.lower_bound(memory.key, key[p])
    known = bool(False)
    if row < memory.key.shape[0]:
        known = memory.key[row] == key[p]
    used = wp.int32(0)
    k = wp.int32(0)
    while k < manifolds.count[p]:
        n = manifolds.normal[p, k]
        x = manifolds.point[p, k]
        rows_out.arm_a[p, k] = x - bodies.position[a]
        rows_out.arm_b[p, k] = x - bodies.position[b]
        set_masses(bodies, rows_out, p, k, a, b, n)
        moved = velocity_at(bodies, b, rows_out.arm_b[p, k]) - velocity_at(bodies, a, rows_out.arm_a[p, k])
        before = wp.dot(n, moved)
        rows_out.bias[p, k] = PULL * (manifolds.depth[p, k] - slop) / dt
        rows_out.impulse_across[p, k] = wp.vec2d()
        rows_out.push[p, k] = zero
        rows_out.match[p, k] = -1
        if known and wp.abs(before) <= threshold:
            local = wp.transpose(objects.rotation[a]) * (x - objects.position[a])
            match = recall_impulse(memory, row, MATCH * wp.min(bodies.reach[a], bodies.reach[b]), local, used)
            if match >= 0:
                used = used | (1 << match)
                rows_out.match[p, k] = row * POINTS + match
        k += 1


@wp.func
def normal_speed(rows: Rows, bodies: Bodies, n: wp.vec3d, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32):
    """Return how fast the two objects leave each other at a point."""
    return wp.dot(n, velocity_at(bodies, b, rows.arm_b[p, k]) - velocity_at(bodies, a, rows.arm_a[p, k]))


@wp.func
def push_speed(rows: Rows, bodies: Bodies, n: wp.vec3d, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32):
    """Return how fast the correction of place takes two objects from each other at a point."""
    return wp.dot(n, push_at(bodies, b, rows.arm_b[p, k]) - push_at(bodies, a, rows.arm_a[p, k]))


@wp.func
def add_impulse(rows: Rows, bodies: Bodies, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32, impulse: wp.vec3d):
    apply_impulse(bodies, a, rows.arm_a[p, k], -impulse)
    apply_impulse(bodies, b, rows.arm_b[p, k], impulse)


@wp.func
def add_push(rows: Rows, bodies: Bodies, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32, impulse: wp.vec3d):
    apply_push(bodies, a, rows.arm_a[p, k], -impulse)
    apply_push(bodies, b, rows.arm_b[p, k], impulse)


@wp.func
def rub_point(
    rows: Rows, bodies: Bodies, n: wp.vec3d, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32, limit: wp.float64
):
    """Relax the velocity of a point across the normal, with an impulse of at most a limit in all."""
    if rows.friction[p] == wp.float64(0.0):
        return
    t = rows.tangent[p, k]
    s = wp.cross(n, t)
    moved = velocity_at(bodies, b, rows.arm_b[p, k]) - velocity_at(bodies, a, rows.arm_a[p, k])
    old = rows.impulse_across[p, k]
    new = old - rows.mass_across[p, k] * wp.vec2d(wp.dot(t, moved), wp.dot(s, moved))
    length = wp.length(new)
    if length > limit:
        new = new * (limit / length)
    rows.impulse_across[p, k] = new
    add_impulse(rows, bodies, p, k, a, b, (new[0] - old[0]) * t + (new[1] - old[1]) * s)


@wp.func
def bounce_pair(manifolds: Manifolds, rows: Rows, bodies: Bodies, p: wp.int32, a: wp.int32, b: wp.int32):
    """Reflect the velocities of a pair that comes in fast.

    The impulses that would stop the approach say in which direction to reflect. How right they are depends on the
    rounds, but a reflection in any direction, (1 + e) times the impulse that stops the motion along it, keeps the
    energy for e = 1 and loses some for less. Friction acts after, against what slides, and loses some.
    Source: Smith et al. 2012, Reflections on Simultaneous Impact (generalized reflections), a pair at a time.
    """
    zero = wp.float64(0.0)
    fastest = zero
    along = zero
    k = wp.int32(0)
    while k < manifolds.count[p]:
        fastest = wp.min(fastest, normal_speed(rows, bodies, manifolds.normal[p, k], p, k, a, b))
        rows.impulse[p, k] = zero
        k += 1
    if not (fastest < -rows.threshold[p]):
        return
    # Pushes hold nothing yet: they are what the velocities would change by.
    round = wp.int32(0)
    while round < BOUNCE_ROUNDS:
        k = wp.int32(0)
        while k < manifolds.count[p]:
            n = manifolds.normal[p, k]
            speed = normal_speed(rows, bodies, n, p, k, a, b) + push_speed(rows, bodies, n, p, k, a, b)
            before = rows.impulse[p, k]
            rows.impulse[p, k] = wp.max(before - rows.mass[p, k] * speed, zero)
            add_push(rows, bodies, p, k, a, b, (rows.impulse[p, k] - before) * n)
            k += 1
        round += 1
    response = zero
    k = wp.int32(0)
    while k < manifolds.count[p]:
        n = manifolds.normal[p, k]
        along -= rows.impulse[p, k] * normal_speed(rows, bodies, n, p, k, a, b)
        response += rows.impulse[p, k] * push_speed(rows, bodies, n, p, k, a, b)
        k += 1
    clear_push(bodies, a)
    clear_push(bodies, b)
    scale = zero
    if response > zero:
        scale = (wp.float64(1.0) + rows.restitution[p]) * wp.max(along, zero) / response
    k = wp.int32(0)
    while k < manifolds.count[p]:
        add_impulse(rows, bodies, p, k, a, b, scale * rows.impulse[p, k] * manifolds.normal[p, k])
        k += 1
    k = wp.int32(0)
    while k < manifolds.count[p]:
        rows.impulse_across[p, k] = wp.vec2d()
        rub_point(rows, bodies, manifolds.normal[p, k], p, k, a, b, rows.friction[p] * scale * rows.impulse[p, k])
        k += 1


@wp.func
def clear_push(bodies: Bodies, i: wp.int32):
    if bodies.role[i] == AWAKE:
        bodies.push[i] = wp.vec3d()
        bodies.turn[i] = wp.vec3d()


@wp.func
def start_point(
    memory: Memory, rows: Rows, bodies: Bodies, n: wp.vec3d, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32
):
    """Put the impulses that a point recalls in force."""
    rows.impulse[p, k] = wp.float64(0.0)
    rows.impulse_across[p, k] = wp.vec2d()
    match = rows.match[p, k]
    if match < 0:
        return
    row = match // POINTS
    at = match % POINTS
    t = rows.tangent[p, k]
    s = wp.cross(n, t)
    across = memory.across[row, at]
    v = wp.vec2d(wp.dot(across, t), wp.dot(across, s))
    rows.impulse[p, k] = memory.impulse[row, at]
    rows.impulse_across[p, k] = v
    add_impulse(rows, bodies, p, k, a, b, memory.impulse[row, at] * n + v[0] * t + v[1] * s)


@wp.func
def relax_velocity(rows: Rows, bodies: Bodies, n: wp.vec3d, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32):
    """Relax the velocity of a point: across the normal within the cone of friction, then along it."""
    rub_point(rows, bodies, n, p, k, a, b, rows.friction[p] * rows.impulse[p, k])
    before = rows.impulse[p, k]
    speed = normal_speed(rows, bodies, n, p, k, a, b)
    rows.impulse[p, k] = wp.max(before - rows.mass[p, k] * speed, wp.float64(0.0))
    add_impulse(rows, bodies, p, k, a, b, (rows.impulse[p, k] - before) * n)


@wp.func
def relax_place(rows: Rows, bodies: Bodies, n: wp.vec3d, p: wp.int32, k: wp.int32, a: wp.int32, b: wp.int32):
    """Relax the place of a point: what its velocity does not do of the way out, a push does that leaves no velocity.

    Without gravity two bodies are not corrected, since that changes their angular momentum. Under gravity nothing that
    leaves fast is corrected, since to lift it adds energy.
    """
    zero = wp.float64(0.0)
    speed = normal_speed(rows, bodies, n, p, k, a, b)
    threshold = rows.threshold[p]
    if wp.where(threshold > zero, speed >= threshold, rows.free[p] != 0):
        return
    before = rows.push[p, k]
    moved = push_speed(rows, bodies, n, p, k, a, b) + wp.max(speed, zero)
    after = before - rows.mass[p, k] * (moved - rows.bias[p, k])
    # What rests sinks to the slop, where no noise breaks its contacts; nothing else is pulled.
    if threshold == zero or rows.impulse[p, k] <= zero:
        after = wp.max(before - rows.mass[p, k] * (moved - wp.max(rows.bias[p, k], zero)), zero)
    rows.push[p, k] = after
    add_push(rows, bodies, p, k, a, b, (rows.push[p, k] - before) * n)


@wp.func
def relax_pair(
    stage: wp.int32,
    backward: wp.int32,
    pairs: wp.array(dtype=wp.vec2i),
    manifolds: Manifolds,
    memory: Memory,
    rows: Rows,
    bodies: Bodies,
    p: wp.int32,
):
    """Relax the points of a pair one after another, the last one first if `backward`."""
    a = pairs[p][0]
    b = pairs[p][1]
    if stage == BOUNCE:
        bounce_pair(manifolds, rows, bodies, p, a, b)
        return
    turn = wp.int32(0)
    while turn < manifolds.count[p]:
        k = wp.where(backward != 0, manifolds.count[p] - 1 - turn, turn)
        n = manifolds.normal[p, k]
        if stage == START:
            start_point(memory, rows, bodies, n, p, k, a, b)
        elif stage == VELOCITY:
            relax_velocity(rows, bodies, n, p, k, a, b)
        else:
            relax_place(rows, bodies, n, p, k, a, b)
        turn += 1


@wp.kernel
def relax_colour_kernel(
    stage: wp.int32,
    backward: wp.int32,
    colour: wp.int32,
    order: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    manifolds: Manifolds,
    memory: Memory,
    rows_inout: Rows,
    bodies_inout: Bodies,
):
    """Relax the pairs of one colour, each by a thread of its own.

    Args:
        key, order: Colours in ascending order, and the pairs that have them.
    """
    k = wp.lower_bound(key, 0, order.shape[0] // 2, colour) + wp.tid()
    if k < order.shape[0] // 2 and key[k] == colour:
        relax_pair(stage, backward, pairs, manifolds, memory, rows_inout, bodies_inout, order[k])


@wp.kernel
def relax_in_turn_kernel(
    stage: wp.int32,
    backward: wp.int32,
    first: wp.int32,
    rounds: wp.int32,
    order: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    manifolds: Manifolds,
    memory: Memory,
    rows_inout: Rows,
    bodies_inout: Bodies,
):
    """Relax the pairs of all colours from the first one on, colour by colour, by one thread, a number of times.

    Args:
        backward: Whether the first round goes from the last colour to the first. Velocities go to and fro, so that no
            end of a stack is always the last to hear of the other; all else goes forward.
    """
    room = order.shape[0] // 2
    start = wp.lower_bound(key, 0, room, first)
    end = wp.lower_bound(key, 0, room, NO_COLOUR)
    round = wp.int32(0)
    while round < rounds:
        reverse = wp.where(stage == VELOCITY, (backward + round) % 2, 0)
        turn = wp.int32(0)
        while turn < end - start:
            k = wp.where(reverse != 0, end - 1 - turn, start + turn)
            relax_pair(stage, reverse, pairs, manifolds, memory, rows_inout, bodies_inout, order[k])
            turn += 1
        round += 1


@wp.kernel
def keep_impulse_kernel(
    pair_count: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int64),
    pairs: wp.array(dtype=wp.vec2i),
    pair_colour: wp.array(dtype=wp.int32),
    objects: ObjectPool,
    manifolds: Manifolds,
    rows: Rows,
    memory_out: Memory,
):
    """Keep the impulses of one pair a thread for the next step, with points where the object stood in this one."""
    p = wp.tid()
    memory_out.key[p] = LAST_KEY
    memory_out.count[p] = 0
    if p >= pair_count[0]:
        return
    memory_out.key[p] = key[p]
    if pair_colour[p] == NO_COLOUR:
        return
    memory_out.count[p] = manifolds.count[p]
    a = pairs[p][0]
    back = wp.transpose(objects.rotation[a])
    k = wp.int32(0)
    while k < manifolds.count[p]:
        t = rows.tangent[p, k]
        v = rows.impulse_across[p, k]
        memory_out.point[p, k] = back * (manifolds.point[p, k] - objects.position[a])
        memory_out.impulse[p, k] = rows.impulse[p, k]
        memory_out.across[p, k] = v[0] * t + v[1] * wp.cross(manifolds.normal[p, k], t)
        k += 1
