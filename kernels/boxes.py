"""Conservative float32 boxes of float64 points, and their overlap under a rigid transform."""

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


@wp.func
def boxes_overlap(
    lower_a: wp.vec3,
    upper_a: wp.vec3,
    lower_b: wp.vec3,
    upper_b: wp.vec3,
    rotation: wp.mat33,
    translation: wp.vec3,
    margin: float,
):
    """Return False only where box A and the posed box B are apart, on the three axes of each.

    rotation, translation: B's frame in A's, both about their models' centres. margin: `pair_margin`, which covers the
    rounding of everything here, so that no pair of points that meet is ever pruned.
    """
    half_a = (upper_a - lower_a) * 0.5
    half_b = (upper_b - lower_b) * 0.5
    centre_b = (upper_b + lower_b) * 0.5
    apart = rotation * centre_b + translation - (upper_a + lower_a) * 0.5
    for i in range(3):
        reach = wp.abs(rotation[i, 0]) * half_b[0] + wp.abs(rotation[i, 1]) * half_b[1]
        reach = reach + wp.abs(rotation[i, 2]) * half_b[2] + half_a[i] + margin
        if wp.abs(apart[i]) > reach:
            return False
    for j in range(3):
        reach = wp.abs(rotation[0, j]) * half_a[0] + wp.abs(rotation[1, j]) * half_a[1]
        reach = reach + wp.abs(rotation[2, j]) * half_a[2] + half_b[j] + margin
        along = apart[0] * rotation[0, j] + apart[1] * rotation[1, j] + apart[2] * rotation[2, j]
        if wp.abs(along) > reach:
            return False
    return True
