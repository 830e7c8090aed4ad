"""Closest points on a triangle, and convex pieces of a triangle cut by planes.

A piece is a convex polygon. One is in hand (`scratch.piece`, the caller counts its corners), others wait on a stack.
Source: Ericson, Real-Time Collision Detection, section 5.1.5 (closest point).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

STACK = wp.constant(64)  # pieces that wait
CORNERS = wp.constant(16)  # of a piece


@wp.struct
class Scratch:
    """Room for one cover."""

    near: wp.array(dtype=int)  # [face_count], candidates; those of the merge before those of the triangle
    used: wp.array(dtype=int)  # [SLOTS], faces that pieces stand on
    waiting: wp.array2d(dtype=wp.vec3d)  # [STACK, CORNERS], pieces
    waiting_count: wp.array(dtype=int)  # [STACK], corners of each
    piece: wp.array(dtype=wp.vec3d)  # [CORNERS], the piece in hand
    inner: wp.array(dtype=wp.vec3d)  # [CORNERS]


@wp.func
def segment_distance_sq(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    ab = b - a
    size = wp.dot(ab, ab)
    t = wp.float64(0.0)
    if size > wp.float64(0.0):
        t = wp.min(wp.max(wp.dot(p - a, ab) / size, wp.float64(0.0)), wp.float64(1.0))
    return wp.length_sq(p - (a + ab * t))


@wp.func
def face_distance_sq(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the squared distance to a point of the triangle: the closest, and never less than that.

    A triangle so thin that its barycentrics are noise is measured by its edges.
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


@wp.func
def load_piece(scratch: Scratch, row: int):
    for i in range(scratch.waiting_count[row]):
        scratch.piece[i] = scratch.waiting[row, i]
    return scratch.waiting_count[row]


@wp.func
def store_piece(scratch: Scratch, row: int, count: int):
    for i in range(count):
        scratch.waiting[row, i] = scratch.piece[i]
    scratch.waiting_count[row] = count


@wp.func
def cut_piece(scratch: Scratch, count: int, row: int, normal: wp.vec3d, origin: wp.vec3d, margin: wp.float64):
    """Cut the piece in hand by a plane; keep what lies along the normal, put the rest into a row of the stack.

    Returns the corners kept, 0 if none. Corners within `margin` count for either side, lest slivers come off.
    """
    above = int(0)
    below = int(0)
    for i in range(count):
        height = wp.dot(normal, scratch.piece[i] - origin)
        above += int(height > margin)
        below += int(height < -margin)
    if below == 0:
        scratch.waiting_count[row] = 0
        return count
    if above == 0:
        store_piece(scratch, row, count)
        return int(0)
    kept = int(0)
    rest = int(0)
    for i in range(count):
        p = scratch.piece[i]
        q = scratch.piece[(i + 1) % count]
        sp = wp.dot(normal, p - origin)
        sq = wp.dot(normal, q - origin)
        if sp >= -margin:
            scratch.inner[kept] = p
            kept += 1
        else:
            scratch.waiting[row, rest] = p
            rest += 1
        if (sp >= -margin) != (sq >= -margin):
            t = wp.min(wp.max(sp / (sp - sq), wp.float64(0.0)), wp.float64(1.0))
            x = p + (q - p) * t
            scratch.inner[kept] = x
            kept += 1
            scratch.waiting[row, rest] = x
            rest += 1
    scratch.waiting_count[row] = rest
    for i in range(kept):
        scratch.piece[i] = scratch.inner[i]
    return kept


@wp.func
def halve_piece(scratch: Scratch, count: int, top: int):
    """Cut the piece in hand across its longest edge; stack both parts, return the new top."""
    longest = wp.float64(-1.0)
    edge = int(0)
    for i in range(count):
        size = wp.length_sq(scratch.piece[(i + 1) % count] - scratch.piece[i])
        if size > longest:
            longest = size
            edge = i
    p = scratch.piece[edge]
    q = scratch.piece[(edge + 1) % count]
    kept = cut_piece(scratch, count, top, wp.normalize(q - p), p + (q - p) * wp.float64(0.5), wp.float64(0.0))
    if scratch.waiting_count[top] > 0:
        top += 1
    if kept > 0:
        store_piece(scratch, top, kept)
        top += 1
    return top


@wp.func
def split_piece(
    face_pos: wp.array2d(dtype=wp.vec3d), scratch: Scratch, count: int, top: int, f: int, margin: wp.float64
):
    """Cut the piece in hand by the prism over face f, or across if that leaves it whole; return the new top."""
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
                kept = cut_piece(scratch, kept, top, side, p, margin)
                if scratch.waiting_count[top] > 0:
                    top += 1
    if kept > 0:
        store_piece(scratch, top, kept)
        top += 1
    if top - bottom == 1:
        top = halve_piece(scratch, load_piece(scratch, bottom), bottom)
    return top
