"""Candidate object pairs: posed root boxes in the world, and which objects may be a pair."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import LAST_KEY, ObjectPool, Trees, pair_key
from warp_abtree.kernels.base.boxes import round_down, round_up
from warp_abtree.kernels.base.generation import LaunchRecord, is_stale
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import ROUNDING_64, measure_skew

wp.set_module_options(native.options())

MIDDLE_MAX = wp.constant(wp.float32(2.0**100))
# Objects whose pairs are counted together, too, where pairs are listed in order.
COUNT_CHUNK = wp.constant(128)
# Of sums of lengths in float64.
REACH_ROUNDING = wp.constant(wp.float64(1.0 + 2.0**-48))


@wp.struct
class PosedBounds:
    """Boxes of objects in the world, and how many pairs of them were found."""

    lower: wp.array(dtype=wp.vec3)  # shape [object]
    upper: wp.array(dtype=wp.vec3)  # shape [object]
    pair_count: wp.array(dtype=wp.int32)  # perhaps more than there is room for, below 0 where it overflowed, shape [1]
    # Pairs of which each object is the first, then sums of COUNT_CHUNK objects; [0] where pairs are found in no order.
    first_count: wp.array(dtype=wp.int32)
    # Least middle of all boxes along each axis, and along the other way, where they are sorted, shape [6] or [0].
    ends: wp.array(dtype=wp.float32)


@wp.struct
class PairFilter:
    """Which objects may be a pair."""

    shared_group: wp.int32  # group of the objects that are in every world, -1 if there is none
    group: wp.array(dtype=wp.int32)  # of each object; worlds are numbered from 0, what is in every world first
    excluded: wp.array(dtype=wp.int64)  # sorted keys i * 2^32 + j, i < j
    collision_bits: wp.array(dtype=wp.vec2ui)  # group and mask of each object; [0] where they keep no pair apart


@wp.func
def write_bounds(i: wp.int32, lower: wp.vec3, upper: wp.vec3, boxes: PosedBounds):
    """Write the box of an object, infinite where it is no number, and start its counts of pairs."""
    for k in range(3):
        lower[k] = wp.where(lower[k] == lower[k], lower[k], -wp.inf)
        upper[k] = wp.where(upper[k] == upper[k], upper[k], wp.inf)
    boxes.lower[i] = lower
    boxes.upper[i] = upper
    if i == 0:
        boxes.pair_count[0] = 0
        for k in range(boxes.ends.shape[0]):
            boxes.ends[k] = wp.inf
    if boxes.first_count.shape[0] > 0:
        boxes.first_count[i] = 0
        if i % COUNT_CHUNK == 0:
            boxes.first_count[boxes.lower.shape[0] + i / COUNT_CHUNK] = 0


@wp.kernel
def pose_box_kernel(
    trees: Trees,
    record: LaunchRecord,
    wide: wp.float64,
    reach: wp.array(dtype=wp.vec4d),
    boxes_out: PosedBounds,
):
    """Box the posed root box of each object in the world, rounded outwards; a stale launch boxes points apart.

    Args:
        wide: By how much boxes are wider on all sides [world units].
        reach: The same of each object, its motion and what comes beside it, where that is more, shape [object]; [0]
            for none.
    """
    i = wp.tid()
    state = trees.objects.state[i]
    root = load_node(trees.states, trees.states.node_start[state] + 1)
    lower = wp.vec3d(root.lower)
    upper = wp.vec3d(root.upper)
    rotation = trees.objects.rotation[i]
    position = trees.objects.position[i]
    middle = trees.models.centre[trees.states.model[state]] + wp.float64(0.5) * (lower + upper)
    half = wp.float64(0.5) * (upper - lower)
    box_lower = wp.vec3()
    box_upper = wp.vec3()
    # B is taken to A's frame by the transpose: where that is no inverse, A stands off by (R R^T - I) of its points:
    # docs/exactness.md, bound 13.
    skew = wp.float64(3.0) * measure_skew(rotation)
    more = wide
    if reach.shape[0] > 0:
        motion = wp.vec3d(reach[i][0], reach[i][1], reach[i][2])
        # A little more than half of what `add_reach_kernel` makes of two.
        more = wp.max(more, (reach[i][3] + wp.length(motion)) * REACH_ROUNDING)
    skew = skew * (wp.length(middle) + wp.length(half) + more) + more
    for k in range(3):
        terms = wp.vec3d(rotation[k, 0] * middle[0], rotation[k, 1] * middle[1], rotation[k, 2] * middle[2])
        centre = terms[0] + terms[1] + terms[2] + position[k]
        side = wp.abs(rotation[k, 0]) * half[0] + wp.abs(rotation[k, 1]) * half[1] + wp.abs(rotation[k, 2]) * half[2]
        size = wp.abs(terms[0]) + wp.abs(terms[1]) + wp.abs(terms[2]) + wp.abs(position[k]) + side + more
        side = side + ROUNDING_64 * size + skew
        box_lower[k] = round_down(centre - side)
        box_upper[k] = round_up(centre + side)
    # At last, so that no load waits for it.
    if is_stale(record):
        box_lower = wp.vec3(wp.float32(i), 0.0, 0.0)
        box_upper = box_lower
    write_bounds(i, box_lower, box_upper, boxes_out)


@wp.func
def may_pair(i: wp.int32, j: wp.int32, filter: PairFilter, objects: ObjectPool):
    """Return whether two objects are not both static, and neither their bits nor the user forbid the pair."""
    if objects.is_static[i] != 0 and objects.is_static[j] != 0:
        return False
    if filter.collision_bits.shape[0] > 0:
        a = filter.collision_bits[i]
        b = filter.collision_bits[j]
        if (a[0] & b[1]) == wp.uint32(0) or (b[0] & a[1]) == wp.uint32(0):
            return False
    if filter.excluded.shape[0] > 0:
        key = pair_key(wp.vec2i(wp.min(i, j), wp.max(i, j)))
        at = wp.lower_bound(filter.excluded, key)
        if at < filter.excluded.shape[0] and filter.excluded[at] == key:
            return False
    return True


@wp.func
def write_pair(slot: wp.int32, i: wp.int32, j: wp.int32, pairs: wp.array(dtype=wp.vec2i)):
    """Write (min, max) if there is room."""
    if slot >= 0 and slot < pairs.shape[0]:
        pairs[slot] = wp.vec2i(wp.min(i, j), wp.max(i, j))


@wp.func
def box_middle(boxes: PosedBounds, i: wp.int32):
    """Return the middle of an object's box, moved into the range of what float32 computes with."""
    middle = wp.vec3()
    for k in range(3):
        x = wp.float32(0.5) * boxes.lower[i][k] + wp.float32(0.5) * boxes.upper[i][k]
        # What is no number lies between infinite ends.
        middle[k] = wp.where(x == x, wp.clamp(x, -MIDDLE_MAX, MIDDLE_MAX), wp.float32(0.0))
    return middle


@wp.kernel
def make_pair_key_kernel(
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    order_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Make the key of each pair; places behind the last sort behind all of them."""
    p = wp.tid()
    order_out[p] = p
    key_out[p] = LAST_KEY
    if p < pair_count[0]:
        key_out[p] = pair_key(pairs[p])


@wp.kernel
def place_pair_kernel(
    key: wp.array(dtype=wp.int64), pair_count_inout: wp.array(dtype=wp.int32), pairs_out: wp.array(dtype=wp.vec2i)
):
    """Write the pairs in key order and count them; a count beyond the capacity stays, as the demand."""
    p = wp.tid()
    room = pairs_out.shape[0]
    if p < room and key[p] != LAST_KEY:
        pairs_out[p] = wp.vec2i(wp.int32(key[p] >> wp.int64(32)), wp.int32(key[p] & wp.int64(0x7FFFFFFF)))
    before = bool(True)
    if p > 0:
        before = key[p - 1] != LAST_KEY
    after = bool(True)
    if p < room:
        after = key[p] == LAST_KEY
    # Exactly one thread stands where the pairs end.
    if before and after and pair_count_inout[0] <= room and pair_count_inout[0] >= 0:
        pair_count_inout[0] = p
