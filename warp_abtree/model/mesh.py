"""Triangle meshes: load, validate, weld and describe.

A face keeps the index that it has in the source, at every later step.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warp_abtree.checks.arguments import first_line
from warp_abtree.kernels.base.poses import COORDINATE_MIN
from warp_abtree.model.files.found import FileSurface, MeshError, Remarks
from warp_abtree.model.files.polygons import distinct_corners, turn
from warp_abtree.model.files.read import read_file, split_file_name
from warp_abtree.model.files.usd_mesh import read_warp_asset
from warp_abtree.model.winding import component_labels, distinct_rows, find_winding, keep_outside, sorted_edges

FACE_LIMIT = 2**30  # int32 forest ids count up to two nodes a vertex, and heap indices up to two a face
EXTENT_LIMITS = (2.0**-100, 2.0**100)  # boxes are float32
COORDINATE_MAX = 2.0**300  # products of three stay finite


@dataclass(frozen=True, eq=False)
class Mesh:
    """A welded triangle mesh, its vertices and faces in the order of the source."""

    vertices: np.ndarray  # positions [model units], float64 (v, 3), distinct and referenced
    faces: np.ndarray  # corners, int32 (n_f, 3)
    dropped_faces: np.ndarray  # without three distinct corners after welding, int32, ascending; they keep their index
    name: str  # for people
    file_vertex_count: int  # vertices in the source
    unreferenced_count: int  # of these, those that no face refers to
    welded_count: int  # and those that coincide with an earlier one and were merged into it
    remarks: str = ""  # what the file holds and was not read, in one line, empty if nothing
    parts: int = 1  # of the source that were joined; `scene_from_file` makes an object of each


def load_mesh(source, name=None):
    """Load a triangle mesh; return a Mesh.

    Args:
        source: One of: a path to an OBJ, PLY, OFF, STL, glTF, GLB or DAE file (the last by pycollada), or to anything
            else that trimesh loads, gzipped (``.obj.gz``) or not, or to a zip archive of these; ``"warp:bunny"``,
            ``"warp:bear"`` or ``"warp:rocks"``, meshes inside Warp (these need the extra ``usd``); a trimesh.Trimesh;
            a trimesh.Scene, whose meshes are joined where its transforms put them.
        name: Name for people; by default the file's, without its extensions, or the "name" of a trimesh object's
            metadata.

    Polygons are cut into fans from their first corner, or by clipping ears where that fan would fold over; either way
    polygon by polygon in the source's order. A warning names what a file holds and is not read, such as lines, points,
    or the facets that one cut short lacks.

    Raises:
        MeshError: The source cannot be read, holds no mesh that can be used, or unpacks past the limit.
    """
    if not isinstance(source, str | os.PathLike):
        import trimesh  # takes as long as the rest of the library

        if isinstance(source, trimesh.parent.Geometry):
            own = source.metadata.get("name")
            own = own if isinstance(own, str) and own else "trimesh"
            return _join_geometry(source, own if name is None else name)
        raise MeshError(f"cannot load a mesh from {type(source).__name__}; give a path, a trimesh.Trimesh or arrays")
    if isinstance(source, str) and source.startswith("warp:"):
        asset = source[len("warp:") :]
        return _weld_mesh(*read_warp_asset(source, asset), asset if name is None else name, where=source)
    path = Path(source)
    remarks = Remarks()
    found = read_file(path, remarks)
    name = split_file_name(path)[0] if name is None else name
    if isinstance(found, FileSurface):
        mesh = _weld_mesh(found.vertices, found.faces, name, where=str(path))
        mesh = replace(mesh, parts=1 if found.parts is None else len(np.unique(found.parts)))
    else:
        mesh = _join_geometry(found, name, where=str(path), remarks=str(remarks))
    remarks.warn(path)
    return replace(mesh, remarks=str(remarks))


def mesh_from_arrays(vertices, faces, name="arrays"):
    """Return the Mesh of arrays, where coordinates under 2^-290 are 0.

    Args:
        vertices: Positions [model units], real numbers, shape [v, 3].
        faces: Corners, integers (or floats with integral values), shape [n_f, 3].
        name: Name for people.

    Raises:
        MeshError: Wrong shape or type, no faces, coordinates not finite or beyond 2^300, an index out of range, or an
            extent outside 2^-100 .. 2^100.
    """
    return _weld_mesh(vertices, faces, name, where=name)


def describe_mesh(mesh):
    """Return counts and sizes of a mesh [model units], as a dictionary for JSON.

    Dropped faces are not counted. An area is zero if its float64 cross product is within the error bound of its
    computation. Faces with the same three corners in any order are duplicates; each one after the first counts. Faces
    that share a vertex are of one component. A mesh is closed if every edge belongs to an even number of faces. Its
    winding is mixed where faces disagree about the outside at an edge, inside out where parts are, see
    `warp_abtree.model.winding`, else consistent, and outwards if the mesh is closed too. What it holds as a solid is
    told in words.
    """
    winding = find_winding(mesh.vertices, mesh.faces, mesh.dropped_faces)
    faces, vertex_count = winding.faces, len(mesh.vertices)
    *_, edge_faces = sorted_edges(faces, vertex_count)
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    right = "outwards" if winding.is_closed else "consistent"
    return {
        "name": mesh.name,
        "parts": mesh.parts,
        "faces": len(mesh.faces),
        "vertices": vertex_count,
        "file_vertices": mesh.file_vertex_count,
        "unreferenced_vertices": mesh.unreferenced_count,
        "welded_vertices": mesh.welded_count,
        "dropped_faces": len(mesh.dropped_faces),
        "zero_area_faces": int(np.count_nonzero(_zero_area(mesh.vertices, faces))),
        "duplicate_faces": len(faces) - len(distinct_rows(np.sort(faces, axis=1))[0]),
        "open_edges": int(np.count_nonzero(edge_faces == 1)),
        "nonmanifold_edges": int(np.count_nonzero(edge_faces > 2)),
        "components": len(np.unique(component_labels(faces, vertex_count)[np.unique(faces)])),
        "closed": winding.is_closed,
        "winding": "mixed" if winding.mixed_edges else "inside out" if len(winding.inside_out) else right,
        "mixed_edges": winding.mixed_edges,
        "inside_out_faces": len(winding.inside_out),
        "solid": winding.describe_solid(),
        "extents": (upper - lower).tolist(),
        "bounds": [lower.tolist(), upper.tolist()],
        "diagonal": float(np.linalg.norm(upper - lower)),
    }


def orient_mesh(mesh):
    """Return a Mesh with its faces turned as `Winding.oriented` says; faces keep their indices, dropped ones too."""
    winding = find_winding(mesh.vertices, mesh.faces, mesh.dropped_faces)
    faces = mesh.faces.copy()
    faces[winding.face_ids] = winding.oriented()
    return replace(mesh, faces=faces)


def _join_geometry(geometry, name, where=None, remarks=""):
    """Join the triangles of a trimesh object; points and paths are ignored."""
    import trimesh

    where = name if where is None else where
    placed = [(geometry, np.eye(4))]
    if isinstance(geometry, trimesh.Scene):
        nodes = map(geometry.graph.get, geometry.graph.nodes_geometry)
        placed = [(geometry.geometry[part], pose) for pose, part in nodes]
    if not placed:
        raise MeshError(f"{where}: no faces" + (f" ({remarks})" if remarks else ""))
    vertices, faces, vertex_count = [], [], 0
    for mesh, pose in placed:
        if not isinstance(mesh, trimesh.Trimesh):
            continue
        part_vertices, part_faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
        if part_faces.size == 0:
            continue
        # Checked before joining: then an index too large would point into the next part.
        part_faces = _checked_faces(part_faces, len(part_vertices), where)
        pose = np.asarray(pose, dtype=np.float64)
        if not np.array_equal(pose, np.eye(4)):
            with np.errstate(invalid="ignore", over="ignore"):
                part_vertices = part_vertices @ pose[:3, :3].T + pose[:3, 3]
            part_faces = keep_outside(part_faces, pose[:3, :3])
        vertices.append(part_vertices)
        faces.append(part_faces + vertex_count)
        vertex_count += len(part_vertices)
    if not faces:
        kinds = sorted({type(part).__name__ for part, _ in placed})
        raise MeshError(f"{where}: no faces (it holds {', '.join(kinds)})")
    return replace(_weld_mesh(np.concatenate(vertices), np.concatenate(faces), name, where), parts=len(faces))


def _weld_mesh(vertices, faces, name, where):
    vertices = _checked_vertices(vertices, where)
    faces = _checked_faces(faces, len(vertices), where)
    file_vertex_count = len(vertices)

    referenced = np.zeros(file_vertex_count, dtype=bool)
    referenced[faces] = True
    used = np.flatnonzero(referenced)
    # Makes -0.0 equal to 0.0, and products of three coordinates free of underflow, which exact predicates require.
    positions = np.where(np.abs(vertices[used]) < float(COORDINATE_MIN), 0.0, vertices[used])
    first, distinct = _weld(positions)
    new_index = np.full(file_vertex_count, -1, dtype=np.int32)
    new_index[used] = distinct
    positions, faces = positions[first], new_index[faces]
    if len(positions) > FACE_LIMIT:
        raise MeshError(f"{where}: {len(positions)} vertices, but at most 2^30 are possible")

    dropped = np.flatnonzero(~distinct_corners(faces)).astype(np.int32)
    if len(dropped) == len(faces):
        raise MeshError(f"{where}: no face has three distinct corners (coincident vertices are one)")
    with np.errstate(over="ignore"):
        extent = float((positions.max(axis=0) - positions.min(axis=0)).max())
    if not EXTENT_LIMITS[0] <= extent <= EXTENT_LIMITS[1]:
        raise MeshError(f"{where}: extent {extent:g} lies outside 2^-100 .. 2^100; scale the mesh")
    if np.abs(positions).max() > COORDINATE_MAX:
        index = int(used[first[np.argmax(np.abs(positions).max(axis=1))]])
        raise MeshError(f"{where}: vertex {index} has a coordinate beyond 2^300; move the mesh towards the origin")
    return Mesh(
        vertices=positions,
        faces=faces,
        dropped_faces=dropped,
        name=str(name),
        file_vertex_count=file_vertex_count,
        unreferenced_count=file_vertex_count - len(used),
        welded_count=len(used) - len(positions),
    )


def _as_array(values, what, where):
    try:
        array = np.asarray(values)
    except (ValueError, TypeError) as error:
        raise MeshError(f"{where}: {what} do not form an array: {first_line(error)}") from None
    if array.size == 0:
        raise MeshError(f"{where}: no {what}")
    if array.dtype.kind not in "iuf":
        raise MeshError(f"{where}: {what} have type {array.dtype}, not a number that can be used")
    if array.ndim != 2 or array.shape[1] != 3:
        raise MeshError(f"{where}: {what} have shape {array.shape}, not (n, 3)")
    return array


def _checked_vertices(vertices, where):
    with np.errstate(over="ignore"):
        vertices = _as_array(vertices, "vertices", where).astype(np.float64)
    index = _first_wrong(np.isfinite(vertices))
    if index is not None:
        raise MeshError(f"{where}: vertex {index} is not finite: {vertices[index].tolist()}")
    return vertices


def _first_wrong(rows) -> int | None:
    """Return the index of the first row in which something does not hold, None if all do."""
    wrong = np.flatnonzero(~rows.all(axis=1))
    return int(wrong[0]) if len(wrong) else None


def _checked_faces(faces, vertex_count, where):
    faces = _as_array(faces, "faces", where)
    if len(faces) > FACE_LIMIT:
        raise MeshError(f"{where}: {len(faces)} faces, but at most 2^30 are possible")
    if faces.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            index = _first_wrong(np.floor(faces) == faces)
        if index is not None:
            raise MeshError(f"{where}: face {index} has corners that are not integers: {faces[index].tolist()}")
    index = _first_wrong((faces >= 0) & (faces < vertex_count))
    if index is not None:
        raise MeshError(
            f"{where}: face {index} has corners {[int(x) for x in faces[index] if np.isfinite(x)]}, "
            f"but vertices run from 0 to {vertex_count - 1}"
        )
    return faces.astype(np.int64)


def _weld(positions):
    """Return the first vertex of each distinct position, ascending, and each vertex's index into that list."""
    first, number = distinct_rows(positions)
    representative = first[number]
    is_first = representative == np.arange(len(positions))
    return np.flatnonzero(is_first), (np.cumsum(is_first) - 1)[representative]


def _zero_area(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    zero = np.ones(len(faces), dtype=bool)
    for axes in ([1, 2], [2, 0], [0, 1]):
        zero &= turn(a[:, axes], b[:, axes], c[:, axes]) == 0.0
    return zero
