"""What a Warp user writes today: one thread a face of A, a wp.Bvh over the faces of B, wp.intersect_tri_tri.

A baseline for time only: its triangle test has an absolute epsilon and invents pairs on fine meshes.
"""

import numpy as np
import warp as wp

from .timing import time_in_turn

wp.set_module_options({"enable_backward": False})

CONSTRUCTORS = ("sah", "median", "lbvh", "cubql")


@wp.func
def place_face(
    pair: wp.int32,
    a: wp.int32,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    poses: wp.array(dtype=wp.transform),
):
    """Return the corners of a face of object 2 `pair` in the frame of object 2 `pair` + 1."""
    relative = wp.transform_multiply(wp.transform_inverse(poses[2 * pair + 1]), poses[2 * pair])
    face = faces[a]
    p = wp.transform_point(relative, vertices[face[0]])
    q = wp.transform_point(relative, vertices[face[1]])
    r = wp.transform_point(relative, vertices[face[2]])
    return p, q, r


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
    p, q, r = place_face(pair, a, vertices, faces, poses)
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


@wp.kernel
def find_any_kernel(
    face_count: wp.int32,
    bvh: wp.uint64,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    poses: wp.array(dtype=wp.transform),
    any_inout: wp.array(dtype=wp.int32),
):
    """As `count_hits_kernel`, but a pair that is known to meet is left alone."""
    tid = wp.tid()
    pair = tid // face_count
    a = tid % face_count
    if any_inout[pair] != 0:
        return
    p, q, r = place_face(pair, a, vertices, faces, poses)
    query = wp.bvh_query_aabb(bvh, wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r)))
    b = wp.int32(0)
    while wp.bvh_query_next(query, b):
        if wp.intersect_tri_tri(p, q, r, vertices[faces[b][0]], vertices[faces[b][1]], vertices[faces[b][2]]) != 0:
            any_inout[pair] = 1
            return


@wp.kernel
def box_face_kernel(
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    lower_out: wp.array(dtype=wp.vec3),
    upper_out: wp.array(dtype=wp.vec3),
):
    tid = wp.tid()
    face = faces[tid]
    p = vertices[face[0]]
    q = vertices[face[1]]
    r = vertices[face[2]]
    lower_out[tid] = wp.min(p, wp.min(q, r))
    upper_out[tid] = wp.max(p, wp.max(q, r))


class BvhPeer:
    """The peer as an operator: allocates once, launches many times.

    Args:
        capacity: Face pairs that there is room for; 0 builds the tree only.
        constructor: One of `CONSTRUCTORS`, None for Warp's own choice.
    """

    def __init__(self, vertices, faces, poses, capacity, device, constructor="sah"):
        self.device = device
        self.face_count = len(faces)
        self.pair_count = len(poses) // 2
        self.vertices = wp.array(vertices, dtype=wp.vec3, device=device)
        self.faces = wp.array(faces, dtype=wp.vec3i, device=device)
        self.poses = wp.array(np.asarray(poses, np.float32), dtype=wp.transform, device=device)
        self.lower = wp.empty(self.face_count, dtype=wp.vec3, device=device)
        self.upper = wp.empty(self.face_count, dtype=wp.vec3, device=device)
        self._box()
        wp.synchronize_device(device)  # some constructors work on the host
        self.bvh = wp.Bvh(self.lower, self.upper, constructor=constructor)
        self.hits = wp.empty(capacity, dtype=wp.vec3i, device=device)
        self.total = wp.zeros(1, dtype=wp.int32, device=device)

    def _box(self):
        arrays = [self.vertices, self.faces, self.lower, self.upper]
        wp.launch(box_face_kernel, dim=self.face_count, inputs=arrays, device=self.device)

    def rebuild(self):
        """Box the faces and build the tree from scratch."""
        self._box()
        self.bvh.rebuild()

    def launch(self):
        self.total.zero_()
        wp.launch(
            count_hits_kernel,
            dim=self.pair_count * self.face_count,
            inputs=[self.face_count, self.bvh.id, self.vertices, self.faces, self.poses, self.hits, self.total],
            device=self.device,
        )

    def result(self) -> np.ndarray:
        """Return the rows found, int32 (k, 3), sorted. Waits for the device.

        Raises:
            RuntimeError: There was no room for all of them.
        """
        total = int(self.total.numpy()[0])
        if total > len(self.hits):
            raise RuntimeError(f"the peer found {total} face pairs, with room for {len(self.hits)}")
        rows = self.hits.numpy()[:total].reshape(-1, 3)
        return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]


class AnyPeer(BvhPeer):
    """The same for yes or no."""

    def __init__(self, vertices, faces, poses, device, constructor="sah"):
        super().__init__(vertices, faces, poses, 0, device, constructor)
        self.any = wp.zeros(self.pair_count, dtype=wp.int32, device=device)

    def launch(self):
        self.any.zero_()
        wp.launch(
            find_any_kernel,
            dim=self.pair_count * self.face_count,
            inputs=[self.face_count, self.bvh.id, self.vertices, self.faces, self.poses, self.any],
            device=self.device,
        )

    def result(self) -> np.ndarray:
        """Return whether each pair meets, bool (p,). Waits for the device."""
        return self.any.numpy() != 0


def find_constructor(vertices, faces, poses, device, repeats=5) -> str:
    """Return the constructor whose tree answers fastest."""
    names = [name for name in CONSTRUCTORS if device.is_cuda or name != "lbvh"]  # on the CPU lbvh is sah
    launches = {}
    for name in names:
        try:
            launches[name] = BvhPeer(vertices, faces, poses, 0, device, name).launch
        except (RuntimeError, ValueError):  # not compiled in
            continue
    times = time_in_turn(launches, device, repeats)
    return min(times, key=lambda name: float(np.median(times[name])))


def count_differences(found, truth):
    """Return how many rows of face pairs (k, 3) are missed and how many invented; no row comes twice."""
    rows, kept = (np.asarray(x, np.int64).reshape(-1, 3) for x in (truth, found))
    base = 1 + max((int(x[:, 1:].max()) for x in (rows, kept) if len(x)), default=0)
    rows, kept = ((x[:, 0] * base + x[:, 1]) * base + x[:, 2] for x in (rows, kept))
    common = len(np.intersect1d(rows, kept, assume_unique=True))
    return len(rows) - common, len(kept) - common
