"""Mesh files: OBJ in the order of its faces, the meshes inside Warp, and whatever else trimesh reads.

OBJ is read here because trimesh groups its faces by material and moves quads; every other format is read by trimesh,
whose face order is kept (for polygons in PLY and OFF: triangles first, then quads, then the rest).
"""

import codecs
import gzip
import io
import warnings
import zlib
from pathlib import Path

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import first_line

# How lines of plain OBJ files begin; in others, a `v` or `f` might stand behind a tab, say.
PLAIN_STARTS = {b"", b"v ", b"f ", b"vn", b"vt", b"vp", b"# ", b"#", b"o ", b"g ", b"s ", b"us", b"mt"}
WARP_ASSETS = ("bunny", "bear", "rocks")


class MeshError(ValueError):
    """Say in one line what is wrong with a mesh, and where."""


def split_file_name(path: Path) -> tuple[str, str, bool]:
    """Return a mesh file's name without extensions, its format as trimesh calls it, and whether it is gzipped."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    archive = suffixes[-2:] == [".tar", ".gz"]
    zipped = suffixes[-1:] == [".gz"] and not archive
    kind = "".join(suffixes[-2:-1] if zipped else suffixes[-2:] if archive else suffixes[-1:]).removeprefix(".")
    stem = path.name.removesuffix(path.suffixes[-1]) if zipped else path.name
    return stem[: len(stem) - len(kind) - 1] if kind else stem, kind, zipped


def read_file(path: Path):
    """Return vertices and triangles of an OBJ file, two arrays; of any other format a trimesh.Scene.

    Raises MeshError where the file is missing, damaged or of an unknown format.
    """
    if path.is_dir():
        raise MeshError(f"{path}: is a folder, not a mesh file")
    if not path.is_file():
        raise MeshError(f"{path}: no such file")
    _, kind, zipped = split_file_name(path)
    try:
        data = path.read_bytes()
        if zipped:
            data = gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise MeshError(f"{path}: cannot be read: {first_line(error)}") from None
    if kind == "npz":
        raise MeshError(f"{path}: not a mesh file; a built model is read by Model.open")
    if kind == "obj":
        return parse_obj(data, str(path))
    import trimesh

    known = trimesh.available_formats()
    if kind not in known:
        raise MeshError(f"{path}: unknown extension '{kind}'; known here: {' '.join(sorted(known))}")
    try:
        with warnings.catch_warnings():
            # Older NumPy only warns where a number in a text file cannot be read, and cuts the file short there.
            warnings.filterwarnings("error", message="string or file could not be read")
            resolver = trimesh.resolvers.FilePathResolver(str(path))
            return trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
    except Exception as error:  # trimesh's readers raise whatever goes wrong inside them
        raise MeshError(f"{path}: cannot be read as {kind}: {first_line(error)}") from None


def _parse_plain_obj(data) -> tuple[np.ndarray, np.ndarray] | None:
    """Return vertices and triangles of an OBJ file where each `v` has three numbers and each `f` three plain indices.

    None for any other file, and for one that has mistakes.
    """
    lines = data.splitlines()
    if any(mark in data for mark in (b"\\", b"\t", b"\v", b"\f")) or not {line[:2] for line in lines} <= PLAIN_STARTS:
        return None
    points = _plain_triples([line[2:] for line in lines if line[:2] == b"v "], float)
    corners = _plain_triples([line[2:] for line in lines if line[:2] == b"f "], int)
    if points is None or corners is None or corners.min() <= 0:
        return None
    return points, corners - 1


def _plain_triples(rows, number) -> np.ndarray | None:
    """Return the numbers of rows that have three each with a blank between them, [n, 3]; None if one has not."""
    if {row.count(b" ") for row in rows} != {2}:
        return None
    words = b" ".join(rows).split()
    try:
        # Two blanks make three words at most, so every row has three if there are as many in all.
        kind = np.float64 if number is float else np.int64
        return np.array(list(map(number, words)), kind).reshape(-1, 3) if len(words) == 3 * len(rows) else None
    except (ValueError, OverflowError):
        return None


def parse_obj(data, where) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of an OBJ file; only `v` and `f` lines matter here."""
    data = data.removeprefix(codecs.BOM_UTF8)
    plain = _parse_plain_obj(data)
    if plain is not None:
        return plain
    vertices, corners, counts = [], [], []
    for number, line in enumerate(data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines(), start=1):
        fields = line.split()
        kind = fields[0] if fields else b""
        if kind != b"v" and kind != b"f":
            continue
        if b"#" in line:
            fields = line.split(b"#", 1)[0].split()
        try:
            if kind == b"v":
                x, y, z = fields[1:4]
                vertices.append((float(x), float(y), float(z)))
                continue
            if b"/" in line:
                fields = [field.split(b"/", 1)[0] for field in fields]
            polygon = [int(field) for field in fields[1:]]
            if len(polygon) < 3:
                raise ValueError
        except ValueError:
            text = line.decode(errors="replace").strip()
            raise MeshError(f"{where}: line {number} cannot be read: {text[:60]}") from None
        if min(polygon) <= 0:
            # A negative index counts back from the last vertex so far.
            polygon = [index if index > 0 else len(vertices) + index + 1 if index else 0 for index in polygon]
            if min(polygon) <= 0:
                raise MeshError(f"{where}: line {number} refers to a vertex before the first")
        corners.extend(polygon)
        counts.append(len(polygon))
    if not counts:
        raise MeshError(f"{where}: no faces")
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    try:
        indices = np.array(corners, dtype=np.int64) - 1
    except OverflowError:
        raise MeshError(f"{where}: a face refers to vertex {max(corners)}, but there are {len(points)}") from None
    return points, triangulate(points, np.array(counts), indices, where)


