"""Closed intersection where a plane is shared or missing: coplanar triangles, and faces that are segments or points."""

import warp as wp

from warp_abtree.kernels.exact.predicates import drop_axis, orient2d, orient3d, orient_edges

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func(inline=False)
def separates_line(mode: wp.int32, a: wp.vec2d, b: wp.vec2d, inner: wp.vec2d, p: wp.vec2d, q: wp.vec2d, r: wp.vec2d):
    """Return whether p, q and r all lie strictly on the side of line ab that `inner` is not on."""
    side = orient2d(mode, a, b, inner)
    sp = orient2d(mode, a, b, p)
    if sp == 0 or sp == side:
        return False
    return orient2d(mode, a, b, q) == sp and orient2d(mode, a, b, r) == sp


@wp.func(inline=False)
def widest_axis(mode: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the axis along which a triangle projects to about the largest area, -1 where all three are collinear."""
    axis = wp.int32(-1)
    most = wp.float64(-1.0)
    u = b - a
    v = c - a
    for i in range(3):
        if orient2d(mode, drop_axis(a, i), drop_axis(b, i), drop_axis(c, i)) != 0:
            j = (i + 1) % 3
            k = (i + 2) % 3
            area = wp.abs(u[j] * v[k] - u[k] * v[j])
            if area > most:
                axis = i
                most = area
    return axis


@wp.func(inline=False)
def intersect_coplanar(
    mode: wp.int32, axis: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d
):
    """Return whether two closed triangles in one plane meet: no edge line separates what they project to along an axis.

    Complete for two triangles, and for a triangle and a segment or a point: every edge of their Minkowski difference
    is then parallel to an edge of one of them. (A segment as p, q, r has side 0 on its own line, so both sides are
    asked.)
    """
    a2, b2, c2 = drop_axis(a, axis), drop_axis(b, axis), drop_axis(c, axis)
    p2, q2, r2 = drop_axis(p, axis), drop_axis(q, axis), drop_axis(r, axis)
    if (
        separates_line(mode, a2, b2, c2, p2, q2, r2)
        or separates_line(mode, b2, c2, a2, p2, q2, r2)
        or separates_line(mode, c2, a2, b2, p2, q2, r2)
    ):
        return False
    return not (
        separates_line(mode, p2, q2, r2, a2, b2, c2)
        or separates_line(mode, q2, r2, p2, a2, b2, c2)
        or separates_line(mode, r2, p2, q2, a2, b2, c2)
    )


@wp.func
def is_before(a: wp.vec3d, b: wp.vec3d):
    """Return whether a comes before b in the order by x, then y, then z."""
    if a[0] != b[0]:
        return a[0] < b[0]
    if a[1] != b[1]:
        return a[1] < b[1]
    return a[2] < b[2]


@wp.func(inline=False)
def find_ends(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the ends of the segment that three collinear points span."""
    low = a
    high = a
    if is_before(b, low):
        low = b
    if is_before(high, b):
        high = b
    if is_before(c, low):
        low = c
    if is_before(high, c):
        high = c
    return low, high


@wp.func(inline=False)
def intersect_segment_triangle(
    mode: wp.int32, axis: wp.int32, p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d
):
    """Return whether a closed segment (or point) meets a triangle of positive area, `axis` its `widest_axis`."""
    sp = orient3d(mode, a, b, c, p)
    sq = orient3d(mode, a, b, c, q)
    if sp == 0 and sq == 0:
        return intersect_coplanar(mode, axis, a, b, c, p, q, q)
    if sp == sq:
        return False
    ab = orient_edges(mode, p, q, a, b)
    bc = orient_edges(mode, p, q, b, c)
    ca = orient_edges(mode, p, q, c, a)
    return (ab >= 0 and bc >= 0 and ca >= 0) or (ab <= 0 and bc <= 0 and ca <= 0)


@wp.func
def intersect_segments(mode: wp.int32, p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Return whether two closed segments (or points) meet.

    Coplanar ones meet iff their boxes and all three projections do: one projection keeps the plane, or the line, apart.
    """
    if orient_edges(mode, p, q, a, b) != 0:
        return False
    meet = bool(True)
    for i in range(3):
        if wp.max(p[i], q[i]) < wp.min(a[i], b[i]) or wp.max(a[i], b[i]) < wp.min(p[i], q[i]):
            meet = False
        p2 = drop_axis(p, i)
        q2 = drop_axis(q, i)
        a2 = drop_axis(a, i)
        b2 = drop_axis(b, i)
        if separates_line(mode, p2, q2, q2, a2, b2, b2) or separates_line(mode, a2, b2, b2, p2, q2, q2):
            meet = False
    return meet


@wp.func(inline=False)
def intersect_special(
    mode: wp.int32, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d
):
    """Decide faces whose plane is shared, or not defined."""
    axis_a = widest_axis(mode, a0, a1, a2)
    axis_b = widest_axis(mode, b0, b1, b2)
    if axis_a >= 0 and axis_b >= 0:
        return intersect_coplanar(mode, axis_a, a0, a1, a2, b0, b1, b2)
    a_low, a_high = find_ends(a0, a1, a2)
    b_low, b_high = find_ends(b0, b1, b2)
    if axis_a >= 0:
        return intersect_segment_triangle(mode, axis_a, b_low, b_high, a0, a1, a2)
    if axis_b >= 0:
        return intersect_segment_triangle(mode, axis_b, a_low, a_high, b0, b1, b2)
    return intersect_segments(mode, a_low, a_high, b_low, b_high)
