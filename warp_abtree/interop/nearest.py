"""Least distance of posed original meshes, on the host: branch and bound over the boxes of their AB-Trees.

Pairs of nodes whose boxes are farther apart than some pair of faces are pruned; the bounds allow for rounding, so the
result is the least distance of all pairs of faces, to the rounding of coordinates.
"""

import numpy as np

CHUNK = 2**12  # node pairs expanded at a time, the nearest first
ROUNDING = 2.0**-44


class NodeBoxes:
    """Boxes over an original mesh at every node of its tree, float64, model frame.

    Attributes:
        middle, half: Centre and half extents of each heap node, (nodes, 3); half is negative without a face.
        radius: Length of half, (nodes,).
        face: Face of a leaf, else -1, (nodes,).
    """

    def __init__(self, model):
        progressive, tree = model.progressive, model.tree
        kept = np.delete(np.arange(model.face_count), model.dropped_faces)
        corners = progressive.vertex_pos[progressive.face_vertex[kept]]
        lower, upper = tree.node_boxes(kept, corners.min(1), corners.max(1))
        used = (lower <= upper).all(1)
        self.middle, self.half = np.zeros_like(lower), np.full_like(lower, -1.0)
        self.middle[used] = 0.5 * lower[used] + 0.5 * upper[used]
        self.half[used] = (0.5 * upper[used] - 0.5 * lower[used]) * (1 + ROUNDING)
        self.radius = np.linalg.norm(self.half, axis=1)
        self.face = tree.node_face


class _Search:
    """Branch and bound over the nodes of many object pairs at once."""

    def __init__(self, shapes, poses, pairs, upper):
        self.shapes, self.poses, self.pairs = shapes, poses, pairs
        used = {shapes[i]: None for i in np.unique(pairs).tolist()}
        boxes = [shape.node_boxes for shape in used]
        start = np.cumsum([0, *(len(part.face) for part in boxes)])
        first_node = dict(zip(used, start.tolist()))
        # Nodes of all shapes are numbered consecutively; those of each pair's shapes begin here, (2, p).
        self.start = np.array([[first_node[shapes[i]] for i in column.tolist()] for column in pairs.T])
        self.middle, self.half, self.radius, self.face = (
            np.concatenate([getattr(part, name) for part in boxes]) for name in ("middle", "half", "radius", "face")
        )
        a, b = poses[pairs[:, 0]], poses[pairs[:, 1]]
        back = a[:, :3, :3].transpose(0, 2, 1)
        self.rotation = back @ b[:, :3, :3]
        self.shift = np.einsum("nij,nj->ni", back, b[:, :3, 3] - a[:, :3, 3])
        # A frame that deviates from orthonormal by s changes lengths by a factor within 1 +- 1.5 s.
        skew = [np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max((1, 2)) for r in (a[:, :3, :3], b[:, :3, :3])]
        self.stretch = 1 + 4 * (skew[0] + skew[1]) + ROUNDING
        reach = max(float(np.abs(part.middle[1]).max() + part.radius[1]) for part in boxes)
        size = reach + np.linalg.norm(self.shift, axis=1)
        # Distances of faces are computed in the world, with rounding relative to the distance from its origin.
        world = np.linalg.norm(a[:, :3, 3], axis=1) + np.linalg.norm(b[:, :3, 3], axis=1)
        self.slack = size * (4 * (skew[0] + skew[1]) + ROUNDING) + world * ROUNDING
        self.bound = upper
        self.found = None

    def walk_corners(self, pair):
        """Lower `bound` to the distance of two close corners, found by alternating nearest-corner searches."""
        a, b = (self._place(slot, slice(self.shapes[slot].model.vertex_count)) for slot in self.pairs[pair])
        i, best = 0, np.inf
        while True:
            j = int(np.square(b - a[i]).sum(1).argmin())
            squares = np.square(a - b[j]).sum(1)
            i = int(squares.argmin())
            if not squares[i] < best:
                break
            best = squares[i]
        self.bound = min(self.bound, float(np.sqrt(best)) * (1 + ROUNDING))

    def _place(self, slot, vertices):
        corners = self.shapes[slot].model.progressive.vertex_pos[vertices]
        return corners @ self.poses[slot, :3, :3].T + self.poses[slot, :3, 3]

    def measure_boxes(self, pair, a, b):
        """Return lower bounds on the distances of boxes, and lower `bound` to the least of their upper bounds."""
        middle = np.einsum("nij,nj->ni", self.rotation[pair], self.middle[b]) + self.shift[pair] - self.middle[a]
        half = np.einsum("nij,nj->ni", np.abs(self.rotation[pair]), self.half[b]) + self.half[a]
        gap = np.linalg.norm(np.maximum(np.abs(middle) - half, 0), axis=1)
        most = np.linalg.norm(middle, axis=1) + self.radius[a] + self.radius[b]
        self.bound = min(self.bound, float((most * self.stretch[pair] + self.slack[pair]).min()))
        return gap / self.stretch[pair] - self.slack[pair]

    def measure_faces(self, pair, face_a, face_b):
        """Compute distances of pairs of faces, and keep the nearest pair."""
        a, b = (self._posed(self.pairs[pair, k], face) for k, face in enumerate((face_a, face_b)))
        distance, point_a, point_b = triangle_distances(a, b)
        k = int(distance.argmin())
        if self.found is None or distance[k] < self.found[0]:
            self.found = float(distance[k]), int(pair[k]), (int(face_a[k]), int(face_b[k])), (point_a[k], point_b[k])
            self.bound = min(self.bound, self.found[0])

    def _posed(self, slot, face):
        corners = np.empty((len(face), 3, 3))
        for each in np.unique(slot):
            own = slot == each
            corners[own] = self._place(each, self.shapes[each].model.progressive.face_vertex[face[own]])
        return corners

    def children(self, pair, a, b):
        """Return the child pairs of node pairs: each child with faces of the larger node, and the other node."""
        down_a = (self.face[b] >= 0) | ((self.face[a] < 0) & (self.radius[a] >= self.radius[b]))
        first_a, first_b = self.start[:, pair]
        first_a, first_b = 2 * a - first_a, 2 * b - first_b
        rows = [(pair, np.where(down_a, first_a + k, a), np.where(down_a, b, first_b + k)) for k in (0, 1)]
        pair, a, b = (np.concatenate(column) for column in zip(*rows))
        kept = (self.half[a] >= 0).all(1) & (self.half[b] >= 0).all(1)
        return pair[kept], a[kept], b[kept]


