"""The progressive mesh: a collapse sequence, the vertex forest it makes, and a certified error for every LOD."""

from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import whole_number
from warp_abtree.kernels.progressive import collapse, hausdorff_bound, polygon, triangle_cover, vertex_forest
from warp_abtree.kernels.progressive.heap import Heap
from warp_abtree.kernels.progressive.quadric import Quadric

# Merges, and triangles covered by the error bound, per launch of a serial kernel.
MERGES, COVERS = 25_000, 200_000
# Entries of the heap at first: for each edge, and beyond these.
HEAP_PER_EDGE, HEAP_EXTRA = 2, 256
# Slots of faces that cover triangles together: for each face, and beyond these. None left loosens bounds only.
SLOTS_PER_FACE, SLOTS_EXTRA = 3, 4096
NODE_LIMIT = 1 << 30  # a heap entry holds two node ids and a stage in 64 bits

# Error of a bound by rounding, in units of the frame (coordinates about 1/2, so 2^-54 each): reading the vertices of
# both surfaces, a closest point of some ten operations, and the points of at most 64 cuts by three planes each, every
# one within 2^-52 a coordinate of the segment that it cuts: 192 sqrt(3) 2^-52 and a little, under 2^-43.
ROUNDING = 2.0**-43


@dataclass(frozen=True)
class ProgressiveMesh:
    """A mesh at every level of detail; `lod` counts vertex splits, 0 at the base and m at the original.

    Nodes 0..n_v-1 of the forest are the original vertices, node n_v+j is made by merge j; at `lod` the merges
    0..m-lod-1 are applied, and split i undoes merge m-1-i.

    Attributes:
        vertex_parent: Node that each node merges into, -1 at a root, shape [n_v+m].
        vertex_pos: Positions [model units], shape [n_v+m, 3]; the first n_v are the original's, to the bit.
        face_vertex: Original faces, shape [n_f, 3].
        face_split: Face f is active iff lod >= face_split[f], m+1 for dropped faces; shape [n_f].
        split_start: Where each split's slice of `split_face` begins, shape [m+1].
        split_face: Slice i lists, ascending, every face that split i inserts or deforms.
        lod_error: Certified bound [model units] on the distance of any point of the original surface from the
            surface at each LOD, shape [m+1]; falls with lod, 0 at m.
    """

    vertex_parent: np.ndarray
    vertex_pos: np.ndarray
    face_vertex: np.ndarray
    face_split: np.ndarray
    split_start: np.ndarray
    split_face: np.ndarray
    lod_error: np.ndarray

    @property
    def lod_max(self):
        """Return m, the LOD of the original mesh."""
        return len(self.split_start) - 1

    @property
    def vertex_count(self):
        """Return n_v, the number of original vertices."""
        return len(self.vertex_parent) - self.lod_max

    @property
    def face_count(self):
        """Return n_f, the number of original faces, dropped ones included."""
        return len(self.face_vertex)

    @cached_property
    def _active_counts(self):
        return np.cumsum(np.bincount(self.face_split, minlength=self.lod_max + 2)[: self.lod_max + 1])

    def active_count(self, lod):
        """Count the active faces at a LOD, or at each of an array of LODs; raise ValueError outside 0..m."""
        lods = np.asarray(lod)
        if not np.issubdtype(lods.dtype, np.integer):
            raise ValueError(f"lod must be an integer, got {lod!r}")
        if np.any(lods < 0) or np.any(lods > self.lod_max):
            raise ValueError(f"lod must lie in 0..{self.lod_max}, got {lod}")
        counts = self._active_counts[lods]
        return int(counts) if lods.ndim == 0 else counts

    def active_vertices(self, lod):
        """Return the active ancestor of every original vertex at a LOD, int32 [n_v]; raise ValueError outside 0..m."""
        self.active_count(lod)
        limit = self.vertex_count + self.lod_max - int(lod)
        node = np.arange(limit, dtype=np.int32)
        parent = self.vertex_parent[:limit]
        inner = (parent >= 0) & (parent < limit)
        node[inner] = parent[inner]
        # pointer doubling: the forest's depth in its logarithm of rounds
        while True:
            above = node[node]
            if np.array_equal(above, node):
                return node[: self.vertex_count].copy()
            node = above

    def mesh_at(self, lod):
        """Return the surface at a LOD: used vertices float64 [v, 3], faces int32 [f, 3], face ids int32 [f].

        Faces are in the order of the original, and so are the vertices at m. Raises ValueError outside 0..m.
        """
        active = self.active_vertices(lod)
        face_ids = np.flatnonzero(self.face_split <= lod).astype(np.int32)
        corners = active[self.face_vertex[face_ids]]
        if lod == self.lod_max:
            return self.vertex_pos[: self.vertex_count].copy(), corners, face_ids
        used, faces = np.unique(corners, return_inverse=True)
        return self.vertex_pos[used], faces.reshape(-1, 3).astype(np.int32), face_ids

    def lod_for(self, fraction=None, tolerance=None):
        """Return the LOD whose active count is nearest to a fraction of the faces, the finer of equals; or the coarsest
        whose `lod_error` is within a tolerance. See `Model.lod_for`."""
        if (fraction is None) == (tolerance is None):
            raise ValueError("lod_for takes exactly one of fraction= and tolerance=")
        if tolerance is not None:
            if not (isinstance(tolerance, Real) and float(tolerance) >= 0):
                raise ValueError(f"tolerance must be >= 0, got {tolerance!r}")
            return int(np.argmax(self.lod_error <= tolerance))
        if not (isinstance(fraction, Real) and 0 < float(fraction) <= 1):
            raise ValueError(f"fraction must lie in (0, 1], got {fraction!r}")
        miss = np.abs(self._active_counts - fraction * self.face_count)
        return int(self.lod_max - np.argmin(miss[::-1]))


