"""Contact reduction: the points of an object pair that its violated motions choose.

Of a set of twists of the second object, each goes as far as the points chosen allow, and no farther than a limit: fixed
ones, and turns about lines at the rim of the candidates, across the normal of the deepest one and of that whose normal
is most against it, since a random motion seldom is one that a single corner stops.
The candidate that any of them takes deepest into the other object is the next point, until none is taken in. So the
points chosen are about as good as all candidates in what they allow, for any motion. The deepest candidate is among
them, or one about as deep. A block works on a pair, on the CPU one thread.

Candidates are wrenches. A wrench is two entries of 16 bytes, in the frame of A, for which motions are small:

    127        96 95         64 63         32 31          0
    [ separation |  normal z   |  normal y   |  normal x   ]
    [   number   |  moment z   |  moment y   |  moment x   ]

The moment is that of the normal about the middle of all candidates of the pair, over their `size`, so that rotations
count as what they move. Separations count from the deepest candidate, if that is inside: as if both objects had first
come apart as far as that. The number is the candidate's place among those of all contacts.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.nodes import load_entry, store_entry
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.contacts.column import COLUMN_CORNERS, NO_DEPTH
from warp_abtree.kernels.contacts.manifold import Manifolds, Witnesses
from warp_abtree.kernels.contacts.slots import WitnessRows, gap_of

TWIST_COUNT, RANDOM_TWISTS = native.constant("TWIST_COUNT"), native.constant("RANDOM_TWISTS")
wp.set_module_options(native.options("contacts/twists.cuh") | {"block_dim": TWIST_COUNT})

# Part of the limit of motions that candidates may be taken in by.
TOLERANCE = wp.constant(wp.float64(2.0**-10))
# Motions go so far, in sizes of the contact, where gap and depth are less.
LEAST_MOTION = wp.constant(wp.float64(2.0**-8))
# The deepest candidate is among those chosen if this part of its depth is more than theirs.
DEEPER = wp.constant(wp.float64(0.9))


@native.func_native()
def group_size() -> wp.int32: ...


@native.func_native()
def group_lane() -> wp.int32: ...


@native.func_native()
def group_sync(): ...


@native.func_native()
def greatest_of_group(x: wp.float64) -> wp.float64:
    """Return the greatest number of all threads."""


@native.func_native()
def next_place_of_group(end: wp.ref[wp.int32], flag: bool) -> wp.int32:
    """Return this thread's place in a list that ends there, of the threads whose flag is set, and move the end."""


@wp.struct
class ObjectPose:
    """Pose of A, and the sense in which its pair names the objects."""

    rotation: wp.mat33d  # to the world
    position: wp.vec3d  # [world units]
    sense: wp.float64  # 1, or -1 where B is named first


@wp.struct
class Candidates:
    """Candidates of a pair."""

    first: wp.int32  # where its wrenches begin
    end: wp.int32  # where they end
    deepest: wp.float64  # depth of the deepest, NO_DEPTH where none has one [world units]
    middle: wp.vec3d  # of their box, A's frame [world units]
    size: wp.float64  # half of its diagonal [world units]


@wp.func
def has_candidate(number: wp.int32, lowest: wp.float64, witnesses: Witnesses):
    """Return whether there is a candidate of a number that is deep enough."""
    return witnesses.depth[number / COLUMN_CORNERS, number % COLUMN_CORNERS] >= lowest


@wp.func
def deepest_of(first: wp.int32, end: wp.int32, witnesses: Witnesses):
    """Return the depth of the deepest candidate of some numbers, NO_DEPTH where there is none."""
    deepest = NO_DEPTH
    number = first + group_lane()
    while number < end:
        if has_candidate(number, NO_DEPTH, witnesses):
            deepest = wp.max(deepest, witnesses.depth[number / COLUMN_CORNERS, number % COLUMN_CORNERS])
        number += group_size()
    return greatest_of_group(deepest)


