"""Winding: whether a mesh has an inside, whether its faces agree which way is out, and what can be mended of it.

An edge of an odd number of faces is odd. A mesh without odd edges is closed: every ray that avoids its edges, from a
point off it, crosses it an even or an odd number of times whichever way it goes, and odd is inside. So it stays at
every LOD: a face is active while its corners are distinct, a merge of two vertices maps faces to faces or to nothing
and the edges of faces to the edges of their images or to nothing, and numbers of faces at an edge add up.

Faces that meet at edges of two faces form a part. It is mixed where two faces run along an edge the same way; so are
several at an edge of more, of a closed mesh, where more of them run along it one way than the other. A part is
inside out where it is closed by itself and not mixed, and its faces point to where parity says inside: a body faces
out, the wall of a cavity in it faces into the cavity, a body in that cavity faces out again. Of a part some corners and
middles of faces are looked at, those that are not on another surface; it is within that where all of them are. A part
that others close, as where bodies touch at a wall, is judged by parity on both sides of its faces.

Of faces with the same three corners an even number cancels: parity counts none of them.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from warp_abtree.model.files.found import MeshError, warn_caller
from warp_abtree.model.sides import SAMPLED_FACES, holds_points, loose_inside_out, nearness, volume_sign

SHOWN_EDGES = 4


@dataclass(frozen=True, eq=False)
class Winding:
    """How the faces of a mesh are wound.

    Attributes:
        vertices: Positions [model units], float64 (v, 3).
        faces: Corners of the faces, int64 (n, 3), without those that welding dropped.
        face_ids: Their indices in the mesh, int (n,).
        odd_edges: Edges of an odd number of faces: vertices in ascending order, (k, 2); none of a closed mesh.
        odd_faces: The lowest face at each, (k,).
        mixed_edges: Edges of two faces, of a closed mesh of more too, along which more run one way than the other.
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
        return _inside_out(self.vertices, self.faces, self.part, self.doubled)

    @cached_property
    def doubled(self) -> np.ndarray:
        """Rows of the faces that are listed an even number of times and would enclose something if listed once."""
        return _doubled(self.faces, len(self.vertices))

    def describe_solid(self) -> str:
        """Return what the mesh holds as a solid, in a few words."""
        if not self.is_closed:
            return "no: not closed"
        count = len(self.doubled)
        if not count:
            return "yes"
        what = "holds nothing: all" if count == len(self.faces) else "holds less than it shows:"
        return f"{what} {count} faces are listed an even number of times"

    def fault(self) -> str | None:
        """Return what is wrong with the winding in a few words, or None."""
        if self.mixed_edges:
            return f"neighbouring faces disagree about the outside at {self.mixed_edges} edges"
        count = len(self.inside_out)
        some = "it is inside out" if count == len(self.faces) else f"parts of it are inside out, {count} faces"
        return some if count else None

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
        """Return the faces (n, 3), turned so that neighbours agree, as most of them did, and no part is inside out.

        Parts that have one side only, as a Moebius strip, stay as they are.
        """
        first, second, opposite = self.joints
        sign = _propagate(len(self.faces), first, second, np.where(opposite, 1, -1).astype(np.int8), self.part)
        wrong = sign[first] * sign[second] != np.where(opposite, 1, -1)
        sign[np.isin(self.part, self.part[first[wrong]])] = 1
        kept = np.bincount(self.part, sign, len(self.faces))
        sign = np.where(kept[self.part] < 0, -sign, sign)
        faces = np.where(sign[:, None] < 0, self.faces[:, ::-1], self.faces)
        turned = _inside_out(self.vertices, faces, self.part, self.doubled)
        faces[turned] = faces[turned][:, ::-1]
        return faces


