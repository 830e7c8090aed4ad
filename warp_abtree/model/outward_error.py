"""The outward error of a LOD: a certified bound on the distance of its surface from the original, computed on demand.

Rounding. A cut moves a corner of a polygon by at most sqrt(3) 2^-52 in a frame where coordinates are within 1/2; the
parts then cover the polygon up to that distance, and after 192 nested cuts they cover the face up to 192 times that.
Distances of corners are measured to points of original faces, both rounded. `lod_bounds.ROUNDING` covers all of it.
"""

from functools import cached_property

import numpy as np
import warp as wp

from warp_abtree.kernels.build import outward_bound
from warp_abtree.model.cpu_arrays import cpu_array, find_frame, make_scratch
from warp_abtree.model.lod_bounds import ROUNDING


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
        bound_sq = wp.zeros(len(corner), dtype=wp.float64, device="cpu")
        inputs = [float(distance_sq.numpy().max()), cpu_array(corner, wp.vec3d), cpu_array(face_ids, int), original]
        rows = outward_bound.ROWS
        inputs += [make_scratch(1, 1, rows), wp.zeros(rows, dtype=int, device="cpu"), bound_sq]
        wp.launch(outward_bound.bound_faces_kernel, dim=1, inputs=inputs, device="cpu")
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
        original = outward_bound.Original()
        original.face_pos = cpu_array(corner, wp.vec3d)
        original.node_lower, original.node_upper = cpu_array(lower, wp.vec3), cpu_array(upper, wp.vec3)
        original.node_face = cpu_array(tree.node_face, int)
        return centre, scale, original
