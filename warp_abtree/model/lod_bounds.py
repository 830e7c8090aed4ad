"""Certified errors of LODs: inward ones by a replay of the collapse, beside it or later, outward ones on demand."""

from functools import cached_property

import numpy as np
import warp as wp

from warp_abtree.checks.kernel_loading import loading
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.build import hausdorff_bound, outward_bound, polygon, triangle_cover
from warp_abtree.model.cpu_arrays import cpu_array, filled, find_frame, launch, linked_rings, make_scratch, unwritten

# Triangles covered per launch, about.
COVERS = 200_000
# Pooled slots for each face, and beyond these; an empty pool loosens bounds only.
SLOTS_PER_FACE, SLOTS_EXTRA = 3, 4096

# Error of a bound by rounding, in units of the frame (coordinates about 1/2, so 2^-54 each): reading the vertices of
# both surfaces, a closest point of some ten operations, and the points of at most 64 cuts by three planes each, every
# one within 2^-52 a coordinate of the segment that it cuts: 192 sqrt(3) 2^-52 and a little, under 2^-43. The parts of a
# face that outward bounds cut cover it up to the same distance, after 192 nested cuts.
ROUNDING = 2.0**-43

# With the threads of a block, as `loading` takes them.
ERROR_KERNELS = [(hausdorff_bound.replay_merges_kernel, 1)]


def certify_errors(vertices, faces, parent, merged):
    """Return the certified errors of all LODs [model units], float64 [m+1], of a forest and the positions it merges to.

    The forest is vertex_parent, int32 [n_v+m]; positions of the nodes that merges make [model units], float64 [m, 3].
    """
    with loading(wp.get_device("cpu"), ERROR_KERNELS):
        bounds = LodBounds(vertices, faces)
        # The two nodes of each merge, the lower one first.
        nodes = np.flatnonzero(parent >= 0).astype(np.int32)
        bounds.add(nodes[np.argsort(parent[nodes], kind="stable")].reshape(-1, 2), merged)
    while bounds.done < len(merged):
        bounds.advance()
    return bounds.errors()


class LodBounds:
    """Bounds on the distance of any point of the original surface from the surface after each merge.

    Attributes:
        replay: The surface after those that are bounded, and which faces cover which original triangles.
    """

    def __init__(self, vertices, faces):
        self._vertex_count, face_count = len(vertices), len(faces)
        used = np.zeros(len(vertices), dtype=bool)
        used[faces] = True
        self._centre, self._scale = find_frame(vertices[used])
        face_array = cpu_array(faces, int)
        self._pos = np.zeros((2 * len(vertices), 3))
        self._pos[: len(vertices)] = (vertices - self._centre) / self._scale
        self.replay = _new_replay(self._pos, face_count)
        self.replay.rings = linked_rings(face_array, 2 * len(vertices))
        launch(hausdorff_bound.start_replay_kernel, face_count, face_array, self.replay)
        self._covers, rows = triangle_cover.Covers(), triangle_cover.COVERS_AT_ONCE
        self._covers.triangle, self._covers.first = self.replay.queue, self.replay.queue_face
        self._covers.near, self._covers.count = self.replay.scratch.near, filled(rows, 0)
        self._covers.face = filled((rows, triangle_cover.SLOTS), 0)
        self._covers.limit = wp.zeros(rows, dtype=wp.float64, device="cpu")
        self._pair = filled((len(vertices), 2), 0)
        self._bound_sq = wp.zeros(len(vertices), dtype=wp.float64, device="cpu")
        self._state = self.replay.counter.numpy()  # shares the memory
        self._known = 0

    @property
    def done(self):
        """Merges that are bounded."""
        return int(self._state[0])

    def add(self, pair, merged):
        """Take the next merges: their nodes int32 [k, 2], and the positions that they make [model units], [k, 3]."""
        begin, end = self._known, self._known + len(pair)
        self._pair.numpy()[begin:end] = pair
        self._pos[self._vertex_count + begin : self._vertex_count + end] = (merged - self._centre) / self._scale
        self._known = end

    def advance(self):
        """Bound some of the merges that are known, one after the other."""
        inputs = [self._vertex_count, self._known, COVERS, self._pair, self.replay, self._covers, self._bound_sq]
        launch(hausdorff_bound.replay_merges_kernel, *inputs)
        if self._state[5] < 0:
            bvh = _index(self.replay)
            self.replay.bvh, self._state[5] = bvh.id, self._state[1]
            self._bvh = bvh  # lives as long as it is asked

    def errors(self):
        """Return lod_error, float64 [m+1]."""
        error = self._scale * (np.sqrt(self._bound_sq.numpy()[: self._known]) + ROUNDING)
        return np.append(error[::-1], 0.0)


