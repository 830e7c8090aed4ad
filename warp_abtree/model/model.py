"""Model: a mesh with its progressive mesh and its AB-Tree, saved and opened as .npz."""

import hashlib
import io
import math
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from warp_abtree.checks.arguments import first_line, flag, whole_number
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.kernels.base.poses import COORDINATE_MIN
from warp_abtree.model.cache import LEAST_FACES, error_key, file_key, find_model, keep_errors, keep_model, mesh_key
from warp_abtree.model.files.found import warn_caller
from warp_abtree.model.files.read import split_file_name
from warp_abtree.model.files.unpack import exceeds_limit, limit_message
from warp_abtree.model.lod_bounds import OutwardError
from warp_abtree.model.mesh import COORDINATE_MAX, EXTENT_LIMITS, Mesh, load_mesh, mesh_from_arrays, orient_mesh
from warp_abtree.model.progressive import ProgressiveMesh, build_progressive
from warp_abtree.model.tree import Tree, active_build
from warp_abtree.model.winding import Winding, find_winding

FORMAT_NAME = "warp_abtree model"
FORMAT_VERSION = 2
NO_MODEL = "not a warp_abtree model file, as Model.save writes; meshes are read by Model.load"

_ARRAYS = {
    "vertex_parent": (np.int32, 1),
    "vertex_pos": (np.float64, 2),
    "face_vertex": (np.int32, 2),
    "face_split": (np.int32, 1),
    "split_start": (None, 1),
    "split_face": (np.int32, 1),
}
_ERROR = {"lod_error": (np.float64, 1)}  # not of files of the cache, which keeps errors by themselves


class ModelError(ValueError):
    """A file that is no model file, or is damaged."""


