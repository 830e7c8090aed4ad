"""Contact constraints of a step: their set-up, and warm starting from the step before."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool, pair_key
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies, radius_of
from warp_abtree.kernels.bodies.graph_coloring import COLOR_COUNT, INACTIVE
from warp_abtree.kernels.contacts.manifold import Manifolds

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

MATCH_RADIUS = wp.constant(wp.float64(0.05))
"""Largest distance of a point from its match in the step before, as a fraction of the bounding radius."""


@wp.struct
class Constraints:
    """Contact points of each pair as the solver sees them, shape [pair, POINTS] as `Manifolds`, or [pair]."""

    arm_a: wp.array2d(dtype=wp.vec3d)  # from the centre of mass of the first body, where the step begins
    arm_b: wp.array2d(dtype=wp.vec3d)  # from that of the second
    impulse: wp.array2d(dtype=wp.float64)  # of a substep, along the normal
    friction_impulse: wp.array2d(dtype=wp.vec3d)  # of a substep, across the normal, world frame
    is_struck: wp.array(dtype=wp.int32)  # [pair] whether it met fast: the next substep has none of its impulses
    color: wp.array(dtype=wp.int32)  # [pair] 0 .. COLOR_COUNT, or INACTIVE
    rank: wp.array(dtype=wp.vec2i)  # [pair] how many pairs are relaxed before it that have its bodies


@wp.struct
class WarmStart:
    """Impulses of the step before."""

    key: wp.array(dtype=wp.int64)  # pair keys, sorted
    count: wp.array(dtype=wp.int32)  # points of each pair
    point: wp.array2d(dtype=wp.vec3d)  # in the frame of the pair's first object
    impulse: wp.array2d(dtype=wp.float64)  # along the normal
    friction_impulse: wp.array2d(dtype=wp.vec3d)  # across the normal, world frame


@wp.func
def velocity_at(bodies: Bodies, i: wp.int32, arm: wp.vec3d):
    """Return the velocity of a body at the end of an arm from its centre of mass."""
    return bodies.velocity[i] + wp.cross(bodies.inverse_inertia[i] * bodies.momentum[i], arm)


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
    fast: wp.float64,
    batch: PairBatch,
    objects: ObjectPool,
    manifolds: Manifolds,
    warm_start: WarmStart,
    bodies: Bodies,
    order_out: wp.array(dtype=wp.int32),
    constraints_out: Constraints,
):
    """Set up the constraints of one pair a thread; points no faster than `fast` are matched with the step before."""
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
    constraints_out.is_struck[p] = 0
    key = pair_key(batch.pairs[p])
    row = wp.min(wp.lower_bound(warm_start.key, key), warm_start.key.shape[0] - 1)
    known = warm_start.key[row] == key
    used = wp.int32(0)
    before = wp.float64(0.0)
    if known:
        for k in range(warm_start.count[row]):
            before += warm_start.impulse[row, k]
    total = wp.float64(0.0)
    for k in range(manifolds.count[p]):
        x = manifolds.point[p, k]
        normal = manifolds.normal[p, k]
        arm_a = x - bodies.position[a]
        arm_b = x - bodies.position[b]
        constraints_out.arm_a[p, k] = arm_a
        constraints_out.arm_b[p, k] = arm_b
        constraints_out.impulse[p, k] = wp.float64(0.0)
        constraints_out.friction_impulse[p, k] = wp.vec3d()
        speed = wp.dot(normal, velocity_at(bodies, b, arm_b) - velocity_at(bodies, a, arm_a))
        if known and wp.abs(speed) <= fast:
            local = wp.transpose(objects.rotation[a]) * (x - objects.position[a])
            match = find_match(warm_start, row, MATCH_RADIUS * radius_of(bodies, batch.pairs[p]), local, used)
            if match < 0 and before > wp.float64(0.0):
                constraints_out.impulse[p, k] = before / wp.float64(warm_start.count[row])
            if match >= 0:
                used = used | (1 << match)
                friction = warm_start.friction_impulse[row, match]
                constraints_out.impulse[p, k] = warm_start.impulse[row, match]
                constraints_out.friction_impulse[p, k] = friction - wp.dot(friction, normal) * normal
            total += constraints_out.impulse[p, k]
    if total > wp.float64(0.0):
        # Points come and go where many would do; what the pair bears together stays.
        for k in range(manifolds.count[p]):
            constraints_out.impulse[p, k] = (before / total) * constraints_out.impulse[p, k]


@wp.kernel
def save_impulses_kernel(
    key: wp.array(dtype=wp.int64),
    batch: PairBatch,
    objects: ObjectPool,
    manifolds: Manifolds,
    constraints: Constraints,
    bodies: Bodies,
    warm_start_out: WarmStart,
):
    """Save the impulses of one pair a thread for the next step, with points relative to the first object."""
    p = wp.tid()
    if bodies.is_whole[0] == 0:
        return
    warm_start_out.key[p] = key[p]
    warm_start_out.count[p] = manifolds.count[p]
    a = batch.pairs[p][0]
    for k in range(manifolds.count[p]):
        local = wp.transpose(objects.rotation[a]) * (manifolds.point[p, k] - objects.position[a])
        warm_start_out.point[p, k] = local
        warm_start_out.impulse[p, k] = constraints.impulse[p, k]
        warm_start_out.friction_impulse[p, k] = constraints.friction_impulse[p, k]
