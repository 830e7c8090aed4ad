"""The segment, point or farthest points that two intersecting faces share.

The ends of an intersection are chosen by exact signs and placed by determinants of small relative error, so they are
right for slivers and nearly coplanar faces as well: an end errs by at most 2^-40 of the length of the edge that it lies
on, and the rounding of its coordinates. Nothing here depends on the order in which threads run.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.lanes import lowest_bit
from warp_abtree.kernels.exact.expansion import expand_area, expand_volume
from warp_abtree.kernels.exact.predicates import BOUND_2D, BOUND_3D, EXACT, drop_axis, orient2d, orient3d, plain_sign
from warp_abtree.kernels.triangle.coplanar import find_ends, widest_axis
from warp_abtree.kernels.triangle.signs import find_alone, is_one_sided, pack_signs

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Determinants whose relative error may exceed this are summed as expansions.
RELATIVE_ERROR = wp.constant(wp.float64(2.0**-42))
# Extreme points that an overlap may have: corners of either triangle in the other, then edges across one another.
POINT_ROOM = wp.constant(15)
NEAREST_STEPS = wp.constant(32)

ratios = wp.types.vector(length=9, dtype=wp.float64)  # where each edge of A crosses each of B, along that of A


@native.func_native()
def round_volume(u: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.vec2d:
    """Return det(u, v, w) of three differences as float64 has it, and the sum of magnitudes."""


@wp.func
def signed_volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Return det(a - d, b - d, c - d) with the sign of `orient3d` and a relative error of at most RELATIVE_ERROR."""
    value = round_volume(a - d, b - d, c - d)
    if BOUND_3D * value[1] > RELATIVE_ERROR * wp.abs(value[0]):
        return expand_volume(a, b, c, d)
    return value[0]


@native.func_native()
def round_area(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d) -> wp.vec2d:
    """Return det(a - c, b - c) as float64 has it, and the sum of magnitudes."""


