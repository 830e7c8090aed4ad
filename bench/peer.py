"""What a Warp user writes today: one thread a face of A, a wp.Bvh over the faces of B, wp.intersect_tri_tri.

A baseline for time only: its triangle test has an absolute epsilon and invents pairs on fine meshes.
"""

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_hits_kernel(
    face_count: wp.int32,
    bvh: wp.uint64,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    poses: wp.array(dtype=wp.transform),
    hits_out: wp.array(dtype=wp.vec3i),
    total_out: wp.array(dtype=wp.int32),
):
    tid = wp.tid()
    pair = tid // face_count
    a = tid % face_count
    relative = wp.transform_multiply(wp.transform_inverse(poses[2 * pair + 1]), poses[2 * pair])
    p = wp.transform_point(relative, vertices[faces[a][0]])
    q = wp.transform_point(relative, vertices[faces[a][1]])
    r = wp.transform_point(relative, vertices[faces[a][2]])
    query = wp.bvh_query_aabb(bvh, wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r)))
    b = wp.int32(0)
    while wp.bvh_query_next(query, b):
        u = vertices[faces[b][0]]
        v = vertices[faces[b][1]]
        w = vertices[faces[b][2]]
        if wp.intersect_tri_tri(p, q, r, u, v, w) != 0:
            slot = wp.atomic_add(total_out, 0, 1)
            if slot < hits_out.shape[0]:
                hits_out[slot] = wp.vec3i(pair, a, b)


class BvhPeer:
    """The peer as an operator: allocates once, launches many times."""

    def __init__(self, vertices, faces, poses, capacity, device):
        self.device = device
        self.face_count = len(faces)
        self.pair_count = len(poses) // 2
        self.vertices = wp.array(vertices, dtype=wp.vec3, device=device)
        self.faces = wp.array(faces, dtype=wp.vec3i, device=device)
        self.poses = wp.array(np.asarray(poses, np.float32), dtype=wp.transform, device=device)
        corners = vertices[faces]
        lower = wp.array(corners.min(1), dtype=wp.vec3, device=device)
        upper = wp.array(corners.max(1), dtype=wp.vec3, device=device)
        self.bvh = wp.Bvh(lower, upper, constructor="sah")
        self.hits = wp.empty(capacity, dtype=wp.vec3i, device=device)
        self.total = wp.zeros(1, dtype=wp.int32, device=device)

    def launch(self):
        self.total.zero_()
        wp.launch(
            count_hits_kernel,
            dim=self.pair_count * self.face_count,
            inputs=[self.face_count, self.bvh.id, self.vertices, self.faces, self.poses, self.hits, self.total],
            device=self.device,
        )
