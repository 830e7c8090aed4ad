"""PLY files: vertices, polygons in their order, and triangle strips; ASCII, and binary of both byte orders."""

import re
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from warp_abtree.model.files.found import FileSurface, MeshError, Remarks
from warp_abtree.model.files.polygons import cut_strip, triangulate

PLY_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
PLY_TYPES |= {"double": "f8"} | {
    f"{kind}{8 * size}": f"{kind[0]}{size}" for kind in ("int", "uint") for size in (1, 2, 4, 8)
}
PLY_TYPES |= {"float16": "f2", "float32": "f4", "float64": "f8"}
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    """A table of the file: properties are its columns, by name; a list's is the type of length and values."""

    name: str
    count: int
    properties: dict[str, tuple[str | None, str]] = field(default_factory=dict)

    def corners(self) -> str | None:
        """Return the name of the list of corners: one of the usual names, or the only list."""
        lists = [name for name, (length, _) in self.properties.items() if length]
        named = [name for name in lists if name in CORNERS] or lists
        return named[0] if len(named) == 1 else None

    def is_needed(self, name) -> bool:
        """Return whether a property is read, not only passed over."""
        return name in ("x", "y", "z") if self.name == "vertex" else name == self.corners()


def read_ply(data: bytes, where: str, remarks: Remarks) -> FileSurface:
    """Return what a PLY file holds; raise MeshError where it is damaged or holds no faces."""
    order, elements, start = _read_header(data, where)
    table = _read_text if order == "" else _read_binary
    rest, columns = (data[start:].splitlines() if order == "" else memoryview(data)[start:]), {}
    for element in elements:
        rest, columns[element.name] = table(rest, order, element, where)
        shape = element.name == "edge" or any(name in CORNERS for name in element.properties)
        if element.count and shape and element.name not in ("face", "tristrips"):
            remarks.add("left out", f"{element.count} {element.name!r}")
    if (b"".join(rest) if isinstance(rest, list) else bytes(rest)).strip():
        remarks.add("left out", "what follows the elements of its header")
    vertex = columns.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertex):
        raise MeshError(f"{where}: its header has no vertices with x, y and z")
    vertices = np.column_stack([vertex[axis] for axis in "xyz"]).astype(np.float64)
    faces = []
    for element in elements:
        if element.name in ("face", "tristrips") and element.count:
            name = element.corners()
            if name is None:
                raise MeshError(f"{where}: none of the properties of {element.name!r} is a list of vertex indices")
            counts, corners = columns[element.name][name]
            if corners.dtype.kind not in "iu":
                raise MeshError(f"{where}: the indices of {element.name!r} are no integers")
            corners = corners.astype(np.int64)
            if element.name == "face":
                faces.append(triangulate(vertices, counts, corners, where))
            else:
                faces += [cut_strip(strip) for strip in _strips(counts, corners)]
    if not faces:
        raise MeshError(f"{where}: no faces (it holds {', '.join(e.name for e in elements if e.count) or 'nothing'})")
    return FileSurface(vertices, np.concatenate(faces))


def _strips(counts, corners):
    """Yield the strips of lists in which -1 begins the next strip."""
    ends = np.cumsum(counts)
    for start, end in zip(ends - counts, ends):
        part = corners[start:end]
        yield from (piece[piece != -1] for piece in np.split(part, np.flatnonzero(part == -1)))


def _read_header(data, where):
    """Return the byte order ("" for text), the elements, and where their data starts."""
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*(\r\n|\n|\r|$)", data)
    lines = data[: end.start() if end else 0].decode(errors="replace").splitlines()
    if end is None or not lines or lines[0].strip() != "ply":
        raise MeshError(f"{where}: cannot be read as ply: it has no header of one")
    order, elements = None, []
    for line in map(str.split, lines[1:]):
        try:
            match line:
                case ["format", kind, _]:
                    order = ORDERS[kind]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count)))
                case ["property", "list", length, kind, name]:
                    if PLY_TYPES[length][0] == "f":
                        raise ValueError
                    elements[-1].properties[name] = (PLY_TYPES[length], PLY_TYPES[kind])
                case ["property", kind, name]:
                    elements[-1].properties[name] = (None, PLY_TYPES[kind])
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise MeshError(f"{where}: cannot be read as ply: header line {' '.join(line)[:60]!r}") from None
    if order is None or any(element.count < 0 for element in elements):
        raise MeshError(f"{where}: cannot be read as ply: its header names no format, or a negative count")
    return order, elements, end.end()


