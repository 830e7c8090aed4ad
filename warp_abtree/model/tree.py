"""The AB-Tree: its static topology.

Source: Liu, Georganas and Roth 2006, section 3.2.
"""

from dataclasses import dataclass

import numpy as np

from warp_abtree.model.mesh import FACE_LIMIT


@dataclass(frozen=True)
class Tree:
    """Static topology of an AB-Tree over n faces.

    Attributes:
        leaf_node: Heap index of each face's leaf, the paper's indexed list, int32 (n,).
        node_face: Face of each leaf node, -1 elsewhere, int32 (2^(depth+1),); the root is 1.
        depth: ceil(log2 n).
    """

    leaf_node: np.ndarray
    node_face: np.ndarray
    depth: int

    @classmethod
    def from_leaves(cls, leaf_node: np.ndarray) -> "Tree":
        """Make the tree that an indexed list describes; raise ValueError unless every face has a leaf of its own."""
        n = len(leaf_node)
        node_face = np.full(2 << find_depth(n), -1, np.int32)
        if not np.array_equal(np.sort(leaf_node), np.sort(leaf_nodes(n))):
            raise ValueError(f"the indexed list is not one leaf for each of {n} faces")
        node_face[leaf_node] = np.arange(n, dtype=np.int32)
        return cls(leaf_node, node_face, find_depth(n))

    def node_boxes(self, faces, face_lower: np.ndarray, face_upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return minima and maxima of all nodes over some faces, (node_count, 3) each, infinite where there is none."""
        lower = np.full((self.node_count, 3), np.inf, face_lower.dtype)
        upper = np.full((self.node_count, 3), -np.inf, face_upper.dtype)
        lower[self.leaf_node[faces]], upper[self.leaf_node[faces]] = face_lower, face_upper
        for level in range(self.depth - 1, -1, -1):
            node = np.arange(1 << level, 2 << level)
            node = node[self.node_face[node] < 0]
            lower[node] = np.minimum(lower[2 * node], lower[2 * node + 1])
            upper[node] = np.maximum(upper[2 * node], upper[2 * node + 1])
        return lower, upper

    @property
    def node_count(self) -> int:
        """Length of the node arrays: heap indices 0 .. 2^(depth+1)-1, 2n-1 of them in use."""
        return len(self.node_face)


def find_depth(n: int) -> int:
    """Return the depth of a tree of n leaves, ceil(log2 n)."""
    return (n - 1).bit_length()


def leaf_nodes(n: int) -> np.ndarray:
    """Return the heap index of each leaf position of a tree of n leaves, int32 (n,)."""
    depth = find_depth(n)
    bounds = (np.arange((1 << depth) + 1) * n) >> depth
    index = np.flatnonzero(np.diff(bounds))
    node = (1 << depth) + index
    if depth > 0:
        # Halves equal to within one put every leaf on one of the two deepest levels.
        above = (np.arange((1 << (depth - 1)) + 1) * n) >> (depth - 1)
        node = np.where(np.diff(above)[index >> 1] == 1, node >> 1, node)
    return node.astype(np.int32)


def _partition(order, left, begin, middle):
    """Move the faces of every segment that go left before the others, keeping the order of each kind.

    begin and middle are where the segment of each position begins, and where its right half will.
    """
    goes_left = left[order]
    rank = np.cumsum(goes_left) - goes_left
    rank -= rank[begin]
    position = np.arange(len(order))
    out = np.empty_like(order)
    out[np.where(goes_left, begin + rank, middle + (position - begin) - rank)] = order
    return out


def _sort_leaves(lower, upper, depth):
    """Return the face at each leaf position: median splits, one level at a time, over three presorted orders."""
    n = len(lower)
    key = lower + upper
    orders = [np.argsort(key[:, axis], kind="stable") for axis in range(3)]
    left = np.zeros(n, bool)
    for d in range(depth):
        bounds = (np.arange((1 << d) + 1) * n) >> d
        middles = ((2 * np.arange(1 << d) + 1) * n) >> (d + 1)
        lengths = np.diff(bounds)
        extent = np.maximum.reduceat(upper[orders[0]], bounds[:-1]) - np.minimum.reduceat(lower[orders[0]], bounds[:-1])
        axis = np.repeat(np.argmax(extent, 1), lengths)
        begin = np.repeat(bounds[:-1], lengths)
        middle = np.repeat(middles, lengths)
        in_left = np.arange(n) < middle
        for k in range(3):
            here = axis == k
            left[orders[k][here]] = in_left[here]
        orders = [_partition(order, left, begin, middle) for order in orders]
    return orders[0]


def active_build(vertex_pos: np.ndarray, face_vertex: np.ndarray) -> Tree:
    """Build the balanced tree over all faces, int32 (n, 3), top-down; raise ValueError for none or more than 2^30.

    Each segment splits at its median along the longest axis of its box, in the order of the faces' box centres, ties
    by face index; halves are equal to within one. The node at depth d and index i holds leaf positions (i n) >> d ..
    ((i+1) n) >> d.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-BUILD.
    """
    n = len(face_vertex)
    if not 0 < n <= FACE_LIMIT:
        raise ValueError(f"an AB-Tree needs 1 to 2^30 faces, not {n}")
    corners = vertex_pos[face_vertex]
    leaf_face = _sort_leaves(corners.min(1), corners.max(1), find_depth(n))
    leaf_node = np.empty(n, np.int32)
    leaf_node[leaf_face] = leaf_nodes(n)
    return Tree.from_leaves(leaf_node)
