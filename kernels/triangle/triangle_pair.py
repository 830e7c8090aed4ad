"""The least distance of two triangles that do not cross, where it is attained, and its error.

It is attained between two edges, or between a corner and a face above whose inside the corner lies. Each candidate is
a point of either triangle, so none is too short but for rounding; the steps below are about the least being too long.
Corners are taken relative to a corner of A and scaled by a power of two: no coordinate is over 2. u = 2^-53, and L is
the largest coordinate, in magnitude, of the differences of corners from that corner of A, so that no vector in here is
longer than 4 L.

1. The scaled corners are differences of float64 numbers, rounded once: points move by at most sqrt(3) u L.
2. A weighted sum of corners and the difference of two such points carry at most 8 roundings of numbers of at most 4 L:
   14 sqrt(3) u L, and the length 3 u of itself. So with 1. no candidate is shorter than the distance by over 40 u L.
3. A corner over a face. The normal n = e1 x e2 is computed from products whose rounding errors are added back
   (`cross_exactly`), each component within 2 u of itself (Jeannerod, Louvet and Muller 2013, theorem 5.1), so its
   direction errs by 4 u however thin the face is. Height and foot are taken along n: the foot moves by at most 24 u L.
   Its two weights come from cross products of the same vector with e1 and e2, again within 2 u of themselves, so that
   what the weights err by in common, large where the face is thin, moves the foot no farther than the vector's own
   rounding does; what they err by apart is 18 u of themselves, 72 u L of the foot, as the rest is of the order of
   u^2 L / s, s the sine between e1 and e2: under u L, or the face is thinner than u L and an edge is as close. Where
   rounding takes a foot out of the face, it was within 96 u L of an edge. So the candidate, or that of an edge, is
   longer than sqrt(h^2 + (96 u L)^2) by rounding alone, h the distance.
4. Two edges, e and f at an angle of sine s, r from one start to the other. The first parameter is det(r, f, n) / n^2,
   n = e x f, and errs by d of at most 16 u |r| / (s |e|) + 16 u / s, or 1 if that is more. The second is the best for
   the first, then the first the best for the second. Squared distances, each parameter the best for the other, are a
   parabola of curvature |e|^2 s^2: too long by at most (|e| s d)^2, under (128 u L)^2, whatever s is.
5. So what is returned differs from the distance of the triangles by under 256 u L: `PAIR_ROUNDING` of L
   (docs/exactness.md, bound 14).

`tests/distance/test_triangle_pair.py` holds it to fractions.
"""

import warp as wp

from warp_abtree.kernels.exact.expansion import fuse_multiply
from warp_abtree.kernels.triangle.distance import Triangles, clamp_unit, divide

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

PAIR_ROUNDING = wp.constant(wp.float64(2.0**-45))

# Candidates: 3 i + j for edges i of A and j of B, then corners of B over A, then corners of A over B.
CORNERS_OF_B, CORNERS_OF_A = wp.constant(9), wp.constant(12)


@wp.struct
class Features:
    """Features of two triangles that are nearest: edges, or a corner and a face."""

    square: wp.float64  # their distance, squared, in the scale of the pair
    kind: wp.int32  # candidate
    x: wp.float64  # parameters of both edges, or weights of the face's second and third corner
    y: wp.float64  # the other one


@wp.func
def minor_exactly(a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64):
    """Return a b - c d within 2 u of itself. Source: Kahan's algorithm."""
    w = c * d
    return fuse_multiply(a, b, -w) - fuse_multiply(c, d, -w)


@wp.func
def cross_exactly(u: wp.vec3d, v: wp.vec3d):
    """Return the cross product, each component within 2 u of itself."""
    return wp.vec3d(
        minor_exactly(u[1], v[2], u[2], v[1]),
        minor_exactly(u[2], v[0], u[0], v[2]),
        minor_exactly(u[0], v[1], u[1], v[0]),
    )


@wp.func
def offer(best: Features, kind: wp.int32, square: wp.float64, x: wp.float64, y: wp.float64):
    """Return the nearer of two candidates; the first of equal ones."""
    closer = square < best.square
    found = Features()
    found.square = wp.where(closer, square, best.square)
    found.kind = wp.where(closer, kind, best.kind)
    found.x = wp.where(closer, x, best.x)
    found.y = wp.where(closer, y, best.y)
    return found


@wp.func
def offer_edges(best: Features, kind: wp.int32, p: wp.vec3d, e: wp.vec3d, q: wp.vec3d, f: wp.vec3d):
    """Offer the closest points of segments p + s e and q + t f."""
    r = q - p
    n = wp.cross(e, f)
    s = clamp_unit(divide(wp.dot(wp.cross(r, f), n), wp.dot(n, n)))
    t = clamp_unit(divide(wp.dot(s * e - r, f), wp.dot(f, f)))
    s = clamp_unit(divide(wp.dot(t * f + r, e), wp.dot(e, e)))
    v = (r + t * f) - s * e
    return offer(best, kind, wp.dot(v, v), s, t)


