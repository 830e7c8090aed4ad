"""STL files, binary and text; of one whose length is wrong, the facets that are there."""

import re

import numpy as np

from warp_abtree.model.files.found import FileSurface, MeshError, Remarks

FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_HEADER = 84  # bytes of text and count
# Blanks before words that begin a line in most text files.
BREAKS = re.compile(
    rb"\s+(?=(?:facet\s+normal|outer\s+loop|endloop|endfacet|endsolid)\b|vertex(?:\s+[-+.\d]\S*){3})", re.IGNORECASE
)


def read_stl(data: bytes, where: str, remarks: Remarks) -> FileSurface:
    """Return what an STL file holds, a part a solid; raise MeshError where it is neither text nor binary."""
    whole = len(data) >= STL_HEADER and len(data) == STL_HEADER + FACET.itemsize * _facet_count(data)
    spoken = b"\0" not in data or b"endfacet" in data.lower()
    if not whole and data.lstrip()[:5].lower() == b"solid" and spoken:
        return _read_text(data, where, remarks)
    if len(data) < STL_HEADER:
        raise MeshError(f"{where}: cannot be read as stl: {len(data)} bytes, and no text that begins with 'solid'")
    count, there = _facet_count(data), (len(data) - STL_HEADER) // FACET.itemsize
    if min(count, there) == 0:
        raise MeshError(f"{where}: no faces: its header declares {count:,} facets, and {there:,} would fit")
    if not whole:
        if there < count:
            remarks.add("cut short:", f"{there:,} facets are read of the {count:,} that its header declares")
        else:
            more = len(data) - STL_HEADER - FACET.itemsize * count
            remarks.add("left out", f"{more:,} bytes behind the {count:,} facets that its header declares")
    corners = np.frombuffer(data, FACET, min(count, there), STL_HEADER)["corners"]
    vertices = corners.reshape(-1, 3).astype(np.float64)
    return FileSurface(vertices, np.arange(len(vertices)).reshape(-1, 3))


def _facet_count(data) -> int:
    return int.from_bytes(data[STL_HEADER - 4 : STL_HEADER], "little")


def _read_text(data, where, remarks):
    """Read facets of three vertices each; one that is not closed is left out."""
    vertices: list[tuple] = []
    names: list[str | None] = []
    parts: list[int] = []
    done, number, ended = 0, 0, False
    lines, lower = data.splitlines(), data.lower()
    begun = sum(line.lstrip()[:6].lower() in (b"vertex", b"endloo") for line in lines)
    if begun < lower.count(b"vertex") + lower.count(b"endloop"):
        lines = BREAKS.sub(b"\n", data).splitlines()
    for number, line in enumerate(lines, start=1):
        words = line.split(maxsplit=4)
        match words[0].lower() if words else b"":
            case b"vertex":
                try:
                    x, y, z = map(float, words[1:])
                except ValueError:
                    if number == len(lines):
                        break
                    text = line.decode(errors="replace").strip()
                    raise MeshError(f"{where}: cannot be read as stl: line {number}: {text[:60]}") from None
                vertices.append((x, y, z))
            case b"endloop" | b"endfacet" if len(vertices) > done:
                if len(vertices) != done + 3:
                    raise MeshError(f"{where}: line {number}: a facet of {len(vertices) - done} vertices, not 3")
                parts.append(len(names) - 1)
                done = len(vertices)
            case b"solid":
                names.append(b" ".join(words[1:]).decode(errors="replace") or None)
                ended = False
            case b"endsolid":
                ended = True
    if not ended or len(vertices) > done:
        remarks.add("cut short:", f"{done // 3:,} facets are whole, and the last solid does not end")
    if not done:
        raise MeshError(f"{where}: no faces")
    points = np.array(vertices[:done], np.float64)
    return FileSurface(points, np.arange(done).reshape(-1, 3), tuple(names), np.array(parts))
