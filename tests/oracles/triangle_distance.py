"""The least distance of two triangles that do not cross, in integers: nothing is rounded but the end.

Apart from the kernels also in how: corners, feet of corners on edges and on faces, and common normals of edges, each
by itself and only where it lies inside.
"""

import itertools
import math

from oracles.triangle import cross, dot, integer_points, lowest_exponent
from oracles.triangle import sub as minus


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
