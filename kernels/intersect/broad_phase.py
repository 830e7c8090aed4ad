"""Candidate object pairs: posed root boxes in a wp.Bvh grouped by world."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import LAST_KEY, ObjectPool, Trees, pair_key
from warp_abtree.kernels.base.boxes import round_down, round_up
from warp_abtree.kernels.base.generation import LaunchRecord, is_stale
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import ROUNDING_64, measure_skew

wp.set_module_options(native.options())

# Of sums of lengths in float64.
REACH_ROUNDING = wp.constant(wp.float64(1.0 + 2.0**-48))


@wp.kernel
def pose_box_kernel(
    trees: Trees,
    record: LaunchRecord,
    wide: wp.float64,
    reach: wp.array(dtype=wp.vec4d),
    lower_out: wp.array(dtype=wp.vec3),
    upper_out: wp.array(dtype=wp.vec3),
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
    # B is taken to A's frame by the transpose: where that is no inverse, A stands off by (R R^T - I) of its points.
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
    lower_out[i] = box_lower
    upper_out[i] = box_upper


@wp.func
def append_pair(
    i: wp.int32,
    j: wp.int32,
    objects: ObjectPool,
    excluded: wp.array(dtype=wp.int64),
    collision_bits: wp.array(dtype=wp.vec2ui),
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
):
    """Append (min, max) unless both are static, their bits forbid it, or the user excluded it.

    The count goes on past the capacity.
    """
    if objects.is_static[i] != 0 and objects.is_static[j] != 0:
        return
    if collision_bits.shape[0] > 0:
        a = collision_bits[i]
        b = collision_bits[j]
        if (a[0] & b[1]) == wp.uint32(0) or (b[0] & a[1]) == wp.uint32(0):
            return
    low = wp.min(i, j)
    high = wp.max(i, j)
    if excluded.shape[0] > 0:
        key = (wp.int64(low) << wp.int64(32)) + wp.int64(high)
        at = wp.lower_bound(excluded, key)
        if at < excluded.shape[0] and excluded[at] == key:
            return
    slot = wp.atomic_add(pair_count, 0, 1)
    if slot >= 0 and slot < pairs.shape[0]:
        pairs[slot] = wp.vec2i(low, high)


@wp.kernel
def find_pair_kernel(
    shared_group: wp.int32,
    bvh: wp.uint64,
    lower: wp.array(dtype=wp.vec3),
    upper: wp.array(dtype=wp.vec3),
    group: wp.array(dtype=wp.int32),
    excluded: wp.array(dtype=wp.int64),
    collision_bits: wp.array(dtype=wp.vec2ui),
    objects: ObjectPool,
    pair_count_inout: wp.array(dtype=wp.int32),
    pairs_out: wp.array(dtype=wp.vec2i),
):
    """Find the partners of each object: in its own world larger indices and what is static, and all in every world.

    What is static finds none in its world: it may be large, and one thread would meet all others.

    Args:
        shared_group: Group of the objects that are in every world, -1 if there is none.
        group: Group of each object; worlds are renumbered from 0.
        excluded: Sorted keys i * 2^32 + j, i < j.
        collision_bits: Collision group and mask of each object; empty where they keep no pair apart.
    """
    i = wp.tid()
    j = wp.int32(0)
    if objects.is_static[i] == 0:
        # The root of a missing group would be -1, which means the whole tree; an object's own group always exists.
        root = wp.bvh_get_group_root(bvh, group[i])
        query = wp.bvh_query_aabb(bvh, lower[i], upper[i], root)
        while wp.bvh_query_next(query, j):
            if j > i or objects.is_static[j] != 0:
                append_pair(i, j, objects, excluded, collision_bits, pair_count_inout, pairs_out)
    if shared_group >= 0 and group[i] != shared_group:
        root = wp.bvh_get_group_root(bvh, shared_group)
        query = wp.bvh_query_aabb(bvh, lower[i], upper[i], root)
        while wp.bvh_query_next(query, j):
            append_pair(i, j, objects, excluded, collision_bits, pair_count_inout, pairs_out)


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
