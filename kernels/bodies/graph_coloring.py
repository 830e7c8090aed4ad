"""Graph coloring of the pairs in contact: no dynamic body is in two pairs of one color.

In each round every uncolored pair bids for its bodies, and takes the lowest color that is free at both if it wins both.
Source: Luby 1986; Jones and Plassmann 1993.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import lowest_bit
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.bodies.bodies import DYNAMIC, Bodies

wp.set_module_options(native.options("base/lanes.cuh"))

COLOR_COUNT = wp.constant(16)
"""Number of colors. Pairs without one have the color COLOR_COUNT; those left over are relaxed one after another."""

INACTIVE = wp.constant(127)
"""Color of pairs that are not solved."""


@wp.func
def make_bid(p: wp.int32, turn: wp.int32, pair: wp.vec2i, bodies: Bodies):
    """Return the bid of a pair: later rounds outbid earlier ones; within a round it is a hash, then the pair's number.

    The hash is of the round, so that no pair loses for long, and of ranks in a world, not of object numbers, so a world
    has the same coloring alone and among others.

    Bits: 63..56 round + 1 | 55 zero | 54..31 hash | 30..0 pair
    """
    mixed = wp.uint32(bodies.rank[pair[0]]) * wp.uint32(40503) + wp.uint32(bodies.rank[pair[1]])
    mixed += wp.uint32(turn) * wp.uint32(2654435761)
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


@wp.kernel
def find_color_kernel(color: wp.array(dtype=wp.int32), start_out: wp.array(dtype=wp.int32)):
    """Find where the pairs of each color begin among pairs sorted by color, and where the last of them ends.

    Args:
        color: In ascending order, shape [2 pair]; its second half is scratch.
    """
    i = wp.tid()
    room = color.shape[0] // 2
    last = COLOR_COUNT + 1
    before, here = wp.int32(-1), wp.int32(last)
    if i > 0:
        before = wp.min(color[i - 1], last)
    if i < room:
        here = wp.min(color[i], last)
    for c in range(before + 1, here + 1):
        start_out[c] = i
