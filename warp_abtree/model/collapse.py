"""The collapse sequence of a mesh: run in launches of so many merges, which another thread may follow.

Source: Garland and Heckbert 1997.
"""

import threading

import numpy as np
import warp as wp

from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.build import collapse
from warp_abtree.kernels.build.heap import Heap
from warp_abtree.kernels.build.quadric import Quadric
from warp_abtree.model.cpu_arrays import cpu_array, filled, find_frame, launch, linked_rings, unwritten
from warp_abtree.model.files.polygons import distinct_corners
from warp_abtree.model.winding import sorted_edges

# Merges per launch.
MERGES = 25_000
# Entries of the heap at first: for each edge, and beyond these.
HEAP_PER_EDGE, HEAP_EXTRA = 2, 256


class Collapse:
    """The collapse of a mesh.

    Attributes:
        frame: Centre and scale of normalised positions [model units].
        pos: Positions of all nodes, normalised, float64 [2 n_v, 3]; those of the merges that `follow` returned stand.
        pair: The two nodes of each merge, the lower one first, int32 [n_v, 2].
        goal: Faces to be removed.
    """

    def __init__(self, vertices, faces, base_faces):
        self.frame = centre, scale = find_frame(vertices)
        self.vertex_count, self.base_faces, self._faces = len(vertices), base_faces, faces
        self.pos = np.empty((2 * len(vertices), 3))
        np.divide(vertices - centre, scale, out=self.pos[: len(vertices)])
        self._merge_pair = unwritten((len(vertices), 2), wp.vec2i)
        self.pair = self._merge_pair.numpy()  # shares the memory
        self._start_live = int(distinct_corners(faces).sum())
        self.goal = max(self._start_live - base_faces, 1)
        self._state = np.zeros(4, np.int32)
        self._merges, self._removed, self._ended, self._stopped = 0, 0, False, False
        self._moved = threading.Condition()

    def _prepare(self):
        """Weigh the faces, and make a heap of all edges."""
        faces, nodes = self._faces, len(self.pos)
        edges, boundary = _edges(faces, self.vertex_count)
        face_array = cpu_array(faces, int)
        self._surface = surface = collapse.Surface()
        surface.pos = wp.array(self.pos, dtype=wp.vec3d, device="cpu", copy=False)
        surface.quadric = wp.zeros(nodes, dtype=Quadric, device="cpu")
        surface.parent, surface.stamp = filled(nodes, -1), filled(nodes, -1)
        self._rings = linked_rings(face_array, nodes)
        launch(collapse.weigh_faces_kernel, len(faces), face_array, cpu_array(boundary, wp.int8), surface)
        pairs = np.resize(edges, HEAP_PER_EDGE * len(edges) + HEAP_EXTRA)
        self._heap = struct_of(Heap, "cpu", pair=pairs, key=np.zeros(len(pairs)))
        launch(collapse.price_edges_kernel, len(edges), self._heap.pair, surface, self._heap.key)
        self._counter = cpu_array([len(edges), 0, self._start_live, collapse.RUNNING], int)
        launch(collapse.compact_heap_kernel, surface, self._heap, self._counter)
        self._state = self._counter.numpy()  # shares the memory

    def run(self):
        """Collapse to the base mesh, or until `stop`; return whether the base mesh was reached."""
        for _ in self.steps():
            pass
        return self._state[3] == int(collapse.FINISHED)

    def steps(self):
        """Do the same, and yield how many faces are removed after each launch."""
        try:
            self._prepare()
            while self._state[3] != int(collapse.FINISHED) and not self._stopped:
                if self._state[3] == int(collapse.HEAP_FULL):
                    self._make_room()
                limits = [self.vertex_count, self.base_faces, MERGES, len(self._heap.key)]
                changed = [self._surface, self._rings, self._heap, self._counter, self._merge_pair]
                launch(collapse.collapse_edges_kernel, *limits, *changed)
                self._publish(ended=False)
                yield self._removed
        finally:
            self._publish(ended=True)

    def _publish(self, ended):
        with self._moved:
            self._merges, self._ended = int(self._state[1]), ended
            self._removed = min(self._start_live - int(self._state[2]), self.goal)
            self._moved.notify_all()

    def follow(self, merges):
        """Wait until there are more merges than so many, or the end; return how many, faces removed, if it ended."""
        with self._moved:
            self._moved.wait_for(lambda: self._ended or self._merges > merges)
            return self._merges, self._removed, self._ended

    def merged(self, begin, end):
        """Return the positions that some merges make [model units], float64 [end - begin, 3]."""
        centre, scale = self.frame
        return centre + scale * self.pos[self.vertex_count + begin : self.vertex_count + end]

    def stop(self):
        """Let `run` end after the launch under way."""
        self._stopped = True

    def parents(self):
        """Return vertex_parent, int32 [n_v+m]."""
        return self._surface.parent.numpy()[: self.vertex_count + self._merges].copy()

    def _make_room(self):
        """Drop stale entries; take a larger heap if more than three quarters or the next merge's edges do not fit."""
        heap, before = self._heap, int(self._state[0])
        launch(collapse.compact_heap_kernel, self._surface, heap, self._counter)
        size, capacity = int(self._state[0]), len(heap.key)
        if not 4 * size <= 3 * capacity < 4 * before:
            pair, key = (np.resize(array.numpy(), capacity + capacity // 2 + 64) for array in (heap.pair, heap.key))
            self._heap = struct_of(Heap, "cpu", pair=pair, key=key)


def _edges(faces, vertex_count):
    """Return the packed edges of the faces with three corners, ascending, and which corners start a boundary edge."""
    rows = np.flatnonzero(distinct_corners(faces))
    key, _, corner, start, count = sorted_edges(faces[rows].astype(np.int64), vertex_count)
    low, high = np.divmod(key[start], vertex_count)
    boundary = np.zeros(faces.shape, dtype=np.int8)
    row, place = np.divmod(corner[start[count == 1]], 3)
    boundary[rows[row], place] = 1
    return (low << 32) | (high << 2), boundary
