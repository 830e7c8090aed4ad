"""Winding: whether a mesh has an inside, whether its faces agree which way is out, and what can be mended of it.

An edge of an odd number of faces is odd. A mesh without odd edges is closed: every ray that avoids its edges, from a
point off it, crosses it an even or an odd number of times whichever way it goes, and odd is inside. So it stays at
every LOD: a face is active while its corners are distinct, a merge of two vertices maps faces to faces or to nothing
and the edges of faces to the edges of their images or to nothing, and numbers of faces at an edge add up.

Faces that meet at edges of two faces form a part. It is mixed where two faces run along an edge the same way, and
inside out where it is closed by itself, not mixed, of negative volume, and within an even number of other such parts:
the wall of a cavity may face inwards.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from warp_abtree.model.files.found import MeshError

SHOWN_EDGES = 4
# Of the sum of all products of three coordinates: 80 roundings of 2^-53 in each, and those of the sum.
VOLUME_ROUNDING = 2.0**-45


@dataclass(frozen=True, eq=False)
class Winding:
    """How the faces of a mesh are wound.

    Attributes:
        vertices: Positions [model units], float64 (v, 3).
        faces: Corners of the faces, int64 (n, 3), without those that welding dropped.
        face_ids: Their indices in the mesh, int (n,).
        odd_edges: Edges of an odd number of faces: vertices in ascending order, (k, 2); none of a closed mesh.
        odd_faces: The lowest face at each, (k,).
        mixed_edges: Edges of two faces that run along them the same way.
        part: The lowest row of each face's part, (n,).
        joints: Rows of the two faces at each edge that has two, (j,) each, and whether they run along it opposite ways.
    """

    vertices: np.ndarray
    faces: np.ndarray
    face_ids: np.ndarray
    odd_edges: np.ndarray
    odd_faces: np.ndarray
    mixed_edges: int
    part: np.ndarray
    joints: tuple

    @property
    def is_closed(self) -> bool:
        """Whether the mesh has an inside."""
        return len(self.odd_edges) == 0

    @cached_property
    def inside_out(self) -> np.ndarray:
        """Rows of the faces of all parts that are inside out."""
        return _inside_out(self.vertices, self.faces, self.part)

    def fault(self) -> str | None:
        """Return what is wrong with the winding in a few words, or None."""
        if self.mixed_edges:
            return f"neighbouring faces disagree about the outside at {self.mixed_edges} edges"
        inverted = len(self.inside_out)
        if not inverted:
            return None
        return "it is inside out" if inverted == len(self.faces) else f"parts of it are inside out, {inverted} faces"

    def describe_open(self) -> str:
        """Return how many edges are odd, and where some of them lie."""
        shown = [
            f"{_place(self.vertices[a])} to {_place(self.vertices[b])} of face {face}"
            for (a, b), face in zip(self.odd_edges[:SHOWN_EDGES].tolist(), self.odd_faces.tolist())
        ]
        count = len(self.odd_edges)
        more = ", ..." if count > len(shown) else ""
        return f"{count} edges belong to an odd number of faces: {', '.join(shown)}{more}"

    def oriented(self) -> np.ndarray:
        """Return the faces (n, 3), turned so that neighbours agree, as most of them did, and closed parts face out.

        Parts that have one side only, as a Moebius strip, stay as they are.
        """
        first, second, opposite = self.joints
        sign = _propagate(len(self.faces), first, second, np.where(opposite, 1, -1).astype(np.int8), self.part)
        wrong = sign[first] * sign[second] != np.where(opposite, 1, -1)
        sign[np.isin(self.part, self.part[first[wrong]])] = 1
        kept = np.bincount(self.part, sign, len(self.faces))
        sign = np.where(kept[self.part] < 0, -sign, sign)
        faces = np.where(sign[:, None] < 0, self.faces[:, ::-1], self.faces)
        turned = _inside_out(self.vertices, faces, self.part)
        faces[turned] = faces[turned][:, ::-1]
        return faces


def find_winding(vertices, faces, dropped_faces=()) -> Winding:
    """Return the `Winding` of a welded mesh."""
    face_ids = np.delete(np.arange(len(faces)), dropped_faces)
    faces = np.asarray(faces, np.int64)[face_ids]
    key, forward, row = _edges(faces, len(vertices))
    order = np.argsort(key, kind="stable")
    key, forward, row = key[order], forward[order], row[order]
    start = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    count = np.diff(np.append(start, len(key)))
    odd, two = start[count % 2 == 1], start[count == 2]
    first, second, opposite = row[two], row[two + 1], forward[two] != forward[two + 1]
    return Winding(
        vertices=vertices,
        faces=faces,
        face_ids=face_ids,
        odd_edges=np.stack([key[odd] // len(vertices), key[odd] % len(vertices)], 1),
        odd_faces=face_ids[row[odd]],
        mixed_edges=int(np.count_nonzero(~opposite)),
        part=component_labels(np.stack([first, second], 1), len(faces)),
        joints=(first, second, opposite),
    )


def refuse_open(winding: Winding, name: str):
    """Raise MeshError for a mesh that has no inside; its name stands in the message."""
    if not winding.is_closed:
        raise MeshError(f"model {name!r} is no solid: it is not closed, {winding.describe_open()}")


def component_labels(faces, vertex_count):
    """Return the lowest vertex that each vertex is joined to through faces, int (v,)."""
    label = np.arange(vertex_count)
    pending = faces
    while len(pending):
        corner_label = label[pending]
        lowest = corner_label.min(axis=1)
        for column in corner_label.T:
            np.minimum.at(label, column, lowest)
        # Invariant: label[v] <= v, so jumping ends, at roots.
        while True:
            jumped = label[label]
            if np.array_equal(jumped, label):
                break
            label = jumped
        corner_label = label[pending]
        pending = pending[(corner_label != corner_label[:, :1]).any(axis=1)]
    return label


def _place(x) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in x.tolist()) + ")"


def _propagate(count, first, second, relation, part):
    """Return a sign of each face such that neighbours have the product that is given, as far as there is one, int8.

    The lowest face of each part has 1; the others take theirs from the neighbour by which they are first reached.
    """
    ends, others = np.concatenate([first, second]), np.concatenate([second, first])
    order = np.argsort(ends, kind="stable")
    others, relation = others[order], np.concatenate([relation, relation])[order]
    start = np.searchsorted(ends[order], np.arange(count + 1))
    sign = np.zeros(count, np.int8)
    reached = np.unique(part)
    sign[reached] = 1
    while len(reached):
        length = start[reached + 1] - start[reached]
        at = np.repeat(start[reached] - np.append(0, np.cumsum(length)[:-1]), length) + np.arange(length.sum())
        source, target, asked = np.repeat(reached, length), others[at], relation[at]
        new = sign[target] == 0
        sign[target[new]] = sign[source[new]] * asked[new]
        reached = np.unique(target[new])
    return sign


def _edges(faces, vertex_count):
    """Return a key of each face's edges, whether each runs towards the higher vertex, and its face: three a face."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    return np.minimum(tail, head) * vertex_count + np.maximum(tail, head), tail < head, np.arange(tail.size) // 3