@wp.func
def list_wrenches(span: wp.vec2i, lowest: wp.float64, pose: ObjectPose, found: Candidates, witnesses: Witnesses):
    """List the wrenches of a pair's candidates in the order of their numbers, and return where they end."""
    back, zero, one = wp.transpose(pose.rotation), wp.float64(0.0), wp.float64(1.0)
    deepest = wp.max(found.deepest, zero)
    scale = wp.where(found.size > zero, one / found.size, zero)
    end, base = wp.int32(found.first), COLUMN_CORNERS * span[0]
    while base < COLUMN_CORNERS * span[1]:
        number = base + group_lane()
        lists = number < COLUMN_CORNERS * span[1]
        if lists:
            lists = has_candidate(number, lowest, witnesses)
        place = next_place_of_group(end, lists)
        if lists:
            i, k = number / COLUMN_CORNERS, number % COLUMN_CORNERS
            n = pose.sense * (back * witnesses.normal[i])
            arm = (back * (witnesses.point[i, k] - pose.position) - found.middle) * scale
            m = wp.cross(arm, n)
            depth = wp.where(witnesses.depth[i, k] == NO_DEPTH, zero, witnesses.depth[i, k])
            entry = wp.vec4(wp.float32(n[0]), wp.float32(n[1]), wp.float32(n[2]), wp.float32(deepest - depth))
            store_entry(witnesses.wrench, wp.int64(2) * wp.int64(place), entry)
            entry = wp.vec4(wp.float32(m[0]), wp.float32(m[1]), wp.float32(m[2]), wp.cast(number, wp.float32))
            store_entry(witnesses.wrench, wp.int64(2) * wp.int64(place) + wp.int64(1), entry)
        base += group_size()
    group_sync()
    return end


@wp.func
def list_candidates(span: wp.vec2i, shell: wp.float64, pose: ObjectPose, witnesses: Witnesses):
    """List the candidates of a pair, deeper than minus its gap; middles of contacts where no face has a depth.

    Args:
        span: Where the pair's witnesses begin and end.
        shell: The gap.
    """
    found = Candidates()
    first, end = COLUMN_CORNERS * span[0], COLUMN_CORNERS * span[1]
    found.first = first
    found.deepest = deepest_of(first, end, witnesses)
    lowest = wp.where(found.deepest == NO_DEPTH, NO_DEPTH, -shell)
    low = wp.vec3d(-wp.float64(wp.inf))
    high = wp.vec3d(-wp.float64(wp.inf))
    back = wp.transpose(pose.rotation)
    number = first + group_lane()
    while number < end:
        if has_candidate(number, lowest, witnesses):
            x = back * (witnesses.point[number / COLUMN_CORNERS, number % COLUMN_CORNERS] - pose.position)
            low = wp.max(low, -x)
            high = wp.max(high, x)
        number += group_size()
    for k in range(3):
        low[k] = greatest_of_group(low[k])
        high[k] = greatest_of_group(high[k])
    found.middle = wp.float64(0.5) * (high - low)
    found.size = wp.float64(0.5) * wp.length(high + low)
    found.end = list_wrenches(span, lowest, pose, found, witnesses)
    return found


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
def write_in_order(
    p: wp.int32,
    along: wp.vec3d,
    count: wp.int32,
    witnesses: Witnesses,
    manifolds: Manifolds,
):
    """Write the points of a pair in the order in which they lie along a direction of its lower object.

    So points that stay keep their order from step to step, whichever was found first, and whatever face they are on.
    """
    group_sync()
    k = group_lane()
    while k < count:
        number = number_of(witnesses.chosen[p, k], witnesses)
        witnesses.place[p, k] = witnesses.point[number / COLUMN_CORNERS, number % COLUMN_CORNERS]
        k += group_size()
    group_sync()
    k = group_lane()
    while k < count:
        number = number_of(witnesses.chosen[p, k], witnesses)
        point, place = witnesses.place[p, k], wp.int32(0)
        for j in range(count):
            ahead = wp.dot(along, point - witnesses.place[p, j])
            if ahead > wp.float64(0.0) or (ahead == wp.float64(0.0) and j < k):
                place += 1
        depth = witnesses.depth[number / COLUMN_CORNERS, number % COLUMN_CORNERS]
        manifolds.point[p, place] = point
        manifolds.normal[p, place] = witnesses.normal[number / COLUMN_CORNERS]
        manifolds.depth[p, place] = wp.where(depth == NO_DEPTH, wp.float64(0.0), depth)
        if manifolds.witness.shape[0] > 0:
            manifolds.witness[p, place] = number / COLUMN_CORNERS
        k += group_size()
    if group_lane() == 0:
        manifolds.count[p] = count


@wp.kernel(launch_bounds=(TWIST_COUNT, 3))
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
    zero, shell = wp.float64(0.0), gap_of(gap, p)
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    pose = ObjectPose()
    pose.rotation = objects.rotation[a]
    pose.position = objects.position[a]
    pose.sense = wp.where(batch.pairs[p][0] == a, wp.float64(1.0), wp.float64(-1.0))
    found = list_candidates(span, shell, pose, witnesses_inout)
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
            witnesses_inout.chosen.shape[1],
            witnesses_inout.chosen[p],
        )
    write_in_order(p, order_direction(pose.rotation), count, witnesses_inout, manifolds_out)
