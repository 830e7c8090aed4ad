"""Exact triangle intersection for closed sets, from first principles, and brute force over all face pairs.

Touching counts, coplanar overlap counts, and a triangle of zero area is the segment or point that it is. One triangle
is clipped by the half-spaces of the other, in integers on a common exponent.
"""

from fractions import Fraction

import numpy as np


def quaternion_matrix(q):
    """Rotation matrix of a quaternion (x, y, z, w), normalised in float64 first."""
    x, y, z, w = (np.float64(c) for c in q)
    norm = np.sqrt(((x * x + y * y) + z * z) + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    first = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    second = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    return np.array([first, second, (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y))])


def pose_matrix(pose):
    """Rotation and translation of a pose: (x, y, z, qx, qy, qz, qw), or a 4x4 matrix taken as it is."""
    pose = np.asarray(pose, np.float64)
    if pose.shape == (4, 4):
        return pose[:3, :3].copy(), pose[:3, 3].copy()
    return quaternion_matrix(pose[3:]), pose[:3].copy()


def relative_pose(rotation_a, translation_a, rotation_b, translation_b):
    """R = Ra^T Rb and t = Ra^T (tb - ta), each entry ((p + q) + r) of its three products.

    Elementwise on purpose: matmul, dot and einsum may fuse or reorder, and the last bit is part of the contract.
    """
    ra, rb = np.asarray(rotation_a, np.float64), np.asarray(rotation_b, np.float64)
    d = np.asarray(translation_b, np.float64) - np.asarray(translation_a, np.float64)
    rotation = (ra[0][:, None] * rb[0] + ra[1][:, None] * rb[1]) + ra[2][:, None] * rb[2]
    translation = (ra[0] * d[0] + ra[1] * d[1]) + ra[2] * d[2]
    return rotation, translation


def transform(rotation, translation, points):
    """x' = ((R0 x + R1 y) + R2 z) + t with columns R0, R1, R2; coordinates under 2^-290 become 0."""
    x, y, z = (np.asarray(points, np.float64)[:, k, None] for k in range(3))
    moved = ((rotation[:, 0] * x + rotation[:, 1] * y) + rotation[:, 2] * z) + translation
    moved[np.abs(moved) < 2.0**-290] = 0.0
    return moved


def into_frame_of_a(points_b, pose_a, pose_b):
    """Vertices of B in the frame of A: the coordinates on which every answer is defined."""
    return transform(*relative_pose(*pose_matrix(pose_a), *pose_matrix(pose_b)), points_b)


def lowest_exponent(*arrays):
    """Exponent of the power of two that `integer_points` counts in."""
    parts = [np.frexp(np.asarray(a, np.float64)) for a in arrays]
    return min((int(e[m != 0].min()) for m, e in parts if m.any()), default=53) - 53


def integer_points(*arrays):
    """Each (n, 3) float64 array as a list of integer triples, all on one common power of two."""
    parts, lowest = [np.frexp(np.asarray(a, np.float64)) for a in arrays], lowest_exponent(*arrays) + 53
    result = []
    for mantissa, exponent in parts:
        integer, shift = (mantissa * 2.0**53).astype(np.int64), np.where(mantissa != 0, exponent - lowest, 0)
        result.append([tuple(map(int.__lshift__, *rows)) for rows in zip(integer.tolist(), shift.tolist())])
    return result


def fractions(x):
    """Return numbers as fractions, an array of objects."""
    return np.vectorize(lambda v: Fraction(float(v)), otypes=[object])(x)


ZERO = (0, 0, 0)


def sub(a, b):
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _half_spaces(triangle):
    """Yield half-spaces (normal, point), normal . (x - point) >= 0, whose intersection is the closed triangle."""
    a, b, c = triangle
    normal = cross(sub(b, a), sub(c, a))
    if any(normal):
        yield from ((normal, a), (sub(ZERO, normal), a))
        # normal x edge points inwards, as the corners run counterclockwise about their own normal.
        yield from ((cross(normal, sub(q, p)), p) for p, q in ((a, b), (b, c), (c, a)))
        return
    p, q = min(triangle), max(triangle)
    d = sub(q, p)
    walls = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    if any(d):
        yield from ((d, p), (sub(ZERO, d), q))
        across = cross(d, walls[min(range(3), key=lambda k: abs(d[k]))])
        walls = [across, cross(d, across)]
    yield from ((sign, p) for wall in walls for sign in (wall, sub(ZERO, wall)))


