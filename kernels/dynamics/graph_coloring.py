"""Colours of touching pairs, so that no body that moves is in two pairs of one colour.

Round by round every pair left bids for its bodies, and takes the round's colour where it has won both.
Source: Luby 1986; Jones and Plassmann 1993.
"""

import warp as wp

from warp_abtree.kernels.contact.manifold import Manifolds
from warp_abtree.kernels.dynamics.bodies import AWAKE, Bodies

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

COLOURS = wp.constant(24)
"""Colours of pairs; the pairs left over take colour COLOURS and are relaxed one after another."""

NO_COLOUR = wp.constant(127)


@wp.func
def is_active(bodies: Bodies, manifolds: Manifolds, p: wp.int32, pair: wp.vec2i):
    return manifolds.count[p] > 0 and (bodies.role[pair[0]] == AWAKE or bodies.role[pair[1]] == AWAKE)


@wp.func
def make_bid(p: wp.int32, colour: wp.int32, pair: wp.vec2i, bodies: Bodies):
    """Return a number that no other pair has: later colours outbid earlier ones, pairs are in no order otherwise.

    Ranks in their worlds, not numbers in the scene, decide, so that a world goes the same way alone and among others.
    """
    mixed = wp.uint32(bodies.rank[pair[0]]) * wp.uint32(40503) + wp.uint32(bodies.rank[pair[1]])
    mixed = (mixed ^ (mixed >> wp.uint32(15))) * wp.uint32(739982445)
    mixed = (mixed ^ (mixed >> wp.uint32(12))) & wp.uint32(0xFFFFFF)
    return (wp.int64(colour + 1) << wp.int64(56)) | (wp.int64(mixed) << wp.int64(31)) | wp.int64(p)


@wp.kernel
def begin_colour_kernel(
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    manifolds: Manifolds,
    bodies: Bodies,
    order_out: wp.array(dtype=wp.int32),
    colour_out: wp.array(dtype=wp.int32),
):
    """Give all pairs to be solved the last colour, others none."""
    p = wp.tid()
    order_out[p] = p
    colour_out[p] = NO_COLOUR
    if p < pair_count[0] and is_active(bodies, manifolds, p, pairs[p]):
        colour_out[p] = COLOURS


@wp.kernel
def bid_colour_kernel(
    colour: wp.int32, pairs: wp.array(dtype=wp.vec2i), pair_colour: wp.array(dtype=wp.int32), bodies_inout: Bodies
):
    """Bid for both bodies of each pair that is left."""
    p = wp.tid()
    if pair_colour[p] != COLOURS:
        return
    for k in range(2):
        i = pairs[p][k]
        if bodies_inout.role[i] == AWAKE:
            wp.atomic_max(bodies_inout.bid, i, make_bid(p, colour, pairs[p], bodies_inout))


@wp.kernel
def take_colour_kernel(
    colour: wp.int32, pairs: wp.array(dtype=wp.vec2i), bodies: Bodies, pair_colour_inout: wp.array(dtype=wp.int32)
):
    """Give a colour to the pairs that won both bodies."""
    p = wp.tid()
    if pair_colour_inout[p] != COLOURS:
        return
    bid = make_bid(p, colour, pairs[p], bodies)
    won = bool(True)
    for k in range(2):
        i = pairs[p][k]
        if bodies.role[i] == AWAKE and bodies.bid[i] != bid:
            won = False
    if won:
        pair_colour_inout[p] = colour