class Model:
    """A mesh at every level of detail, and the tree over it.

    LOD counts vertex splits from the base mesh: 0 is the base, `lod_max` the original. Face ids are the face's index
    in the file at every LOD.

    Attributes:
        name: Name for people, by default that of the mesh file.
        progressive: `ProgressiveMesh`.
        tree: `Tree`.
        dropped_faces: Faces that welding left without three distinct corners, int32; never active.
        centre: Middle of the box of the original vertices [model units], float64 (3,); boxes are kept about it.
        parts: Of the source that `load` joined into one mesh; 1 for a model that `open` read.
    """

    def __init__(self, progressive: ProgressiveMesh, tree: Tree, name: str, parts: int = 1):
        self.progressive = progressive
        self.tree = tree
        self.name, self.parts = name, parts
        self.dropped_faces = np.flatnonzero(progressive.face_split > progressive.lod_max).astype(np.int32)
        original = progressive.vertex_pos[: progressive.vertex_count]
        self.centre = 0.5 * original.min(0) + 0.5 * original.max(0)
        self._outward = OutwardError(progressive, tree)
        self._warned = False

    def __repr__(self):
        return f"Model({self.name!r}, {self.face_count:,} faces, LODs 0 .. {self.lod_max:,})"

    @classmethod
    def load(
        cls, source, base_faces: int = 10, progress=None, cache: bool = True, orient: bool = False, certify=False
    ) -> "Model":
        """Load a mesh and build its progressive mesh and AB-Tree, or open the model that was built of it before.

        Models of 1,000 faces and more are kept in $WARP_ABTREE_CACHE, by default ~/.cache/warp_abtree, at most 2 GiB of
        them; "off" keeps none.

        Args:
            source: Path of a mesh file (also gzipped), trimesh.Trimesh or Scene, "warp:bunny", "warp:bear",
                "warp:rocks", or a `Mesh`, as for `load_mesh`. What `save` wrote is read by `open`.
            base_faces: Faces at which the collapse sequence stops.
            progress: Called as progress(stage, done, total) during long builds.
            cache: Whether to look for the model in the cache, and to keep it there.
            orient: Whether to turn faces so that neighbours agree about the outside, and closed parts that are inside
                out, walls of cavities among them (`warp_abtree.model.winding`); face ids stay, and so does what has one
                side only.
            certify: Whether to certify the errors of all LODs at once, beside the collapse, which takes less time in
                all; else they are certified when `error_at`, a tolerance or `save` first needs them.

        Raises:
            MeshError: The mesh is missing, unreadable, empty or invalid.
            ValueError: base_faces is below 1, or orient no bool.
        """
        base_faces = whole_number(base_faces, "base_faces", 1, 2**62)
        oriented = ("oriented by parity",) if flag(orient, "orient") else ()
        options = (FORMAT_VERSION, base_faces, *oriented)
        key = file_key(source, *options) if cache else None
        model = find_model(key, partial(_read, error_key=error_key(key)))
        if model is not None:
            model = cls(model.progressive, model.tree, split_file_name(Path(source))[0])
        else:
            mesh = source if isinstance(source, Mesh) else load_mesh(source)
            mesh = orient_mesh(mesh) if orient else mesh
            if not cache or len(mesh.faces) < max(LEAST_FACES, base_faces):
                key = None
            elif key is None or mesh.remarks or mesh.parts > 1:  # then the file is read again, and told of again
                key = mesh_key(mesh, *options)
                model = find_model(key, partial(_read, error_key=error_key(key)))
            model = model or _build(mesh, base_faces, progress, key, certify)
            model = cls(model.progressive, model.tree, mesh.name, mesh.parts)
        if certify:
            model.error_at(0)
        return model

    @classmethod
    def from_arrays(
        cls, vertices, faces, base_faces=10, progress=None, name="arrays", cache=True, orient=False, certify=False
    ) -> "Model":
        """Build a model from vertices (v, 3) and faces (n, 3); see `load`."""
        return cls.load(mesh_from_arrays(vertices, faces, name=name), base_faces, progress, cache, orient, certify)

    @cached_property
    def winding(self) -> Winding:
        """How the original faces are wound, and whether they have an inside: `warp_abtree.model.winding.Winding`."""
        vertices = self.progressive.vertex_pos[: self.vertex_count]
        return find_winding(vertices, self.progressive.face_vertex, self.dropped_faces)

    def warn_of_winding(self, why: str):
        """Warn who called the library where the winding is wrong, once a model, and say what depends on it."""
        fault = self.winding.fault()
        if fault is not None and not self._warned:
            self._warned = True
            mend = "Model.load(orient=True) turns the faces"
            warn_caller(f"model {self.name!r}: {fault}; {why}; {mend}")

    @cached_property
    def digest(self) -> str:
        """Hash of mesh, collapses and tree, hexadecimal; equal for equal models whatever their names."""
        return _hash_arrays(_model_arrays(self.progressive, self.tree, _ERROR)).hex()

    @property
    def face_count(self) -> int:
        """Faces of the original mesh, dropped ones included."""
        return self.progressive.face_count

    @property
    def vertex_count(self) -> int:
        """Vertices of the original mesh after welding."""
        return self.progressive.vertex_count

    @property
    def lod_max(self) -> int:
        """The finest LOD, the original mesh."""
        return self.progressive.lod_max

    def check_lod(self, lod) -> int:
        """Return a LOD as int; raise ValueError if it is no whole number from 0 to lod_max."""
        return whole_number(lod, f"model {self.name!r}: LOD", 0, self.lod_max)

    def mesh_at(self, lod):
        """Return the mesh at a LOD: vertices float64 (v, 3), faces int32 (f, 3), face_ids int32 (f,)."""
        return self.progressive.mesh_at(self.check_lod(lod))

    def error_at(self, lod, side: str = "inward") -> float:
        """Return a certified one-sided bound [model units] on the distance between the original and a LOD.

        Both are bounds on the largest distance and hold in spite of rounding; the greater of them bounds the Hausdorff
        distance. Neither bounds the other: where a LOD closes a gap, "inward" may be 0 and "outward" large.

        Args:
            side: "inward": largest distance of a point of the original surface from the surface at the LOD. Certified
                for all LODs when one is first asked for, on all cores of the CPU, then cached: some 30 us for each face
                of the original. Falls with the LOD. "outward": largest distance of a point of the surface at the LOD
                from the original surface; usually within 1 % of the true one. Computed on demand on one core of the
                CPU, then cached: 2 to 4 us for each face of the original, more for soups of long faces. Not monotone in
                the LOD.

        Raises:
            ValueError: lod is no whole number from 0 to lod_max, or side is another word.
        """
        lod = self.check_lod(lod)
        if side == "inward":
            return float(self.progressive.lod_error[lod])
        if side == "outward":
            return self._outward.at(lod)
        raise ValueError(f"model {self.name!r}: side {side!r} is neither 'inward' nor 'outward'")

    def lod_for(self, fraction: float | None = None, tolerance: float | None = None) -> int:
        """Return the LOD nearest to a fraction of the faces, or the coarsest whose inward error is within a tolerance.

        Args:
            fraction: Fraction of face_count, in (0, 1].
            tolerance: Largest `error_at(lod)` [model units], at least 0: of the original from the LOD, not outward.

        Raises:
            ValueError: Not exactly one of the two is given, or it is out of range.
        """
        return self.progressive.lod_for(fraction=fraction, tolerance=tolerance)

    def save(self, path):
        """Write the model to an .npz file, atomically; raise OSError if that cannot be."""
        members = _file_members(self.progressive, self.tree, self.name, _ERROR)
        with atomic_write(path) as file:
            np.savez_compressed(file, **members)

    @classmethod
    def open(cls, path) -> "Model":
        """Read a model that `save` wrote, and check all of it.

        Raises:
            ModelError: The file is missing, no model file, truncated, altered, of another version, or unpacks past the
                limit.
        """
        return _read(Path(path), _ERROR)