def find_nearest(shapes, poses, pairs, upper, likely):
    """Find the least distance of object pairs whose surfaces do not intersect.

    Args:
        shapes: Shape of each object, with `model` and `node_boxes`.
        poses: Rigid matrices of the objects [world units], float64 (n, 4, 4).
        pairs: Object indices, (p, 2), p > 0.
        upper: Upper bound on the least distance.
        likely: Index of a pair that may be the nearest.

    Returns:
        Distance, index of the pair, its faces (2), and the nearest points (2) [world units].
    """
    search = _Search(shapes, poses, pairs, upper * (1 + ROUNDING))
    pair = np.arange(len(pairs))
    search.walk_corners(likely)
    a, b = search.start + 1
    stack = [(search.measure_boxes(pair, a, b), pair, a, b)]
    while stack:
        kept = stack.pop()
        gap, pair, a, b = (column[kept[0] <= search.bound] for column in kept)
        leaf = (search.face[a] >= 0) & (search.face[b] >= 0)
        if leaf.any():
            search.measure_faces(pair[leaf], search.face[a[leaf]], search.face[b[leaf]])
        pair, a, b = search.children(pair[~leaf], a[~leaf], b[~leaf])
        if not len(pair):
            continue
        gap = search.measure_boxes(pair, a, b)
        order = np.argsort(-gap, kind="stable")
        order = order[gap[order] <= search.bound]
        for start in range(0, len(order), CHUNK):
            part = order[start : start + CHUNK]
            stack.append((gap[part], pair[part], a[part], b[part]))
    return search.found


def triangle_distances(a, b):
    """Return distances and nearest points of pairs of triangles that do not cross.

    Args:
        a, b: Corners, float64 (k, 3, 3).

    Returns:
        Distances (k,), points of a (k, 3), points of b (k, 3).

    Source: Ericson 2005, Real-time collision detection, sections 5.1.5 and 5.1.9.
    """
    best = np.full(len(a), np.inf)
    point_a, point_b = np.zeros((2, len(a), 3))

    def offer(p, q, where):
        length = np.where(where, _dot(q - p, q - p), np.inf)
        closer = length < best
        best[closer], point_a[closer], point_b[closer] = length[closer], p[closer], q[closer]

    for i in range(3):
        for j in range(3):
            p, q = _join_edges(a[:, i], a[:, (i + 1) % 3], b[:, j], b[:, (j + 1) % 3])
            offer(p, q, True)
    for i in range(3):
        foot, inside = _drop_on_face(b[:, i], a)
        offer(foot, b[:, i], inside)
        foot, inside = _drop_on_face(a[:, i], b)
        offer(a[:, i], foot, inside)
    return np.sqrt(best), point_a, point_b


def _dot(p, q):
    return np.einsum("ij,ij->i", p, q)


def _ratio(p, q):
    return np.divide(p, q, out=np.zeros_like(p), where=q > 0)


def _join_edges(p0, p1, q0, q1):
    """Return the nearest points of pairs of segments."""
    e, f, r = p1 - p0, q1 - q0, p0 - q0
    ee, ff, ef, er, fr = _dot(e, e), _dot(f, f), _dot(e, f), _dot(e, r), _dot(f, r)
    s = np.clip(_ratio(ef * fr - er * ff, ee * ff - ef * ef), 0, 1)
    t = np.clip(_ratio(ef * s + fr, ff), 0, 1)
    s = np.clip(_ratio(ef * t - er, ee), 0, 1)
    return p0 + s[:, None] * e, q0 + t[:, None] * f


def _drop_on_face(p, corners):
    """Return the projections of points to the planes of triangles, and whether they lie inside."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area = _dot(normal, normal)
    inside = area > 0
    for u, v in ((a, b), (b, c), (c, a)):
        inside &= _dot(np.cross(v - u, p - u), normal) >= 0
    return p - _ratio(_dot(p - a, normal), area)[:, None] * normal, inside
