"""Conservative float32 boxes of float64 points, and whether two of them overlap under a rigid transform."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


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


@wp.struct
class PosedBox:
    """Twice the centre and the whole width of a box along the axes of its own frame, and along those of the other."""

    sum: wp.vec3
    size: wp.vec3
    turned_sum: wp.vec3
    turned_size: wp.vec3


@wp.func
def pose_box(lower: wp.vec3, upper: wp.vec3, rotation: wp.mat33, translation: wp.vec3):
    """Return a box with its image in another frame: x -> rotation x + translation, both about the models' centres."""
    box = PosedBox()
    box.sum = upper + lower
    box.size = upper - lower
    box.turned_sum = rotation * box.sum + (translation + translation)
    for i in range(3):
        reach = wp.abs(rotation[i, 0]) * box.size[0] + wp.abs(rotation[i, 1]) * box.size[1]
        box.turned_size[i] = reach + wp.abs(rotation[i, 2]) * box.size[2]
    return box


@wp.func
def boxes_overlap(a: PosedBox, b: PosedBox, margin: float):
    """Return False only where two boxes are apart along one of the three axes of each.

    margin: of `PairPose`; it covers the rounding of everything here and of the poses, so that no pair of points that
    meet is ever pruned. Each axis has a box in the frame of which it is an axis, and the other's image there.
    """
    reach = margin + margin
    p = a.sum - b.turned_sum
    q = a.turned_sum - b.sum
    return (
        wp.abs(p[0]) <= a.size[0] + b.turned_size[0] + reach
        and wp.abs(p[1]) <= a.size[1] + b.turned_size[1] + reach
        and wp.abs(p[2]) <= a.size[2] + b.turned_size[2] + reach
        and wp.abs(q[0]) <= a.turned_size[0] + b.size[0] + reach
        and wp.abs(q[1]) <= a.turned_size[1] + b.size[1] + reach
        and wp.abs(q[2]) <= a.turned_size[2] + b.size[2] + reach
    )
