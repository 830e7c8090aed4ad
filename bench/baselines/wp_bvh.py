"""What a Warp user writes today: one thread a face of A, a wp.Bvh over the faces of B, wp.intersect_tri_tri.

A baseline for time only: its triangle test has an absolute epsilon and invents pairs on fine meshes.
"""

import functools

import numpy as np
import warp as wp

from ..timing import medians, time_in_turn

wp.set_module_options({"enable_backward": False})

CONSTRUCTORS = ("sah", "median", "lbvh", "cubql")


@wp.struct
class BvhPairs:
    """Posed pairs of meshes."""

    face_count: wp.int32  # of A
    vertices_a: wp.array(dtype=wp.vec3)  # (v,)
    faces_a: wp.array(dtype=wp.vec3i)  # (f,)
    bvh: wp.uint64  # over the faces of B
    vertices: wp.array(dtype=wp.vec3)  # of B, (v,)
    faces: wp.array(dtype=wp.vec3i)  # of B, (f,)
    poses: wp.array(dtype=wp.transform)  # of objects, (2 p,)


@wp.func
def place_face(asked: BvhPairs, pair: wp.int32, a: wp.int32):
    """Return the corners of a face of object 2 `pair` in the frame of object 2 `pair` + 1."""
    relative = wp.transform_multiply(wp.transform_inverse(asked.poses[2 * pair + 1]), asked.poses[2 * pair])
    face = asked.faces_a[a]
    p = wp.transform_point(relative, asked.vertices_a[face[0]])
    q = wp.transform_point(relative, asked.vertices_a[face[1]])
    r = wp.transform_point(relative, asked.vertices_a[face[2]])
    return p, q, r


@functools.cache
def find_kernel(yes_no):
    """Return the kernel that lists face pairs and counts them, int32 (1,); or that answers yes or no, int32 (p,), and
    leaves a pair alone once it is known to intersect."""

    @wp.kernel(module="unique", enable_backward=False)
    def find_faces_kernel(asked: BvhPairs, hits_out: wp.array(dtype=wp.vec3i), found_inout: wp.array(dtype=wp.int32)):
        tid = wp.tid()
        pair = tid // asked.face_count
        a = tid % asked.face_count
        if wp.static(yes_no):
            if found_inout[pair] != 0:
                return
        p, q, r = place_face(asked, pair, a)
        query = wp.bvh_query_aabb(asked.bvh, wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r)))
        b = wp.int32(0)
        while wp.bvh_query_next(query, b):
            face = asked.faces[b]
            u = asked.vertices[face[0]]
            v = asked.vertices[face[1]]
            w = asked.vertices[face[2]]
            if wp.intersect_tri_tri(p, q, r, u, v, w) != 0:
                if wp.static(yes_no):
                    found_inout[pair] = 1
                    return
                else:
                    slot = wp.atomic_add(found_inout, 0, 1)
                    if slot < hits_out.shape[0]:
                        hits_out[slot] = wp.vec3i(pair, a, b)

    return find_faces_kernel


@wp.kernel
def box_face_kernel(asked: BvhPairs, lower_out: wp.array(dtype=wp.vec3), upper_out: wp.array(dtype=wp.vec3)):
    tid = wp.tid()
    face = asked.faces[tid]
    p = asked.vertices[face[0]]
    q = asked.vertices[face[1]]
    r = asked.vertices[face[2]]
    lower_out[tid] = wp.min(p, wp.min(q, r))
    upper_out[tid] = wp.max(p, wp.max(q, r))


class FaceBvh:
    """A wp.Bvh over the faces of a mesh.

    Args:
        constructor: One of `CONSTRUCTORS`, None for Warp's own choice.
        other: Vertices and faces of A, where it is another mesh.
    """

    def __init__(self, vertices, faces, device, constructor=None, other=None):
        self.device = wp.get_device(device)
        self.asked = BvhPairs()
        vertices_a, faces_a = other or (vertices, faces)
        self.asked.face_count = len(faces_a)
        self.asked.vertices_a = wp.array(vertices_a, dtype=wp.vec3, device=device)
        self.asked.faces_a = wp.array(faces_a, dtype=wp.vec3i, device=device)
        self.asked.vertices = wp.array(vertices, dtype=wp.vec3, device=device)
        self.asked.faces = wp.array(faces, dtype=wp.vec3i, device=device)
        self.lower, self.upper = (wp.empty(len(faces), dtype=wp.vec3, device=device) for _ in range(2))
        self._box()
        wp.synchronize_device(device)  # some constructors work on the host
        self.bvh = wp.Bvh(self.lower, self.upper, constructor=constructor)
        self.asked.bvh = self.bvh.id

    def _box(self):
        arrays = [self.asked, self.lower, self.upper]
        wp.launch(box_face_kernel, dim=len(self.lower), inputs=arrays, device=self.device)

    def rebuild(self):
        """Box the faces and build the tree from scratch."""
        self._box()
        self.bvh.rebuild()


class BvhFaces(FaceBvh):
    """All face pairs.

    Args:
        capacity: Face pairs that there is room for.
    """

    yes_no = False

    def __init__(self, vertices, faces, poses, capacity, device, constructor="sah", other=None):
        super().__init__(vertices, faces, device, constructor, other)
        self.pair_count = len(poses) // 2
        self.asked.poses = wp.array(np.asarray(poses, np.float32), dtype=wp.transform, device=device)
        self.hits = wp.empty(capacity, dtype=wp.vec3i, device=device)
        self.found = wp.zeros(self.pair_count if self.yes_no else 1, dtype=wp.int32, device=device)

    def launch(self):
        self.found.zero_()
        inputs = [self.asked, self.hits, self.found]
        wp.launch(find_kernel(self.yes_no), self.pair_count * self.asked.face_count, inputs, device=self.device)

    def result(self) -> np.ndarray:
        """Return the rows found, int32 (k, 3), sorted.

        Raises:
            RuntimeError: There was no room for all of them.
        """
        total = int(self.found.numpy()[0])
        if total > len(self.hits):
            raise RuntimeError(f"the wp.Bvh baseline found {total} face pairs, with room for {len(self.hits)}")
        rows = self.hits.numpy()[:total].reshape(-1, 3)
        return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]


class BvhAny(BvhFaces):
    """Yes or no."""

    yes_no = True

    def __init__(self, vertices, faces, poses, device, constructor="sah", other=None):
        super().__init__(vertices, faces, poses, 0, device, constructor, other)

    def result(self) -> np.ndarray:
        """Return whether each pair intersects, bool (p,)."""
        return self.found.numpy() != 0


def find_constructor(vertices, faces, poses, device, repeats=5, other=None) -> str:
    """Return the constructor whose tree answers fastest."""
    launches = {}
    for name in CONSTRUCTORS:
        if name == "lbvh" and device.is_cpu:  # there it is sah
            continue
        try:
            launches[name] = BvhFaces(vertices, faces, poses, 0, device, name, other).launch
        except (RuntimeError, ValueError):  # not compiled in
            continue
    times = medians(time_in_turn(launches, device, repeats))
    return min(times, key=times.get)
