"""Slots: contact witnesses of an object pair, those face pairs that a choice of contact points needs.

The normal of a contact is in one of 20 bins. Each bin has a slot for the deepest contact and eight for those that lie
farthest in eight directions across the normal, with their depth, so that what is at the rim of a contact is kept: of
contacts that cross, and again of those apart; and a slot for the deepest of those that are apart, but inside. A slot
keeps the witness of the highest score; which one depends on what was offered alone, not on the order, and is the same
on every device. Bins of normals with extreme points are what contact reductions of physics engines keep, too (Newton,
PhysX).

Offered are candidate points of contacts that cross (`manifold`), and faces that are apart, nearer than the gap. Of
these in float32: faces that look at one another within 60 degrees have the mean of their normals, and each corner
within the column of the other face counts as a point of its own; others have the direction of their distance, unless
either face looks away from it. Who wins is measured in float64 (`near_points`).

Scores are float32, in A's frame at unit size: the depth, and for directions the reach times the pair's weight, the gap
over the size of the smaller object. A key of a slot is a score above a name: the place of a contact that crosses, or
both faces of a pair that is apart, in as many bits as there are; the score has the rest. Of equal scores the lower name
wins.

    63          n n-1          0
    [   score    |    ~name    ]    n = 32, or as many bits as names of faces take beyond
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.lanes import next_place, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits
from warp_abtree.kernels.triangle.distance_bounds import load_points, three_points

wp.set_module_options(native.options("base/lanes.cuh", "contacts/near_offer.cuh"))

NORMAL_BINS, SCORES = native.constant("NORMAL_BINS"), native.constant("SCORES")
SLOTS_A_BIN, SLOT_ROOM = native.constant("SLOTS_A_BIN"), native.constant("SLOT_ROOM")
ALL_SLOTS = wp.constant(wp.int64(SLOT_ROOM))
# Directions count so much at least, where gaps are tiny.
WEIGHT_LEAST = wp.constant(wp.float64(2.0**-8))


@wp.struct
class Slots:
    """Slots of all object pairs."""

    key: wp.array(dtype=wp.int64)  # unsigned, 0 where there is none, shape [SLOT_ROOM * pair]
    used: wp.array(dtype=wp.int32)  # whether anything was offered to those of a pair, 0 or 1, shape [pair]
    widths: wp.array(dtype=wp.vec2i)  # bits that a face of A takes, and one of B, shape [pair]
    weight: wp.array(dtype=wp.float32)  # of directions, shape [pair]
    directions: wp.array(dtype=wp.float32)  # normal of each bin and two vectors across it, shape [9 * NORMAL_BINS]


@wp.struct
class WitnessRows:
    """What slots keep, those of each pair side by side in the order of its slots."""

    start: wp.array(dtype=wp.int32)  # where those of a pair begin, shape [pair]
    count: wp.array(dtype=wp.int32)  # how many, shape [pair]
    item: wp.array(dtype=wp.vec3i)  # (pair with NEAR_BIT, face of its first object, of its second) of faces apart,
    # (pair, crossing contact, 0), or (-1, 0, 0) for a place that is left, shape [witness]


@native.func_native()
def offer_faces(
    a: three_points,
    b: three_points,
    gap: wp.float32,
    weight: wp.float32,
    directions: wp.array(dtype=wp.float32),
    widths: wp.vec2i,
    face_a: wp.int32,
    face_b: wp.int32,
    pair: wp.int32,
    slots: wp.array(dtype=wp.int64),
):
    """Offer a face pair that is apart, in A's frame at unit size, to the slots of its object pair."""


@wp.func
def gap_of(gap: wp.array(dtype=wp.float64), p: wp.int32):
    """Return the gap of a pair, 0 where there is none."""
    shell = wp.float64(0.0)
    if gap.shape[0] > 0:
        shell = gap[p]
    return shell


@wp.func
def tree_size(trees: Trees, state: wp.int32):
    """Return half of the diagonal of the root box of a tree state."""
    root = load_node(trees.states, trees.states.node_start[state] + 1)
    return wp.float64(0.5) * wp.length(wp.vec3d(root.upper) - wp.vec3d(root.lower))


@wp.func
def smaller_size(trees: Trees, a: wp.int32, b: wp.int32):
    """Return half of the diagonal of the box of the smaller of two objects."""
    return wp.min(tree_size(trees, trees.objects.state[a]), tree_size(trees, trees.objects.state[b]))


@wp.func
def count_bits(trees: Trees, state: wp.int32):
    """Return how many bits a face of a tree state takes."""
    bits, faces = wp.int32(1), trees.models.face_count[trees.states.model[state]]
    while (faces - 1) >> bits > 0:
        bits += 1
    return bits


@wp.kernel
def start_slots_kernel(
    trees: Trees, batch: PairBatch, gap: wp.array(dtype=wp.float64), hits_out: Hits, slots_out: Slots
):
    """Empty the slots of one object pair, if they were used, and measure the pair, by a warp.

    Args:
        gap: Of each pair [world units], or [0] for none.
    """
    p, k = wp.tid() / warp_size(), warp_lane()
    while k < SLOT_ROOM and slots_out.used[p] != 0:
        slots_out.key[SLOT_ROOM * p + k] = wp.int64(0)
        k += warp_size()
    warp_sync()
    if warp_lane() > 0:
        return
    slots_out.used[p] = 0
    if p == 0:
        hits_out.witness_total[0] = 0
    if p < batch.count[0] and p < batch.pairs.shape[0]:
        shell = gap_of(gap, p)
        size = smaller_size(trees, batch.pairs[p][0], batch.pairs[p][1])
        weight = WEIGHT_LEAST
        if shell > WEIGHT_LEAST * size:
            weight = wp.where(shell < size, shell / size, wp.float64(1.0))
        slots_out.weight[p] = wp.float32(weight)
        lower, higher = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
        of_a, of_b = count_bits(trees, trees.objects.state[lower]), count_bits(trees, trees.objects.state[higher])
        slots_out.widths[p] = wp.vec2i(of_a, of_b)