def find_winding(vertices, faces, dropped_faces=()) -> Winding:
    """Return the `Winding` of a welded mesh."""
    face_ids = np.delete(np.arange(len(faces)), dropped_faces)
    faces = np.asarray(faces, np.int64)[face_ids]
    key, forward, corner, start, count = sorted_edges(faces, len(vertices))
    row = corner // 3
    odd, two = start[count % 2 == 1], start[count == 2]
    # Bodies that each agree about the outside run along an edge as often one way as the other.
    mixed = (np.add.reduceat(np.where(forward, 1, -1), start) != 0) & ((count == 2) | (len(odd) == 0))
    first, second, opposite = row[two], row[two + 1], forward[two] != forward[two + 1]
    return Winding(
        vertices=vertices,
        faces=faces,
        face_ids=face_ids,
        odd_edges=np.stack([key[odd] // len(vertices), key[odd] % len(vertices)], 1),
        odd_faces=face_ids[row[odd]],
        mixed_edges=int(np.count_nonzero(mixed)),
        part=component_labels(np.stack([first, second], 1), len(faces)),
        joints=(first, second, opposite),
    )


def check_solid(winding: Winding, name: str):
    """Raise MeshError for a mesh that has no inside, and warn of faces that hold nothing; its name stands in both."""
    if not winding.is_closed:
        raise MeshError(f"model {name!r} is no solid: it is not closed, {winding.describe_open()}")
    if len(winding.doubled):
        what = f"model {name!r} as a solid {winding.describe_solid()}; keep one of each"
        warn_caller(what)


def keep_outside(faces, linear):
    """Return faces (n, 3) for vertices that a matrix (3, 3) maps: turned where it mirrors, so that they face out."""
    return faces[:, ::-1] if np.linalg.det(linear) < 0 else faces


def component_labels(faces, vertex_count):
    """Return the lowest vertex that each vertex is joined to through faces, int (v,)."""
    label = np.arange(vertex_count)
    pending = faces
    while len(pending):
        corner_label = label[pending]
        lowest = corner_label.min(axis=1)
        for column in corner_label.T:
            np.minimum.at(label, column, lowest)
        label = find_roots(label)  # there are some: label[v] <= v
        corner_label = label[pending]
        pending = pending[(corner_label != corner_label[:, :1]).any(axis=1)]
    return label


def find_roots(above):
    """Return the root over each node of a forest; `above` has the node over each, a root over itself."""
    # Pointer doubling: the forest's depth in its logarithm of rounds.
    while True:
        further = above[above]
        if np.array_equal(further, above):
            return above
        above = further


def distinct_rows(rows):
    """Return the lowest of each set of equal rows, in the order of their values, and the place of each row there."""
    order = np.lexsort(rows.T)  # stable: equal rows stay in ascending order
    ordered = rows[order]
    new = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    place = np.empty(len(rows), np.int64)
    place[order] = np.cumsum(new) - 1
    return order[new], place


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
    """Return a key of the edge that starts at each corner of faces, and whether it runs towards the higher vertex."""
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    return np.minimum(tail, head) * vertex_count + np.maximum(tail, head), tail < head


def sorted_edges(faces, vertex_count):
    """Return what `_edges` does, by rising keys, the corners, and where those of each edge start and how many they are.

    A key is the lower vertex times the number of vertices, plus the higher one.
    """
    key, forward = _edges(faces, vertex_count)
    corner = np.argsort(key, kind="stable")
    key, forward = key[corner], forward[corner]
    start = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    return key, forward, corner, start, np.diff(np.append(start, len(key)))


def _edge_groups(faces, vertex_count):
    """Return the lowest row of the faces that each is joined to by edges, and whether these leave no edge odd."""
    key, _, corner, start, count = sorted_edges(faces, vertex_count)
    row, same = corner // 3, key[1:] == key[:-1]
    group = component_labels(np.stack([row[:-1][same], row[1:][same]], 1), len(faces))
    return group, ~np.isin(group, group[row[start[count % 2 == 1]]])


def _doubled(faces, vertex_count):
    """Return the rows of `Winding.doubled`: all, or those of closed surfaces of faces that cancel."""
    first, number = distinct_rows(np.sort(faces, axis=1))
    even = np.bincount(number) % 2 == 0
    once = first[even]
    if len(once) < len(even):
        even[even] = _edge_groups(faces[once], vertex_count)[1]
    return np.flatnonzero(even[number])


def _inside_out(vertices, faces, part, doubled):
    """Return the rows of the faces of all parts that are inside out."""
    names, part = np.unique(part, return_inverse=True)
    key, forward = _edges(faces, len(vertices))
    row = np.arange(key.size) // 3
    edges, edge = np.unique(key, return_inverse=True)
    own, place = np.unique(part[row] * len(edges) + edge, return_inverse=True)
    # Other parts may touch it at an edge, which then has more than two faces.
    balance = np.bincount(place, np.where(forward, 1, -1))
    whole = np.ones(len(names), bool)
    whole[own[balance != 0] // len(edges)] = False
    # Parity counts whole parts, and what else there is of faces that leave no edge odd.
    group, closed = _edge_groups(faces, len(vertices))
    body = np.where(whole[part], part, len(names) + group)
    order = np.argsort(body, kind="stable")
    start = np.flatnonzero(np.append(True, np.diff(body[order]) != 0))
    rows = np.split(order, start[1:])
    is_whole = body[order[start]] < len(names)
    counts = is_whole | closed[order[start]]
    corners = vertices[faces]
    lower = np.minimum.reduceat(corners.min(1)[order], start)
    upper = np.maximum.reduceat(corners.max(1)[order], start)
    turned = []
    for k in np.flatnonzero(is_whole):
        near = nearness(lower[k], upper[k])
        around = counts & (lower <= lower[k] + near).all(1) & (upper >= upper[k] - near).all(1)
        around[k] = False
        depth = 0
        if around.any():
            some = corners[rows[k][np.unique(np.linspace(0, len(rows[k]) - 1, SAMPLED_FACES).astype(int))]]
            points = np.stack([some[:, 0], some.mean(1)], 1).reshape(-1, 3)
            depth = sum(holds_points(corners[rows[other]], points) for other in np.flatnonzero(around))
        if volume_sign(corners[rows[k]]) == (1 if depth % 2 else -1):
            turned.append(rows[k])
    loose = ~whole & (np.bincount(part, ~closed) == 0)
    loose[part[doubled]] = False
    if loose.any():
        counted = np.concatenate([rows[k] for k in np.flatnonzero(counts)])
        name, border = own[balance != 0] // len(edges), own[balance != 0] % len(edges)
        start, ways = np.searchsorted(name, np.arange(len(names) + 1)), balance[balance != 0]
        borders = [(border[a:b].tobytes(), ways[a:b].tobytes()) for a, b in pairwise(start)]
        turned += loose_inside_out(vertices, faces, part, np.flatnonzero(loose), counted, borders)
    return np.sort(np.concatenate(turned)) if turned else np.empty(0, np.int64)
