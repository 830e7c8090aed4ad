"""Conservative float32 boxes of float64 points, and whether two of them overlap under a rigid transform."""

import warp as wp

from warp_abtree.kernels import native

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

ROUNDING_UP = wp.constant(wp.float32(1.0 + 2.0**-20))
ROUNDING_DOWN = wp.constant(wp.float32(1.0 - 2.0**-20))


@wp.func
def next_below(x: wp.float32):
    """Return the largest float32 below a finite x."""
    bits = wp.cast(x, wp.int32)
    if bits > 0:
        return wp.cast(bits - 1, wp.float32)
    if (bits & 0x7FFFFFFF) == 0:
        return wp.cast(wp.int32(-2147483647), wp.float32)
    return wp.cast(bits + 1, wp.float32)


@wp.func
def round_down(x: wp.float64):
    """Return a float32 below x that stays below when x carries half a unit of float64 rounding."""
    y = wp.float32(x)
    if wp.float64(y) >= x:
        y = next_below(y)
    return y


@wp.func
def round_up(x: wp.float64):
    """Return a float32 above x, mirrored from `round_down`."""
    return -round_down(-x)


@wp.func
def round_down_vec(x: wp.vec3d):
    return wp.vec3(round_down(x[0]), round_down(x[1]), round_down(x[2]))


@wp.func
def round_up_vec(x: wp.vec3d):
    return wp.vec3(round_up(x[0]), round_up(x[1]), round_up(x[2]))


@native.func_native()
def fuse32(a: wp.float32, b: wp.float32, c: wp.float32) -> wp.float32:
    """Return a b + c, rounded once on every device (fused multiply-add): half the work, and no less exact."""


@wp.func
def map_point(rotation: wp.mat33, translation: wp.vec3, p: wp.vec3):
    """Return rotation p + translation."""
    x = wp.vec3()
    for i in range(3):
        part = fuse32(rotation[i, 2], p[2], translation[i])
        x[i] = fuse32(rotation[i, 0], p[0], fuse32(rotation[i, 1], p[1], part))
    return x


@wp.func
def reach_there(rotation: wp.mat33, size: wp.vec3, margin: wp.float32):
    """Return the width of a box's image in the other frame, widened by a margin on either side."""
    reach = wp.vec3()
    for i in range(3):
        x = fuse32(wp.abs(rotation[i, 2]), size[2], margin + margin)
        reach[i] = fuse32(wp.abs(rotation[i, 0]), size[0], fuse32(wp.abs(rotation[i, 1]), size[1], x))
    return reach


@wp.struct
class PosedBox:
    """A box along the axes of its own frame, and its image along those of the other frame."""

    sum: wp.vec3  # twice the centre, own frame
    size: wp.vec3  # whole width, own frame
    posed_sum: wp.vec3  # twice the centre, other frame
    posed_size: wp.vec3  # whole width, other frame


@wp.func
def pose_box(lower: wp.vec3, upper: wp.vec3, rotation: wp.mat33, translation: wp.vec3, margin: wp.float32):
    """Return a box with its image in another frame: x -> rotation x + translation, both about the models' centres.

    The image is wider by a margin on either side, along all axes.
    """
    box = PosedBox()
    box.sum = upper + lower
    box.size = upper - lower
    box.posed_sum = map_point(rotation, translation + translation, box.sum)
    box.posed_size = reach_there(rotation, box.size, margin)
    return box


@native.func_native()
def all_within(p: wp.vec3, u: wp.vec3, q: wp.vec3, v: wp.vec3) -> bool:
    """Return whether |p| <= u and |q| <= v in every component, without branches."""


@wp.func
def boxes_overlap(a: PosedBox, b: PosedBox):
    """Return False only where two boxes are apart along one of the three axes of each.

    Each axis has a box in whose frame it is an axis, and the other's image there, wider by the margin of `PairPose`,
    which covers the rounding of everything here and of the poses, so that no pair of points that meet is ever pruned.
    """
    return all_within(a.sum - b.posed_sum, a.size + b.posed_size, a.posed_sum - b.sum, a.posed_size + b.size)
