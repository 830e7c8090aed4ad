"""A serial AB-Tree in plain Python, after Algorithms 1 to 3 of Liu, Georganas and Roth 2006, section 3.2.

Operations keep the paper's names and structure, and share no code with the library's parallel tree. What both must
agree on to the bit is stated where it is computed: the median split, the heap numbering, the rounding of leaf boxes.
"""

import math
from collections import namedtuple
from dataclasses import dataclass, field

import numpy as np

INACTIVE, ACTIVE, DEFORMED = 0, 1, 2
NONE = -1
EMPTY = ((math.inf,) * 3, (-math.inf,) * 3)


@dataclass
class Progressive:
    """A progressive mesh as plain lists; `lod` counts vertex splits from the base mesh.

    Face f is active iff lod >= face_split[f]; slice i of split_face lists the faces that split i inserts or deforms.
    """

    vertex_parent: list
    vertex_pos: list
    face_vertex: list
    face_split: list
    split_start: list
    split_face: list

    @classmethod
    def of(cls, source):
        """Copy the six arrays of any object that has them as attributes into plain lists."""
        return cls(*(np.asarray(getattr(source, name)).tolist() for name in cls.__dataclass_fields__))

    @property
    def lod_max(self):
        return len(self.split_start) - 1

    def ancestor(self, vertex, lod):
        """Highest ancestor of an original vertex that exists at this lod."""
        while NONE < self.vertex_parent[vertex] < len(self.vertex_parent) - lod:
            vertex = self.vertex_parent[vertex]
        return vertex

    def corners(self, face, lod):
        """The three active vertex nodes of a face."""
        return [self.ancestor(v, lod) for v in self.face_vertex[face]]

    def is_active(self, face, lod):
        return lod >= self.face_split[face]

    def sets_between(self, lod_from, lod_to):
        """The paper's sets I, R and D (inserted, removed, deformed) for a change of lod in either direction."""
        low, high = sorted((lod_from, lod_to))
        touched = sorted(set(self.split_face[self.split_start[low] : self.split_start[high]]))
        change = {face: (self.is_active(face, lod_from), self.is_active(face, lod_to)) for face in touched}
        return [[f for f in touched if change[f] == kind] for kind in ((False, True), (True, False), (True, True))]

    def centre(self):
        """Centre of the box of the original vertices; 0.5 * lower + 0.5 * upper cannot overflow."""
        points = self.vertex_pos[: len(self.vertex_parent) - self.lod_max]
        return [0.5 * min(p[k] for p in points) + 0.5 * max(p[k] for p in points) for k in range(3)]


class Node:
    """A tree node: range is (lower, upper), index the primitive of a leaf.

    Beside the paper's fields, number is the heap index (root 1, children 2x and 2x+1), and skip the highest
    descendant-or-self that a traversal need visit.
    """

    __slots__ = ("index", "left", "number", "parent", "range", "right", "skip", "status")

    def __init__(self, number, parent):
        self.number, self.parent = number, parent
        self.left = self.right = self.index = self.skip = None
        self.range, self.status = EMPTY, INACTIVE

    @property
    def is_leaf(self):
        return self.index is not None

    def deactivate(self):
        self.status, self.range, self.skip = INACTIVE, EMPTY, None


@dataclass
class ABTree:
    """An AB-Tree: linked nodes, the indexed list `leaf` (face -> leaf node), and the lod that the mesh stands at."""

    mesh: Progressive
    lod: int
    root: Node = None
    leaf: list = field(default_factory=list)
    centre: list = field(default_factory=list)

    def nodes(self):
        """All nodes, children after parents."""
        stack = [self.root]
        while stack:
            node = stack.pop()
            yield node
            if not node.is_leaf:
                stack += [node.right, node.left]

    def flat(self):
        """Return the state as arrays by heap index, of length 2^(depth+1); numbers without a node are inactive."""
        numbered = {node.number: node for node in self.nodes()}
        size = 2 << (max(numbered).bit_length() - 1)
        state = {
            "status": np.zeros(size, np.int8),
            "lower": np.full((size, 3), np.inf, np.float32),
            "upper": np.full((size, 3), -np.inf, np.float32),
            "skip": np.full(size, NONE, np.int32),
            "face_node": np.array([leaf.number for leaf in self.leaf], np.int32),
        }
        for number, node in numbered.items():
            state["status"][number] = node.status
            state["lower"][number], state["upper"][number] = node.range
            if node.skip is not None:
                state["skip"][number] = node.skip.number
        return state


# What one ACTIVE-UPDATE cost: k distinct faces, and the number of nodes marked (equation 1 bounds it).
Update = namedtuple("Update", "k nodes_refitted")


def refit_bound(n, k):
    """Equation (1): at most k (log2 n - log2 k + 2) - 1 nodes are marked, n rounded up to a power of two."""
    return k * ((n - 1).bit_length() - math.log2(k) + 2) - 1 if k else 0


def round_out(value, end):
    """Return the next float32 strictly beyond a float64 on the side of an end: outwards even where it is exact."""
    f = np.float32(value)
    return float(f if end * (float(f) - value) > 0 else np.nextafter(f, np.float32(end * np.inf)))


