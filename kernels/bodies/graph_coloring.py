"""Graph coloring of the pairs in contact: no dynamic body is in two pairs of one color.

In each round every uncolored pair bids for its bodies, and takes the lowest color that is free at both if it wins both.
Source: Luby 1986; Jones and Plassmann 1993.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import count_set_bits, lowest_bit
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies

wp.set_module_options(native.options("base/lanes.cuh"))

COLOR_COUNT = wp.constant(16)
"""Number of colors. Pairs without one of their own have the color COLOR_COUNT, and are the last in order."""

INACTIVE = wp.constant(127)
"""Color of pairs that are not solved."""

GOLDEN_RATIO = wp.constant(wp.uint32(2654435761))
"""2^32 over it, which spreads the numbers of rounds."""


@wp.func
def make_bid(p: wp.int32, turn: wp.int32, pair: wp.vec2i, bodies: Bodies):
    """Return the bid of a pair: later rounds outbid earlier ones; within a round it is a hash, then the pair's number.

    The hash is of the round, so that no pair loses for long, and of ranks in a world, not of object numbers, so a world
    has the same coloring alone and among others.

    Bits: 63..56 round + 1 | 55 zero | 54..31 hash | 30..0 pair
    """
    mixed = wp.uint32(bodies.rank[pair[0]]) * wp.uint32(40503) + wp.uint32(bodies.rank[pair[1]])
    mixed += wp.uint32(turn) * GOLDEN_RATIO
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * wp.uint32(739982445)
    mixed = (mixed ^ (mixed >> wp.uint32(12))) & wp.uint32(0xFFFFFF)
    return (wp.int64(turn + 1) << wp.int64(56)) | (wp.int64(mixed) << wp.int64(31)) | wp.int64(p)


@wp.func
def free_color(bodies: Bodies, pair: wp.vec2i):
    """Return the lowest color that no pair of either body has, COLOR_COUNT or more where all are taken."""
    return lowest_bit(~(bodies.colors[pair[0]] | bodies.colors[pair[1]]))


@wp.kernel
def bid_kernel(turn: wp.int32, batch: PairBatch, pair_color: wp.array(dtype=wp.int32), bodies_inout: Bodies):
    """Bid for both bodies of each uncolored pair in a round, unless no color is free."""
    p = wp.tid()
    if pair_color[p] != COLOR_COUNT or free_color(bodies_inout, batch.pairs[p]) >= COLOR_COUNT:
        return
    for k in range(2):
        i = batch.pairs[p][k]
        if bodies_inout.motion_type[i] == DYNAMIC:
            wp.atomic_max(bodies_inout.bid, i, make_bid(p, turn, batch.pairs[p], bodies_inout))


@wp.kernel
def assign_color_kernel(
    turn: wp.int32, batch: PairBatch, pair_color_inout: wp.array(dtype=wp.int32), bodies_inout: Bodies
):
    """Give the pairs that won both bodies of a round the lowest color that is free at both."""
    p = wp.tid()
    if pair_color_inout[p] != COLOR_COUNT:
        return
    bid = make_bid(p, turn, batch.pairs[p], bodies_inout)
    for k in range(2):
        i = batch.pairs[p][k]
        if bodies_inout.motion_type[i] == DYNAMIC and bodies_inout.bid[i] != bid:
            return
    color = free_color(bodies_inout, batch.pairs[p])
    pair_color_inout[p] = color
    for k in range(2):
        # No other pair has won it; of what does not move no color is taken.
        i = batch.pairs[p][k]
        if bodies_inout.motion_type[i] == DYNAMIC:
            bodies_inout.colors[i] = bodies_inout.colors[i] | (1 << color)


@wp.func
def rank_among(i: wp.int32, color: wp.int32, bodies: Bodies):
    """Return how many pairs of a body have lower colors."""
    return count_set_bits(bodies.colors[i] & ((1 << color) - 1))


@wp.func
def count_uncolored(i: wp.int32, bodies: Bodies):
    """Count a pair without a color of its own to a body; return its rank among the body's pairs."""
    rank = rank_among(i, COLOR_COUNT, bodies) + bodies.uncolored[i]
    bodies.uncolored[i] = bodies.uncolored[i] + 1
    return rank


@wp.kernel
def rank_pairs_kernel(
    color: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    batch: PairBatch,
    bodies_inout: Bodies,
    rank_out: wp.array(dtype=wp.vec2i),
    count_out: wp.array(dtype=wp.int32),
):
    """Rank pairs among those of their bodies, in the order of colors; one thread ranks those without one.

    Args:
        color: In ascending order, shape [2 pair]; its second half is scratch.
        order: Pairs in this order.
        count_out: Entry 0: number of pairs in contact, 0 before.
    """
    i, room = wp.tid(), color.shape[0] // 2
    if color[i] > COLOR_COUNT:
        return
    if i + 1 == room or color[wp.min(i + 1, room - 1)] > COLOR_COUNT:
        count_out[0] = i + 1
    if color[i] < COLOR_COUNT:
        pair = batch.pairs[order[i]]
        rank_out[order[i]] = wp.vec2i(
            rank_among(pair[0], color[i], bodies_inout), rank_among(pair[1], color[i], bodies_inout)
        )
    elif i == 0 or color[wp.max(i - 1, 0)] < COLOR_COUNT:
        k = wp.int32(i)
        while k < room and color[wp.min(k, room - 1)] == COLOR_COUNT:
            pair = batch.pairs[order[k]]
            rank_a = count_uncolored(pair[0], bodies_inout)
            rank_out[order[k]] = wp.vec2i(rank_a, count_uncolored(pair[1], bodies_inout))
            k += 1
