"""Paths of objects in numbers of at least 64 digits: where points of one object are in the other's frame, and how fast.

Each object's frame is posed by x -> M x + c, M = R E(t), as `warp_abtree.kernels.motion.path` says; derivatives are
those of the formulas. Arrays have one entry an object, or a pair.
"""

import numpy as np

LONG = np.longdouble
# Elsewhere long numbers are those of float64, and nothing could be compared with them.
HAS_LONG = np.finfo(LONG).nmant >= 63


def cross_matrices(axis):
    """Return the matrices (n, 3, 3) that take v to axis x v."""
    return np.cross(axis[:, None], np.eye(3, dtype=LONG)).swapaxes(1, 2)


def shortest_turns(first, last):
    """Return unit axes in the first frame, and angles, of the shortest turns between quaternions x y z w (n, 4)."""
    (p, s), (q, w) = ((rows[:, :3].astype(LONG), rows[:, 3:].astype(LONG)) for rows in (first, last))
    vector, real = s * q - w * p - np.cross(p, q), s * w + (p * q).sum(1, keepdims=True)
    vector = np.where(real < 0, -vector, vector)
    length = np.sqrt((vector**2).sum(1, keepdims=True))
    axis = np.where(length > 0, vector / np.where(length > 0, length, 1), [[0, 0, 1]])
    return axis, 2 * np.arctan2(length, np.abs(real))[:, 0]


def frames_at(rotation, axis, angle, anchor, start, travel, t):
    """Return M and c at times t (n,), their velocities, and their accelerations: three pairs."""
    rotation, axis, angle, anchor = (np.asarray(x).astype(LONG) for x in (rotation, axis, angle, anchor))
    k, angle, t = cross_matrices(axis), angle[:, None, None], np.asarray(t).astype(LONG)
    turned = angle * t[:, None, None]
    m = rotation @ (np.eye(3, dtype=LONG) + np.sin(turned) * k + (1 - np.cos(turned)) * (k @ k))
    m1 = m @ (angle * k)
    m2 = m1 @ (angle * k)
    travel = travel.astype(LONG)
    c = start.astype(LONG) + t[:, None] * travel
    about = [apply(x, anchor) for x in (m, m1, m2)]
    return (m, c - about[0]), (m1, travel - about[1]), (m2, -about[2])


def apply(matrices, points):
    """Return matrices (n, 3, 3) times one point each (n, 3), or several (n, k, 3)."""
    points = points.astype(LONG)
    return np.einsum("nij,nj->ni" if points.ndim == 2 else "nij,nkj->nki", matrices, points)


def invert(m):
    """Return the inverses of matrices that are nearly orthonormal, by Newton's steps."""
    x = np.swapaxes(m, 1, 2)
    for _ in range(3):
        x = x @ (2 * np.eye(3, dtype=LONG) - m @ x)
    return x


def seen_from(own, other):
    """Return the map of another object's points to an object's own frame, its velocity and acceleration: three pairs.

    Args:
        own, other: What `frames_at` returns.
    """
    (ma, ca), (ma1, ca1), (ma2, ca2) = own
    (mb, cb), (mb1, cb1), (mb2, cb2) = other
    n = invert(ma)
    n1 = -(n @ ma1 @ n)
    n2 = 2 * (n @ ma1 @ n @ ma1 @ n) - n @ ma2 @ n
    u, u1, u2 = cb - ca, cb1 - ca1, cb2 - ca2
    place = n @ mb, apply(n, u)
    speed = n1 @ mb + n @ mb1, apply(n1, u) + apply(n, u1)
    bend = n2 @ mb + 2 * (n1 @ mb1) + n @ mb2, apply(n2, u) + 2 * apply(n1, u1) + apply(n, u2)
    return place, speed, bend


def move(linear_map, points):
    """Return points (n, k, 3) under a pair of `seen_from`."""
    matrices, shift = linear_map
    return apply(matrices.astype(LONG), points) + shift.astype(LONG)[:, None]
