"""Exact triangle intersection for closed sets, from first principles, and brute force over all face pairs.

Touching counts, coplanar overlap counts, and a triangle of zero area is the segment or point that it is.
`triangles_intersect` asks whether an edge of one meets the other, in integers: a float64 is an integer times a power of
two, so integers on a common exponent are exact. `shared_polygon` clips one by the half-spaces of the other, in
fractions; contacts need its corners, and each checks the other.
"""

from fractions import Fraction

import numpy as np

# --- poses -----------------------------------------------------------------------------------------------------------


def quaternion_matrix(q):
    """Rotation matrix of a quaternion (x, y, z, w), normalised in float64 first."""
    x, y, z, w = (np.float64(c) for c in q)
    norm = np.sqrt(((x * x + y * y) + z * z) + w * w)
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


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


# --- exact test in integers ------------------------------------------------------------------------------------------

ZERO = (0, 0, 0)
KEPT_AXES = ((1, 2), (2, 0), (0, 1))  # the two axes left when one is dropped


def integer_points(*arrays):
    """Each (n, 3) float64 array as a list of integer triples, all on one common power of two."""
    parts = [np.frexp(np.asarray(a, np.float64)) for a in arrays]
    exponents = [e[m != 0] for m, e in parts]
    lowest = min((int(e.min()) for e in exponents if e.size), default=0)
    result = []
    for mantissa, exponent in parts:
        integer = (mantissa * 2.0**53).astype(np.int64).tolist()
        shift = np.where(mantissa != 0, exponent - lowest, 0).tolist()
        result.append(
            [tuple(i << s for i, s in zip(row, srow, strict=True)) for row, srow in zip(integer, shift, strict=True)]
        )
    return result


def sub(a, b):
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _kept_axes(normal):
    """Axes of a projection that is one-to-one on a plane with this (nonzero) normal."""
    return KEPT_AXES[0 if normal[0] else 1 if normal[1] else 2]


def _turn(a, b, c, i, j):
    return (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])


def _apart_sides(s, t):
    return (s > 0 and t > 0) or (s < 0 and t < 0)


def _segments_meet_2d(p, q, r, s, i, j):
    """Closed segments, points included: boxes overlap, and neither lies strictly on one side of the other's line."""
    for k in (i, j):
        if max(p[k], q[k]) < min(r[k], s[k]) or max(r[k], s[k]) < min(p[k], q[k]):
            return False
    return not (
        _apart_sides(_turn(p, q, r, i, j), _turn(p, q, s, i, j))
        or _apart_sides(_turn(r, s, p, i, j), _turn(r, s, q, i, j))
    )


def _segments_meet(p, q, r, s):
    d, e, f = sub(q, p), sub(s, r), sub(r, p)
    normal = cross(d, e)
    if normal != ZERO:
        return dot(normal, f) == 0 and _segments_meet_2d(p, q, r, s, *_kept_axes(normal))
    # Parallel, or one of them a point. On a common line, lexicographic order is order along the line.
    line = d if d != ZERO else e
    return cross(f, line) == ZERO and max(min(p, q), min(r, s)) <= min(max(p, q), max(r, s))


def _segment_meets_triangle(p, q, side_p, side_q, triangle, normal):
    """Closed segment or point against a triangle of nonzero area; side_p, side_q: normal . (p - triangle[0]), ..."""
    if _apart_sides(side_p, side_q):
        return False
    a, b, c = triangle
    if side_p == 0 and side_q == 0:
        i, j = _kept_axes(normal)
        s, t, u = _turn(a, b, p, i, j), _turn(b, c, p, i, j), _turn(c, a, p, i, j)
        if (s >= 0 and t >= 0 and u >= 0) or (s <= 0 and t <= 0 and u <= 0):
            return True
        return any(_segments_meet_2d(p, q, r, s, i, j) for r, s in ((a, b), (b, c), (c, a)))
    # One point of the segment is in the plane; it is inside iff the line passes all edges on the same side.
    d, a, b, c = sub(q, p), sub(a, p), sub(b, p), sub(c, p)
    s, t = dot(d, cross(a, b)), dot(d, cross(b, c))
    if _apart_sides(s, -t):
        return False
    u = dot(d, cross(c, a))
    return (s >= 0 and t >= 0 and u >= 0) or (s <= 0 and t <= 0 and u <= 0)


def _edge_meets_triangle(edges_of, sides, triangle, normal):
    return any(
        _segment_meets_triangle(edges_of[k - 1], edges_of[k], sides[k - 1], sides[k], triangle, normal)
        for k in range(3)
    )