def build_progressive(mesh, base_faces=10, progress=None):
    """Collapse a `Mesh` to a base of about `base_faces` faces and certify the error of every LOD on the way.

    The sequence for a larger base is a prefix of that for a smaller one, and does not depend on the mesh's scale by
    powers of two. It stops early only where every further merge would kill the last face.

    Args:
        base_faces: Stop when no more faces than this are left, >= 1.
        progress: Called as progress(stage, done, total) between launches; stages "collapse" and "LOD bounds".

    Raises ValueError where base_faces is no whole number from 1, or the mesh has 2^29 vertices or 2^31 / 3 faces.

    Source: Garland and Heckbert 1997 (collapse).
    """
    whole_number(base_faces, "base_faces", 1, 2**62)
    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces)
    if 2 * len(vertices) >= NODE_LIMIT or 3 * len(faces) >= 2**31:
        raise ValueError(f"too large: {len(vertices)} vertices and {len(faces)} faces")
    report = progress if progress is not None else lambda stage, done, total: None
    centre, scale = find_frame(vertices)
    parent, pos = _collapse((vertices - centre) / scale, faces, int(base_faces), report)
    vertex_pos = np.concatenate([vertices, centre + scale * pos[len(vertices) :]])
    face_split, split_start, split_face = _splits(parent, faces, len(vertices))
    lod_error = _bound_errors(vertex_pos, parent, faces, report)
    return ProgressiveMesh(parent, vertex_pos, faces, face_split, split_start, split_face, lod_error)


def _distinct(faces):
    return (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])


def find_frame(vertices):
    """Return the centre and a power of two that bounds the extent, so that scaling back and forth rounds nothing."""
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    extent = float(np.max(upper / 2 - lower / 2))
    exponent = np.frexp(extent)[1] + 1 if extent > 0 else 0
    return lower / 2 + upper / 2, float(np.ldexp(1.0, int(np.clip(exponent, -1000, 1000))))


def _edges(faces):
    """Return the packed edges of the faces with three corners, ascending, and which corners start a boundary edge."""
    valid = _distinct(faces)
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    pair = (np.minimum(start, end) << 32) | (np.maximum(start, end) << 2)
    slot = np.flatnonzero(np.repeat(valid, 3))
    pair = pair.reshape(-1)[slot]
    order = np.argsort(pair)
    pair = pair[order]
    first = np.flatnonzero(np.concatenate([[True], pair[1:] != pair[:-1]]))
    single = np.diff(np.append(first, len(pair))) == 1
    boundary = np.zeros(faces.size, dtype=np.int8)
    boundary[slot[order[first[single]]]] = 1
    return pair[first], boundary.reshape(faces.shape)


