"""Proof that two posed surfaces are farther apart than d: separating gaps of triangles, and their margins.

Triangles are farther apart than d iff some vector n leaves a gap over d: min n.b - max n.a > d |n|, over the corners
a of one and b of the other. ANY n proves it, however roughly it was found, so only the gap itself needs an error
bound; a face of zero area is no special case. The best n joins the closest points: it is a face's normal, or joins the
closest points of two edges.

Bound of the gap. With u = 2^-53, corners relative to a corner of A and scaled by a power of two have coordinates under
2 with an error of 2 u each, and n is scaled to |n_k| <= 1. So the errors of the corners add 6 u to a dot product, its
five roundings 18 u; two dot products and their difference (at most 12) stay under 60 u. The length errs by 3 u of
itself, d |n| by 2 u more. `GAP_ROUNDING` is 128 u. What underflows is under 2^-1000 and vanishes in it.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import measure_rotation, reach_box

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

GAP_ROUNDING = wp.constant(wp.float64(2.0**-46))
POSE_ROUNDING = wp.constant(wp.float64(2.0**-45))
DISTANCE_MAX = wp.constant(wp.float64(2.0**1000))
# The sum of the bits of two powers of two whose product is 1.
EXPONENTS_OF_ONE = wp.constant(wp.int64(2046 << 52))
EXPONENT_BITS = wp.constant(wp.int64(0x7FF0000000000000))

corners_type = wp.types.matrix(shape=(3, 3), dtype=wp.float64)


@wp.func
def power_below(x: wp.float64):
    """Return the power of two at or below a number above 0, the exponent without the digits; 0 of 0."""
    return wp.cast(wp.cast(x, wp.int64) & EXPONENT_BITS, wp.float64)


@wp.func
def inverse_power(x: wp.float64):
    """Return 1 / x, of a power of two from 2^-1022 to 2^1022, by its exponent."""
    return wp.cast(EXPONENTS_OF_ONE - wp.cast(x, wp.int64), wp.float64)


@wp.func
def largest_coordinate(x: wp.vec3d):
    """Return the largest coordinate in magnitude."""
    return wp.max(wp.max(wp.abs(x[0]), wp.abs(x[1])), wp.abs(x[2]))


@wp.func
def divide(a: wp.float64, b: wp.float64):
    """Return a / b, 0 where b is not positive."""
    return wp.where(b > wp.float64(0.0), a / wp.where(b > wp.float64(0.0), b, wp.float64(1.0)), wp.float64(0.0))


@wp.func
def clamp_unit(x: wp.float64):
    return wp.min(wp.max(x, wp.float64(0.0)), wp.float64(1.0))


@wp.struct
class Triangles:
    """Two triangles relative to a corner of A, by a power of two."""

    a1: wp.vec3d  # corners of A, the first at the origin
    a2: wp.vec3d  # the other one
    b0: wp.vec3d  # corners of B
    b1: wp.vec3d  # the second
    b2: wp.vec3d  # the third
    size: wp.float64  # the power of two


@wp.func
def scale_triangles(a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    t = Triangles()
    t.a1 = a1 - a0
    t.a2 = a2 - a0
    t.b0 = b0 - a0
    t.b1 = b1 - a0
    t.b2 = b2 - a0
    size = wp.max(
        wp.max(largest_coordinate(t.a1), largest_coordinate(t.a2)),
        wp.max(largest_coordinate(t.b0), wp.max(largest_coordinate(t.b1), largest_coordinate(t.b2))),
    )
    # 1 where all points are in one place.
    power = power_below(size)
    t.size = wp.where(power > wp.float64(0.0), power, wp.float64(1.0))
    scale = wp.float64(1.0) / t.size
    t.a1 = t.a1 * scale
    t.a2 = t.a2 * scale
    t.b0 = t.b0 * scale
    t.b1 = t.b1 * scale
    t.b2 = t.b2 * scale
    return t


@wp.func
def has_gap(n: wp.vec3d, a: corners_type, b: corners_type, d: wp.float64):
    """Return whether a gap over d between the corners a and b (rows) along n, to either side, is certain."""
    m = largest_coordinate(n)
    if not (m > wp.float64(0.0) and m < wp.float64(wp.inf)):
        return False
    n = n / m
    pa = a * n
    pb = b * n
    gap = wp.max(wp.min(pb) - wp.max(pa), wp.min(pa) - wp.max(pb))
    one = wp.float64(1.0)
    # Comparisons with what overflowed or is not a number come out False: not proved.
    return gap - GAP_ROUNDING > d * wp.sqrt(wp.dot(n, n)) * (one + GAP_ROUNDING)


@wp.func
def square_up(n: wp.vec3d, e: wp.vec3d, f: wp.vec3d):
    """Return n less its components along e and f: removes most of the rounding in a vector normal to both."""
    f = f - divide(wp.dot(e, f), wp.dot(e, e)) * e
    n = n - divide(wp.dot(n, e), wp.dot(e, e)) * e
    return n - divide(wp.dot(n, f), wp.dot(f, f)) * f


@wp.func
def join_edges(p: wp.vec3d, e: wp.vec3d, q: wp.vec3d, f: wp.vec3d):
    """Return the parameters of the closest points of segments p + s e and q + t f, and the vector between them.

    Source: Ericson 2005, Real-time collision detection, section 5.1.9.
    """
    r = p - q
    ee = wp.dot(e, e)
    ff = wp.dot(f, f)
    ef = wp.dot(e, f)
    er = wp.dot(e, r)
    fr = wp.dot(f, r)
    s = clamp_unit(divide(ef * fr - er * ff, ee * ff - ef * ef))
    t = divide(ef * s + fr, ff)
    if not (t >= wp.float64(0.0) and t <= wp.float64(1.0)):
        t = clamp_unit(t)
        s = clamp_unit(divide(ef * t - er, ee))
    elif ff == wp.float64(0.0):
        s = clamp_unit(divide(-er, ee))
    return s, t, (q - p) + t * f - s * e


@wp.func
def edges_have_gap(a: corners_type, b: corners_type, d: wp.float64):
    """Return whether the closest points of the 3 x 3 edges prove a gap over d."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    least = wp.float64(wp.inf)
    nearest = wp.vec3d()
    squared = wp.vec3d()
    k = wp.int32(0)
    while k < 9:
        i = k / 3
        j = k - 3 * i
        e = a[(i + 1) % 3] - a[i]
        f = b[(j + 1) % 3] - b[j]
        s, t, n = join_edges(a[i], e, b[j], f)
        length = wp.dot(n, n)
        if length < least:
            least = length
            nearest = n
            # Normal to an edge only where the closest point lies inside it.
            squared = square_up(
                n, wp.where(s > zero and s < one, one, zero) * e, wp.where(t > zero and t < one, one, zero) * f
            )
        k += 1
    return has_gap(squared, a, b, d) or has_gap(nearest, a, b, d)