def _cut_short(where, element, there):
    return MeshError(f"{where}: cut short: its header declares {element.count} {element.name!r}, {there} are whole")


def _read_text(lines, _, element, where):
    """Return the lines after an element, and its columns: a list's as lengths and values."""
    rows, used = [], 0
    for used, line in enumerate(lines, start=1):
        if len(rows) == element.count:
            used -= 1
            break
        if line and not line.isspace():
            rows.append(line.split())
    if len(rows) < element.count:
        raise _cut_short(where, element, len(rows))
    found: dict[str, list] = {name: [] for name in element.properties}
    lengths: dict[str, list] = {name: [] for name, (length, _) in element.properties.items() if length}
    try:
        if not lengths:
            table = list(map(list, zip(*rows, strict=True))) or [[]] * len(found)
            found = dict(zip(found, table, strict=True))
        for row in rows if lengths else ():
            at = 0
            for name, values in found.items():
                size = 1
                if name in lengths:
                    size, at = int(row[at]), at + 1
                    lengths[name].append(size)
                if size < 0 or at + size > len(row):
                    raise ValueError
                values.extend(row[at : at + size])
                at += size
            if at != len(row):
                raise ValueError
        columns: dict = {}
        for name, values in found.items():
            if element.is_needed(name):
                kind = element.properties[name][1]
                read = np.array(list(map(float, values)), kind) if kind[0] == "f" else np.array(list(map(int, values)))
                columns[name] = (np.array(lengths[name], np.int64), read) if name in lengths else read
    except (ValueError, IndexError, OverflowError):
        raise MeshError(
            f"{where}: cannot be read as ply: a line of the {element.count} {element.name!r} does not fit the header"
        ) from None
    return lines[used:], columns


def _read_binary(data, order, element, where):
    """Return the bytes after an element, and its columns: a list's as lengths and values."""
    kinds = {name: (length and order + length, order + kind) for name, (length, kind) in element.properties.items()}
    if not kinds or not element.count:
        return data, dict.fromkeys(kinds, np.zeros(0))
    same = _read_alike(data, kinds, element.count)
    if same is not None:
        return same
    starts: dict[str, list] = {name: [] for name, (length, _) in kinds.items() if length or element.is_needed(name)}
    lengths: dict[str, list] = {name: [] for name in starts}
    steps = [(name, length and np.dtype(length), np.dtype(kind).itemsize) for name, (length, kind) in kinds.items()]
    at, last = 0, len(data)
    byte_order: Literal["big", "little"] = "big" if order == ">" else "little"
    for row in range(element.count):
        for name, length, size in steps:
            there = 1
            if length is not None:
                there = int.from_bytes(data[at : at + length.itemsize], byte_order, signed=length.kind == "i")
                if there < 0:
                    raise MeshError(f"{where}: {element.name} {row} has {there} corners")
                at += length.itemsize
            if name in starts:
                starts[name].append(at)
                lengths[name].append(there)
            at += there * size
        if at > last:
            raise _cut_short(where, element, row)
    raw, columns = np.frombuffer(data[:at], np.uint8), {}
    for name in starts:
        kind, counts = np.dtype(kinds[name][1]), np.array(lengths[name])
        first = np.repeat(np.array(starts[name]) - kind.itemsize * (np.cumsum(counts) - counts), counts)
        place = first + kind.itemsize * np.arange(len(first))
        values = raw[place[:, None] + np.arange(kind.itemsize)].reshape(-1).view(kind)
        columns[name] = (counts, values) if kinds[name][0] else values
    return data[at:], columns


def _read_alike(data, kinds, count):
    """Return what `_read_binary` does if all lists of a column are as long as its first; None else, or if cut short."""
    fields, at = [], 0
    for name, (length, kind) in kinds.items():
        if length:
            size = np.dtype(length).itemsize
            if at + size > len(data):
                return None
            first = int(np.frombuffer(data[at : at + size], length)[0])
            if not 0 <= first <= len(data):
                return None
            fields += [(f"{name} length", length), (name, kind, (first,))]
            at += size + first * np.dtype(kind).itemsize
        else:
            fields.append((name, kind))
            at += np.dtype(kind).itemsize
    if at * count > len(data):
        return None
    rows, columns = np.frombuffer(data[: at * count], np.dtype(fields)), {}
    for name, (length, _) in kinds.items():
        if length is None:
            columns[name] = rows[name]
            continue
        lengths = rows[f"{name} length"]
        if (lengths != lengths[0]).any():
            return None
        columns[name] = lengths.astype(np.int64), rows[name].reshape(-1)
    return data[at * count :], columns