def clip(a, b):
    """Corners of the intersection of two closed triangles of exact numbers, by clipping B with every half-space of A.

    A corner (x, y, z, w), w > 0, is the point (x, y, z) / w, so that nothing is divided.
    """
    polygon = [(*p, 1) for p in b]
    for normal, origin in _half_spaces(a):
        offset = dot(normal, origin)
        side = [dot(normal, p) - offset * p[3] for p in polygon]
        if max(side) < 0:
            return []
        clipped = []
        for k, (q, t) in enumerate(zip(polygon, side, strict=True)):
            p, s = polygon[k - 1], side[k - 1]
            if s * t < 0:
                clipped.append(tuple(abs(t) * x + abs(s) * y for x, y in zip(p, q, strict=True)))
            if t >= 0:
                clipped.append(q)
        polygon = clipped
    return polygon


def triangles_intersect(a, b):
    """Whether two closed triangles of float64 coordinates, (3, 3) each, meet; exact."""
    return bool(clip(*integer_points(a, b)))


def shared_polygon(a, b):
    """Corners of the intersection of two closed triangles, float64 (n, 3), each rounded once."""
    a, b = ([tuple(map(Fraction, p)) for p in np.asarray(t, np.float64).tolist()] for t in (a, b))
    return np.array([[float(x / w) for x in point] for *point, w in clip(a, b)])


def pairs_intersect(points_a, faces_a, points_b, faces_b, pairs):
    """Exact answers for a list of (face of A, face of B), all in one frame; returns bool [k]."""
    ia, ib = integer_points(points_a, points_b)
    faces_a, faces_b = np.asarray(faces_a).tolist(), np.asarray(faces_b).tolist()
    meets = [bool(clip([ia[v] for v in faces_a[i]], [ib[v] for v in faces_b[j]])) for i, j in pairs]
    return np.array(meets, bool)


def box_pairs(a, b):
    """All (i, j) whose closed boxes overlap, for triangles a [n, 3, 3] and b [m, 3, 3]; comparisons are exact."""
    found = [np.zeros((0, 2), np.int64)]
    for start in range(0, len(a), 128):
        block = a[start : start + 128]
        near = (block.min(1)[:, None] <= b.max(1)) & (block.max(1)[:, None] >= b.min(1))
        found.append(np.argwhere(near.all(2)) + [start, 0])
    return np.concatenate(found)


def _strictly_beside(a, b):
    """Whether all of b lies strictly on one side of the plane of a, beyond rounding.

    The determinant takes 8 roundings of 2^-53, so it is certain beyond 1.0e-15 times the sum of the absolute products;
    4e-15 leaves room. The constant covers underflow below 1e100.
    """
    e, f = a[:, 1] - a[:, 0], a[:, 2] - a[:, 0]
    left, right = e[:, [1, 2, 0]] * f[:, [2, 0, 1]], e[:, [2, 0, 1]] * f[:, [1, 2, 0]]
    arm = b - a[:, :1]
    side = ((left - right)[:, None] * arm).sum(2)
    bound = 4e-15 * ((np.abs(left) + np.abs(right))[:, None] * np.abs(arm)).sum(2) + 1e-200
    return (side > bound).all(1) | (side < -bound).all(1)


def provably_apart(a, b):
    """Float64 filter for triangle pairs a, b [k, 3, 3]: True only where they cannot meet, False where uncertain."""
    if max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0)) > 1e100:
        return np.zeros(len(a), bool)
    return _strictly_beside(a, b) | _strictly_beside(b, a)


def brute_force_faces(vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b):
    """All intersecting (face of A, face of B), sorted, int32 [k, 2]; A is the object with the smaller index.

    Every face pair passes a box test; of those left, the pairs that float64 cannot prove apart are tested exactly.
    """
    points_a, points_b = np.asarray(vertices_a, np.float64), into_frame_of_a(vertices_b, pose_a, pose_b)
    faces_a, faces_b = np.asarray(faces_a), np.asarray(faces_b)
    candidates = box_pairs(points_a[faces_a], points_b[faces_b])
    blocks = np.array_split(candidates, len(candidates) // 100_000 + 1)
    apart = [provably_apart(points_a[faces_a[p[:, 0]]], points_b[faces_b[p[:, 1]]]) for p in blocks]
    uncertain = candidates[~np.concatenate(apart)]
    hits = uncertain[pairs_intersect(points_a, faces_a, points_b, faces_b, uncertain)]
    return hits[np.lexsort((hits[:, 1], hits[:, 0]))].astype(np.int32)
