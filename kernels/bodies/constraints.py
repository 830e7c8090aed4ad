"""Contact constraints of a step: their set-up, and warm starting from the step before."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool, pair_key
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies
from warp_abtree.kernels.bodies.graph_coloring import COLOR_COUNT, INACTIVE
from warp_abtree.kernels.contacts.manifold import Manifolds

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BAUMGARTE = wp.constant(wp.float64(0.2))
"""Fraction of the penetration that one step corrects."""

SLOP = wp.constant(wp.float64(2.0**-9))
"""Penetration that is not corrected, as a fraction of the bounding radius."""

MATCH_RADIUS = wp.constant(wp.float64(0.05))
"""Largest distance of a point from its match in the step before, as a fraction of the bounding radius."""

IMPACT = wp.constant(wp.float64(64.0))
"""Speed of impacts from which on nothing is kept, times what gravity adds in two steps."""


@wp.struct
class Constraints:
    """Contact points of each pair as the solver sees them, shape [pair, POINTS] as `Manifolds`, or [pair]."""

    arm_a: wp.array2d(dtype=wp.vec3d)  # from the centre of mass of the first body
    arm_b: wp.array2d(dtype=wp.vec3d)  # from that of the second
    mass: wp.array2d(dtype=wp.float64)  # effective mass along the normal
    tangent_mass: wp.array2d(dtype=wp.mat33d)  # effective mass across the normal, world frame
    bias: wp.array2d(dtype=wp.float64)  # separation speed that the position correction aims for [world units/s]
    approach: wp.array2d(dtype=wp.float64)  # speed at which points that are apart meet after the step [world units/s]
    speed: wp.array2d(dtype=wp.float64)  # of separation before the step [world units/s]
    impulse: wp.array2d(dtype=wp.float64)  # accumulated, along the normal
    friction_impulse: wp.array2d(dtype=wp.vec3d)  # accumulated, across the normal, world frame
    pseudo_impulse: wp.array2d(dtype=wp.float64)  # accumulated, of the position correction
    color: wp.array(dtype=wp.int32)  # [pair] 0 .. COLOR_COUNT, or INACTIVE


@wp.struct
class WarmStart:
    """Impulses of the step before."""

    key: wp.array(dtype=wp.int64)  # pair keys, sorted
    count: wp.array(dtype=wp.int32)  # points of each pair
    point: wp.array2d(dtype=wp.vec3d)  # in the frame of the pair's first object
    impulse: wp.array2d(dtype=wp.float64)  # along the normal
    friction_impulse: wp.array2d(dtype=wp.vec3d)  # across the normal, world frame


@wp.struct
class Point:
    """A contact point, as functions of the solver take it."""

    pair: wp.int32  # row of `Constraints`
    column: wp.int32  # column of `Constraints`
    a: wp.int32  # first object
    b: wp.int32  # second object
    normal: wp.vec3d  # from the first to the second object


@wp.func
def make_point(manifolds: Manifolds, pair: wp.vec2i, p: wp.int32, k: wp.int32):
    """Return point k of pair p."""
    point = Point()
    point.pair = p
    point.column = k
    point.a = pair[0]
    point.b = pair[1]
    point.normal = manifolds.normal[p, k]
    return point


@wp.func
def point_velocity(inverse_inertia: wp.mat33d, velocity: wp.vec3d, momentum: wp.vec3d, arm: wp.vec3d):
    """Return the velocity of a body at the end of an arm from its centre of mass."""
    return velocity + wp.cross(inverse_inertia * momentum, arm)


@wp.func
def relative_velocity(constraints: Constraints, bodies: Bodies, c: Point):
    """Return the velocity of the second object relative to the first at a point."""
    arm_a = constraints.arm_a[c.pair, c.column]
    arm_b = constraints.arm_b[c.pair, c.column]
    at_a = point_velocity(bodies.inverse_inertia[c.a], bodies.velocity[c.a], bodies.momentum[c.a], arm_a)
    at_b = point_velocity(bodies.inverse_inertia[c.b], bodies.velocity[c.b], bodies.momentum[c.b], arm_b)
    return at_b - at_a


@wp.func
def mobility(bodies: Bodies, i: wp.int32, arm: wp.vec3d):
    """Return the matrix that takes an impulse at the end of an arm to the velocity that it gives there."""
    if bodies.motion_type[i] != DYNAMIC:
        return wp.mat33d()
    cross = wp.skew(arm)
    return bodies.inverse_mass[i] * wp.identity(n=3, dtype=wp.float64) - cross * bodies.inverse_inertia[i] * cross


@wp.func
def set_effective_mass(bodies: Bodies, constraints: Constraints, c: Point):
    """Set the effective masses of a point along the normal and across it."""
    k = mobility(bodies, c.a, constraints.arm_a[c.pair, c.column])
    k += mobility(bodies, c.b, constraints.arm_b[c.pair, c.column])
    along = wp.dot(c.normal, k * c.normal)
    normal = wp.outer(c.normal, c.normal)
    across = wp.identity(n=3, dtype=wp.float64) - normal
    constraints.mass[c.pair, c.column] = wp.float64(1.0) / along
    # The inverse within the tangent plane: along the normal the matrix is made `along`, and its inverse taken off.
    tangent_mass = wp.inverse(across * k * across + along * normal) - normal / along
    constraints.tangent_mass[c.pair, c.column] = tangent_mass


@wp.func
def find_match(warm_start: WarmStart, row: wp.int32, radius: wp.float64, point: wp.vec3d, used: wp.int32):
    """Return the nearest unused point of a pair of the step before within a radius, or -1."""
    best = wp.int32(-1)
    nearest = radius * radius
    for k in range(warm_start.count[row]):
        r = warm_start.point[row, k] - point
        if ((used >> k) & 1) == 0 and wp.dot(r, r) <= nearest:
            nearest = wp.dot(r, r)
            best = k
    return best


@wp.kernel
def prepare_constraints_kernel(
    dt: wp.float64,
    fast: wp.float64,
    shell: wp.float64,
    batch: PairBatch,
    objects: ObjectPool,
    manifolds: Manifolds,
    warm_start: WarmStart,
    bodies: Bodies,
    order_out: wp.array(dtype=wp.int32),
    constraints_out: Constraints,
):
    """Set up the constraints of one pair a thread; points no faster than `fast` are matched with the step before.

    Args:
        shell: By how much points count as deeper than they are, as a fraction of the bounding radius.
    """
    p = wp.tid()
    order_out[p] = p
    constraints_out.color[p] = INACTIVE
    if manifolds.count[p] == 0:
        return
    a = batch.pairs[p][0]
    b = batch.pairs[p][1]
    if bodies.motion_type[a] != DYNAMIC and bodies.motion_type[b] != DYNAMIC:
        return
    constraints_out.color[p] = COLOR_COUNT
    radius = wp.min(bodies.bounding_radius[a], bodies.bounding_radius[b])
    key = pair_key(batch.pairs[p])
    row = wp.min(wp.lower_bound(warm_start.key, key), warm_start.key.shape[0] - 1)
    known = warm_start.key[row] == key
    used = wp.int32(0)
    for k in range(manifolds.count[p]):
        x = manifolds.point[p, k]
        c = make_point(manifolds, batch.pairs[p], p, k)
        constraints_out.arm_a[p, k] = x - bodies.position[a]
        constraints_out.arm_b[p, k] = x - bodies.position[b]
        set_effective_mass(bodies, constraints_out, c)
        whole = manifolds.depth[p, k] + shell * radius
        depth = wp.max(whole, wp.float64(0.0))
        constraints_out.bias[p, k] = BAUMGARTE * (depth - SLOP * radius) / dt
        constraints_out.approach[p, k] = (depth - whole) / dt
        constraints_out.impulse[p, k] = wp.float64(0.0)
        constraints_out.friction_impulse[p, k] = wp.vec3d()
        constraints_out.pseudo_impulse[p, k] = wp.float64(0.0)
        speed = wp.dot(c.normal, relative_velocity(constraints_out, bodies, c))
        constraints_out.speed[p, k] = speed
        if known and wp.abs(speed) <= fast:
            local = wp.transpose(objects.rotation[a]) * (x - objects.position[a])
            match = find_match(warm_start, row, MATCH_RADIUS * radius, local, used)
            if match >= 0:
                used = used | (1 << match)
                friction = warm_start.friction_impulse[row, match]
                constraints_out.impulse[p, k] = warm_start.impulse[row, match]
                constraints_out.friction_impulse[p, k] = friction - wp.dot(friction, c.normal) * c.normal


@wp.kernel
def save_impulses_kernel(
    fast: wp.float64,
    key: wp.array(dtype=wp.int64),
    batch: PairBatch,
    objects: ObjectPool,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
    warm_start_out: WarmStart,
):
    """Save the impulses of one pair a thread for the next step, with points relative to the first object.

    But for those of impacts, much faster than `fast`: what the next step's rounds leave of them would lift the body.
    """
    p = wp.tid()
    if bodies.is_whole[0] == 0:
        return
    warm_start_out.key[p] = key[p]
    warm_start_out.count[p] = manifolds.count[p]
    a = batch.pairs[p][0]
    for k in range(manifolds.count[p]):
        local = wp.transpose(objects.rotation[a]) * (manifolds.point[p, k] - objects.position[a])
        warm_start_out.point[p, k] = local
        strikes = fast > wp.float64(0.0) and constraints.speed[p, k] < -IMPACT * fast
        warm_start_out.impulse[p, k] = wp.where(strikes, wp.float64(0.0), constraints.impulse[p, k])
        warm_start_out.friction_impulse[p, k] = wp.where(strikes, wp.vec3d(), constraints.friction_impulse[p, k])