def _build(mesh, base_faces, progress, key, certify) -> Model:
    """Build a model of a `Mesh`, and keep it in the cache by its key, None for not at all."""
    trees: list[Tree] = []
    progressive = build_progressive(
        mesh, base_faces, progress, lambda: trees.append(active_build(mesh.vertices, mesh.faces)), certify
    )
    if key is not None:
        progressive = replace(progressive, error_key=error_key(key))
        keep_model(key, _file_members(progressive, trees[0], mesh.name))
        if certify:
            keep_errors(progressive.error_key, progressive.known_error)
    return Model(progressive, trees[0], mesh.name)


def _read(path, more=(), error_key=None) -> Model:
    """Read a model file with more arrays, and check all of it, as `Model.open`; the cache may have its errors."""
    names = (*_ARRAYS, *more, "leaf_node", "name")
    if path.exists() and not path.is_file():
        raise ModelError(f"{path}: is no regular file")
    try:
        with path.open("rb") as raw:
            begin = raw.read(4)
        if begin[:2] != b"PK":  # as zip files do
            raise ModelError(f"{path}: {NO_MODEL}")
        with np.load(path, allow_pickle=False) as file:
            _check_size(path, file.zip)
            _check_format(path, file, names)
            digest = file["digest"]
            arrays = {name: file[name] for name in names}
    except ModelError:
        raise
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file") from None
    except Exception as error:  # NumPy's readers raise whatever goes wrong inside them
        raise ModelError(f"{path}: cannot be read as a model file ({first_line(error)})") from None
    model = _assemble(path, dict(arrays), error_key)
    # Consistent arrays may still have altered values, such as a bound.
    if not isinstance(digest, np.ndarray) or digest.tobytes() != _hash_arrays(arrays):
        raise ModelError(f"{path}: altered since it was saved")
    return model


def _model_arrays(progressive: ProgressiveMesh, tree: Tree, more) -> dict[str, Any]:
    return {name: getattr(progressive, name) for name in (*_ARRAYS, *more)} | {"leaf_node": tree.leaf_node}


def _file_members(progressive: ProgressiveMesh, tree: Tree, name: str, more=()) -> dict[str, Any]:
    """Return the arrays of a model file by name, with more of the progressive mesh."""
    arrays = _model_arrays(progressive, tree, more) | {"name": np.array(name)}
    digest = np.frombuffer(_hash_arrays(arrays), np.uint8)
    return {"format": np.array(FORMAT_NAME), "version": np.array(FORMAT_VERSION), "digest": digest} | arrays


def _hash_arrays(arrays: dict) -> bytes:
    """Return a hash of the names, types, shapes and values of arrays, 32 bytes."""
    found = hashlib.blake2b(digest_size=32)
    for name in arrays:
        value = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {value.dtype.str} {value.shape}".encode())
        found.update(value.tobytes())
    return found.digest()


def _check_size(path, archive):
    """Refuse an archive that unpacks past the limit, or arrays larger than their members, before any is read."""
    packed = path.stat().st_size
    if exceeds_limit(sum(member.file_size for member in archive.infolist()), packed):
        raise ModelError(f"{path}: {limit_message(packed)}")
    for member in archive.infolist():
        with archive.open(member) as file:
            begin = file.read(min(member.file_size, 2**14))
        if begin[:6] == b"\x93NUMPY":
            header = io.BytesIO(begin)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
            shape, _, dtype = read[np.lib.format.read_magic(header)](header)
            if not dtype.hasobject and math.prod(shape) * dtype.itemsize != member.file_size - header.tell():
                raise ModelError(f"{path}: member {member.filename!r} has another length than its array")


