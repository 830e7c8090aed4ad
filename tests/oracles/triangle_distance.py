"""The least distance of two triangles that do not cross, in integers: nothing is rounded but the end.

Apart from the kernels also in how: corners, feet of corners on edges and on faces, and common normals of edges, each
by itself and only where it lies inside.
"""

import itertools
import math

import numpy as np


def to_integers(corners):
    """Return float64 numbers as integers on a common exponent, and the exponent."""
    fraction, exponent = np.frexp(corners)
    used = corners != 0
    least = int(exponent[used].min()) - 53 if used.any() else 0
    mantissa = np.ldexp(fraction, 53).astype(np.int64)
    flat = [int(m) << max(int(e) - 53 - least, 0) if m else 0 for m, e in zip(mantissa.flat, exponent.flat)]
    return np.array(flat, object).reshape(corners.shape), least


def dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


def cross(u, v):
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


def minus(u, v):
    return (u[0] - v[0], u[1] - v[1], u[2] - v[2])


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
    corners, exponent = to_integers(np.stack([a, b]))
    a, b = [[tuple(corner) for corner in triangle] for triangle in corners.tolist()]
    found = []
    for i, j in itertools.product(range(3), repeat=2):
        r = minus(b[j], a[i])
        e, f = minus(a[(i + 1) % 3], a[i]), minus(b[(j + 1) % 3], b[j])
        found += [dot(r, r), between_edges(r, e, f), over_edges(r, e), over_edges(minus(a[i], b[j]), f)]
    found += [over_face(p, *b) for p in a] + [over_face(p, *a) for p in b]
    return math.ldexp(math.sqrt(min(x for x in found if x is not None)), exponent)
