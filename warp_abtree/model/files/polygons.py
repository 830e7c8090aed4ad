"""Polygons, strips and fans as triangles: one triangulation for all files."""

from collections import deque

import numpy as np

from warp_abtree.model.files.found import MeshError


def triangulate(vertices, counts, corners, where):
    """Cut polygons into triangles, in place: polygon p gives counts[p] - 2 of them.

    Raises MeshError for a polygon with fewer than three corners, or that refers to no vertex.
    """
    if not len(vertices):
        raise MeshError(f"{where}: no vertices")
    few = np.flatnonzero(counts < 3)
    if len(few):
        raise MeshError(f"{where}: face {few[0]} has {counts[few[0]]} corners")
    if len(corners) and not 0 <= corners.min() <= corners.max() < len(vertices):
        wrong = np.argmax((corners < 0) | (corners >= len(vertices)))
        face = np.searchsorted(np.cumsum(counts), wrong, side="right")
        last = len(vertices) - 1
        raise MeshError(f"{where}: face {face} refers to vertex {corners[wrong]}, but they run from 0 to {last}")
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    polygon_start = np.cumsum(counts) - counts
    triangle_start = np.cumsum(counts - 2) - (counts - 2)
    polygon = np.repeat(np.arange(len(counts)), counts - 2)
    apex = polygon_start[polygon]
    second = apex + 1 + np.arange(len(polygon)) - triangle_start[polygon]
    triangles = np.stack([corners[apex], corners[second], corners[second + 1]], axis=1)

    # Three in five polygons of warp:rocks are not convex. A fan's cross products sum to the polygon's area vector.
    with np.errstate(invalid="ignore", over="ignore"):
        a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
        cross = np.cross(b - a, c - a)
        area = np.add.reduceat(cross, triangle_start)
        size = np.sqrt(np.einsum("ij,ij->i", area, area))[polygon]
        # Rounding, of thin polygons and of small notches in large ones.
        least = 1e-9 * size * np.minimum(size, np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1))
        fold = np.einsum("ij,ij->i", cross, area[polygon]) < -least
    for p in np.unique(polygon[fold]):
        ring = corners[polygon_start[p] : polygon_start[p] + counts[p]]
        drop = np.argmax(np.abs(area[p]))
        flat = np.delete(vertices[ring], drop, axis=1) * (1.0, (1.0, -1.0, 1.0)[drop] * np.sign(area[p][drop]))
        triangles[triangle_start[p] :][: counts[p] - 2] = ring[_clip_ears(flat)]
    return triangles


def cut_strip(corners):
    """Return the triangles of a triangle strip, all wound as the first, without those that repeat a corner."""
    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    triangles[1::2] = triangles[1::2, [1, 0, 2]]
    return triangles[distinct_corners(triangles)]


def distinct_corners(faces):
    """Return which faces have three distinct corners."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)


def _clip_ears(points):
    """Cut a counterclockwise polygon whose fan folds into triangles that do not; return their corners.

    Corners may repeat, and edges touch, as where cuts join a polygon's holes to its outline. Cuts through corners that
    lie on them within rounding may leave what crosses itself: there, cuts with none near them go first.
    """
    if len(points) == 4:
        return [(3, 0, 1), (1, 2, 3)]  # the fan from corner 0 folds
    found = []
    for least in (0.0, 2.0**-40 * np.ptp(points, axis=0).max() ** 2):
        triangles = _cut_ears(points, least)
        areas = turn(*points[np.array(triangles)].transpose(1, 0, 2))
        found.append((np.abs(areas).sum(), triangles))
        if found[-1][0] <= (1 + 1e-9) * areas.sum():
            break
    return min(found, key=lambda each: each[0])[1]


def _cut_ears(points, least):
    """Cut ears off a polygon, as long as there are any those of more area than the least, with no corner so near."""
    count = len(points)
    before, after = np.roll(np.arange(count), 1), np.roll(np.arange(count), -1)
    left, triangles = np.ones(count, bool), []
    queue, all_asked = deque(range(count)), True
    while len(triangles) < count - 2:
        if queue:
            j = queue.popleft()
            if not left[j] or not _is_ear(points, np.flatnonzero(left), before[j], j, after[j], after, least):
                continue
        elif least:
            queue, least = deque(np.flatnonzero(left)), 0.0
            continue
        else:
            # No ear: corners without area first, which may free others; what crosses itself is cut anyhow.
            ring = np.flatnonzero(left)
            turns = turn(points[before[ring]], points[ring], points[after[ring]])
            flat = (turns == 0.0).any()
            if not flat and not all_asked:
                queue, all_asked = deque(ring), True
                continue
            j, all_asked = ring[np.argmax(turns == 0.0 if flat else turns)], not flat
        i, k = before[j], after[j]
        triangles.append((i, j, k))
        left[j], after[i], before[k] = False, k, i
        queue += i, k  # a cut makes no other ears
    return triangles


def _is_ear(points, ring, i, j, k, after, least) -> bool:
    """Return whether a triangle at corner j turns left, or is a point that repeats, and no edge enters it.

    With a least area it has more than that, and each other corner of the ring makes more with an edge, outside of it.
    """
    corners = points[[i, j, k]]
    if (corners[1] == corners[::2]).all(axis=1).any():
        return True
    if not turn(*corners) > least:
        return False
    # Edges whose boxes are beside the triangle's do not enter it.
    ends, margin = np.stack([points[ring], points[after[ring]]]), least**0.5
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    near = ((ends.max(axis=0) >= low) & (ends.min(axis=0) <= high)).all(axis=1)
    ring, ends = ring[near], ends[:, near]
    turns = turn(corners[:, None], corners[[1, 2, 0], None], ends[:, None])
    if least and not (turns[0][:, ~np.isin(ring, (i, j, k))] < -least).any(axis=0).all():
        return False
    beyond = (turns <= 0.0).all(axis=0).any(axis=0)
    sides = turn(ends[0, :, None], ends[1, :, None], corners)
    return bool((beyond | (sides >= 0.0).all(axis=1) | (sides <= 0.0).all(axis=1)).all())


def turn(a, b, c):
    """Return twice the area of triangles of the plane, negative where they turn right, 0 within rounding."""
    u, v = b - a, c - a
    p, q = u[..., 0] * v[..., 1], u[..., 1] * v[..., 0]
    return np.where(np.abs(p - q) <= 2.0**-50 * (np.abs(p) + np.abs(q)), 0.0, p - q)
