"""Broad phase by warps: tiles of objects, each compared with those behind it.

Objects are in the order of their groups, one a world. A tile is a warp of objects in this order; each task of a warp is
a tile beside a few others from itself on. Where groups are large, their objects are sorted along a Morton curve in each
launch, and boxes of tiles drop most of them. Source of the curve: Karras 2012, Thinking Parallel, part III.

Where the objects of each group stay in the order of their numbers, pairs are listed in order without a sort: tasks keep
which objects meet, a bit a pair, and count the pairs of each object; then a warp an object adds the counts of those
before it, and lists its own.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import LAST_KEY, ObjectPool, pair_key
from warp_abtree.kernels.base.counters import take_together
from warp_abtree.kernels.base.lanes import (
    WARP_SIZE,
    count_lanes,
    hold_uniform,
    lowest_bit,
    next_place,
    value_of_lane,
    vector_of_lane,
    vote_lanes,
    warp_any,
    warp_lane,
    warp_min32,
    warp_size,
    warp_sum,
)
from warp_abtree.kernels.intersect.broad_phase import (
    COUNT_CHUNK,
    PairFilter,
    PosedBounds,
    box_middle,
    may_pair,
    write_pair,
)

wp.set_module_options(native.options("base/counters.cuh", "base/lanes.cuh") | {"block_dim": WARP_SIZE})

# Bits of a place on the Morton curve, and cells along an axis.
CURVE_BITS = 24
CURVE_CELLS = wp.constant(wp.float32(255.0))


@wp.struct
class Tiles:
    """Objects in the order of their groups, and boxes of each warp of them."""

    order: wp.array(dtype=wp.int32)  # objects, shape [object], or more where it is sorted
    lower: wp.array(dtype=wp.vec3)  # shape [tile]; [0] where tiles have no boxes
    upper: wp.array(dtype=wp.vec3)  # shape [tile] or [0]
    place: wp.array(dtype=wp.int32)  # of each object in the order, where pairs are listed in order, else [0]
    task: wp.array(dtype=wp.int32)  # the first of each tile, then how many there are, or [0]
    # A bit for each object of a task's other tile, a word for each of its tile, shape [task * lanes] or [0].
    meets: wp.array(dtype=wp.int32)


@wp.func
def bounds_meet(lower: wp.vec3, upper: wp.vec3, other_lower: wp.vec3, other_upper: wp.vec3):
    """Return whether two closed boxes overlap."""
    x = lower[0] <= other_upper[0] and other_lower[0] <= upper[0]
    y = lower[1] <= other_upper[1] and other_lower[1] <= upper[1]
    return x and y and lower[2] <= other_upper[2] and other_lower[2] <= upper[2]


@wp.func
def drop_lowest_bit(bits: wp.uint32):
    return bits & (bits - wp.uint32(1))


@wp.struct
class TileObject:
    """Object of a tile that a lane has."""

    place: wp.int32  # in the order, perhaps behind the last
    object: wp.int32  # the last one behind it
    group: wp.int32  # its group
    lower: wp.vec3  # lower ends of its box
    upper: wp.vec3  # upper ends


@wp.func
def load_tile_object(tile: wp.int32, filter: PairFilter, tiles: Tiles, boxes: PosedBounds):
    """Return the object of a tile that this lane has."""
    own = TileObject()
    own.place = warp_size() * tile + warp_lane()
    own.object = tiles.order[wp.min(own.place, boxes.lower.shape[0] - 1)]
    own.group = filter.group[own.object]
    own.lower = boxes.lower[own.object]
    own.upper = boxes.upper[own.object]
    return own


@wp.func
def has_bit(bits: wp.uint32, k: wp.int32):
    return ((bits >> wp.uint32(k)) & wp.uint32(1)) != wp.uint32(0)


@wp.func
def list_columns(
    row: wp.int32,
    column: wp.int32,
    word: wp.int32,
    count: wp.int32,
    boxes: PosedBounds,
    pairs: wp.array(dtype=wp.vec2i),
):
    """List the pairs of a warp's objects, after all that are listed, with one atomic.

    Args:
        row, column: This lane's objects.
        word: The lanes whose columns meet its row, a bit each.
        count: How many these are.
    """
    lane, total = warp_lane(), warp_sum(count)
    if total > 0:
        end = take_together(boxes.pair_count, 0, total)
        rows = vote_lanes(count > 0)
        while rows != wp.uint32(0):
            k = lowest_bit(wp.int32(rows))
            rows = drop_lowest_bit(rows)
            i, meets = value_of_lane(row, k), has_bit(wp.uint32(value_of_lane(word, k)), lane)
            slot = next_place(end, meets)
            if meets:
                write_pair(slot, i, column, pairs)


@wp.func
def find_columns(
    own: TileObject,
    rows: wp.uint32,
    task: wp.int32,
    tile: wp.int32,
    filter: PairFilter,
    tiles: Tiles,
    objects: ObjectPool,
    boxes: PosedBounds,
    pairs: wp.array(dtype=wp.vec2i),
):
    """Find the pairs of some objects of a tile, a bit each, with those behind them in another, one a lane."""
    column = load_tile_object(tile, filter, tiles, boxes)
    in_order, lane = tiles.meets.shape[0] > 0, warp_lane()
    is_row = has_bit(rows, lane)
    word, count = wp.int32(0), wp.int32(0)
    is_column = column.place < boxes.lower.shape[0]
    while rows != wp.uint32(0):
        k = lowest_bit(wp.int32(rows))
        rows = drop_lowest_bit(rows)
        lower, upper = vector_of_lane(own.lower, k), vector_of_lane(own.upper, k)
        # Before any condition, since all lanes take part.
        group, i, place = value_of_lane(own.group, k), value_of_lane(own.object, k), value_of_lane(own.place, k)
        meets = is_column and column.place > place
        meets = meets and bounds_meet(lower, upper, column.lower, column.upper)
        shared = group == filter.shared_group or column.group == filter.shared_group
        meets = meets and (group == column.group or shared)
        if warp_any(meets):
            if meets:
                meets = may_pair(i, column.object, filter, objects)
            bits, number = vote_lanes(meets), count_lanes(meets)
            word = wp.where(lane == k, wp.int32(bits), word)
            count = wp.where(lane == k, number, count)
    if not in_order:
        list_columns(own.object, column.object, word, count, boxes, pairs)
    elif is_row:
        tiles.meets[warp_size() * task + lane] = word
        if count > 0:
            wp.atomic_add(boxes.first_count, own.object, count)
            wp.atomic_add(boxes.first_count, boxes.lower.shape[0] + own.object / COUNT_CHUNK, count)


@wp.kernel
def find_tile_pair_kernel(
    parts: wp.int32,
    tasks: wp.array(dtype=wp.vec3i),
    filter: PairFilter,
    tiles: Tiles,
    objects: ObjectPool,
    boxes_inout: PosedBounds,
    pairs_out: wp.array(dtype=wp.vec2i),
):
    """Find the pairs of a tile with so many others by some warps; where they are listed in order, with one.

    Args:
        parts: Warps that share the objects of the tile.
        tasks: A tile, the first of the others, none before it, and how many these are.
    """
    warp = wp.tid() / warp_size()
    place, part = warp / parts, warp % parts
    task = tasks[place]
    if hold_uniform(boxes_inout.pair_count[0]) < 0:
        return
    lane, with_boxes = warp_lane(), tiles.lower.shape[0] > 0
    own = load_tile_object(task[0], filter, tiles, boxes_inout)
    first = wp.int32(0)
    while first < task[2]:
        near = first + lane < task[2]
        if near and with_boxes:
            other = task[1] + first + lane
            near = bounds_meet(tiles.lower[task[0]], tiles.upper[task[0]], tiles.lower[other], tiles.upper[other])
        others = vote_lanes(near)
        while others != wp.uint32(0):
            tile = task[1] + first + lowest_bit(wp.int32(others))
            others = drop_lowest_bit(others)
            is_row = own.place < boxes_inout.lower.shape[0] and lane % parts == part
            if is_row and with_boxes:
                is_row = bounds_meet(own.lower, own.upper, tiles.lower[tile], tiles.upper[tile])
            find_columns(own, vote_lanes(is_row), place, tile, filter, tiles, objects, boxes_inout, pairs_out)
        first += warp_size()


@wp.func
def count_before(i: wp.int32, boxes: PosedBounds):
    """Return how many pairs have a first object before this one; for all lanes of a warp."""
    count, lane = wp.int32(0), warp_lane()
    chunk = wp.int32(lane)
    while chunk < i / COUNT_CHUNK:
        count += boxes.first_count[boxes.lower.shape[0] + chunk]
        chunk += warp_size()
    other = i / COUNT_CHUNK * COUNT_CHUNK + lane
    while other < i:
        count += boxes.first_count[other]
        other += warp_size()
    return warp_sum(count)


@wp.kernel
def list_tile_pair_kernel(
    tasks: wp.array(dtype=wp.vec3i),
    tiles: Tiles,
    boxes_inout: PosedBounds,
    pairs_out: wp.array(dtype=wp.vec2i),
    key_out: wp.array(dtype=wp.int64),
):
    """List the pairs of each object with those behind it, in order, by a warp; the last one counts all.

    Args:
        key_out: Key of each pair, LAST_KEY behind the last, as long as the list or longer.
    """
    i, lane, n = wp.tid() / warp_size(), warp_lane(), boxes_inout.lower.shape[0]
    own = boxes_inout.first_count[i]
    if own == 0 and i < n - 1:
        return
    end = count_before(i, boxes_inout)
    row, size = tiles.place[i] % warp_size(), warp_size()
    tile = tiles.place[i] / size
    first = wp.int32(tiles.task[tile])
    last = tiles.task[tile + 1]
    while own > 0 and first < last:
        word = wp.int32(0)
        if first + lane < last:
            word = tiles.meets[size * (first + lane) + row]
        words = vote_lanes(word != 0)
        while words != wp.uint32(0):
            k = lowest_bit(wp.int32(words))
            words = drop_lowest_bit(words)
            meets = has_bit(wp.uint32(value_of_lane(word, k)), lane)
            slot = next_place(end, meets)
            if meets:
                pair = wp.vec2i(i, tiles.order[size * tasks[first + k][1] + lane])
                write_pair(slot, pair[0], pair[1], pairs_out)
                if slot < pairs_out.shape[0]:
                    key_out[slot] = pair_key(pair)
        first += size
    if i == n - 1:
        boxes_inout.pair_count[0] = end
        free = end + lane
        while free < pairs_out.shape[0]:
            key_out[free] = LAST_KEY
            free += size


@wp.kernel
def bound_middle_kernel(step: wp.int32, boxes_inout: PosedBounds):
    """Bound the middles of all boxes, in a grid-stride loop: the least of each axis, and of the other way."""
    i = wp.tid()
    least, most = box_middle(boxes_inout, 0), -box_middle(boxes_inout, 0)
    while i < boxes_inout.lower.shape[0]:
        middle = box_middle(boxes_inout, i)
        least = wp.min(least, middle)
        most = wp.min(most, -middle)
        i += step
    for k in range(3):
        low, high = warp_min32(least[k]), warp_min32(most[k])
        if warp_lane() == 0:
            wp.atomic_min(boxes_inout.ends, k, low)
            wp.atomic_min(boxes_inout.ends, 3 + k, high)


@wp.func
def spread_bits(x: wp.int32):
    """Return eight bits with two zeros in front of each."""
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249


@wp.kernel
def make_curve_key_kernel(
    filter: PairFilter,
    boxes: PosedBounds,
    order_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Make the key of each object: its group, and where its middle lies on a Morton curve."""
    i = wp.tid()
    middle, code = box_middle(boxes, i), wp.int32(0)
    for k in range(3):
        low = boxes.ends[k]
        # Of no width: an order alone, on which no pair depends.
        width = wp.max(-boxes.ends[3 + k] - low, wp.float32(1.0e-30))
        cell = wp.int32(wp.clamp((middle[k] - low) / width, wp.float32(0.0), wp.float32(1.0)) * CURVE_CELLS)
        code = code | (spread_bits(cell) << k)
    order_out[i] = i
    key_out[i] = (wp.int64(filter.group[i]) << wp.int64(wp.static(CURVE_BITS))) | wp.int64(code)


@wp.kernel
def bound_tile_kernel(boxes: PosedBounds, tiles_inout: Tiles):
    """Box the objects of one tile a warp."""
    tile = wp.tid() / warp_size()
    i = tiles_inout.order[wp.min(wp.tid(), boxes.lower.shape[0] - 1)]
    lower, upper = boxes.lower[i], -boxes.upper[i]
    least = wp.vec3(warp_min32(lower[0]), warp_min32(lower[1]), warp_min32(lower[2]))
    most = wp.vec3(warp_min32(upper[0]), warp_min32(upper[1]), warp_min32(upper[2]))
    if warp_lane() == 0:
        tiles_inout.lower[tile] = least
        tiles_inout.upper[tile] = -most