def triangles_intersect_integer(a, b):
    """Whether two triangles (triples of integer triples) meet.

    The intersection is convex and bounded, so if it is not empty it has an extreme point, and an extreme point cannot
    be interior to both: it lies on an edge of one, hence some edge of one meets the other. A triangle of zero area is
    the segment between its lexicographically first and last corner.
    """
    normal_a = cross(sub(a[1], a[0]), sub(a[2], a[0]))
    normal_b = cross(sub(b[1], b[0]), sub(b[2], b[0]))
    if normal_a == ZERO and normal_b == ZERO:
        return _segments_meet(min(a), max(a), min(b), max(b))
    if normal_a == ZERO:
        a, b, normal_a, normal_b = b, a, normal_b, normal_a
    if normal_b == ZERO:
        p, q = min(b), max(b)
        return _segment_meets_triangle(p, q, dot(normal_a, sub(p, a[0])), dot(normal_a, sub(q, a[0])), a, normal_a)
    sides_b = [dot(normal_a, sub(p, a[0])) for p in b]
    if min(sides_b) > 0 or max(sides_b) < 0:
        return False
    sides_a = [dot(normal_b, sub(p, b[0])) for p in a]
    if min(sides_a) > 0 or max(sides_a) < 0:
        return False
    return _edge_meets_triangle(b, sides_b, a, normal_a) or _edge_meets_triangle(a, sides_a, b, normal_b)


def triangles_intersect(a, b):
    """Whether two closed triangles of float64 coordinates, (3, 3) each, meet; exact."""
    return triangles_intersect_integer(*map(tuple, integer_points(a, b)))


def pairs_intersect(points_a, faces_a, points_b, faces_b, pairs):
    """Exact answers for a list of (face of A, face of B), all in one frame; returns bool [k]."""
    ia, ib = integer_points(points_a, points_b)
    faces_a, faces_b = np.asarray(faces_a).tolist(), np.asarray(faces_b).tolist()
    answers = np.zeros(len(pairs), bool)
    for k, (i, j) in enumerate(pairs):
        answers[k] = triangles_intersect_integer(tuple(ia[v] for v in faces_a[i]), tuple(ib[v] for v in faces_b[j]))
    return answers


# --- exact test in fractions -----------------------------------------------------------------------------------------


def _half_spaces(triangle):
    """Half-spaces (normal, point), normal . (x - point) >= 0, whose intersection is the closed triangle."""
    a, b, c = triangle
    normal = cross(sub(b, a), sub(c, a))
    if any(normal):
        planes = [(normal, a), (sub(ZERO, normal), a)]
        # normal x edge points inwards, as the corners run counterclockwise about their own normal.
        return planes + [(cross(normal, sub(q, p)), p) for p, q in ((a, b), (b, c), (c, a))]
    p, q = min(triangle), max(triangle)
    d = sub(q, p)
    if any(d):
        unit = tuple(Fraction(int(k == min(range(3), key=lambda k: abs(d[k])))) for k in range(3))
        across = cross(d, unit)
        walls = [across, cross(d, across)]
        ends = [(d, p), (sub(ZERO, d), q)]
    else:
        walls = [tuple(Fraction(int(k == axis)) for k in range(3)) for axis in range(3)]
        ends = []
    return ends + [(sign, p) for wall in walls for sign in (wall, sub(ZERO, wall))]


def shared_polygon(a, b):
    """Corners of the intersection of two closed triangles, by clipping B with every half-space of A; empty if apart."""
    a, b = ([tuple(Fraction(float(x)) for x in p) for p in t] for t in (a, b))
    polygon = b
    for normal, origin in _half_spaces(a):
        side = [dot(normal, sub(p, origin)) for p in polygon]
        clipped = []
        for k in range(len(polygon)):
            p, q, s, t = polygon[k - 1], polygon[k], side[k - 1], side[k]
            if s * t < 0:
                clipped.append(tuple(x + (y - x) * s / (s - t) for x, y in zip(p, q, strict=True)))
            if t >= 0:
                clipped.append(q)
        polygon = clipped
    return polygon


# --- brute force -----------------------------------------------------------------------------------------------------


def box_pairs(a, b):
    """All (i, j) whose closed boxes overlap, for triangles a [n, 3, 3] and b [m, 3, 3]; comparisons are exact."""
    order = np.argsort(a[:, :, 0].min(1), kind="stable")
    lower_b, upper_b = b.min(1), b.max(1)
    found = []
    for block in np.array_split(order, max(1, len(order) // 128)):
        if not len(block):
            continue
        lower, upper = a[block].min(1), a[block].max(1)
        near = np.flatnonzero(((lower_b <= upper.max(0)) & (upper_b >= lower.min(0))).all(1))
        overlap = np.ones((len(block), len(near)), bool)
        for k in range(3):
            overlap &= lower[:, None, k] <= upper_b[near, k]
            overlap &= upper[:, None, k] >= lower_b[near, k]
        i, j = np.nonzero(overlap)
        found.append(np.stack([block[i], near[j]], 1))
    return np.concatenate(found) if found else np.zeros((0, 2), np.int64)


def _strictly_beside(a, b):
    """Whether all of b lies strictly on one side of the plane of a, beyond rounding.

    The determinant takes 8 roundings of 2^-53 (three differences, two products, three sums), so it is certain beyond
    1.0e-15 times the sum of the absolute products; 4e-15 leaves room. The constant covers underflow below 1e100.
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
    uncertain = np.concatenate(
        [p[~provably_apart(points_a[faces_a[p[:, 0]]], points_b[faces_b[p[:, 1]]])] for p in blocks]
    )
    hits = uncertain[pairs_intersect(points_a, faces_a, points_b, faces_b, uncertain)]
    return hits[np.lexsort((hits[:, 1], hits[:, 0]))].astype(np.int32)