def cpu_array(values, dtype):
    """Return a Warp array on the CPU."""
    return wp.array(values, dtype=dtype, device="cpu")


def _filled(count, value):
    return wp.full(count, value, dtype=int, device="cpu")


def _zeros(shape, dtype):
    return wp.zeros(shape, dtype=dtype, device="cpu")


def _launch(kernel, *inputs):
    wp.launch(kernel, dim=1, inputs=inputs, device="cpu")


def _linked_rings(faces, face_array, node_capacity):
    """Return `vertex_forest.Rings` of the original mesh with room for `node_capacity` nodes."""
    rings = vertex_forest.Rings()
    rings.head, rings.degree = _filled(node_capacity, -1), _filled(node_capacity, 0)
    rings.next, rings.corner_node = _filled(3 * len(faces), -1), _filled(3 * len(faces), -1)
    _launch(vertex_forest.link_rings_kernel, len(faces), face_array, rings)
    return rings


def _collapse(pos, faces, base_faces, report):
    """Run the collapse; return vertex_parent int32 [n_v+m] and all normalised positions float64 [n_v+m, 3]."""
    vertex_count, capacity = len(pos), 2 * len(pos)
    edges, boundary = _edges(faces)
    face_array = cpu_array(faces, int)
    surface = collapse.Surface()
    surface.pos = cpu_array(np.concatenate([pos, np.zeros_like(pos)]), wp.vec3d)
    surface.quadric = _zeros(capacity, Quadric)
    surface.parent, surface.stamp = _filled(capacity, -1), _filled(capacity, -1)
    rings = _linked_rings(faces, face_array, capacity)
    _launch(collapse.weigh_faces_kernel, len(faces), face_array, cpu_array(boundary, wp.int8), surface)
    heap, size = Heap(), len(edges)
    room = HEAP_PER_EDGE * size + HEAP_EXTRA
    heap.pair = cpu_array(np.resize(edges, room), wp.int64)
    heap.key = _zeros(room, wp.float64)
    _launch(collapse.price_edges_kernel, size, heap.pair, surface, heap.key)
    start_live = int(_distinct(faces).sum())
    counter = cpu_array(np.array([size, 0, start_live, collapse.RUNNING], dtype=np.int32), int)
    _launch(collapse.compact_heap_kernel, surface, heap, counter)
    state = counter.numpy()  # shares the memory
    goal = max(start_live - base_faces, 1)
    while state[3] != int(collapse.FINISHED):
        if state[3] == int(collapse.HEAP_FULL):
            heap = _roomier_heap(surface, heap, counter)
        limits = [vertex_count, base_faces, MERGES, len(heap.key)]
        _launch(collapse.collapse_edges_kernel, *limits, surface, rings, heap, counter)
        report("collapse", min(start_live - int(state[2]), goal), goal)
    nodes = vertex_count + int(state[1])
    return surface.parent.numpy()[:nodes].copy(), surface.pos.numpy()[:nodes]


def _roomier_heap(surface, heap, counter):
    """Drop stale entries; return a larger heap if more than three quarters or the next merge's edges do not fit."""
    before = int(counter.numpy()[0])
    _launch(collapse.compact_heap_kernel, surface, heap, counter)
    size, capacity = int(counter.numpy()[0]), len(heap.key)
    if 4 * size <= 3 * capacity < 4 * before:
        return heap
    larger, room = Heap(), capacity + capacity // 2 + 64
    larger.key, larger.pair = _zeros(room, wp.float64), _zeros(room, wp.int64)
    wp.copy(larger.key, heap.key, count=size)
    wp.copy(larger.pair, heap.pair, count=size)
    return larger


