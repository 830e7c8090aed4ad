"""Sides of closed surfaces: which points they hold, which of their faces point to what they hold, by parity."""

from fractions import Fraction

import numpy as np

# Of the sum of all products of three coordinates: 80 roundings of 2^-53 in each, and those of the sum.
VOLUME_ROUNDING = 2.0**-45
# Faces of a part whose first corner and middle are looked at, and entries of a table of points and faces.
SAMPLED_FACES = 16
TABLE = 2**22
# Points as near to a surface count as on it, as a part of its size, and of coordinates.
NEAR_FRACTION, NEAR_ROUNDING = 1e-9, 2.0**-48


def loose_inside_out(vertices, faces, part, loose, counted, borders):
    """Return the rows of each part that is inside out of some, `loose`, which are closed by others alone.

    Parity, which counts the rows `counted`, at the middle of a face decides, of one that is not on another surface. Of
    two flat parts on one another, the walls of bodies that touch, one is turned where both run along their border the
    same way: `borders` has the edges that leave each part open, and how it runs along them, as bytes.
    """
    corners = vertices[faces]
    order = np.argsort(part, kind="stable")
    start, end = np.searchsorted(part[order], [loose, loose + 1])
    windows = [_Window(corners[counted], counted, axis) for axis in range(3)]
    alike: dict[tuple, list] = {}
    for k, at, to in zip(loose.tolist(), start, end):
        (edges, way), rows = borders[k], order[at:to]
        alike.setdefault((edges, np.unique(faces[rows]).tobytes()), []).append((way, rows))
    turned = []
    for parts in alike.values():
        if len(parts) == 2 and all(_is_flat(corners[rows]) for _, rows in parts):
            turned += [parts[1][1]] if parts[0][0] == parts[1][0] else []
            continue
        for _, rows in parts:
            some = rows[np.unique(np.linspace(0, len(rows) - 1, SAMPLED_FACES).astype(int))]
            sides = (_points_inside(corners, face, windows) for face in some)
            if next(filter(None, sides), 0) > 0:
                turned.append(rows)
    return turned


def _is_flat(corners) -> bool:
    """Return whether faces lie in one plane."""
    normal = np.cross(corners[0, 1] - corners[0, 0], corners[0, 2] - corners[0, 0])
    x = corners.reshape(-1, 3) - corners[0, 0]
    return bool((np.abs(x @ normal) <= NEAR_FRACTION * np.abs(x).max() * np.linalg.norm(normal)).all())


class _Window:
    """Faces in the order of their lower ends along an axis, to find those whose box is over a point."""

    def __init__(self, corners, faces, axis):
        lower, upper = corners.min(1), corners.max(1)
        order = np.argsort(lower[:, axis], kind="stable")
        self.faces, self._lower, self._upper = faces[order], lower[order], upper[order]
        self._start, self._reach = self._lower[:, axis].copy(), (upper - lower)[:, axis].max()
        self.near = nearness(lower.min(0), upper.max(0))

    def over(self, point, axes, face):
        """Return the faces but one whose boxes hold a point as seen along the last of some axes; the first is ours."""
        ends = point[axes[0]] + np.array([-self._reach - 2 * self.near, 2 * self.near])
        start, end = np.searchsorted(self._start, ends)
        lower, upper = self._lower[start:end, axes[:2]], self._upper[start:end, axes[:2]]
        held = (lower <= point[axes[:2]] + self.near).all(1) & (upper >= point[axes[:2]] - self.near).all(1)
        found = self.faces[start:end][held]
        return found[found != face]


def _points_inside(corners, face, windows) -> int:
    """Return 1 for a face that points to where parity says inside, -1 for one that points out, 0 for one on another."""
    a, b, c = corners[face]
    normal = np.cross(b - a, c - a)
    z = int(np.abs(normal).argmax())
    axes = [(z + 1) % 3, (z + 2) % 3, z]
    point, near = (a + b + c) / 3, windows[0].near
    x = (corners[windows[axes[0]].over(point, axes, face)] - point)[:, :, axes]
    across = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    flat = np.abs(np.einsum("ij,ij->i", across, x[:, 0])) <= near * np.linalg.norm(across, axis=1)
    y = np.roll(x, -1, axis=1)
    turns = (x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0])[flat]
    slack = near * np.abs(x[flat]).max((1, 2))[:, None]
    if ((turns >= -slack).all(1) | (turns <= slack).all(1)).any():
        return 0
    x = x[~flat]
    side = _sides(x, (x.min(1).T, x.max(1).T), np.zeros((1, 3)), near)[0] if len(x) else -1
    return int(side * np.sign(normal[z]))


def volume_sign(corners) -> int:
    """Return the sign of the volume within a closed, consistently wound surface, exactly."""
    origin = corners[0, 0]
    scale = np.abs(corners - origin).max()
    a, b, c = ((corners[:, k] - origin) / scale for k in range(3))
    terms = np.einsum("ij,ij->i", a, np.cross(b, c))
    a, b, c = np.abs(a), np.abs(b), np.abs(c)
    sizes = np.roll(b, -1, 1) * np.roll(c, -2, 1) + np.roll(b, -2, 1) * np.roll(c, -1, 1)
    volume = terms.sum()
    if abs(volume) <= VOLUME_ROUNDING * np.einsum("ij,ij->", a, sizes):
        volume = sum(_exact_volume(*face) for face in corners)
    return int(volume > 0) - int(volume < 0)


def _exact_volume(a, b, c) -> Fraction:
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = ([Fraction(x) for x in p] for p in (a.tolist(), b.tolist(), c.tolist()))
    return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)


def nearness(lower, upper):
    """Return how near to a surface in a box counts as on it."""
    return max(NEAR_FRACTION * (upper - lower).max(), NEAR_ROUNDING * max(np.abs(lower).max(), np.abs(upper).max()))


def holds_points(corners, points) -> bool:
    """Return whether a closed surface holds those of some points that are not on it, and there are some."""
    box = corners.min(1).T, corners.max(1).T
    near = nearness(box[0].min(1), box[1].max(1))
    step = max(1, TABLE // len(corners))
    held = False
    for at in range(0, len(points), step):
        sides = _sides(corners, box, points[at : at + step], near)
        if (sides < 0).any():
            return False
        held |= bool((sides > 0).any())
    return held


def _sides(corners, box, points, near):
    """Return 1 for points in a closed surface, -1 for those outside, 0 for those on it: crossings of rays along z."""
    lower, upper = box
    least, most = (points - near).T[..., None], (points + near).T[..., None]
    column = (most[0] >= lower[0]) & (most[1] >= lower[1]) & (least[0] <= upper[0]) & (least[1] <= upper[1])
    point, face = np.nonzero(column & (least[2] <= upper[2]))
    x = corners[face] - points[point, None]
    normal = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    height = np.einsum("ij,ij->i", normal, x[:, 0])
    on = (most[2, point, 0] >= lower[2, face]) & (np.abs(height) <= near * np.linalg.norm(normal, axis=1))
    high = x[:, :, 1] > 0
    crosses = np.zeros(len(x), bool)
    for k in range(3):
        a, b = x[:, k], x[:, (k + 1) % 3]
        # The same numbers for both faces of an edge.
        swap = (high[:, k] > high[:, (k + 1) % 3])[:, None]
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        crosses ^= (high[:, k] != high[:, (k + 1) % 3]) & (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0)
    crosses &= (x[:, :, 2].min(1) > 0) | (height * normal[:, 2] > 0)
    sides = np.where(np.bincount(point[crosses], minlength=len(points)) % 2, 1, -1)
    sides[point[on]] = 0
    return sides
