"""Points of surfaces and their distances to meshes, by Warp's own mesh query: independent of the library."""

import numpy as np
import warp as wp


@wp.kernel(enable_backward=False)
def distance_kernel(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach: wp.float32, distance_out: wp.array(dtype=wp.float32)
):
    """Find the distance of each point to a mesh."""
    i = wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], reach)
    distance_out[i] = reach
    if query.result:
        distance_out[i] = wp.length(wp.mesh_eval_position(mesh, query.face, query.u, query.v) - points[i])


def distances(points, vertices, faces, device="cpu"):
    """Return the distance of each point to a mesh, found in float32 about the mesh's middle."""
    middle, reach = (vertices.min(0) + vertices.max(0)) / 2, 2 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    corners = wp.array((vertices - middle).astype(np.float32), dtype=wp.vec3, device=device)
    mesh = wp.Mesh(corners, wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device=device))
    found = wp.zeros(len(points), dtype=wp.float32, device=device)
    queried = wp.array((points - middle).astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(distance_kernel, len(points), [mesh.id, queried, reach, found], device=device)
    return found.numpy().astype(np.float64)


def sample_surface(rng, vertices, faces, count):
    """Return points spread evenly over a surface, (count, 3)."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(faces), count, p=area / area.sum())]
    return np.einsum("ni,nij->nj", rng.dirichlet((1, 1, 1), count), chosen)
