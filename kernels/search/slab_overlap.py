"""Separating axis test by slabs (k-DOPs) of two nodes of few faces, whose boxes overlap.

Boxes of faces that look aside reach beyond the surface, so that those of nested surfaces overlap all over. A slab says
how far the faces below a node reach along the direction in which they are thinnest. Along either node's direction n the
other is bounded by its own slab, along m, and its box: n . x = a m . x + (n - a m) . x, whatever a. The
margin is docs/exactness.md, bound 12. A record:

    127        96 95         64 63      48 47      32 31      16 15       0
    [    size    |     sum     |     0    |     z    |     y    |     x    ]    x, y, z of the direction plus 2^14
"""

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, Trees
from warp_abtree.kernels.base.boxes import fuse32, map_point
from warp_abtree.kernels.base.nodes import load_constant, load_constant_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.search.item import INDEX_MASK, item_first, item_second

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DIRECTION_LENGTH = wp.constant(16384)
# The last bits of the float32 2^23 + k are those of k.
COMPONENT_BITS, COMPONENT_SHIFT = wp.constant(0x4B000000), wp.constant(wp.float32(2.0**23 + 2.0**14))
INVERSE_SQUARE = wp.constant(wp.float32(2.0**-28))
# Twice eight margins of boxes for a direction of length 2^14.
MARGINS = wp.constant(wp.float32(2.0**18))
# The margin has a distance eight times, too, of which once is enough, with what directions are longer by and rounding.
WITHIN_FACTOR = wp.constant(wp.float32(2.0**18 - 1.01 * 2.0**15))


@wp.struct
class NodeSlab:
    """A slab along a direction: |2 n . x - sum| <= size for all x below the node, about the model's centre."""

    direction: wp.vec3  # n, whole numbers, about 2^14 long
    sum: wp.float32  # least plus greatest n . x
    size: wp.float32  # greatest minus least, rounded up


@wp.func
def unpack_component(bits: wp.int32):
    return wp.cast(bits | COMPONENT_BITS, wp.float32) - COMPONENT_SHIFT


@wp.func
def load_node_slab(models: ModelPool, at: wp.int32):
    record = load_constant(models.node_slab, wp.int64(at))
    low = wp.cast(record[0], wp.int32)
    slab = NodeSlab()
    slab.direction = wp.vec3(
        unpack_component(low & 0xFFFF),
        unpack_component((low >> 16) & 0xFFFF),
        unpack_component(wp.cast(record[1], wp.int32)),
    )
    slab.sum = record[2]
    slab.size = record[3]
    return slab


@wp.func
def add_product(x: wp.vec3, y: wp.vec3, sum: wp.float32):
    return fuse32(x[0], y[0], fuse32(x[1], y[1], fuse32(x[2], y[2], sum)))


@wp.func
def take_multiple(x: wp.vec3, factor: wp.float32, y: wp.vec3):
    """Return x - factor y."""
    return wp.vec3(fuse32(-factor, y[0], x[0]), fuse32(-factor, y[1], x[1]), fuse32(-factor, y[2], x[2]))


@wp.func
def overlaps_along(
    along: NodeSlab,
    other: NodeSlab,
    there: wp.vec3,
    shift: wp.vec3,
    sum: wp.vec3,
    size: wp.vec3,
    ratio: wp.float32,
    margin: wp.float32,
):
    """Return False only where a slab separates from a node along the slab's direction.

    Args:
        there: The direction in the other frame.
        shift: The translation from the other frame to this one.
        sum, size: Twice the centre of the node's box, and its widths.
        ratio: Of the node's slab, as much as is taken of it.
    """
    rest = take_multiple(there, ratio, other.direction)
    middle = add_product(rest, sum, add_product(along.direction, shift + shift, 0.0))
    reach = add_product(wp.abs(rest), size, along.size + margin)
    middle = fuse32(ratio, other.sum, middle)
    reach = fuse32(wp.abs(ratio), other.size, reach)
    # True of NaN: of margins that are infinite, as distances are that float32 does not hold.
    return not wp.abs(middle - along.sum) > reach


@wp.func
def slabs_overlap(trees: Trees, pose: PairPose, item: wp.int64):
    """Return False only where the slabs of an item's two nodes separate them."""
    x = item_first(item)
    y = item_second(item)
    # Children are named by the first of them.
    x = wp.where(x < 0, (x & INDEX_MASK) >> 1, x)
    y = wp.where(y < 0, (y & INDEX_MASK) >> 1, y)
    node_a = load_constant_node(trees.states, pose.node_a + x)
    node_b = load_constant_node(trees.states, pose.node_b + y)
    a = load_node_slab(trees.models, pose.slab[0] + x)
    b = load_node_slab(trees.models, pose.slab[1] + y)
    zero = wp.vec3()
    a_there = map_point(wp.transpose(pose.rotation32), zero, a.direction)
    b_there = map_point(pose.rotation32, zero, b.direction)
    ratio = add_product(a.direction, b_there, 0.0) * INVERSE_SQUARE
    margin = fuse32(-WITHIN_FACTOR, wp.float32(pose.within), MARGINS * pose.margin)
    sum_a, size_a = node_a.upper + node_a.lower, node_a.upper - node_a.lower
    sum_b, size_b = node_b.upper + node_b.lower, node_b.upper - node_b.lower
    by_a = overlaps_along(a, b, a_there, pose.translation32, sum_b, size_b, ratio, margin)
    by_b = overlaps_along(b, a, b_there, pose.back32, sum_a, size_a, ratio, margin)
    return by_a and by_b
