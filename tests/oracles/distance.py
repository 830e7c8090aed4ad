"""Distances of points to a surface, apart from the kernels: by brute force in float64, and in fractions."""

import itertools
from fractions import Fraction

import numpy as np
import warp as wp

from oracles.triangle import dot, into_frame_of_a, sub
from oracles.triangle_distance import over_edges, over_face


def lattice_points(corners, count):
    """Return a lattice of points of each triangle, `count` to an edge, corners included, float64 (k, 3)."""
    i, j = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T
    weights = np.stack([i, j, count - i - j], 1) / count
    return np.einsum("sk,fkx->fsx", weights, corners).reshape(-1, 3)


def brute_distances(points, corners):
    """Return the distance of points (p, 3) to the nearest triangle (f, 3, 3): to its edges, or its plane inside."""
    least = np.full(len(points), np.inf)
    step = max(1, 500_000 // len(points))
    for start in range(0, len(corners), step):
        a, b, c = np.moveaxis(corners[start : start + step], 1, 0)
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1)
        inside = np.broadcast_to(length > 0, (len(points), len(a)))
        best = np.full(inside.shape, np.inf)
        for p, q in ((a, b), (b, c), (c, a)):
            edge, to = q - p, points[:, None] - p
            size = np.einsum("fx,fx->f", edge, edge)
            along = np.clip(np.einsum("pfx,fx->pf", to, edge) / np.where(size > 0, size, 1), 0, 1)
            best = np.minimum(best, np.linalg.norm(to - along[..., None] * edge, axis=2))
            inside = inside & (np.einsum("pfx,fx->pf", np.cross(edge, to), normal) >= 0)
        height = np.abs(np.einsum("pfx,fx->pf", points[:, None] - a, normal)) / np.where(length > 0, length, 1)
        least = np.minimum(least, np.where(inside, np.minimum(best, height), best).min(1))
    return least


@wp.kernel(module="unique")
def measure_distance_kernel(mesh: wp.uint64, points: wp.array[wp.vec3], distance_out: wp.array[float]):
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e6)
    foot = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    distance_out[i] = wp.length(points[i] - foot)


def estimate_distances(points, corners):
    """Return distances of points to triangles by Warp's own query, in float32."""
    low, size = corners.min((0, 1)), np.ptp(corners, axis=(0, 1)).max()
    soup = wp.array(((corners - low) / size).reshape(-1, 3), dtype=wp.vec3, device="cpu")
    surface = wp.Mesh(soup, wp.array(np.arange(3 * len(corners)), dtype=int, device="cpu"))
    place = wp.array((points - low) / size, dtype=wp.vec3, device="cpu")
    distance = wp.empty(len(points), dtype=float, device="cpu")
    wp.launch(measure_distance_kernel, len(points), [surface.id, place], [distance], device="cpu")
    return distance.numpy()


def farthest_points(points, corners, count):
    """Return the points that seem farthest from triangles; an error of the estimate can only hide some."""
    return points[np.argsort(estimate_distances(points, corners))[-count:]]


def farthest_distance(triangles, corners):
    """Return the greatest distance of some triangles from others that a search by points finds.

    Estimates choose triangles with the farthest points, and these; their errors make the answer less, never more.
    """
    coarse = estimate_distances(lattice_points(triangles, 6), corners).reshape(len(triangles), -1).max(1)
    points = lattice_points(triangles[np.argsort(coarse)[-40:]], 100)
    return brute_distances(farthest_points(points, corners, 20), corners).max()


def exact_distance_sq(point, corners):
    """Return the squared distance of a point of fractions to the nearest triangle, a Fraction."""
    found = []
    for triangle in ([[Fraction(x) for x in corner] for corner in triangle] for triangle in corners.tolist()):
        for p, q in zip(triangle, triangle[1:] + triangle[:1]):
            to = sub(point, p)
            found += [dot(to, to), over_edges(to, sub(q, p))]
        found.append(over_face(point, *triangle))
    return min(x for x in found if x is not None)


def over(a, b):
    """a / b, and 0 where b is 0."""
    return np.divide(a, b, out=np.zeros(np.broadcast_shapes(np.shape(a), np.shape(b))), where=b > 0)


def mesh_distance(model_a, lod_a, pose_a, model_b, lod_b, pose_b):
    """Return the distance of two posed meshes that do not intersect, in A's frame."""
    (vertices_a, faces_a, _), (vertices_b, faces_b, _) = model_a.mesh_at(lod_a), model_b.mesh_at(lod_b)
    return surface_distance(vertices_a[faces_a], into_frame_of_a(vertices_b, pose_a, pose_b)[faces_b])


def surface_distance(a, b):
    """Return the distance of the faces a from the faces b, corners (f, 3, 3) each, that do not intersect.

    The least over all pairs of features: corner and face, and the lines of two edges where closest inside both.
    """
    least = min(brute_distances(a.reshape(-1, 3), b).min(), brute_distances(b.reshape(-1, 3), a).min())
    for i, j in itertools.product(range(3), repeat=2):
        p, q = a[:, None, i], b[None, :, j]
        e, f = a[:, None, (i + 1) % 3] - p, b[None, :, (j + 1) % 3] - q
        across = np.cross(e, f)
        size = (across**2).sum(-1)
        s, t = (over((np.cross(q - p, edge) * across).sum(-1), size) for edge in (f, e))
        inside = (size > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
        gap = np.abs(over(((q - p) * across).sum(-1), np.sqrt(size)))
        least = min(least, gap[inside].min(initial=np.inf))
    return least
