"""The separation of two triangles in integers: their distance, or minus the shortest motion that parts them.

The depth is that of the origin in the hull of all differences of corners, found from the planes of all triples of them
that have no difference on one side: apart from the kernels also in that no edge or normal of a face is used.
"""

import itertools
import math

import numpy as np

from oracles.triangle import box_pairs, cross, dot, integer_points, lowest_exponent, triangles_intersect
from oracles.triangle import sub as minus
from oracles.triangle_distance import triangle_distance


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
