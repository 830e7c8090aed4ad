"""Slabs of small nodes: how far the few faces below a node reach along the direction in which they are thinnest.

Boxes of faces that look aside reach beyond the surface, so that those of nested surfaces overlap all over. Of two
nodes of a few faces each, whose boxes overlap, the traversal on CUDA compares slabs: along either one's direction n the
other is bounded by its slab along m and its box, n . x = a m . x + (n - a m) . x, whatever a. `docs/exactness.md` has
the margin. Slabs are of original faces, and serve trees at the finest LOD. A record:

    127        96 95         64 63      48 47      32 31      16 15       0
    [    size    |     sum     |     0    |     z    |     y    |     x    ]    x, y, z: plus 2^14
"""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, StatePool, load_vertex
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.boxes import fuse32, map_point, round_up
from warp_abtree.kernels.traversal.node_pair import INDEX_MASK, item_first, item_second
from warp_abtree.kernels.traversal.nodes import load_constant, load_constant_node

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DIRECTION_LENGTH = wp.constant(16384)
# The last bits of the float32 2^23 + k are those of k.
COMPONENT_BITS, COMPONENT_SHIFT = wp.constant(0x4B000000), wp.constant(wp.float32(2.0**23 + 2.0**14))
INVERSE_SQUARE = wp.constant(wp.float32(2.0**-28))
# Twice eight margins of boxes for a direction of length 2^14.
MARGINS = wp.constant(wp.float32(2.0**18))


@wp.struct
class Slab:
    """A slab along a direction: |2 n . x - sum| <= size for all x below the node, about the model's centre."""

    direction: wp.vec3  # n, whole numbers, about 2^14 long
    sum: wp.float32  # least plus greatest n . x
    size: wp.float32  # greatest minus least, rounded up


@wp.func
def unpack_component(bits: wp.int32):
    return wp.cast(bits | COMPONENT_BITS, wp.float32) - COMPONENT_SHIFT