@wp.func
def offer_corner(best: Features, kind: wp.int32, w: wp.vec3d, e1: wp.vec3d, e2: wp.vec3d, n: wp.vec3d):
    """Offer the point of a face under a corner w relative to the face's first one, if there is one."""
    zero = wp.float64(0.0)
    nn = wp.dot(n, n)
    level = w - divide(wp.dot(w, n), nn) * n
    x = divide(wp.dot(cross_exactly(level, e2), n), nn)
    y = divide(wp.dot(cross_exactly(e1, level), n), nn)
    v = (w - x * e1) - y * e2
    inside = nn > zero and x >= zero and y >= zero and x + y <= wp.float64(1.0)
    return offer(best, kind, wp.where(inside, wp.dot(v, v), wp.float64(wp.inf)), x, y)


@wp.func
def nearest_features(t: Triangles):
    """Return the nearest points of two triangles that do not cross."""
    best = Features()
    best.square = wp.float64(wp.inf)
    # Without loops, in which corners would have to take turns: half the time on a CPU.
    zero = wp.vec3d()
    e0, e1, e2 = t.a1, t.a2 - t.a1, -t.a2
    f0, f1, f2 = t.b1 - t.b0, t.b2 - t.b1, t.b0 - t.b2
    best = offer_edges(best, 0, zero, e0, t.b0, f0)
    best = offer_edges(best, 1, zero, e0, t.b1, f1)
    best = offer_edges(best, 2, zero, e0, t.b2, f2)
    best = offer_edges(best, 3, t.a1, e1, t.b0, f0)
    best = offer_edges(best, 4, t.a1, e1, t.b1, f1)
    best = offer_edges(best, 5, t.a1, e1, t.b2, f2)
    best = offer_edges(best, 6, t.a2, e2, t.b0, f0)
    best = offer_edges(best, 7, t.a2, e2, t.b1, f1)
    best = offer_edges(best, 8, t.a2, e2, t.b2, f2)
    normal_a, normal_b = cross_exactly(t.a1, t.a2), cross_exactly(f0, -f2)
    best = offer_corner(best, CORNERS_OF_B, t.b0, t.a1, t.a2, normal_a)
    best = offer_corner(best, CORNERS_OF_A, -t.b0, f0, -f2, normal_b)
    best = offer_corner(best, CORNERS_OF_B + 1, t.b1, t.a1, t.a2, normal_a)
    best = offer_corner(best, CORNERS_OF_A + 1, t.a1 - t.b0, f0, -f2, normal_b)
    best = offer_corner(best, CORNERS_OF_B + 2, t.b2, t.a1, t.a2, normal_a)
    best = offer_corner(best, CORNERS_OF_A + 2, t.a2 - t.b0, f0, -f2, normal_b)
    return best


@wp.func
def triangle_distance(t: Triangles):
    """Return the least distance of two triangles that do not cross."""
    return wp.sqrt(nearest_features(t).square) * t.size


@wp.func
def edge_weights(i: wp.int32, s: wp.float64):
    """Return the weights of a triangle's corners at a parameter of its edge i."""
    rest = wp.float64(1.0) - s
    zero = wp.float64(0.0)
    return wp.vec3d(
        wp.where(i == 0, rest, wp.where(i == 2, s, zero)),
        wp.where(i == 1, rest, wp.where(i == 0, s, zero)),
        wp.where(i == 2, rest, wp.where(i == 1, s, zero)),
    )


@wp.func
def feature_weights(near: Features):
    """Return the weights of the corners of A and of B at the nearest points."""
    one = wp.float64(1.0)
    inside = wp.vec3d((one - near.x) - near.y, near.x, near.y)
    if near.kind < CORNERS_OF_B:
        return edge_weights(near.kind / 3, near.x), edge_weights(near.kind % 3, near.y)
    if near.kind < CORNERS_OF_A:
        return inside, edge_weights(near.kind - CORNERS_OF_B, wp.float64(0.0))
    return edge_weights(near.kind - CORNERS_OF_A, wp.float64(0.0)), inside


@wp.func
def between_features(t: Triangles, near: Features):
    """Return the vector from the nearest point of A to that of B, scaled."""
    a, b = feature_weights(near)
    return (b[0] * t.b0 + b[1] * t.b1 + b[2] * t.b2) - (a[1] * t.a1 + a[2] * t.a2)