@wp.func
def signed_area(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return det(a - c, b - c) with the sign of `orient2d` and a relative error of at most RELATIVE_ERROR."""
    value = round_area(a, b, c)
    if BOUND_2D * value[1] > RELATIVE_ERROR * wp.abs(value[0]):
        return expand_area(a, b, c)
    return value[0]


@native.func_native()
def divide_vector(v: wp.vec3d, s: wp.float64) -> wp.vec3d:
    """Return v / s, each number rounded once."""


@native.func_native()
def measure_length(v: wp.vec3d) -> wp.float64:
    """Return the length of a vector whose squares may underflow or overflow."""


@native.func_native()
def unit_vector(v: wp.vec3d) -> wp.vec3d:
    """Return a vector at length 1, or the zero vector as it is."""


@wp.func
def face_normal(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the unit normal by winding, to rounding for slivers too; zero iff the corners are collinear."""
    n = wp.vec3d()
    i = wp.int32(0)
    while i < 3:
        n[i] = signed_area(drop_axis(a, i), drop_axis(b, i), drop_axis(c, i))
        i += 1
    return unit_vector(n)


@native.func_native()
def cross_edge(p: wp.vec3d, q: wp.vec3d, value_p: wp.float64, value_q: wp.float64) -> wp.vec3d:
    """Return the point of edge pq where a linear function of these values, of opposite signs or one 0, vanishes."""


@wp.func
def cross_planes(corner: wp.array(dtype=wp.vec3d), volume: wp.array(dtype=wp.float64)):
    """Return the number of points (0: apart) and the ends of the segment that two triangles in two planes share.

    Corners 0..2 are A's, 3..5 B's, volume those of a corner and the other triangle. On the line that the planes share
    A is the interval from X(q) to X(r) and B that from Y(r) to Y(q), X(e) on the edge from A's lone corner to e.
    It runs along normal_a x normal_b. Source: as `intersect_triangles`.
    """
    none = wp.vec3d()
    sa = wp.vec3i(plain_sign(volume[0]), plain_sign(volume[1]), plain_sign(volume[2]))
    sb = wp.vec3i(plain_sign(volume[3]), plain_sign(volume[4]), plain_sign(volume[5]))
    if is_one_sided(sa[0], sa[1], sa[2]) or is_one_sided(sb[0], sb[1], sb[2]):
        return 0, none, none
    ap, back_a = find_alone(pack_signs(sa[0], sa[1], sa[2]))
    bp, back_b = find_alone(pack_signs(sb[0], sb[1], sb[2]))
    aq = wp.where(back_b, (ap + 2) % 3, (ap + 1) % 3)
    ar = wp.where(back_b, (ap + 1) % 3, (ap + 2) % 3)
    bq = 3 + wp.where(back_a, (bp + 2) % 3, (bp + 1) % 3)
    br = 3 + wp.where(back_a, (bp + 1) % 3, (bp + 2) % 3)
    bp = 3 + bp
    # Signs that order X(q) and X(r) (bit 0) against Y(q) and Y(r) (bit 1): 1 where X comes after Y.
    order = wp.vec4i()
    k = wp.int32(0)
    while k < 4:
        ae = wp.where((k & 1) != 0, ar, aq)
        be = wp.where((k & 2) != 0, br, bq)
        order[k] = orient3d(EXACT, corner[ap], corner[ae], corner[bp], corner[be])
        k += 1
    if order[0] > 0 or order[3] < 0:
        return 0, none, none
    start = cross_edge(corner[bp], corner[br], volume[bp], volume[br])
    if order[2] > 0:
        start = cross_edge(corner[ap], corner[aq], volume[ap], volume[aq])
    end = cross_edge(corner[ap], corner[ar], volume[ap], volume[ar])
    if order[1] > 0:
        end = cross_edge(corner[bp], corner[bq], volume[bp], volume[bq])
    if back_a != back_b:
        return 2, end, start
    return 2, start, end


@wp.func
def holds_point(axis: wp.int32, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d):
    """Return whether a closed triangle, segment or point holds a point of its plane or line."""
    for i in range(3):
        if p[i] < wp.min(wp.min(a[i], b[i]), c[i]) or p[i] > wp.max(wp.max(a[i], b[i]), c[i]):
            return False
    a2 = drop_axis(a, axis)
    b2 = drop_axis(b, axis)
    c2 = drop_axis(c, axis)
    p2 = drop_axis(p, axis)
    ab = orient2d(EXACT, a2, b2, p2)
    bc = orient2d(EXACT, b2, c2, p2)
    ca = orient2d(EXACT, c2, a2, p2)
    # Off the line of a segment the signs differ, since the way there and back adds up to nothing.
    return (ab >= 0 and bc >= 0 and ca >= 0) or (ab <= 0 and bc <= 0 and ca <= 0)


@wp.func
def overlap_point(k: wp.int32, ratio: ratios, corner: wp.array(dtype=wp.vec3d)):
    """Return an extreme point of an overlap, by its place among those that there may be; any beyond the last."""
    if k < 6:
        return corner[k]
    i = (k - 6) // 3 % 3
    return corner[i] + (corner[(i + 1) % 3] - corner[i]) * ratio[wp.min(k - 6, 8)]


@wp.func(inline=False)
def overlap_ends(axis: wp.int32, corner: wp.array(dtype=wp.vec3d)):
    """Return the number of points and the two that are farthest apart of the overlap of two sets in one plane.

    Extreme points of the overlap are corners of one set in the other, and proper crossings of two edges.
    """
    ratio = ratios()
    found = wp.int32(0)  # a bit each
    k = wp.int32(0)
    while k < 6:
        other = wp.where(k < 3, 3, 0)
        if holds_point(axis, corner[other], corner[other + 1], corner[other + 2], corner[k]):
            found |= 1 << k
        k += 1
    k = wp.int32(0)
    while k < 9:
        a = corner[k // 3]
        b = corner[(k // 3 + 1) % 3]
        a2 = drop_axis(a, axis)
        b2 = drop_axis(b, axis)
        p2 = drop_axis(corner[3 + k % 3], axis)
        q2 = drop_axis(corner[3 + (k % 3 + 1) % 3], axis)
        if orient2d(EXACT, a2, b2, p2) * orient2d(EXACT, a2, b2, q2) < 0:
            value_a = signed_area(p2, q2, a2)
            value_b = signed_area(p2, q2, b2)
            if plain_sign(value_a) * plain_sign(value_b) < 0:
                ratio[k] = value_a / (value_a - value_b)
                found |= 1 << (6 + k)
        k += 1
    count = wp.bit_count(found)
    low = overlap_point(lowest_bit(found | (1 << POINT_ROOM)), ratio, corner)
    high = low
    most = wp.float64(0.0)
    k = wp.int32(0)
    while k < POINT_ROOM * POINT_ROOM:
        i = k // POINT_ROOM
        j = k % POINT_ROOM
        if (found >> i) & (found >> j) & 1 != 0:
            start = overlap_point(i, ratio, corner)
            end = overlap_point(j, ratio, corner)
            length = measure_length(end - start)
            if length > most:
                most = length
                low = start
                high = end
        k += 1
    return count, low, high


@wp.func(inline=False)
def pierce_triangle(axis: wp.int32, low: wp.vec3d, high: wp.vec3d, base: wp.int32, corner: wp.array(dtype=wp.vec3d)):
    """Return the number of points and the ends of the overlap of a segment (or point) and the triangle at base."""
    value_low = signed_volume(corner[base], corner[base + 1], corner[base + 2], low)
    value_high = signed_volume(corner[base], corner[base + 1], corner[base + 2], high)
    if value_low == wp.float64(0.0) and value_high == wp.float64(0.0):
        count, p0, p1 = overlap_ends(axis, corner)
        return count, p0, p1
    if plain_sign(value_low) == plain_sign(value_high):
        return 0, low, high
    least = wp.int32(1)
    most = wp.int32(-1)
    k = wp.int32(0)
    while k < 3:
        side = orient3d(EXACT, low, high, corner[base + k], corner[base + (k + 1) % 3])
        least = wp.min(least, side)
        most = wp.max(most, side)
        k += 1
    point = cross_edge(low, high, value_low, value_high)
    return wp.where(least * most < 0, 0, 1), point, point


@wp.func
def overlap_special(corner: wp.array(dtype=wp.vec3d)):
    """Return number of points and ends where a plane is shared or missing, and whether the faces are coplanar."""
    axis_a = widest_axis(EXACT, corner[0], corner[1], corner[2])
    axis_b = widest_axis(EXACT, corner[3], corner[4], corner[5])
    a_low, a_high = find_ends(corner[0], corner[1], corner[2])
    b_low, b_high = find_ends(corner[3], corner[4], corner[5])
    if axis_a < 0 and axis_b >= 0:
        count, p0, p1 = pierce_triangle(axis_b, a_low, a_high, 3, corner)
        return count, p0, p1, 0
    if axis_a >= 0 and axis_b < 0:
        count, p0, p1 = pierce_triangle(axis_a, b_low, b_high, 0, corner)
        return count, p0, p1, 0
    axis = axis_a
    if axis_a < 0:
        axis = widest_axis(EXACT, a_low, a_high, b_low)
        if axis < 0:
            # On one line any projection will do.
            axis = wp.max(widest_axis(EXACT, a_low, a_high, b_high), 0)
    count, p0, p1 = overlap_ends(axis, corner)
    return count, p0, p1, wp.where(axis_a < 0, 0, 1)


@wp.func
def nearest_on_segment(a: wp.vec3d, b: wp.vec3d, p: wp.vec3d):
    d = b - a
    square = wp.dot(d, d)
    if square == wp.float64(0.0):
        return a
    return a + d * wp.clamp(wp.dot(p - a, d) / square, wp.float64(0.0), wp.float64(1.0))


@wp.func
def nearest_on_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d):
    """Return the point of a closed triangle, segment or point nearest to p."""
    zero = wp.float64(0.0)
    n = wp.cross(b - a, c - a)
    best = nearest_on_segment(a, b, p)
    for k in range(2):
        q = nearest_on_segment(wp.where(k == 0, b, c), wp.where(k == 0, c, a), p)
        if wp.dot(q - p, q - p) < wp.dot(best - p, best - p):
            best = q
    outside = wp.dot(wp.cross(b - a, p - a), n) <= zero or wp.dot(wp.cross(c - b, p - b), n) <= zero
    outside = outside or wp.dot(wp.cross(a - c, p - c), n) <= zero
    if not outside and wp.dot(n, n) > zero:
        best = p - n * (wp.dot(p - a, n) / wp.dot(n, n))
    return best


@wp.func(inline=False)
def nearest_middle(scale: wp.float64, corner: wp.array(dtype=wp.vec3d)):
    """Return a point between two triangles that are nearly nearest to each other there, by alternating projection."""
    q = (corner[3] * scale + corner[4] * scale + corner[5] * scale) / wp.float64(3.0)
    p = q
    k = wp.int32(0)
    while k < NEAREST_STEPS:
        p = nearest_on_triangle(corner[0] * scale, corner[1] * scale, corner[2] * scale, q)
        q = nearest_on_triangle(corner[3] * scale, corner[4] * scale, corner[5] * scale, p)
        k += 1
    return (p + q) * (wp.float64(0.5) / scale)


@wp.func
def intersect_faces(scale: wp.float64, corner: wp.array(dtype=wp.vec3d)):
    """Return the ends of the intersection of two faces, and 1 where they are coplanar.

    Faces that exact signs deny to meet, as a coarser precision can report them, give a point between them twice.
    """
    volume = wp.zeros(shape=(6,), dtype=wp.float64)
    zeros_a = wp.int32(0)
    zeros_b = wp.int32(0)
    k = wp.int32(0)
    while k < 6:
        other = wp.where(k < 3, 3, 0)
        volume[k] = signed_volume(corner[other], corner[other + 1], corner[other + 2], corner[k])
        if volume[k] == wp.float64(0.0):
            zeros_a += wp.where(k < 3, 1, 0)
            zeros_b += wp.where(k < 3, 0, 1)
        k += 1
    count = wp.int32(0)
    coplanar = wp.int32(0)
    p0 = wp.vec3d()
    p1 = wp.vec3d()
    if zeros_a == 3 or zeros_b == 3:
        count, p0, p1, coplanar = overlap_special(corner)
    else:
        count, p0, p1 = cross_planes(corner, volume)
    if count == 0:
        p0 = nearest_middle(scale, corner)
        p1 = p0
    return p0, p1, coplanar


@native.func_native()
def find_normal(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, normal: wp.ref[wp.vec3d]) -> bool:
    """Find `face_normal` without expansions; return whether it is certain."""


@native.func_native()
def find_segment(proven: bool, a: wp.mat33d, b: wp.mat33d, start: wp.ref[wp.vec3d], end: wp.ref[wp.vec3d]) -> bool:
    """Find the ends of `cross_planes` without expansions or arrays; return whether they are certain.

    Args:
        proven: Whether the triangles are known to intersect.
    """