def _inside_out(vertices, faces, part):
    """Return the rows of the faces of all parts that are inside out."""
    names, part = np.unique(part, return_inverse=True)
    key, forward, row = _edges(faces, len(vertices))
    edges, edge = np.unique(key, return_inverse=True)
    own, place = np.unique(part[row] * len(edges) + edge, return_inverse=True)
    # Other parts may touch it at an edge, which then has more than two faces.
    balance = np.bincount(place, np.where(forward, 1, -1))
    whole = np.ones(len(names), bool)
    whole[own[balance != 0] // len(edges)] = False
    order = np.argsort(part, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(part))[:-1])
    corners = vertices[faces]
    signs = np.array([_volume_sign(corners[rows[k]]) if whole[k] else 0 for k in range(len(names))])
    boxes = np.array([(corners[of].min((0, 1)), corners[of].max((0, 1))) for of in rows])
    turned = []
    for k in np.flatnonzero(signs < 0):
        around = (boxes[:, 0] < boxes[k, 0]).all(1) & (boxes[:, 1] > boxes[k, 1]).all(1) & (signs != 0)
        point = corners[rows[k][0], 0]
        if sum(_contains(corners[rows[other]], point) for other in np.flatnonzero(around)) % 2 == 0:
            turned.append(rows[k])
    return np.sort(np.concatenate(turned)) if turned else np.empty(0, np.int64)


def _volume_sign(corners) -> int:
    """Return the sign of the volume within a closed, consistently wound surface, exactly."""
    origin = corners[0, 0]
    scale = np.abs(corners - origin).max()
    a, b, c = ((corners[:, k] - origin) / scale for k in range(3))
    terms = np.einsum("ij,ij->i", a, np.cross(b, c))
    a, b, c = np.abs(a), np.abs(b), np.abs(c)
    sizes = np.roll(b, -1, 1) * np.roll(c, -2, 1) + np.roll(b, -2, 1) * np.roll(c, -1, 1)
    volume = terms.sum()
    if abs(volume) <= VOLUME_ROUNDING * np.einsum("ij,ij->", a, sizes):
        volume = sum(_exact_volume(*face) for face in corners)
    return int(volume > 0) - int(volume < 0)


def _exact_volume(a, b, c) -> Fraction:
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = ([Fraction(x) for x in p] for p in (a.tolist(), b.tolist(), c.tolist()))
    return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)


def _contains(corners, point) -> bool:
    """Return whether a point lies within a closed surface that it is not on, in float64: crossings of a ray along z."""
    corners = corners - point
    above = corners[:, :, 1] > 0
    crossings = np.zeros(len(corners), bool)
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        # The same numbers for both faces of an edge.
        swap = (above[:, k] > above[:, (k + 1) % 3])[:, None]
        a, b = np.where(swap, b, a), np.where(swap, a, b)
        right = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
        crossings ^= (above[:, k] != above[:, (k + 1) % 3]) & right
    a, b, c = (corners[crossings, k] for k in range(3))
    normal = np.cross(b - a, c - a)
    return bool(np.count_nonzero(np.einsum("ij,ij->i", normal, a) * normal[:, 2] > 0) % 2)
