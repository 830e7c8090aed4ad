"""ACTIVE-BUILD: the order of a tree's leaves, by median splits one level at a time.

Source: Liu et al. 2006, section 3.2.2, ACTIVE-BUILD.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Of fewer faces, coarse LODs leave one or none. So to split them well pays at the finest LOD alone.
SMALL_SEGMENT = wp.constant(10)


@wp.struct
class FaceBoxes:
    """Boxes of all faces, and where the tree splits them."""

    lower: wp.array(dtype=wp.vec3d)  # [model units], shape [face]
    upper: wp.array(dtype=wp.vec3d)  # [model units], shape [face]
    left: wp.array(dtype=wp.uint8)  # whether a face goes into the left half, shape [face]


@wp.func
def find_extent(boxes: FaceBoxes, order: wp.array2d(dtype=wp.int32), axis: wp.int32, begin: wp.int32, end: wp.int32):
    """Return the extent of the bounding box of the faces from begin to end of an order."""
    lower = boxes.lower[order[axis, begin]]
    upper = boxes.upper[order[axis, begin]]
    for i in range(begin + 1, end):
        face = order[axis, i]
        lower = wp.min(lower, boxes.lower[face])
        upper = wp.max(upper, boxes.upper[face])
    return upper - lower


@wp.func
def cost_of_axis(boxes: FaceBoxes, order: wp.array2d(dtype=wp.int32), axis: int, begin: int, middle: int, end: int):
    """Return the cost of a split along an axis, which is minimised."""
    if end - begin < SMALL_SEGMENT:
        return -find_extent(boxes, order, axis, begin, end)[axis]
    left = find_extent(boxes, order, axis, begin, middle)
    right = find_extent(boxes, order, axis, middle, end)
    return ((left[0] + left[1]) + left[2]) + ((right[0] + right[1]) + right[2])


@wp.kernel
def split_segment_kernel(
    depth: wp.int32,
    order: wp.array2d(dtype=wp.int32),
    boxes_inout: FaceBoxes,
    order_out: wp.array2d(dtype=wp.int32),
):
    """Split each segment of a level at its median, along the axis of the least cost, ties by axis.

    `order` has the faces by the centre of their boxes along each axis, segment by segment, shape [3, face].
    """
    i = wp.int64(wp.tid())
    n = wp.int64(order.shape[1])
    begin = wp.int32((i * n) >> wp.int64(depth))
    end = wp.int32(((i + wp.int64(1)) * n) >> wp.int64(depth))
    middle = wp.int32(((wp.int64(2) * i + wp.int64(1)) * n) >> wp.int64(depth + 1))
    best = wp.int32(0)
    least = wp.float64(wp.inf)
    for axis in range(3):
        if begin < end:
            cost = cost_of_axis(boxes_inout, order, axis, begin, middle, end)
            if cost < least:
                least = cost
                best = axis
    for at in range(begin, end):
        boxes_inout.left[order[best, at]] = wp.where(at < middle, wp.uint8(1), wp.uint8(0))
    for axis in range(3):
        to_left = wp.int32(begin)
        to_right = wp.int32(middle)
        for at in range(begin, end):
            face = order[axis, at]
            if boxes_inout.left[face] != wp.uint8(0):
                order_out[axis, to_left] = face
                to_left += 1
            else:
                order_out[axis, to_right] = face
                to_right += 1
