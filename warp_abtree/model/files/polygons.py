"""Polygons, strips and fans as triangles: one triangulation for all files."""

import numpy as np

from warp_abtree.model.files.found import MeshError


def triangulate(vertices, counts, corners, where):
    """Cut polygons into triangles, in place: polygon p gives counts[p] - 2 of them.

    Raises:
        MeshError: A polygon has fewer than three corners, or refers to no vertex.
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
        fold = np.einsum("ij,ij->i", cross, area[polygon]) < -1e-9 * np.einsum("ij,ij->i", area, area)[polygon]
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
    a, b, c = triangles.T
    return triangles[(a != b) & (b != c) & (c != a)]


def _clip_ears(points):
    """Cut a counterclockwise polygon of the plane into triangles that do not fold; return their corners."""

    def turn(i, j, k):
        (ax, ay), (bx, by), (cx, cy) = points[i], points[j], points[k]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    points = list(map(tuple, points.tolist()))
    ring, triangles = list(range(len(points))), []
    while len(ring) > 3:
        candidates = list(zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1]))
        for i, j, k in candidates:
            others = [x for x in ring if points[x] not in (points[i], points[j], points[k])]
            if turn(i, j, k) > 0.0 and not any(
                turn(i, j, x) >= 0.0 and turn(j, k, x) >= 0.0 and turn(k, i, x) >= 0.0 for x in others
            ):
                break
        else:
            # No ear: the polygon crosses itself, or is flat to rounding. Any cut will do.
            i, j, k = max(candidates, key=lambda corner: turn(*corner))
        triangles.append((i, j, k))
        ring.remove(j)
    return [*triangles, tuple(ring)]