def _splits(parent, faces, vertex_count):
    """Return face_split int32 [n_f], split_start int64 [m+1] and split_face int32 of a forest."""
    node_count = len(parent)
    merge_count = node_count - vertex_count
    face_array, parent_array = cpu_array(faces, int), cpu_array(parent, int)
    size = _zeros(merge_count + 1, wp.int64)
    face_split = _zeros(len(faces), int)
    _launch(vertex_forest.count_events_kernel, vertex_count, node_count, face_array, parent_array, size, face_split)
    split_start = np.concatenate([[0], np.cumsum(size.numpy()[:merge_count])]).astype(np.int64)
    split_face = _zeros(int(split_start[-1]), int)
    cursor = cpu_array(split_start.copy(), wp.int64)
    _launch(vertex_forest.fill_events_kernel, node_count, face_array, parent_array, cursor, split_face)
    return face_split.numpy(), split_start, split_face.numpy()


def make_scratch(candidates, faces, rows):
    """Return `polygon.Scratch` for so many candidate faces, covering faces and polygons on the stack."""
    scratch, corners = polygon.Scratch(), int(polygon.CORNERS)
    scratch.near, scratch.used = _filled(candidates, 0), _filled(faces, 0)
    scratch.stack, scratch.stack_count = _zeros((rows, corners), wp.vec3d), _filled(rows, 0)
    scratch.polygon, scratch.clipped = _zeros(corners, wp.vec3d), _zeros(corners, wp.vec3d)
    return scratch


def _bound_errors(vertex_pos, parent, faces, report):
    """Return lod_error float64 [m+1]."""
    centre, scale = find_frame(vertex_pos[np.unique(faces)])
    child = np.flatnonzero(parent >= 0)
    merge_count, face_count = len(child) // 2, len(faces)  # every merge has exactly two children
    if merge_count == 0:
        return np.zeros(1)
    pair = child[np.argsort(parent[child], kind="stable")].reshape(-1, 2)
    face_array = cpu_array(faces, int)
    replay = _replay((vertex_pos - centre) / scale, face_count)
    replay.rings = _linked_rings(faces, face_array, len(parent))
    _launch(hausdorff_bound.start_replay_kernel, face_count, face_array, replay)
    bound_sq = _zeros(merge_count, wp.float64)
    inputs = [len(parent) - merge_count, merge_count, COVERS, cpu_array(pair, int)]
    state = replay.counter.numpy()  # shares the memory
    while state[0] < merge_count:
        _launch(hausdorff_bound.replay_merges_kernel, *inputs, replay, bound_sq)
        if state[5] < 0:
            bvh = _index(replay)
            replay.bvh, state[5] = bvh.id, state[1]
        report("LOD bounds", int(state[0]), merge_count)
    error = scale * (np.sqrt(bound_sq.numpy()) + ROUNDING)
    return np.append(error[::-1], 0.0)


def _replay(pos, face_count):
    replay = triangle_cover.Replay()
    replay.counter = _filled(6, 0)
    replay.scratch = make_scratch(face_count, triangle_cover.SLOTS, polygon.STACK)
    replay.pos = cpu_array(pos, wp.vec3d)
    replay.triangle_pos, replay.face_pos = _zeros((face_count, 3), wp.vec3d), _zeros((face_count, 3), wp.vec3d)
    replay.face_box = _zeros((face_count, 2), wp.vec3d)
    for name in ("face_slot", "face_stamp", "triangle_stamp", "queue", "queue_face"):
        setattr(replay, name, _filled(face_count, -1))
    pooled = SLOTS_PER_FACE * face_count + SLOTS_EXTRA
    for name in ("slot_face", "slot_triangle", "slot_sibling", "slot_next", "slot_last"):
        setattr(replay, name, _filled(face_count + pooled, -1))
    replay.free_slot = _filled(pooled, 0)
    replay.bvh_face = _filled(1, 0)
    return replay


def _index(replay):
    """Return a wp.Bvh over the active faces, for triangles whose connected component vanishes."""
    active = np.flatnonzero(replay.rings.corner_node.numpy()[::3] >= 0).astype(np.int32)
    corners = replay.face_pos.numpy()[active]
    lower, upper = corners.min(axis=1).astype(np.float32), corners.max(axis=1).astype(np.float32)
    replay.bvh_face = cpu_array(active, int)
    return wp.Bvh(cpu_array(lower, wp.vec3), cpu_array(upper, wp.vec3))
