"""The progressive mesh: a collapse sequence, the vertex forest it makes, and a certified error for every LOD."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import whole_number
from warp_abtree.checks.cpu_threads import core_count, wait_for
from warp_abtree.checks.kernel_loading import compiling_ahead
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.build import active_build, vertex_forest
from warp_abtree.kernels.build import collapse as collapse_kernels
from warp_abtree.model.cache import find_errors, keep_errors
from warp_abtree.model.collapse import Collapse
from warp_abtree.model.cpu_arrays import cpu_array, launch
from warp_abtree.model.lod_bounds import ERROR_KERNELS, LodBounds, certify_errors
from warp_abtree.model.winding import find_roots

NODE_LIMIT = 1 << 30  # a heap entry holds two node ids and a stage in 64 bits
# Of all modules of a build, those first that take longest to compile; each is launched as a block of one thread.
KERNELS = [
    (collapse_kernels.collapse_edges_kernel, 1),
    (active_build.split_segment_kernel, 1),
    (vertex_forest.find_events_kernel, 1),
]
_certifying = threading.Lock()  # each takes all cores


@dataclass(frozen=True)
class ProgressiveMesh:
    """A mesh at every level of detail; `lod` counts vertex splits, 0 at the base and m at the original.

    Nodes 0..n_v-1 of the forest are the original vertices, node n_v+j is made by merge j; at `lod` the merges
    0..m-lod-1 are applied, and split i undoes merge m-1-i.
    """

    vertex_parent: np.ndarray  # node that each node merges into, -1 at a root, [n_v+m]
    vertex_pos: np.ndarray  # positions [model units], [n_v+m, 3]; the first n_v are the original's, to the bit
    face_vertex: np.ndarray  # original faces, [n_f, 3]
    face_split: np.ndarray  # face f is active iff lod >= face_split[f], m+1 for dropped faces; [n_f]
    split_start: np.ndarray  # where each split's slice of `split_face` begins, [m+1]
    split_face: np.ndarray  # slice i lists, ascending, every face that split i inserts or deforms
    known_error: np.ndarray | None = None  # `lod_error` where it was certified before
    error_key: str | None = None  # of the cache under which `lod_error` is kept once certified; None keeps none

    @cached_property
    def lod_error(self) -> np.ndarray:
        """Certified bound [model units] on the distance of any point of the original surface from the surface at each
        LOD, float64 [m+1]; falls with lod, 0 at m. Certified when it is first read, on all cores of the host."""
        if self.known_error is not None:
            return self.known_error
        with _certifying:
            if "lod_error" in self.__dict__:  # by another thread meanwhile
                return self.__dict__["lod_error"]
            errors = find_errors(self.error_key, self.lod_max + 1)
            if errors is None:
                vertices, merged = np.split(self.vertex_pos, [self.vertex_count])
                errors = certify_errors(vertices, self.face_vertex, self.vertex_parent, merged)
                keep_errors(self.error_key, errors)
            self.__dict__["lod_error"] = errors
            return errors

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
        if np.any((lods < 0) | (lods > self.lod_max)):
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
        return find_roots(node)[: self.vertex_count].copy()

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
            if not _as_float(tolerance) >= 0:
                raise ValueError(f"tolerance must be >= 0, got {tolerance!r}")
            return int(np.argmax(self.lod_error <= tolerance))
        if not 0 < _as_float(fraction) <= 1:
            raise ValueError(f"fraction must lie in (0, 1], got {fraction!r}")
        miss = np.abs(self._active_counts - fraction * self.face_count)
        return int(self.lod_max - np.argmin(miss[::-1]))


def _as_float(value) -> float:
    """Return a real number as float, NaN for what is none or has none."""
    try:
        return float(value) if isinstance(value, Real) else np.nan
    except OverflowError:
        return np.nan


def build_progressive(mesh, base_faces=10, progress=None, then=lambda: None, certify=False):
    """Collapse a `Mesh` to a base of about `base_faces` faces.

    The sequence for a larger base is a prefix of that for a smaller one, and does not depend on the mesh's scale by
    powers of two. It stops early only where every further merge would kill the last face.

    Args:
        progress: Called as progress(stage, done, total) between launches; stages "collapse" and "LOD bounds".
        then: Called once, by another thread while the collapse goes on or after it.
        certify: Whether to certify the error of every LOD beside the collapse, not when it is first read.

    Raises ValueError where base_faces is no whole number from 1, or the mesh has 2^29 vertices or 2^31 / 3 faces.
    """
    whole_number(base_faces, "base_faces", 1, 2**62)
    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces)
    if 2 * len(vertices) >= NODE_LIMIT or 3 * len(faces) >= 2**31:
        raise ValueError(f"too large: {len(vertices)} vertices and {len(faces)} faces")
    report = progress if progress is not None else lambda stage, done, total: None
    kernels = [*ERROR_KERNELS, *KERNELS] if certify else KERNELS
    with compiling_ahead(len(faces), kernels):
        collapse = Collapse(vertices, faces, int(base_faces))
        merged, errors = _collapse(collapse, vertices, faces, report, then, certify)
        parent = collapse.parents()
        pos = np.concatenate([vertices, *merged])
        face_split, split_start, split_face = _splits(parent, faces, len(vertices))
        return ProgressiveMesh(parent, pos, faces, face_split, split_start, split_face, errors)


def _collapse(collapse, vertices, faces, report, then, certify):
    """Run a collapse, beside `then` or, to certify, the bounds of its merges where there is a core for them.

    Returns the positions that merges make [model units], in parts, and the certified errors, None without.
    """
    jobs: list = []
    with ThreadPoolExecutor(1) as pool:
        try:
            if (current_regime().cpu_threads or core_count()) > 1:
                jobs.append(pool.submit((lambda: then() if collapse.run() else None) if certify else then))
            if not (jobs and certify):
                for removed in collapse.steps():
                    report("collapse", removed, collapse.goal)
            if certify:
                bounds = LodBounds(vertices, faces)
                merged = _follow(collapse, bounds, report)
        finally:
            collapse.stop()
            wait_for(jobs)
    if not jobs:
        then()
    for job in jobs:
        job.result()
    return (merged, bounds.errors()) if certify else ([collapse.merged(0, collapse.follow(-1)[0])], None)


def _follow(collapse, bounds, report):
    """Bound the merges of a collapse while it goes on; return the positions that they make [model units], in parts."""
    merged, known, ended = [], 0, False
    while not ended or bounds.done < known:
        if bounds.done == known or not ended:
            begin, (known, removed, ended) = known, collapse.follow(bounds.done)
            report("collapse", removed, collapse.goal)
            merged.append(collapse.merged(begin, known))
            bounds.add(collapse.pair[begin:known], merged[-1])
        if bounds.done < known:
            bounds.advance()
            if ended:
                report("LOD bounds", bounds.done, known)
    return merged


def _splits(parent, faces, vertex_count):
    """Return face_split int32 [n_f], split_start int64 [m+1] and split_face int32 of a forest."""
    merge_count = len(parent) - vertex_count
    given = vertex_count, len(parent), cpu_array(faces, int), cpu_array(parent, int)
    face_split = wp.zeros(len(faces), dtype=int, device="cpu")
    size = wp.zeros(merge_count + 1, dtype=wp.int64, device="cpu")
    launch(vertex_forest.find_events_kernel, *given, size, face_split, None)
    split_start = np.concatenate([[0], np.cumsum(size.numpy()[:merge_count])]).astype(np.int64)
    split_face = wp.zeros(int(split_start[-1]), dtype=int, device="cpu")
    launch(vertex_forest.find_events_kernel, *given, cpu_array(split_start.copy(), wp.int64), face_split, split_face)
    return face_split.numpy(), split_start, split_face.numpy()
