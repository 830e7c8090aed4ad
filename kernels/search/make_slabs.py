"""Slabs of a model's nodes of few faces, at its finest LOD or another one: they serve the trees that stand there."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, Trees, load_vertex
from warp_abtree.kernels.base.boxes import round_up
from warp_abtree.kernels.base.poses import SLAB_GAIN_UNIT
from warp_abtree.kernels.search.slab_overlap import DIRECTION_LENGTH

wp.set_module_options(native.options())


@wp.struct
class Extent:
    """Extent of faces along a direction."""

    direction: wp.vec3d  # whole numbers
    low: wp.float64  # least product with it
    high: wp.float64  # greatest


@wp.func
def face_below(models: ModelPool, start: wp.int32, node: wp.int32, level: wp.int32, i: wp.int32):
    """Return the i-th face so many levels below a node, -1 where there is none: leaves lie on the last two levels."""
    face = models.node_face[start + (node << level) + i]
    if face < 0 and level > 0 and (i & 1) == 0:
        face = models.node_face[start + (((node << level) + i) >> 1)]
    return face


@wp.func
def corners_of(trees: Trees, model: wp.int32, state: wp.int32, face: wp.int32):
    """Return the corners of a face at the LOD of a tree state, -1 where it is inactive; of the original for -1."""
    if state < 0:
        return trees.models.face_vertex[trees.models.face_start[model] + face]
    corner = trees.states.face_corner[trees.states.face_start[state] + face]
    return wp.vec3i(corner[0], corner[1], corner[2])


@wp.func
def corners_below(trees: Trees, model: wp.int32, state: wp.int32, node: wp.int32, level: wp.int32, i: wp.int32):
    """Return the corners of the i-th face so many levels below a node, -1 where there is none or it is inactive."""
    face = face_below(trees.models, trees.models.node_start[model], node, level, i)
    if face < 0:
        return wp.vec3i(-1, -1, -1)
    return corners_of(trees, model, state, face)


@wp.func
def normal_of_corners(models: ModelPool, corner: wp.vec3i):
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
def measure_faces(trees: Trees, model: wp.int32, state: wp.int32, node: wp.int32, level: wp.int32, direction: wp.vec3d):
    """Return the extent of the faces below a node along a direction."""
    extent = Extent()
    extent.direction = direction
    extent.low = wp.float64(wp.inf)
    extent.high = -wp.float64(wp.inf)
    for i in range(1 << level):
        corner = corners_below(trees, model, state, node, level, i)
        if corner[0] >= 0:
            for k in range(3):
                x = wp.dot(direction, load_vertex(trees.models.vertex_pos, corner[k]) - trees.models.centre[model])
                extent.low = wp.min(extent.low, x)
                extent.high = wp.max(extent.high, x)
    return extent


@wp.func
def record_of(extent: Extent):
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


@wp.func
def measure_box(trees: Trees, model: wp.int32, state: wp.int32, node: wp.int32, level: wp.int32):
    """Return the widths of the box of the faces below a node."""
    widths = wp.vec3d()
    for k in range(3):
        axis = wp.vec3d()
        axis[k] = wp.float64(1.0)
        extent = measure_faces(trees, model, state, node, level, axis)
        widths[k] = extent.high - extent.low
    return widths


@wp.func
def gain_of(widths: wp.vec3d, slab: Extent):
    """Return the excess of a box's width over a slab's, along the slab's direction, see `poses.SLAB_GAIN_UNIT`."""
    n = slab.direction
    whole = (wp.abs(n[0]) * widths[0] + wp.abs(n[1]) * widths[1]) + wp.abs(n[2]) * widths[2]
    most = wp.float64(DIRECTION_LENGTH) * ((widths[0] + widths[1]) + widths[2])
    if not most > wp.float64(0.0):
        return wp.int32(0)
    return wp.int32(wp.float64(SLAB_GAIN_UNIT) * (whole - (slab.high - slab.low)) / most)


@wp.kernel
def make_slab_kernel(
    model: wp.int32,
    state: wp.int32,
    first: wp.int32,
    trees: Trees,
    start: wp.int32,
    entry: wp.int32,
    slab_out: wp.array(dtype=wp.vec4),
    gain_out: wp.array(dtype=wp.vec2i),
    lod_out: wp.array(dtype=wp.int32),
):
    """Make the slab of each node of few faces, along its faces' mean normal or that of a face.

    Args:
        state: A tree state of the model at the LOD, -1 for the finest.
        first: The first such node.
        start, entry: Where slabs of its nodes begin, and the place of its gain.
    """
    node = first + wp.tid()
    level = wp.int32(0)
    if node == first and state >= 0:
        lod_out[model] = trees.states.lod[state]
    while (node << level) < (1 << trees.models.depth[model]):
        level += 1
    mean = wp.vec3d()
    count = wp.int32(0)
    for i in range(1 << level):
        corner = corners_below(trees, model, state, node, level, i)
        if corner[0] >= 0:
            mean += normal_of_corners(trees.models, corner)
            count += 1
    if count == 0:
        slab_out[start + node] = wp.vec4()
        return
    if wp.length(mean) > wp.float64(0.0):
        mean = mean / wp.length(mean)
    best = measure_faces(trees, model, state, node, level, whole_direction(mean))
    for i in range(1 << level):
        corner = corners_below(trees, model, state, node, level, i)
        if corner[0] >= 0:
            normal = normal_of_corners(trees.models, corner)
            extent = measure_faces(trees, model, state, node, level, whole_direction(normal))
            if extent.high - extent.low < best.high - best.low:
                best = extent
    slab_out[start + node] = record_of(best)
    if count > 1:
        gain = gain_of(measure_box(trees, model, state, node, level), best)
        wp.atomic_add(gain_out, entry, wp.vec2i(gain, 1))
