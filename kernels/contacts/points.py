"""Contact reduction: the points of an object pair that its violated motions choose.

Of a set of twists of the second object, each goes as far as the points chosen allow, and no farther than a limit: fixed
ones, and turns about lines at the rim of the candidates, across the normal of the deepest one and of that whose normal
is most against it, since a random motion seldom is one that a single corner stops.
The candidate that any of them takes deepest into the other object is the next point, until none is taken in. So the
points chosen are about as good as all candidates in what they allow, for any motion. The deepest candidate is among
them, or one about as deep.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.nodes import load_entry
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.contacts.candidates import ObjectPose, group_lane, group_size, list_candidates
from warp_abtree.kernels.contacts.column import COLUMN_CORNERS, NO_DEPTH
from warp_abtree.kernels.contacts.manifold import Manifolds, Witnesses
from warp_abtree.kernels.contacts.slots import WitnessRows

TWIST_COUNT, RANDOM_TWISTS = native.constant("TWIST_COUNT"), native.constant("RANDOM_TWISTS")
MODULE_OPTIONS = native.options("contacts/twists.cuh") | {"block_dim": TWIST_COUNT}
wp.set_module_options(MODULE_OPTIONS)

# Part of the limit of motions that candidates may be taken in by.
TOLERANCE = wp.constant(wp.float64(2.0**-10))
# Motions go so far, in sizes of the contact, where gap and depth are less.
LEAST_MOTION = wp.constant(wp.float64(2.0**-8))
# The deepest candidate is among those chosen if this part of its depth is more than theirs.
DEEPER = wp.constant(wp.float64(0.9))


@native.func_native()
def choose_by_twists(
    wrenches: wp.array(dtype=wp.vec4),
    first: wp.int32,
    end: wp.int32,
    twists: wp.array(dtype=wp.float32),
    limit: wp.float32,
    tolerance: wp.float32,
    deep: wp.float32,
    most: wp.int32,
    chosen: wp.array(dtype=wp.int32),
) -> wp.int32:
    """Choose wrenches by the twists that violate them, the first of several as deep; return how many are chosen.

    Args:
        first, end: Which wrenches are the candidates, one at least.
        twists: Linear and angular velocities, each component of all in a row, shape [6 TWIST_COUNT].
        limit: How far motions go.
        tolerance: Depth that does not count.
        deep: Separation that one of those chosen must not be above; else the nearest is the last.
    """


@wp.func
def order_direction(rotation: wp.mat33d):
    """Return the direction along which the points of a pair are in order, of its lower object's rotation."""
    return rotation * wp.vec3d(wp.float64(0.6134), wp.float64(0.5327), wp.float64(0.5831))


@wp.func
def number_of(wrench: wp.int32, witnesses: Witnesses):
    """Return the number of the candidate of a wrench."""
    entry = load_entry(witnesses.wrench, wp.int64(2) * wp.int64(wrench) + wp.int64(1))
    return wp.cast(entry[3], wp.int32)


@wp.func
def point_of(number: wp.int32, witnesses: Witnesses):
    return witnesses.point[number / COLUMN_CORNERS, number % COLUMN_CORNERS]


@wp.func
def write_in_order(
    p: wp.int32,
    along: wp.vec3d,
    count: wp.int32,
    chosen: wp.array(dtype=wp.int32),
    witnesses: Witnesses,
    manifolds: Manifolds,
):
    """Write the points of a pair in the order in which they lie along a direction of its lower object.

    So points that stay keep their order from step to step, whichever was found first, and whatever face they are on.
    """
    k = group_lane()
    while k < count:
        number = number_of(chosen[k], witnesses)
        point = point_of(number, witnesses)
        place = wp.int32(0)
        for j in range(count):
            ahead = wp.dot(along, point - point_of(number_of(chosen[j], witnesses), witnesses))
            if ahead > wp.float64(0.0) or (ahead == wp.float64(0.0) and j < k):
                place += 1
        depth = witnesses.depth[number / COLUMN_CORNERS, number % COLUMN_CORNERS]
        manifolds.point[p, place] = point
        manifolds.normal[p, place] = witnesses.normal[number / COLUMN_CORNERS]
        manifolds.depth[p, place] = wp.where(depth == NO_DEPTH, wp.float64(0.0), depth)
        k += group_size()
    if group_lane() == 0:
        manifolds.count[p] = count


@functools.cache
def point_chooser(most: int):
    """Return the kernel that chooses the points of each pair, so many at most, by a block a pair."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def choose_point_kernel(
        objects: ObjectPool,
        batch: PairBatch,
        twists: wp.array(dtype=wp.float32),
        gap: wp.array(dtype=wp.float64),
        rows: WitnessRows,
        witnesses_inout: Witnesses,
        manifolds_out: Manifolds,
    ):
        """Choose the points of one pair.

        Args:
            twists: As for `choose_by_twists`.
            gap: Of each pair [world units], or [0] for none.
        """
        p = wp.tid() / group_size()
        span = wp.vec2i(rows.start[p], rows.start[p] + rows.count[p])
        if span[0] >= span[1]:
            if group_lane() == 0:
                manifolds_out.count[p] = 0
            return
        zero, shell = wp.float64(0.0), wp.float64(0.0)
        if gap.shape[0] > 0:
            shell = gap[p]
        a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
        pose = ObjectPose()
        pose.rotation = objects.rotation[a]
        pose.position = objects.position[a]
        pose.sense = wp.where(batch.pairs[p][0] == a, wp.float64(1.0), wp.float64(-1.0))
        found = list_candidates(span, shell, pose, witnesses_inout)
        chosen = wp.zeros(shape=(wp.static(most),), dtype=wp.int32)
        count = wp.int32(0)
        if found.first < found.end:
            inside = wp.where(found.deepest == NO_DEPTH, zero, found.deepest)
            deepest = wp.max(inside, zero)
            limit = wp.float64(2.0) * (shell + deepest) + LEAST_MOTION * found.size
            deep = (shell - DEEPER * (shell + inside)) + deepest
            count = choose_by_twists(
                witnesses_inout.wrench,
                found.first,
                found.end,
                twists,
                wp.float32(limit),
                wp.float32(TOLERANCE * limit),
                wp.float32(deep),
                wp.static(most),
                chosen,
            )
        write_in_order(p, order_direction(pose.rotation), count, chosen, witnesses_inout, manifolds_out)

    return choose_point_kernel
