"""Point-triangle distance, and convex polygons cut from a triangle by planes.

One polygon is current (`scratch.polygon`; its corner count is a variable of the caller), others lie on a stack.
Source: Ericson, Real-Time Collision Detection, section 5.1.5 (closest point).
"""

import warp as wp

from warp_abtree.kernels.triangle.segment import nearest_on_segment

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STACK = wp.constant(64)  # polygons on the stack
POLYGON_CORNERS = wp.constant(16)  # of a polygon


@wp.struct
class Scratch:
    """Working memory of one triangle that is cut into polygons."""

    near: wp.array(dtype=int)  # [face_count], faces to cover with; those of the merge before those of the triangle
    used: wp.array(dtype=int)  # [SLOTS], faces that cover a polygon
    stack: wp.array2d(dtype=wp.vec3d)  # [STACK, POLYGON_CORNERS], polygons still to be covered
    stack_count: wp.array(dtype=int)  # [STACK], corners of each
    polygon: wp.array(dtype=wp.vec3d)  # [POLYGON_CORNERS], current polygon
    clipped: wp.array(dtype=wp.vec3d)  # [POLYGON_CORNERS], part of it that a cut keeps


@wp.func
def segment_distance_sq(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    return wp.length_sq(p - nearest_on_segment(a, b, p))


@wp.func
def triangle_distance_sq(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the squared distance of a point to a triangle, never less than the true one up to rounding.

    A triangle too thin for accurate barycentric coordinates is measured by its edges.
    """
    zero = wp.float64(0.0)
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= zero and d2 <= zero:
        return wp.length_sq(ap)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= zero and d4 <= d3:
        return wp.length_sq(bp)
    vc = d1 * d4 - d3 * d2
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= zero and d5 <= d6:
        return wp.length_sq(cp)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    total = va + vb + vc
    if va > zero and vb > zero and vc > zero and total > wp.float64(1.0e-12) * wp.dot(ab, ab) * wp.dot(ac, ac):
        v = vb / total
        w = vc / total
        return wp.length_sq(p - (a + ab * v + ac * w))
    return wp.min(segment_distance_sq(p, a, b), wp.min(segment_distance_sq(p, b, c), segment_distance_sq(p, c, a)))


@wp.func(inline=False)
def face_distance_sq(face_pos: wp.array2d(dtype=wp.vec3d), f: int, p: wp.vec3d):
    return triangle_distance_sq(p, face_pos[f, 0], face_pos[f, 1], face_pos[f, 2])


@wp.func
def interval_distance(p: wp.float64, lower: wp.float64, upper: wp.float64):
    below = lower - p
    above = p - upper
    most = wp.where(below > above, below, above)
    return wp.where(most > wp.float64(0.0), most, wp.float64(0.0))


@wp.func
def box_distance_sq(p: wp.vec3d, lower: wp.vec3d, upper: wp.vec3d):
    x = interval_distance(p[0], lower[0], upper[0])
    y = interval_distance(p[1], lower[1], upper[1])
    z = interval_distance(p[2], lower[2], upper[2])
    return x * x + y * y + z * z


@wp.func
def polygon_distance_sq(face_pos: wp.array2d(dtype=wp.vec3d), scratch: Scratch, count: int, f: int, enough: wp.float64):
    """Return the largest squared distance of the current polygon's corners to face f.

    The maximum over corners is that over the polygon, as the distance to one triangle is a convex function. Stops at
    the first value above `enough`.
    """
    worst = wp.float64(0.0)
    i = int(0)
    while i < count and worst <= enough:
        worst = wp.max(worst, face_distance_sq(face_pos, f, scratch.polygon[i]))
        i += 1
    return worst


@wp.func
def polygon_middle(scratch: Scratch, count: int):
    sum = wp.vec3d()
    for i in range(count):
        sum = sum + scratch.polygon[i]
    return sum / wp.float64(count)


@wp.func
def load_polygon(scratch: Scratch, row: int):
    for i in range(scratch.stack_count[row]):
        scratch.polygon[i] = scratch.stack[row, i]
    return scratch.stack_count[row]


@wp.func
def store_polygon(scratch: Scratch, row: int, count: int):
    for i in range(count):
        scratch.stack[row, i] = scratch.polygon[i]
    scratch.stack_count[row] = count


@wp.func(inline=False)
def cut_polygon(scratch: Scratch, count: int, row: int, normal: wp.vec3d, origin: wp.vec3d, margin: wp.float64):
    """Cut the current polygon by a plane: keep the side of the normal, write the rest to a row of the stack.

    Returns the number of corners kept, 0 if none. Corners within `margin` of the plane belong to both sides, which
    prevents slivers.
    """
    above = int(0)
    below = int(0)
    for i in range(count):
        height = wp.dot(normal, scratch.polygon[i] - origin)
        above += int(height > margin)
        below += int(height < -margin)
    if below == 0:
        scratch.stack_count[row] = 0
        return count
    if above == 0:
        store_polygon(scratch, row, count)
        return int(0)
    kept = int(0)
    rest = int(0)
    for i in range(count):
        p = scratch.polygon[i]
        q = scratch.polygon[(i + 1) % count]
        sp = wp.dot(normal, p - origin)
        sq = wp.dot(normal, q - origin)
        if sp >= -margin:
            scratch.clipped[kept] = p
            kept += 1
        else:
            scratch.stack[row, rest] = p
            rest += 1
        if (sp >= -margin) != (sq >= -margin):
            t = wp.min(wp.max(sp / (sp - sq), wp.float64(0.0)), wp.float64(1.0))
            x = p + (q - p) * t
            scratch.clipped[kept] = x
            kept += 1
            scratch.stack[row, rest] = x
            rest += 1
    scratch.stack_count[row] = rest
    for i in range(kept):
        scratch.polygon[i] = scratch.clipped[i]
    return kept


@wp.func
def halve_polygon(scratch: Scratch, count: int, top: int):
    """Cut the current polygon across its longest edge; push both parts, return the new top."""
    longest = wp.float64(-1.0)
    edge = int(0)
    for i in range(count):
        size = wp.length_sq(scratch.polygon[(i + 1) % count] - scratch.polygon[i])
        if size > longest:
            longest = size
            edge = i
    p = scratch.polygon[edge]
    q = scratch.polygon[(edge + 1) % count]
    kept = cut_polygon(scratch, count, top, wp.normalize(q - p), p + (q - p) * wp.float64(0.5), wp.float64(0.0))
    if scratch.stack_count[top] > 0:
        top += 1
    if kept > 0:
        store_polygon(scratch, top, kept)
        top += 1
    return top


@wp.func
def split_polygon(
    face_pos: wp.array2d(dtype=wp.vec3d), scratch: Scratch, count: int, top: int, f: int, margin: wp.float64
):
    """Cut the current polygon by the prism over face f, or in half if that leaves it whole; return the new top."""
    a = face_pos[f, 0]
    normal = wp.cross(face_pos[f, 1] - a, face_pos[f, 2] - a)
    bottom = top
    kept = count
    if wp.length_sq(normal) > wp.float64(0.0):
        normal = wp.normalize(normal)
        for k in range(3):
            if kept > 0:
                p = face_pos[f, k]
                side = wp.normalize(wp.cross(normal, face_pos[f, (k + 1) % 3] - p))
                kept = cut_polygon(scratch, kept, top, side, p, margin)
                if scratch.stack_count[top] > 0:
                    top += 1
    if kept > 0:
        store_polygon(scratch, top, kept)
        top += 1
    if top - bottom == 1:
        top = halve_polygon(scratch, load_polygon(scratch, bottom), bottom)
    return top