def _new_replay(pos, face_count):
    replay = triangle_cover.Replay()
    replay.counter = filled(6, 0)
    replay.scratch = make_scratch(face_count, triangle_cover.SLOTS, polygon.STACK)
    replay.pos = wp.array(pos, dtype=wp.vec3d, device="cpu", copy=False)
    for name, corners in (("triangle_pos", 3), ("face_pos", 3), ("face_box", 2)):
        setattr(replay, name, unwritten((face_count, corners), wp.vec3d))
    replay.queue, replay.queue_face = unwritten(face_count), unwritten(face_count)
    replay.face_slot, replay.face_stamp = filled(face_count, -1), filled(face_count, -1)
    pooled = SLOTS_PER_FACE * face_count + SLOTS_EXTRA
    replay.slot = unwritten((face_count + pooled, triangle_cover.SLOT_FIELDS))
    replay.free_slot = unwritten(pooled)
    replay.bvh_face = filled(1, 0)
    return replay


def _index(replay):
    """Return a wp.Bvh over the active faces, for triangles whose connected component vanishes."""
    node = replay.rings.corner_node.numpy().reshape(-1, 3)
    active = np.flatnonzero(node[:, 0] >= 0).astype(np.int32)
    corners = replay.pos.numpy()[node[active]]
    lower, upper = corners.min(axis=1).astype(np.float32), corners.max(axis=1).astype(np.float32)
    replay.bvh_face = cpu_array(active, int)
    return wp.Bvh(cpu_array(lower, wp.vec3), cpu_array(upper, wp.vec3))


class OutwardError:
    """Bounds on the distance of any point of the surface at a LOD from the original surface, computed on demand.

    Caches its results and, from the first call on, about 120 bytes for each face of the original; neither is pickled.
    """

    def __init__(self, progressive, tree):
        self.progressive, self.tree = progressive, tree
        self._found: dict[int, float] = {}

    def __getstate__(self):
        return {"progressive": self.progressive, "tree": self.tree, "_found": {}}

    def at(self, lod: int) -> float:
        """Return the bound [model units] at a LOD; 0 where every active face lies where it does in the original."""
        if lod not in self._found:
            self._found[lod] = self._bound(lod)
        return self._found[lod]

    def _bound(self, lod):
        progressive = self.progressive
        vertices, faces, face_ids = progressive.mesh_at(lod)
        moved = (vertices[faces] != progressive.vertex_pos[progressive.face_vertex[face_ids]]).any((1, 2))
        if not moved.any():
            return 0.0
        faces, face_ids = faces[moved], face_ids[moved]
        centre, scale, original = self._index
        vertices = (vertices - centre) / scale
        corner = vertices[faces]
        # Corners and middles first: a face whose bound is below their greatest distance is not cut.
        used, first = np.unique(faces, return_index=True)
        point = np.concatenate([vertices[used], corner.mean(1)])
        guess = np.concatenate([face_ids[first // 3], face_ids])
        distance_sq = wp.zeros(len(point), dtype=wp.float64, device="cpu")
        inputs = [cpu_array(point, wp.vec3d), cpu_array(guess, int), original, distance_sq]
        wp.launch(outward_bound.measure_points_kernel, dim=len(point), inputs=inputs, device="cpu")
        bound_sq, rows = wp.zeros(len(corner), dtype=wp.float64, device="cpu"), outward_bound.ROWS
        inputs = [float(distance_sq.numpy().max()), cpu_array(corner, wp.vec3d), cpu_array(face_ids, int), original]
        launch(outward_bound.bound_faces_kernel, *inputs, make_scratch(1, 1, rows), filled(rows, 0), bound_sq)
        # ROUNDING is of coordinates up to 1/2; merged vertices may lie outside the box of the original ones.
        reach = max(1.0, 2 * float(np.abs(point).max()))
        return float(scale * (np.sqrt(bound_sq.numpy().max()) + ROUNDING * reach))

    @cached_property
    def _index(self):
        """Return the frame, and in it the original faces with a box for each node of the tree."""
        progressive, tree = self.progressive, self.tree
        centre, scale = find_frame(progressive.vertex_pos[: progressive.vertex_count])
        corner = (progressive.vertex_pos[progressive.face_vertex] - centre) / scale
        there = progressive.face_split <= progressive.lod_max
        # the next float32, whichever way the conversion rounded
        lower = np.nextafter(corner[there].min(1).astype(np.float32), np.float32(-np.inf))
        upper = np.nextafter(corner[there].max(1).astype(np.float32), np.float32(np.inf))
        lower, upper = tree.node_boxes(there, lower, upper)
        boxes = {"node_lower": lower, "node_upper": upper, "node_face": tree.node_face}
        return centre, scale, struct_of(outward_bound.Original, "cpu", face_pos=corner, **boxes)