def read_warp_asset(source, asset) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a mesh inside Warp; raise MeshError if it cannot be had."""
    if asset not in WARP_ASSETS:
        raise MeshError(f"{source}: unknown; Warp's meshes are {', '.join('warp:' + each for each in WARP_ASSETS)}")
    try:
        from pxr import Usd, UsdGeom
    except ImportError:
        raise MeshError(f"{source}: reading it needs usd-core: pip install usd-core") from None
    path = Path(wp.__file__).parent / "examples" / "assets" / f"{asset}.usd"
    if not path.is_file():
        raise MeshError(f"{source}: {path} is missing from this installation of Warp")
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/root/{asset}"))  # its transform is the identity in all three files
    return read_usd_mesh(mesh, Usd.TimeCode.Default(), source)


def read_usd_mesh(mesh, time, where):
    """Return vertices and triangles of a `UsdGeom.Mesh`, None without any; raise MeshError if they do not fit."""
    points, counts = mesh.GetPointsAttr().Get(time), mesh.GetFaceVertexCountsAttr().Get(time)
    if not points or not counts:
        return None
    vertices, counts = np.array(points, np.float64), np.array(counts)
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(time))
    if (counts < 3).any() or counts.sum() != len(corners):
        raise MeshError(f"{where}: its face counts do not fit its indices")
    return vertices, triangulate(vertices, counts, corners, where)


# Polygons.


def triangulate(vertices, counts, corners, where):
    """Cut polygons into triangles, in place: polygon p gives counts[p] - 2 of them."""
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    if corners.min() < 0 or corners.max() >= len(vertices):
        raise MeshError(f"{where}: a face refers to vertex {corners.max()}, but there are {len(vertices)}")
    polygon_start = np.cumsum(counts) - counts
    triangle_start = np.cumsum(counts - 2) - (counts - 2)
    polygon = np.repeat(np.arange(len(counts)), counts - 2)
    apex = polygon_start[polygon]
    second = apex + 1 + np.arange(len(polygon)) - triangle_start[polygon]
    triangles = np.stack([corners[apex], corners[second], corners[second + 1]], axis=1)

    # Three in five polygons of warp:rocks are not convex. A fan's cross products sum to the polygon's area vector.
    with np.errstate(invalid="ignore", over="ignore"):
        a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
        cross = np.cross(b - a, c - a)
        area = np.add.reduceat(cross, triangle_start)
        fold = np.einsum("ij,ij->i", cross, area[polygon]) < -1e-9 * np.einsum("ij,ij->i", area, area)[polygon]
    for p in np.unique(polygon[fold]):
        ring = corners[polygon_start[p] : polygon_start[p] + counts[p]]
        drop = np.argmax(np.abs(area[p]))
        flat = np.delete(vertices[ring], drop, axis=1) * (1.0, (1.0, -1.0, 1.0)[drop] * np.sign(area[p][drop]))
        triangles[triangle_start[p] :][: counts[p] - 2] = ring[_clip_ears(flat)]
    return triangles


def _clip_ears(points):
    """Cut a counterclockwise polygon of the plane into triangles that do not fold; return their corners."""

    def turn(i, j, k):
        (ax, ay), (bx, by), (cx, cy) = points[i], points[j], points[k]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    points = list(map(tuple, points.tolist()))
    ring, triangles = list(range(len(points))), []
    while len(ring) > 3:
        candidates = list(zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1]))
        for i, j, k in candidates:
            others = [x for x in ring if points[x] not in (points[i], points[j], points[k])]
            if turn(i, j, k) > 0.0 and not any(
                turn(i, j, x) >= 0.0 and turn(j, k, x) >= 0.0 and turn(k, i, x) >= 0.0 for x in others
            ):
                break
        else:
            # No ear: the polygon crosses itself, or is flat to rounding. Any cut will do.
            i, j, k = max(candidates, key=lambda corner: turn(*corner))
        triangles.append((i, j, k))
        ring.remove(j)
    return [*triangles, tuple(ring)]
