"""Work stealing between warps: idle warps wait in a queue; busy warps donate the oldest items of their stack.

Units of work are numbered. A warp starts with that of its own number, takes the next one until there are no more, then
a ticket, and waits at the slot of
that number. A busy warp compares the tickets taken with those served, and serves the next few with the oldest items of
its stack. The warp that ends the last unit or donation terminates all that wait.

Liveness: each donation is consumed exactly once. Warps that have looked at the same time may serve tickets that no warp
has taken yet, DONATIONS_AT_ONCE each at most, since a warp that looks then sees none to serve. Each of these is taken
in the end: a busy warp ends, takes the next ticket, and goes on with the items of its slot. Tickets that share a slot
are told apart by their number. A warp that finds the slot of its ticket full waits for one that runs: as there are more
slots than tickets served ahead, the ticket that the slot is full for has been taken. So a launch may have any number of
warps.

The word of `load_tickets`, from two counters side by side:

    63          32 31           0
    [ tickets taken | served    ]
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import take_once, take_together
from warp_abtree.kernels.base.generation import LaunchRecord
from warp_abtree.kernels.base.lanes import hold_uniform, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.search.item import pack_item
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, read_item, write_item

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# A test replaces an item by four at most, each a level deeper in both trees, or by two, a level deeper in one. So depth
# first leaves three items a level at most, 31 levels deep.
DEPTH_FIRST_ROOM = wp.constant(128)
STACK_MASK = wp.constant(STACK_LENGTH - 1)

# More than DONATIONS_AT_ONCE for each warp that a device runs at a time.
SLOT_COUNT = native.constant("SLOT_COUNT")
SLOT_ITEMS = native.constant("SLOT_ITEMS")
DONATIONS_AT_ONCE = wp.constant(3)
COUNTER_COUNT = 5

# The counter of units that are taken.
UNITS_TAKEN = wp.constant(3)
NO_UNIT = native.constant("NO_UNIT")
# The bit of half an item that names two siblings.
SIBLINGS = wp.constant(-(2**31))


@wp.struct
class Work:
    """Counters and slots of one launch."""

    # Tickets served, tickets taken, units and donations not ended, units taken; not 0 where there may be descents.
    counter: wp.array(dtype=wp.int32)
    flag: wp.array(dtype=wp.int32)  # 0 free, the ticket + 1 that it is full for, -1 when all is done, shape [slot]
    owner: wp.array(dtype=wp.vec2i)  # (object pair, number of items), shape [slot]
    item: wp.array(dtype=wp.int64)  # node pairs (`node_pair`), shape [slot * SLOT_ITEMS]
    warps: wp.int32  # of the launch; each starts with the unit of its own number
    warps_per_pair: wp.int32  # units of a single pair; c pairs have 1 / sqrt(c) of that each
    small_faces: wp.int32  # two trees of so many faces at most are compared at once (`small_trees`)
    record: LaunchRecord  # what the launch was given; here, since another argument takes time in every launch


@native.func_native()
def first_ended(descends: bool, counter: wp.array(dtype=wp.int32)) -> wp.int32:
    """Return the initial count of units and donations ended: 0, or a very negative one where nothing is given away."""


@native.func_native()
def first_unit(counter: wp.array(dtype=wp.int32)) -> wp.int32:
    """Return the unit that this warp starts with, NO_UNIT or more where there is no work."""


@wp.func
def take_unit(counter: wp.array(dtype=wp.int32)):
    """Return the number of a unit of work that no other warp has; from the number of units on there is none."""
    return take_together(counter, UNITS_TAKEN, 1)


@native.func_native()
def load_tickets(counter: wp.array(dtype=wp.int32)) -> wp.int64:
    """Return the tickets taken and, in the low half, those served, to be subtracted when they have arrived."""


@native.func_native()
def count_idle(tickets: wp.int64) -> wp.int32:
    """Return about how many warps wait for a donation."""


@native.func_native()
def await_donation(counter: wp.array(dtype=wp.int32), flag: wp.array(dtype=wp.int32), ended: wp.int32) -> wp.int32:
    """End so many units and donations, and wait for a donation; return its slot, or -1 when all work is done.

    Who ends the last one terminates all warps that wait.
    """


@native.func_native()
def free_slot(flag: wp.array(dtype=wp.int32), slot: wp.int32): ...


@native.func_native()
def claim_slot(counter: wp.array(dtype=wp.int32), flag: wp.array(dtype=wp.int32)) -> wp.int32:
    """Return the next ticket to serve, its slot free."""


@native.func_native()
def fill_slot(flag: wp.array(dtype=wp.int32), ticket: wp.int32):
    """Publish the items that this warp has put into the slot of a ticket."""


@wp.func
def count_to_pop(free: wp.int32, shift: wp.int32, size: wp.int32):
    """Return how many items to take from a stack of a size with so much room beside what depth first needs.

    One at a time, depth first, needs little room; more where there is.
    """
    return wp.min(wp.max(1, free >> shift), wp.min(warp_size(), size))


@wp.func
def note_descent(work: Work):
    """Note that an object pair is not for `small_trees`; the warp that ends the last unit forgets it."""
    work.counter[4] = 1


@wp.func
def units_per_pair(warps_per_pair: wp.int32, count: wp.int32):
    """Return the number of units that a pair is split into at first; more cost more, since each starts at the roots."""
    return wp.max(1, wp.int32(wp.float32(warps_per_pair) / wp.sqrt(wp.float32(wp.max(count, 1)))))


@wp.func
def claim_ahead(ended: wp.int32, unit: wp.int32, units: wp.int32, work: Work):
    """Return the unit, or where nothing is ever given away the one after it, in the first lane alone."""
    claimed = wp.int32(unit)
    if ended < 0:
        claimed = units
        if units > work.warps:
            claimed = take_once(work.counter, UNITS_TAKEN, 1)
    return claimed


@wp.func
def next_unit(ended: wp.int32, unit: wp.int32, units: wp.int32, work: Work):
    """Return the unit that follows what `claim_ahead` returned, `units` or more where there is none.

    Where the warp has had none, but a donation, `units` or more comes back as it is.
    """
    if ended < 0:
        return hold_uniform(unit)
    if unit < units:
        unit = wp.int32(units)
        if units > work.warps:
            unit = take_unit(work.counter)
    return unit


@wp.func
def parts_at_once(parts: wp.int32, count: wp.int32, warps: wp.int32):
    """Return the number of units to split a pair into when each unit repeats its start-up work."""
    return wp.clamp(warps / wp.max(count, 1), 1, parts)


@wp.func
def units_of_pair(ended: wp.int32, count: wp.int32, work: Work):
    """Return the number of units of an object pair: no more than start at once where all pairs are small."""
    parts = units_per_pair(work.warps_per_pair, count)
    if ended < 0:
        parts = parts_at_once(parts, count, work.warps)
    return parts


@wp.func
def await_items(ended: wp.int32, work: Work):
    """Return what `await_donation` does, -1 at once where nothing is ever given away."""
    slot = wp.int32(-1)
    if ended >= 0:
        slot = await_donation(work.counter, work.flag, ended)
    return slot


@wp.func
def start_level(level: wp.int32, faces: wp.int32):
    """Return the level of a tree to start from, the deepest with two faces or more below a node, on average."""
    while level > 0 and (2 << level) > faces:
        level -= 1
    return level


@wp.func
def level_pair(level: wp.int32, i: wp.int32):
    """Return half an item: two siblings of a level, or the root."""
    return wp.where(level > 0, ((1 << level) + 2 * i) | SIBLINGS, 1)


@wp.func
def start_items(items: wp.uint64, part: wp.int32, parts: wp.int32, pose: PairPose):
    """Put this unit's part of a pair's first items on the stack; return how many there are.

    All pairs of siblings of a level, compared at once: from the roots down, level by level, a warp would wait as often.
    """
    # As measured: about 32 a unit, one a lane.
    level = 3 + wp.where(parts >= 2, 1, 0) + wp.where(parts >= 8, 1, 0)
    level += wp.where(parts >= 32, 1, 0) + wp.where(parts >= 64, 1, 0)
    level = wp.where(pose.margin < 0.0, 0, level)
    level_a = start_level(level, pose.faces_a)
    level_b = start_level(level, pose.faces_b)
    shift = wp.max(level_b - 1, 0)
    total = 1 << (wp.max(level_a - 1, 0) + shift)
    count = wp.max(0, (total - part + parts - 1) / parts)
    k = warp_lane()
    while k < count:
        i = part + parts * k
        x = i >> shift
        # Each part gets pairs from all over both trees.
        y = (i + x) & ((1 << shift) - 1)
        write_item(items, k, pack_item(level_pair(level_a, x), level_pair(level_b, y)))
        k += warp_size()
    warp_sync()
    return count


@wp.func
def receive_items(items: wp.uint64, slot: wp.int32, work: Work):
    """Copy the items of a slot to the empty stack; return the stack's end."""
    size = work.owner[slot][1]
    lane = warp_lane()
    if lane < size:
        write_item(items, lane, work.item[slot * SLOT_ITEMS + lane])
    free_slot(work.flag, slot)
    return size


@wp.func
def donate_items(
    least: wp.int32, pair: wp.int32, idle: wp.int32, items: wp.uint64, head: wp.int32, end: wp.int32, work: Work
):
    """Donate the oldest items to idle warps, so many each at least: most work lies below them. Return the new head."""
    wanted = wp.min(idle, DONATIONS_AT_ONCE)
    size = wp.min(wp.max((end - head) / (wanted + 1), least), SLOT_ITEMS)
    lane = warp_lane()
    while wanted > 0 and end - head >= 2 * size:
        ticket = claim_slot(work.counter, work.flag)
        slot = ticket & (SLOT_COUNT - 1)
        if lane < size:
            work.item[slot * SLOT_ITEMS + lane] = read_item(items, (head + lane) & STACK_MASK)
        if lane == 0:
            work.owner[slot] = wp.vec2i(pair, size)
        fill_slot(work.flag, ticket)
        head += size
        wanted -= 1
    return head


@native.func_native()
def take_thread(counter: wp.array(dtype=wp.int32)) -> wp.int32:
    """Return the number of a thread that no other thread of a launch has."""