@wp.func
def load_slab(models: ModelPool, at: wp.int32):
    record = load_constant(models.node_slab, wp.int64(at))
    low = wp.cast(record[0], wp.int32)
    slab = Slab()
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
    along: Slab,
    other: Slab,
    there: wp.vec3,
    shift: wp.vec3,
    sum: wp.vec3,
    size: wp.vec3,
    ratio: wp.float32,
    margin: wp.float32,
):
    """Return False only where a slab lies apart from a node, along the slab's direction.

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
    return wp.abs(middle - along.sum) <= reach


@wp.func
def small_nodes_overlap(models: ModelPool, states: StatePool, pose: PairPose, slab: wp.vec2i, item: wp.int64):
    """Return False only where the slabs of the two nodes that an item goes down from separate them."""
    x = item_first(item)
    y = item_second(item)
    # Children are named by the first of them.
    x = wp.where(x < 0, (x & INDEX_MASK) >> 1, x)
    y = wp.where(y < 0, (y & INDEX_MASK) >> 1, y)
    node_a = load_constant_node(states, pose.node_a + x)
    node_b = load_constant_node(states, pose.node_b + y)
    a = load_slab(models, slab[0] + x)
    b = load_slab(models, slab[1] + y)
    zero = wp.vec3()
    a_there = map_point(wp.transpose(pose.rotation32), zero, a.direction)
    b_there = map_point(pose.rotation32, zero, b.direction)
    ratio = add_product(a.direction, b_there, 0.0) * INVERSE_SQUARE
    margin = MARGINS * pose.margin
    sum_a, size_a = node_a.upper + node_a.lower, node_a.upper - node_a.lower
    sum_b, size_b = node_b.upper + node_b.lower, node_b.upper - node_b.lower
    by_a = overlaps_along(a, b, a_there, pose.translation32, sum_b, size_b, ratio, margin)
    by_b = overlaps_along(b, a, b_there, pose.back32, sum_a, size_a, ratio, margin)
    return by_a and by_b


@wp.struct
class Extent:
    """How far faces reach along a direction."""

    direction: wp.vec3d  # whole numbers
    low: wp.float64
    high: wp.float64


@wp.func
def face_below(models: ModelPool, start: wp.int32, node: wp.int32, level: wp.int32, i: wp.int32):
    """Return the i-th face so many levels below a node, -1 where there is none: leaves lie on the last two levels."""
    face = models.node_face[start + (node << level) + i]
    if face < 0 and level > 0 and (i & 1) == 0:
        face = models.node_face[start + (((node << level) + i) >> 1)]
    return face


@wp.func
def face_normal(models: ModelPool, corner: wp.vec3i):
    """Return the unit normal of a face, 0 where it has no area."""
    a = load_vertex(models.vertex_pos, corner[0])
    n = wp.cross(load_vertex(models.vertex_pos, corner[1]) - a, load_vertex(models.vertex_pos, corner[2]) - a)
    length = wp.length(n)
    if length > wp.float64(0.0) and length < wp.float64(wp.inf):
        return n / length
    return wp.vec3d()


@wp.func
def whole_direction(n: wp.vec3d):
    """Return about 2^14 times a unit vector in whole numbers, an axis for 0."""
    length = wp.float64(DIRECTION_LENGTH)
    if wp.dot(n, n) == wp.float64(0.0):
        return wp.vec3d(wp.float64(0.0), wp.float64(0.0), length)
    return wp.vec3d(wp.rint(n[0] * length), wp.rint(n[1] * length), wp.rint(n[2] * length))


@wp.func
def measure_faces(models: ModelPool, model: wp.int32, node: wp.int32, level: wp.int32, direction: wp.vec3d):
    """Return how far the faces below a node reach along a direction."""
    extent = Extent()
    extent.direction = direction
    extent.low = wp.float64(wp.inf)
    extent.high = -wp.float64(wp.inf)
    for i in range(1 << level):
        face = face_below(models, models.node_start[model], node, level, i)
        if face >= 0:
            corner = models.face_vertex[models.face_start[model] + face]
            for k in range(3):
                x = wp.dot(direction, load_vertex(models.vertex_pos, corner[k]) - models.centre[model])
                extent.low = wp.min(extent.low, x)
                extent.high = wp.max(extent.high, x)
    return extent


@wp.func
def pack_slab(extent: Extent):
    n = wp.vec3i(
        wp.int32(extent.direction[0]) + DIRECTION_LENGTH,
        wp.int32(extent.direction[1]) + DIRECTION_LENGTH,
        wp.int32(extent.direction[2]) + DIRECTION_LENGTH,
    )
    sum = wp.float32(extent.low + extent.high)
    middle = wp.float64(sum)
    two = wp.float64(2.0)
    size = round_up(wp.max(two * extent.high - middle, middle - two * extent.low))
    return wp.vec4(wp.cast(n[0] | (n[1] << 16), wp.float32), wp.cast(n[2], wp.float32), sum, size)


@wp.kernel
def make_small_slab_kernel(model: wp.int32, first: wp.int32, models: ModelPool, slab_out: wp.array(dtype=wp.vec4)):
    """Make the slab of each small node of a model, along its faces' mean normal or that of a face.

    Args:
        first: The first small node.
    """
    node = first + wp.tid()
    start = models.node_start[model]
    level = wp.int32(0)
    while (node << level) < (1 << models.depth[model]):
        level += 1
    mean = wp.vec3d()
    count = wp.int32(0)
    for i in range(1 << level):
        face = face_below(models, start, node, level, i)
        if face >= 0:
            mean += face_normal(models, models.face_vertex[models.face_start[model] + face])
            count += 1
    if count == 0:
        slab_out[start + node] = wp.vec4()
        return
    if wp.length(mean) > wp.float64(0.0):
        mean = mean / wp.length(mean)
    best = measure_faces(models, model, node, level, whole_direction(mean))
    for i in range(1 << level):
        face = face_below(models, start, node, level, i)
        if face >= 0:
            normal = face_normal(models, models.face_vertex[models.face_start[model] + face])
            extent = measure_faces(models, model, node, level, whole_direction(normal))
            if extent.high - extent.low < best.high - best.low:
                best = extent
    slab_out[start + node] = pack_slab(best)