def active_build(mesh, lod=None):
    """ACTIVE-BUILD(P): split the set of all primitives top-down, then take the state of one lod (default: finest).

    Node i of depth d covers the leaf positions (i n) >> d .. ((i+1) n) >> d. The axis is that of the least sum of
    extents of both halves' boxes at the finest lod, or for fewer than 10 faces the longest of their box (ties: lowest).
    The paper takes the longest everywhere. The order is by lower + upper of a face's own box (ties: lowest face).
    """
    n = len(mesh.face_vertex)
    points = [[mesh.vertex_pos[v] for v in face] for face in mesh.face_vertex]
    lower = [[min(p[k] for p in face) for k in range(3)] for face in points]
    upper = [[max(p[k] for p in face) for k in range(3)] for face in points]
    tree = ABTree(mesh, mesh.lod_max, leaf=[None] * n, centre=mesh.centre())

    def sort_faces(faces, axis):
        return sorted(faces, key=lambda f: (lower[f][axis] + upper[f][axis], f))

    def extents(faces):
        return [max(upper[f][k] for f in faces) - min(lower[f][k] for f in faces) for k in range(3)]

    def subdivide(faces, number, parent):
        node = Node(number, parent)
        if len(faces) == 1:
            node.index = faces[0]
            tree.leaf[node.index] = node
            return node
        depth = number.bit_length() - 1
        i = number - (1 << depth)
        half = ((2 * i + 1) * n >> depth + 1) - (i * n >> depth)
        orders = [sort_faces(faces, axis) for axis in range(3)]
        costs = [sum(extents(order[:half])) + sum(extents(order[half:])) for order in orders]
        if len(faces) < 10:
            costs = [-extent for extent in extents(faces)]
        ordered = orders[costs.index(min(costs))]
        node.left = subdivide(ordered[:half], 2 * number, node)
        node.right = subdivide(ordered[half:], 2 * number + 1, node)
        return node

    tree.root = subdivide(list(range(n)), 1, None)
    rebuild(tree, mesh.lod_max if lod is None else lod)
    return tree


def rebuild(tree, lod):
    """Set every node for a lod from nothing: the state that any ACTIVE-UPDATE must arrive at, bit for bit."""
    tree.lod = lod

    def visit(node):
        if not node.is_leaf:
            visit(node.left)
            visit(node.right)
            alive = node.left.status == ACTIVE or node.right.status == ACTIVE
        else:
            alive = tree.mesh.is_active(node.index, lod)
        if alive:
            active_refit(tree, node)
        else:
            node.deactivate()

    visit(tree.root)


def active_mark(inserted, removed, deformed, tree):
    """ACTIVE-MARK(I, R, D, T): mark bottom-up what a refinement touches; returns the subtree Ts as a set of nodes.

    Erratum (a). Algorithm 2 as printed climbs from a removed leaf only while the sibling is active and writes nothing
    on the way; at the first inactive sibling it returns from the whole operation (lines 6 and 10), so that the rest of
    R and all of D and I are never marked. The text says what is meant: a node is inactive iff no active primitive lies
    under it, and every box is the smallest. So a removed leaf becomes inactive, and with it each ancestor whose other
    child is inactive too; those above are deformed. R goes before D and I, which revive what R had emptied.
    """
    marked = set()
    for face in removed:
        x = tree.leaf[face]
        while x is not None:
            if x.is_leaf or x.left.status == x.right.status == INACTIVE:
                x.deactivate()
            else:
                x.status = DEFORMED
            marked.add(x)
            x = x.parent
    for face in deformed + inserted:
        x = tree.leaf[face]
        while x is not None:
            x.status = DEFORMED
            marked.add(x)
            x = x.parent
    return marked


def active_refit(tree, node):
    """ACTIVE-REFIT(x): the smallest box, status active, and the skip link.

    A leaf's float32 box is about the model's centre and strictly encloses the float64 differences.
    """
    if node.is_leaf:
        corners = [tree.mesh.vertex_pos[v] for v in tree.mesh.corners(node.index, tree.lod)]
        moved = [[p[k] - tree.centre[k] for k in range(3)] for p in corners]
        lower = tuple(round_out(min(p[k] for p in moved), -1) for k in range(3))
        upper = tuple(round_out(max(p[k] for p in moved), 1) for k in range(3))
        node.range, node.skip = (lower, upper), node
    else:
        children = [c for c in (node.left, node.right) if c.status == ACTIVE]
        lower = tuple(min(c.range[0][k] for c in children) for k in range(3))
        upper = tuple(max(c.range[1][k] for c in children) for k in range(3))
        node.range = (lower, upper)
        node.skip = node if len(children) == 2 else children[0].skip
    node.status = ACTIVE


def active_walk(tree, node):
    """ACTIVE-WALK(x): refit the deformed nodes in post-order, so that children are final before their parent."""
    if node is not None and node.status == DEFORMED:
        active_walk(tree, node.left)
        active_walk(tree, node.right)
        active_refit(tree, node)


def set_lod(tree, lod):
    """Refine or coarsen the mesh under a tree, then ACTIVE-UPDATE(I, R, D, T): mark, and walk from the root."""
    sets = tree.mesh.sets_between(tree.lod, lod)
    tree.lod = lod
    marked = active_mark(*sets, tree)
    active_walk(tree, tree.root)
    return Update(sum(map(len, sets)), len(marked))
