"""OBJ files in the order of their faces, a part an object (`o`)."""

import numpy as np

from warp_abtree.model.files.found import FileSurface, MeshError, Remarks
from warp_abtree.model.files.polygons import triangulate

# How lines of plain OBJ files begin; in others, a `v` or `f` might stand behind a tab, say.
PLAIN_STARTS = {b"", b"v ", b"f ", b"vn", b"vt", b"# ", b"#", b"o ", b"g ", b"s ", b"us", b"mt"}
NAMES = (b"o", b"g", b"usemtl", b"mtllib")  # of objects, groups, materials and files: one may end with a backslash
LEFT_OUT = {b"p": "points", b"l": "lines", b"curv": "curves", b"curv2": "curves", b"surf": "free-form surfaces"}
LEFT_OUT |= {b"call": "called files", b"fo": "faces as 'fo'", b"cdc": "curves", b"cdp": "free-form surfaces"}
LEFT_OUT |= {b"bsp": "free-form surfaces", b"bzp": "free-form surfaces"}


def _parse_plain_obj(data) -> FileSurface | None:
    """Return an OBJ file in which each `v` has three numbers and each `f` three plain indices, None of any other."""
    lines = data.splitlines()
    starts = {line[:2] for line in lines}
    if any(mark in data for mark in (b"\\", b"\t", b"\v", b"\f")) or not starts <= PLAIN_STARTS:
        return None
    points = _plain_triples([line[2:] for line in lines if line[:2] == b"v "], float)
    corners = _plain_triples([line[2:] for line in lines if line[:2] == b"f "], int)
    if points is None or corners is None or corners.min() <= 0 or corners.max() > len(points):
        return None
    begun, count = [], 0
    for line in lines if b"o " in starts else ():
        if line[:2] == b"o ":
            begun.append((line, count))
        count += line[:2] == b"f "
    return FileSurface(points, corners - 1, *_find_parts(begun, np.ones(count, int)))


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


def _find_parts(begun: list, triangle_counts) -> tuple:
    """Return the names of the parts, and the part of each triangle; None for one part.

    Args:
        begun: Lines that begin an object, each `o` line one whatever its name, and how many polygons stand before.
        triangle_counts: Triangles of each polygon.
    """
    if not begun:
        return (None,), None
    names = [b" ".join(line.split()[1:]).decode(errors="replace") or None for line, _ in begun]
    starts = [0, *(count for _, count in begun)]
    parts = np.searchsorted(starts, np.arange(len(triangle_counts)), side="right") - 1
    return (None, *names), np.repeat(parts, triangle_counts)


def _join_lines(lines: list) -> list:
    """Append to lines that end with a backslash the next ones, which become empty; comments and names do not go on."""
    for k in range(len(lines) - 1, 0, -1):
        before = lines[k - 1].rstrip()
        if before.endswith(b"\\") and b"#" not in before and before.split()[0] not in NAMES:
            lines[k - 1 : k + 1] = before[:-1] + b" " + lines[k], b""
    return lines


def read_obj(data: bytes, where: str, remarks: Remarks) -> FileSurface:
    """Return what an OBJ file holds; raise MeshError with the line that cannot be read."""
    plain = _parse_plain_obj(data)
    if plain is not None:
        return plain
    vertices, corners, counts, begun = [], [], [], []
    for number, line in enumerate(_join_lines(data.splitlines()) if b"\\" in data else data.splitlines(), start=1):
        fields = line.split()
        kind = fields[0] if fields else b""
        if kind != b"v" and kind != b"f":
            if kind == b"o":
                begun.append((line, len(counts)))
            elif kind in LEFT_OUT:
                remarks.add("left out", LEFT_OUT[kind])
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
        raise MeshError(f"{where}: no faces" + (f" ({remarks})" if str(remarks) else ""))
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    try:
        indices = np.array(corners, dtype=np.int64) - 1
    except OverflowError:
        raise MeshError(f"{where}: a face refers to vertex {max(corners)}, but there are {len(points)}") from None
    polygons = np.array(counts)
    return FileSurface(points, triangulate(points, polygons, indices, where), *_find_parts(begun, polygons - 2))
