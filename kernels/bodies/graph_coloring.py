"""Graph coloring of the pairs in contact: no dynamic body is in two pairs of one color.

In each round every uncolored pair bids for its bodies, and takes the color of the round where it has won both. A color
may have several rounds: the bodies that its pairs hold are not to be won in the later ones.
Source: Luby 1986; Jones and Plassmann 1993.
"""

import warp as wp

from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

COLOR_COUNT = wp.constant(16)
"""Number of colors. Pairs without one have the color COLOR_COUNT; those left over are relaxed one after another."""

INACTIVE = wp.constant(127)
"""Color of pairs that are not solved."""


HELD_BID = wp.constant(wp.int64(2**55))
"""Outbids all pairs of a round."""


@wp.func
def make_bid(p: wp.int32, turn: wp.int32, pair: wp.vec2i, bodies: Bodies):
    """Return the bid of a pair: later rounds outbid earlier ones; within a round it is a hash, then the pair's number.

    The hash is of ranks in a world, not of object numbers, so a world has the same coloring alone and among others.

    Bits: 63..56 round + 1 | 55 zero, or HELD_BID | 54..31 hash | 30..0 pair
    """
    mixed = wp.uint32(bodies.rank[pair[0]]) * wp.uint32(40503) + wp.uint32(bodies.rank[pair[1]])
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * wp.uint32(739982445)
    mixed = (mixed ^ (mixed >> wp.uint32(12))) & wp.uint32(0xFFFFFF)
    return (wp.int64(turn + 1) << wp.int64(56)) | (wp.int64(mixed) << wp.int64(31)) | wp.int64(p)


@wp.func
def held_bid(color: wp.int32, rounds: wp.int32):
    """Return the bid by which a pair holds a body that it has won, for the rounds of a color."""
    return (wp.int64((color + 1) * rounds) << wp.int64(56)) | HELD_BID


@wp.kernel
def bid_kernel(
    turn: wp.int32, rounds: wp.int32, batch: PairBatch, pair_color: wp.array(dtype=wp.int32), bodies_inout: Bodies
):
    """Bid for both bodies of each uncolored pair in a round, unless another pair of its color holds one.

    Args:
        rounds: Rounds of a color.
    """
    p = wp.tid()
    if pair_color[p] != COLOR_COUNT:
        return
    for k in range(2):
        if bodies_inout.bid[batch.pairs[p][k]] >= held_bid(turn / rounds, rounds):
            return
    for k in range(2):
        i = batch.pairs[p][k]
        if bodies_inout.motion_type[i] == DYNAMIC:
            wp.atomic_max(bodies_inout.bid, i, make_bid(p, turn, batch.pairs[p], bodies_inout))


@wp.kernel
def assign_color_kernel(
    turn: wp.int32, rounds: wp.int32, batch: PairBatch, pair_color_inout: wp.array(dtype=wp.int32), bodies_inout: Bodies
):
    """Give the color of a round to the pairs that won both bodies, which they hold while rounds have this color.

    Args:
        rounds: Rounds of a color.
    """
    p = wp.tid()
    if pair_color_inout[p] != COLOR_COUNT:
        return
    bid = make_bid(p, turn, batch.pairs[p], bodies_inout)
    for k in range(2):
        i = batch.pairs[p][k]
        if bodies_inout.motion_type[i] == DYNAMIC and bodies_inout.bid[i] != bid:
            return
    color = turn / rounds
    pair_color_inout[p] = color
    for k in range(2):
        # No other pair has won it; what does not move is never won.
        if bodies_inout.motion_type[batch.pairs[p][k]] == DYNAMIC:
            bodies_inout.bid[batch.pairs[p][k]] = held_bid(color, rounds)
