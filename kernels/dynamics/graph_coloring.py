"""Graph coloring of the pairs in contact: no dynamic body is in two pairs of one color.

In each round every uncolored pair bids for its bodies, and takes the color of the round where it has won both.
Source: Luby 1986; Jones and Plassmann 1993.
"""

import warp as wp

from warp_abtree.kernels.dynamics.bodies import DYNAMIC, Bodies

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

COLOR_COUNT = wp.constant(24)
"""Number of colors. Pairs without one have the color COLOR_COUNT; those left over are relaxed one after another."""

INACTIVE = wp.constant(127)
"""Color of pairs that are not solved."""


@wp.func
def make_bid(p: wp.int32, color: wp.int32, pair: wp.vec2i, bodies: Bodies):
    """Return the bid of a pair: later rounds outbid earlier ones; within a round it is a hash, then the pair's number.

    The hash is of ranks in a world, not of object numbers, so a world has the same coloring alone and among others.

    Bits: 63..56 round + 1 | 55 zero | 54..31 hash | 30..0 pair
    """
    mixed = wp.uint32(bodies.rank[pair[0]]) * wp.uint32(40503) + wp.uint32(bodies.rank[pair[1]])
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * wp.uint32(739982445)
    mixed = (mixed ^ (mixed >> wp.uint32(12))) & wp.uint32(0xFFFFFF)
    return (wp.int64(color + 1) << wp.int64(56)) | (wp.int64(mixed) << wp.int64(31)) | wp.int64(p)


@wp.kernel
def bid_kernel(
    color: wp.int32, pairs: wp.array(dtype=wp.vec2i), pair_color: wp.array(dtype=wp.int32), bodies_inout: Bodies
):
    """Bid for both bodies of each uncolored pair."""
    p = wp.tid()
    if pair_color[p] != COLOR_COUNT:
        return
    for k in range(2):
        i = pairs[p][k]
        if bodies_inout.motion_type[i] == DYNAMIC:
            wp.atomic_max(bodies_inout.bid, i, make_bid(p, color, pairs[p], bodies_inout))


@wp.kernel
def assign_color_kernel(
    color: wp.int32, pairs: wp.array(dtype=wp.vec2i), bodies: Bodies, pair_color_inout: wp.array(dtype=wp.int32)
):
    """Give a color to the pairs that won both bodies."""
    p = wp.tid()
    if pair_color_inout[p] != COLOR_COUNT:
        return
    bid = make_bid(p, color, pairs[p], bodies)
    for k in range(2):
        i = pairs[p][k]
        if bodies.motion_type[i] == DYNAMIC and bodies.bid[i] != bid:
            return
    pair_color_inout[p] = color
