"""Baseline of Warp alone, tuned: one thread a face of A, a wp.Bvh over the faces of B, wp.intersect_tri_tri.

Tuned: one relative pose a pair, corners face by face, faces along a Morton curve so that neighbouring threads walk
alike, 64 threads a block, and the constructor that answers fastest (`find_constructor`). A baseline for time only: its
triangle test has an absolute epsilon and invents pairs on fine meshes.
"""

import contextlib
import functools

import numpy as np
import warp as wp

from ..timing import medians, time_in_turn

wp.set_module_options({"enable_backward": False})
CONSTRUCTORS = ("sah", "median", "lbvh", "cubql")
BLOCK_THREADS = 64
TUNED = 64  # pairs that the constructor is chosen for
MORTON_BITS = 10  # of each coordinate


@wp.struct
class BvhPairs:
    """Posed pairs of a mesh with itself."""

    face_count: wp.int32
    bvh: wp.uint64  # over the faces
    corners: wp.array(dtype=wp.vec3)  # three a face, (3 f,)
    poses: wp.array(dtype=wp.transform)  # of objects, (2 p,)
    relative: wp.array(dtype=wp.transform)  # of each pair, A's frame to B's, (p,)


@wp.kernel
def relate_kernel(asked_inout: BvhPairs):
    p = wp.tid()
    asked_inout.relative[p] = wp.transform_inverse(asked_inout.poses[2 * p + 1]) * asked_inout.poses[2 * p]


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
        relative = asked.relative[pair]
        p = wp.transform_point(relative, asked.corners[3 * a])
        q = wp.transform_point(relative, asked.corners[3 * a + 1])
        r = wp.transform_point(relative, asked.corners[3 * a + 2])
        query = wp.bvh_query_aabb(asked.bvh, wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r)))
        b = wp.int32(0)
        while wp.bvh_query_next(query, b):
            u = asked.corners[3 * b]
            if wp.intersect_tri_tri(p, q, r, u, asked.corners[3 * b + 1], asked.corners[3 * b + 2]) != 0:
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
    i = wp.tid()
    p = asked.corners[3 * i]
    q = asked.corners[3 * i + 1]
    r = asked.corners[3 * i + 2]
    lower_out[i] = wp.min(p, wp.min(q, r))
    upper_out[i] = wp.max(p, wp.max(q, r))


def morton_order(points) -> np.ndarray:
    """Return the order of points (n, 3) along a Morton curve."""
    low, size = points.min(0), max(np.ptp(points, axis=0).max(), 1e-30)
    cell = ((points - low) / size * (2**MORTON_BITS - 1)).astype(np.int64)
    bit, axis = np.meshgrid(np.arange(MORTON_BITS), np.arange(3))
    code = ((cell[:, :, None] >> bit & 1) << (3 * bit + axis)).sum((1, 2))
    return np.argsort(code, kind="stable")


class FaceBvh:
    """A wp.Bvh over the faces of a mesh, by one of `CONSTRUCTORS`; None is Warp's own choice."""

    def __init__(self, vertices, faces, device, constructor=None):
        self.device = wp.get_device(device)
        corners = np.asarray(vertices, np.float32)[faces]
        self.face = morton_order(corners.mean(1))
        self.asked = BvhPairs()
        self.asked.corners = wp.array(corners[self.face].reshape(-1, 3), dtype=wp.vec3, device=device)
        self.asked.face_count = len(self.face)
        self.boxes = [wp.empty(len(faces), dtype=wp.vec3, device=device) for _ in range(2)]
        self.bvh = None
        self.rebuild()
        wp.synchronize_device(device)  # some constructors work on the host
        self.bvh = wp.Bvh(*self.boxes, constructor=constructor)
        self.asked.bvh = self.bvh.id

    def rebuild(self):
        """Box the faces and build the tree from scratch."""
        wp.launch(box_face_kernel, dim=len(self.face), inputs=[self.asked, *self.boxes], device=self.device)
        if self.bvh is not None:
            self.bvh.rebuild()


class BvhPosed(FaceBvh):
    """All face pairs of posed pairs, with room for `capacity`; or yes or no, where that is None.

    Without a constructor it takes the one that answers fastest.
    """

    def __init__(self, vertices, faces, poses, capacity, device, constructor=None):
        self.constructor = constructor or find_constructor(vertices, faces, poses[: 2 * TUNED], device)
        super().__init__(vertices, faces, device, self.constructor)
        self.yes_no = capacity is None
        self.pair_count = len(poses) // 2
        self.asked.poses = wp.array(np.asarray(poses, np.float32), dtype=wp.transform, device=device)
        self.asked.relative = wp.empty(self.pair_count, dtype=wp.transform, device=device)
        self.hits = wp.empty(capacity or 0, dtype=wp.vec3i, device=device)
        self.found = wp.zeros(self.pair_count if self.yes_no else 1, dtype=wp.int32, device=device)

    def launch(self):
        self.found.zero_()
        wp.launch(relate_kernel, self.pair_count, inputs=[self.asked], device=self.device)
        kernel, threads = find_kernel(self.yes_no), self.pair_count * self.asked.face_count
        inputs = [self.asked, self.hits, self.found]
        wp.launch(kernel, threads, inputs=inputs, block_dim=BLOCK_THREADS, device=self.device)

    def result(self) -> np.ndarray:
        """Return the rows found, int32 (k, 3), sorted; or whether each pair intersects, bool (p,)."""
        if self.yes_no:
            return self.found.numpy() != 0
        total = int(self.found.numpy()[0])
        if total > len(self.hits):
            raise RuntimeError(f"the wp.Bvh baseline found {total} face pairs, with room for {len(self.hits)}")
        rows = self.hits.numpy()[:total].reshape(-1, 3)
        rows = np.stack([rows[:, 0], self.face[rows[:, 1]], self.face[rows[:, 2]]], 1).astype(np.int32)
        return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]


def find_constructor(vertices, faces, poses, device) -> str:
    """Return the constructor whose tree answers fastest."""
    launches = {}
    for name in CONSTRUCTORS:
        if name == "lbvh" and device.is_cpu:  # there it is sah
            continue
        with contextlib.suppress(RuntimeError, ValueError):  # not compiled in
            launches[name] = BvhPosed(vertices, faces, poses, 0, device, name).launch
    times = medians(time_in_turn(launches, device, repeats=5))
    return min(times, key=times.get)
