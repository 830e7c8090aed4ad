"""OFF files: vertices and polygons in their order, with or without normals, colours and texture coordinates."""

import re

import numpy as np

from warp_abtree.model.files.found import FileSurface, MeshError, Remarks
from warp_abtree.model.files.polygons import triangulate


def read_off(data: bytes, where: str, remarks: Remarks) -> FileSurface:
    """Return what an OFF file holds; raise MeshError where it is damaged, binary, or not of three dimensions."""
    # Numbers may stand right behind the keyword.
    keyword = re.match(rb"\s*(?:#[^\n]*\s+)*(?:ST)?C?N?(4?n?)OFF(?![A-Za-z])[ \t]*(BINARY)?", data)
    if keyword is None:
        raise MeshError(f"{where}: cannot be read as off: it does not begin with OFF")
    if keyword[1] or keyword[2]:
        raise MeshError(f"{where}: cannot be read as off: {(keyword[2] or keyword[1] + b'OFF').decode()} is not read")
    lines = data[keyword.end() :].splitlines()
    before = data[: keyword.end()].count(b"\n") + 1
    rows = [(before + k, line.split(b"#", 1)[0].split()) for k, line in enumerate(lines)]
    rows = [row for row in rows if row[1]]
    try:
        vertex_count, face_count = map(int, rows[0][1][:2])
    except (ValueError, IndexError):
        raise MeshError(f"{where}: cannot be read as off: no counts of vertices and faces") from None
    rest = rows[1:]
    if min(vertex_count, face_count) < 0 or len(rest) < vertex_count + face_count:
        raise MeshError(
            f"{where}: cut short: it declares {vertex_count} vertices and {face_count} faces, "
            f"and has {len(rest)} lines of them"
        )
    if len(rest) > vertex_count + face_count:
        remarks.add("left out", f"{len(rest) - vertex_count - face_count} lines behind the faces")
    if face_count == 0:
        raise MeshError(f"{where}: no faces")
    vertices, counts, corners = [], [], []
    number, row = 0, []
    try:
        for place in rest[:vertex_count]:
            number, row = place
            x, y, z = map(float, row[:3])
            vertices.append((x, y, z))
        for place in rest[vertex_count : vertex_count + face_count]:
            number, row = place
            count = int(row[0])
            polygon = list(map(int, row[1 : count + 1]))
            if count < 3 or len(polygon) != count:
                raise ValueError
            counts.append(count)
            corners += polygon
        indices = np.array(corners, np.int64)
    except (ValueError, OverflowError):
        text = b" ".join(row).decode(errors="replace")
        raise MeshError(f"{where}: line {number} cannot be read: {text[:60]}") from None
    points = np.array(vertices, np.float64).reshape(-1, 3)
    return FileSurface(points, triangulate(points, np.array(counts), indices, where))
