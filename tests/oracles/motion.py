"""First contacts apart from the kernels: poses on the way by spherical interpolation, and translations in fractions."""

import itertools
from fractions import Fraction

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from oracles.triangle import cross, dot, quaternion_matrix, sub


def pose_between(start, end, t):
    """Return the pose (7,) at a time: the origin on a straight line, the shortest turn."""
    turn = Slerp([0, 1], Rotation.from_quat([start[3:], end[3:]]))(t)
    return np.concatenate([(1 - t) * start[:3] + t * end[:3], turn.as_quat()])


def posed(vertices, pose):
    return vertices @ quaternion_matrix(pose[3:]).T + pose[:3]


def straight_soups(meshes, starts, ends):
    """Return a function of time that gives the corners (f, 3, 3) of meshes whose vertices move straight."""
    both = [[posed(vertices, pose) for (vertices, _), pose in zip(meshes, poses)] for poses in (starts, ends)]
    return lambda t: [((1 - t) * p + t * q)[faces] for p, q, (_, faces) in zip(*both, meshes)]


def _inside(point, a, b, c):
    """Return whether a point of a triangle's plane lies in the closed triangle, which has an area."""
    n = cross(sub(b, a), sub(c, a))
    return all(dot(cross(sub(q, p), sub(point, p)), n) >= 0 for p, q in ((a, b), (b, c), (c, a)))


def _corner_times(corner, triangle, way):
    """Yield when a corner that moves by `way` in unit time passes a triangle that rests."""
    a, b, c = triangle
    n = cross(sub(b, a), sub(c, a))
    if dot(way, n) != 0:
        t = dot(sub(a, corner), n) / dot(way, n)
        if 0 <= t <= 1 and _inside([x + t * v for x, v in zip(corner, way)], a, b, c):
            yield t


def _edge_times(p, q, a, b, way):
    """Yield when an edge p q that moves by `way` passes an edge a b that rests, if they are not parallel."""
    e, f = sub(q, p), sub(b, a)
    n = cross(e, f)
    if dot(way, n) != 0:
        t = dot(sub(a, p), n) / dot(way, n)
        if 0 <= t <= 1:
            r = sub(a, [x + t * v for x, v in zip(p, way)])
            s, u = dot(cross(r, f), n) / dot(n, n), dot(cross(r, e), n) / dot(n, n)
            if 0 <= s <= 1 and 0 <= u <= 1:
                yield t


def translation_contact(resting, moving, way):
    """Return the first time at which triangles that move by `way` touch resting ones, a Fraction, or None.

    For faces in general position, which first touch at a corner and a face or at two edges that are not parallel.

    Args:
        resting, moving: Corners (f, 3, 3) of faces that are apart at first.
    """

    def exact(corners):
        return [[[Fraction(x) for x in corner] for corner in triangle] for triangle in corners.tolist()]

    way = [Fraction(x) for x in way.tolist()]
    back, times = [-x for x in way], []
    for a, b in itertools.product(exact(resting), exact(moving)):
        for k in range(3):
            times += [*_corner_times(b[k], a, way), *_corner_times(a[k], b, back)]
            for j in range(3):
                times += _edge_times(b[k], b[(k + 1) % 3], a[j], a[(j + 1) % 3], way)
    return min(times, default=None)
