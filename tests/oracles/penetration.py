"""Largest shifts along a direction at which shapes touch: triangles by projection, convex ones by Minkowski."""

import numpy as np
from scipy.spatial import ConvexHull

EDGE = ((0, 1), (1, 2), (2, 0))


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _corners_over(points, triangles):
    """Return how far points (p, 3) lie under triangles (f, 3, 3) along z, -inf where a point is beside one, (p, f)."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area, to = _cross(ab, ac), points[:, None] - a
    with np.errstate(divide="ignore", invalid="ignore"):
        v, w = _cross(to, ac) / area, _cross(ab, to) / area
        over = v * ab[:, 2] + w * ac[:, 2] - to[..., 2]
        return np.where((v >= 0) & (w >= 0) & (v + w <= 1), over, -np.inf)


def _edges_over(p, q, a, b):
    """Return how far edges p q (k, 3) lie under edges a b (f, 3) along z where they cross, seen along it, (k, f)."""
    e, f, to = (q - p)[:, None], b - a, a - p[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = _cross(to, f) / _cross(e, f), _cross(to, e) / _cross(e, f)
        over = to[..., 2] + t * f[..., 2] - s * e[..., 2]
        return np.where((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1), over, -np.inf)


def last_touch(resting, moving, direction) -> float:
    """Return the largest shift of moving triangles (g, 3, 3) along a unit direction that touches resting ones.

    -inf where none touches the resting (f, 3, 3). Seen along the direction, surfaces are farthest over one another at a
    corner and a face, or where two edges cross.
    """
    frame = np.linalg.qr(np.column_stack([direction, np.eye(3)]))[0][:, [1, 2, 0]]
    frame[:, 2] = direction
    a, b = resting @ frame, moving @ frame
    mirrored = [1, 1, -1]
    found = [_corners_over(b.reshape(-1, 3), a).max()]
    found.append(_corners_over(a.reshape(-1, 3) * mirrored, b * mirrored).max())
    found += [_edges_over(b[:, i], b[:, j], a[:, k], a[:, m]).max() for i, j in EDGE for k, m in EDGE]
    return max(found)


def convex_exits(resting, moving, directions) -> np.ndarray:
    """Return the largest shifts of a convex shape along unit directions (m, 3) that touch another one, (m,).

    Where a ray leaves the convex hull of the differences of their corners (p, 3) and (q, 3).
    """
    hull = ConvexHull((resting[:, None] - moving[None]).reshape(-1, 3))
    normals, offsets = hull.equations[:, :3], hull.equations[:, 3]
    slope = directions @ normals.T
    with np.errstate(divide="ignore"):
        return np.where(slope > 0, -offsets / slope, np.inf).min(1)