def _check_format(path, file, names):
    """Check the format name, version and members of an opened file."""
    if not {"format", "version"} <= set(file.files):
        raise ModelError(f"{path}: {NO_MODEL}")
    form, version = file["format"], file["version"]
    if not isinstance(form, np.ndarray) or form.shape != () or str(form) != FORMAT_NAME:
        raise ModelError(f"{path}: {NO_MODEL}")
    if not isinstance(version, np.ndarray) or version.shape != () or version.tolist() != FORMAT_VERSION:
        raise ModelError(f"{path}: format version {version}, this library reads {FORMAT_VERSION}; build it again")
    missing = [name for name in (*names, "digest") if name not in file.files]
    if missing:
        raise ModelError(f"{path}: lacks the array {missing[0]!r}")


def _assemble(path, arrays, error_key) -> Model:
    """Check every array of a model file against the others and build the model."""

    def require(truth, what):
        if not truth:
            raise ModelError(f"{path}: {what}")

    require(all(isinstance(value, np.ndarray) for value in arrays.values()), "a member is no array")
    leaf_node, name = arrays.pop("leaf_node"), str(arrays.pop("name"))
    for key, value in arrays.items():
        dtype, ndim = (_ARRAYS | _ERROR)[key]
        integral = value.dtype.kind == "i" if dtype is None else value.dtype == dtype
        require(integral and value.ndim == ndim, f"array {key!r} has type {value.dtype} and shape {value.shape}")
    error = arrays.pop("lod_error", None)
    parent, pos, faces, split, start, slices = (arrays[key] for key in _ARRAYS)
    m = len(start) - 1
    n_v, n_f = len(parent) - m, len(faces)
    require(m >= 0 and n_v > 0 and n_f > 0, "empty arrays")
    require(pos.shape == (n_v + m, 3) and np.isfinite(pos).all(), "'vertex_pos' has the wrong length or is not finite")
    size = np.abs(pos)
    fits = ((size >= float(COORDINATE_MIN)) | (size == 0)) & (size <= COORDINATE_MAX)
    require(fits.all(), "'vertex_pos' has coordinates outside 2^-290 .. 2^300")
    require(faces.shape == (n_f, 3) and faces.min() >= 0 and faces.max() < n_v, "'face_vertex' is out of range")
    nodes = np.arange(n_v + m)
    above = (parent > nodes) & (parent >= n_v) & (parent < n_v + m)
    require(((parent == -1) | above).all(), "'vertex_parent' is no forest")
    require(split.shape == (n_f,) and split.min() >= 0 and split.max() <= m + 1, "'face_split' is out of range")
    rises = len(start) == m + 1 and start[0] == 0 and (np.diff(start) >= 0).all()
    require(rises and start[-1] == len(slices), "'split_start' does not fit 'split_face'")
    require(len(slices) == 0 or (slices.min() >= 0 and slices.max() < n_f), "'split_face' is out of range")
    extent = np.ptp(pos[:n_v], axis=0).max()
    require(EXTENT_LIMITS[0] <= extent <= EXTENT_LIMITS[1], f"extent {extent:g} lies outside 2^-100 .. 2^100")
    require(np.ptp(pos, axis=0).max() <= 2.0**120, "'vertex_pos' has merged vertices beyond float32")
    require((np.bincount(parent[parent >= 0] - n_v, minlength=m) == 2).all(), "'vertex_parent' has a merge not of two")
    if error is not None:
        falls = len(error) == m + 1 and np.isfinite(error).all() and error[-1] == 0 and (np.diff(error) <= 0).all()
        require(falls, "'lod_error' is not finite, falling and 0 at the end")
    require((split <= m).any(), "no face is ever active")
    require(leaf_node.dtype == np.int32 and leaf_node.shape == (n_f,), "'leaf_node' has the wrong type or length")
    try:
        tree = Tree.from_leaves(leaf_node)
    except ValueError as mistake:
        raise ModelError(f"{path}: {mistake}") from None
    return Model(ProgressiveMesh(**arrays, known_error=error, error_key=error_key), tree, name)
