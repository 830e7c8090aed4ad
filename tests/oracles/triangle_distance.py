"""The distance of two triangles in integers, or minus the shortest motion that parts them: the end alone is rounded.

The depth is that of the origin in the hull of all differences of corners, found from the planes of all triples of them
that have no difference on one side: apart from the kernels also in that no edge or normal of a face is used.
"""

import itertools
import math

import numpy as np

from oracles.triangle import box_pairs, cross, dot, integer_points, lowest_exponent, triangles_intersect
from oracles.triangle import sub as minus


def crossing_depth(a, b):
    """Return the shortest motion that parts two triangles which intersect, to the rounding of a division and a root."""
    (a, b), exponent = integer_points(a, b), lowest_exponent(a, b)
    differences = [minus(p, q) for p, q in itertools.product(a, b)]
    least = None
    for x, y, z in itertools.combinations(differences, 3):
        n = cross(minus(y, x), minus(z, x))
        if not any(n):
            continue
        sides = [dot(n, minus(p, x)) for p in differences]
        if min(sides) >= 0 or max(sides) <= 0:
            square = dot(n, x) ** 2 / dot(n, n)
            least = square if least is None else min(least, square)
    return math.ldexp(math.sqrt(least or 0), exponent)


def separation(a, b):
    """Return the separation of triangles float64 (3, 3) each, and whether they intersect, which is exact."""
    if triangles_intersect(a, b):
        return -crossing_depth(a, b), True
    return triangle_distance(a, b), False


def near_faces(a, b, gap):
    """Return (face of A, face of B), separations and which intersect, of faces (n, 3, 3) within a gap or a bit more."""
    wide = 1.01 * gap + 1e-9
    pairs = box_pairs(np.concatenate([a, a.min(1, keepdims=True) - wide, a.max(1, keepdims=True) + wide], 1), b)
    found = [separation(a[i], b[j]) for i, j in pairs]
    rows = [(pair, s, met) for pair, (s, met) in zip(pairs, found) if met or s <= wide]
    order = sorted(rows, key=lambda row: tuple(row[0]))
    return (
        np.array([row[0] for row in order], np.int64).reshape(-1, 2),
        np.array([row[1] for row in order]),
        np.array([row[2] for row in order], bool),
    )


def over_edges(w, e):
    """Return the squared distance of a point at w from a line along e that starts at 0, None outside the edge."""
    ee, we = dot(e, e), dot(w, e)
    return (dot(w, w) * ee - we * we) / ee if 0 < we < ee else None


def between_edges(r, e, f):
    """Return the squared distance of two lines where their common normal meets both edges; r joins their starts."""
    n = cross(e, f)
    nn = dot(n, n)
    if nn == 0:
        return None
    s, t = dot(cross(r, f), n), dot(cross(r, e), n)
    return dot(r, n) ** 2 / nn if 0 <= s <= nn and 0 <= t <= nn else None


def over_face(p, a, b, c):
    """Return the squared distance of a point from a plane, None where its foot lies outside the face."""
    n = cross(minus(b, a), minus(c, a))
    nn = dot(n, n)
    sides = [dot(cross(minus(v, u), minus(p, u)), n) for u, v in ((a, b), (b, c), (c, a))]
    return dot(minus(p, a), n) ** 2 / nn if nn and min(sides) >= 0 else None


def triangle_distance(a, b):
    """Return the distance of triangles float64 (3, 3) each, to the rounding of one division and one root."""
    (a, b), exponent = integer_points(a, b), lowest_exponent(a, b)
    found = []
    for i, j in itertools.product(range(3), repeat=2):
        r = minus(b[j], a[i])
        e, f = minus(a[(i + 1) % 3], a[i]), minus(b[(j + 1) % 3], b[j])
        found += [dot(r, r), between_edges(r, e, f), over_edges(r, e), over_edges(minus(a[i], b[j]), f)]
    found += [over_face(p, *b) for p in a] + [over_face(p, *a) for p in b]
    return math.ldexp(math.sqrt(min(x for x in found if x is not None)), exponent)