@wp.func
def triangles_near(d: wp.float64, a0: wp.vec3d, a1: wp.vec3d, a2: wp.vec3d, b0: wp.vec3d, b1: wp.vec3d, b2: wp.vec3d):
    """Return 0 where two closed triangles are certainly farther apart than d >= 0, else 1."""
    t = scale_triangles(a0, a1, a2, b0, b1, b2)
    a = wp.matrix_from_rows(wp.vec3d(), t.a1, t.a2)
    b = wp.matrix_from_rows(t.b0, t.b1, t.b2)
    far = d * (wp.float64(1.0) / t.size)
    normal_a = square_up(wp.cross(a[1], a[2]), a[1], a[2])
    normal_b = square_up(wp.cross(b[1] - b[0], b[2] - b[0]), b[1] - b[0], b[2] - b[0])
    if has_gap(normal_a, a, b, far) or has_gap(normal_b, a, b, far) or edges_have_gap(a, b, far):
        return 0
    return 1


@wp.func
def pad_distance(trees: Trees, a: wp.int32, b: wp.int32, d: wp.float64):
    """Return the distance in A's frame, between A's vertices and B's x', beyond which two surfaces are over d apart.

    Over d in the world, and after any displacement of A's and B's points by e_a and e_b [model units], e_a + e_b = d.
    With reaches A and B of the vertices, T of the translation, and skews s_a and s_b of the rotations,
    |a - Ra^T (Rb b + tb - ta)| <= (1 + 1.5 s_a) |p - q| + 3 sqrt(3) s_a A for world points p and q, and Rb
    lengthens by at most 1 + 1.5 s_b. x' errs by at most 24 u (B + T), two such errors count, a matrix made of a
    quaternion by 24 u, which moves p and q by 42 u (A + B), and the skew's own rounding of 4 u counts 21 u A: under
    192 u (A + B + T) in all. `POSE_ROUNDING` is 256 u.
    """
    state_a = trees.objects.state[a]
    state_b = trees.objects.state[b]
    root_a = load_node(trees.states, trees.states.node_start[state_a] + 1)
    root_b = load_node(trees.states, trees.states.node_start[state_b] + 1)
    reach_a = reach_box(root_a.lower, root_a.upper)
    reach_b = reach_box(root_b.lower, root_b.upper)
    reach_a = reach_a + largest_coordinate(trees.models.centre[trees.states.model[state_a]])
    reach_b = reach_b + largest_coordinate(trees.models.centre[trees.states.model[state_b]])
    shift = largest_coordinate(trees.objects.position[b] - trees.objects.position[a])
    skew_a, _ = measure_rotation(trees.objects.rotation[a])
    skew_b, _ = measure_rotation(trees.objects.rotation[b])
    two = wp.float64(2.0)
    padded = d * (wp.float64(1.0) + two * (skew_a + skew_b) + POSE_ROUNDING)
    return padded + wp.float64(6.0) * skew_a * reach_a + POSE_ROUNDING * (reach_a + reach_b + shift)