@wp.kernel
def offer_near_kernel(step: wp.int32, trees: Trees, batch: PairBatch, hits: Hits, slots_inout: Slots):
    """Offer the face pairs that are listed as apart to the slots of their object pairs, in a grid-stride loop."""
    i = wp.tid()
    end = wp.int32(wp.min(wp.uint32(hits.apart_total[0]), wp.uint32(hits.apart.shape[0])))
    while i < end:
        pair, face_a, face_b = hits.apart[i][0], hits.apart[i][1], hits.apart[i][2]
        pose, slots = batch.poses[pair], slots_inout
        scale = wp.float32(pose.scale)
        a, b = load_points(trees, pose, pose.translation32 * scale, scale, face_a, face_b)
        reach, weight, widths = wp.float32(hits.gap[pair] * pose.scale), slots.weight[pair], slots.widths[pair]
        offer_faces(a, b, reach, weight, slots.directions, widths, face_a, face_b, pair, slots.key)
        slots.used[pair] = 1
        i += step


@wp.func
def crosses(at: wp.int32):
    """Return whether a slot is one of contacts that cross."""
    return at % SLOTS_A_BIN < SCORES


@wp.func
def name_in(slots: Slots, p: wp.int32, at: wp.int32):
    """Return the name of what a slot of an object pair keeps, -1 for none."""
    key = slots.key[at]
    width = wp.where(crosses(at), 32, slots.widths[p][0] + slots.widths[p][1])
    if key == wp.int64(0):
        return wp.int64(-1)
    return ~key & ((wp.int64(1) << wp.int64(width)) - wp.int64(1))


@wp.func
def is_first(slots: Slots, p: wp.int32, at: wp.int32):
    """Return whether a slot keeps a witness that no slot of its kind before it in its bin keeps."""
    name = name_in(slots, p, at)
    if name < wp.int64(0):
        return False
    k = at - at % SLOTS_A_BIN
    while k < at and (crosses(k) != crosses(at) or name_in(slots, p, k) != name):
        k += 1
    return k == at


@wp.kernel
def reserve_witness_kernel(batch: PairBatch, slots: Slots, hits_inout: Hits, rows_out: WitnessRows):
    """Reserve places for the witnesses of one object pair, by a warp: of near faces, and all that may yet cross."""
    p = wp.tid() / warp_size()
    found, first = wp.int32(0), wp.int32(0)
    is_pair = p < batch.count[0] and p < batch.pairs.shape[0]
    if not is_pair or (slots.used[p] == 0 and hits_inout.count[p] == wp.int64(0)):
        if warp_lane() == 0:
            rows_out.count[p] = 0
        return
    while first < SLOT_ROOM:
        k = first + warp_lane()
        _ = next_place(found, k < SLOT_ROOM and is_first(slots, p, SLOT_ROOM * p + wp.min(k, SLOT_ROOM - 1)))
        first += warp_size()
    if warp_lane() == 0:
        count = wp.min(SLOT_ROOM, found + wp.int32(wp.min(hits_inout.count[p], ALL_SLOTS)))
        rows_out.count[p] = count
        rows_out.start[p] = wp.atomic_add(hits_inout.witness_total, 0, count)


@wp.kernel
def list_witness_kernel(batch: PairBatch, slots: Slots, rows_inout: WitnessRows):
    """List what the slots of one object pair keep, by a warp; places that are left say so."""
    p = wp.tid() / warp_size()
    count = rows_inout.count[p]
    if count == 0:
        return
    room = rows_inout.item.shape[0]
    start, end, first = rows_inout.start[p], wp.int32(0), wp.int32(0)
    swapped = batch.poses[p].swapped
    if start < 0 or start > room - count:  # a launch that has lost work
        first = wp.int32(SLOT_ROOM)
    while first < SLOT_ROOM:
        k = SLOT_ROOM * p + wp.min(first + warp_lane(), SLOT_ROOM - 1)
        kept = first + warp_lane() < SLOT_ROOM
        if kept:
            kept = is_first(slots, p, k)
        place = next_place(end, kept)
        if kept:
            name = name_in(slots, p, k)
            item = wp.vec3i(p, wp.int32(name), 0)
            if not crosses(k):
                width = wp.int64(slots.widths[p][1])
                a, b = wp.int32(name >> width), wp.int32(name & ((wp.int64(1) << width) - wp.int64(1)))
                item = wp.vec3i(p | NEAR_BIT, wp.where(swapped != 0, b, a), wp.where(swapped != 0, a, b))
            rows_inout.item[start + place] = item
        first += warp_size()
    if start >= 0:
        k = end + warp_lane()
        while k < wp.min(count, room - start):
            rows_inout.item[start + k] = wp.vec3i(-1, 0, 0)
            k += warp_size()
    warp_sync()
    if warp_lane() == 0 and (start < 0 or start > room - count):
        rows_inout.count[p] = 0
