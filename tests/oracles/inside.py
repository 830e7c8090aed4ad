"""Even-odd test of a point in a closed surface, in integers: along a line in general position, found by trying."""

import random

import numpy as np
import trimesh

from oracles.triangle import brute_force_faces, clip, cross, dot, integer_points, into_frame_of_a


def parity(point, triangles):
    """Return whether a point off a surface is inside it; triangles float64 (n, 3, 3)."""
    return winding_number(point, triangles) % 2 == 1


def winding_number(point, triangles):
    """Return how many times a surface winds about a point off it; triangles float64 (n, 3, 3).

    Signs of three determinants with a direction say whether a line through the point passes a triangle, one more on
    which side of the point. A direction for which any of the three is 0 is not in general position: another is tried.
    """
    flat, origin = integer_points(np.reshape(triangles, (-1, 3)), np.reshape(point, (1, 3)))
    corners = np.array(flat, object).reshape(-1, 3, 3) - np.array(origin, object)
    a, b, c = corners.transpose(1, 2, 0)
    volume = dot(a, cross(b, c))
    # A line in general position passes the plane of a face where the point is in it, or its line, in the point alone.
    assert not any(clip(face, [(0, 0, 0)] * 3) for face in corners[volume == 0].tolist()), "it is on the surface"
    normals = [np.stack(cross(u, v))[:, volume != 0] for u, v in ((a, b), (b, c), (c, a))]
    rng = random.Random(0)
    while True:
        direction = tuple(rng.randint(-(10**6), 10**6) for _ in range(3))
        sides = np.array([dot(direction, normal) for normal in normals])
        if (sides == 0).any():
            continue
        passed = ((sides > 0).all(0) | (sides < 0).all(0)) & (volume[volume != 0] * sides[0] > 0)
        # Out of a face's side that is wound about it, or in.
        return int(np.where(sides[0] > 0, 1, -1)[passed].sum())


def components(faces):
    """Return the rows of faces that share vertices, an array for each component."""
    faces = np.asarray(faces)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    labels = trimesh.graph.connected_component_labels(edges)[faces[:, 0]]
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]


def solids_intersect(mesh_a, mesh_b, pose_a, pose_b, solid_a, solid_b):
    """Return (whether surfaces meet, whether a solid holds a component of the other).

    Args:
        mesh_a, mesh_b: Vertices (v, 3) and faces (n, 3) of the object with the smaller index, and of the other.
    """
    (vertices_a, faces_a), (vertices_b, faces_b) = mesh_a, mesh_b
    if len(brute_force_faces(vertices_a, faces_a, vertices_b, faces_b, pose_a, pose_b)):
        return True, False
    a, b = np.asarray(vertices_a, np.float64)[faces_a], into_frame_of_a(vertices_b, pose_a, pose_b)[faces_b]
    held = solid_b and any(parity(a[rows[-1], 1], b) for rows in components(faces_a))
    return False, held or bool(solid_a and any(parity(b[rows[-1], 1], a) for rows in components(faces_b)))
