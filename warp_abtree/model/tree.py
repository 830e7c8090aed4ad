"""The AB-Tree: its static topology.

Source: Liu, Georganas and Roth 2006, section 3.2.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.kernels.build.active_build import FaceBoxes, split_segment_kernel
from warp_abtree.model.cpu_arrays import cpu_array
from warp_abtree.model.mesh import FACE_LIMIT


@dataclass(frozen=True)
class Tree:
    """Static topology of an AB-Tree over n faces."""

    leaf_node: np.ndarray  # heap index of each face's leaf, the paper's indexed list, int32 (n,)
    node_face: np.ndarray  # face of each leaf node, -1 elsewhere, int32 (2^(depth+1),); the root is 1
    depth: int  # ceil(log2 n)

    @classmethod
    def from_leaves(cls, leaf_node: np.ndarray) -> "Tree":
        """Make the tree that an indexed list describes; raise ValueError unless every face has a leaf of its own."""
        n = len(leaf_node)
        node_face = np.full(2 << tree_depth(n), -1, np.int32)
        if not np.array_equal(np.sort(leaf_node), np.sort(leaf_nodes(n))):
            raise ValueError(f"the indexed list is not one leaf for each of {n} faces")
        node_face[leaf_node] = np.arange(n, dtype=np.int32)
        return cls(leaf_node, node_face, tree_depth(n))

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


def tree_depth(n: int) -> int:
    """Return the depth of a tree of n leaves, ceil(log2 n)."""
    return (n - 1).bit_length()


def leaf_nodes(n: int) -> np.ndarray:
    """Return the heap index of each leaf position of a tree of n leaves, int32 (n,)."""
    depth = tree_depth(n)
    bounds = (np.arange((1 << depth) + 1) * n) >> depth
    index = np.flatnonzero(np.diff(bounds))
    node = (1 << depth) + index
    if depth > 0:
        # Halves equal to within one put every leaf on one of the two deepest levels.
        above = (np.arange((1 << (depth - 1)) + 1) * n) >> (depth - 1)
        node = np.where(np.diff(above)[index >> 1] == 1, node >> 1, node)
    return node.astype(np.int32)


def _sort_leaves(lower, upper, depth):
    """Return the face at each leaf position: median splits, one level at a time, over three presorted orders."""
    key = lower + upper
    order = cpu_array(np.stack([np.argsort(key[:, axis], kind="stable") for axis in range(3)]), wp.int32)
    boxes, other = FaceBoxes(), wp.empty_like(order)
    boxes.lower, boxes.upper = cpu_array(lower, wp.vec3d), cpu_array(upper, wp.vec3d)
    boxes.left = wp.empty(len(lower), dtype=wp.uint8, device="cpu")
    for level in range(depth):
        wp.launch(split_segment_kernel, dim=1 << level, inputs=[level, order, boxes, other], device="cpu")
        order, other = other, order
    return order.numpy()[0]


def active_build(vertex_pos: np.ndarray, face_vertex: np.ndarray) -> Tree:
    """Build the balanced tree over all faces, int32 (n, 3), top-down; raise ValueError for none or more than 2^30.

    Each segment splits at its median in the order of the faces' box centres along an axis, ties by face index; halves
    are equal to within one. The axis is the one whose halves have the least sum of extents; in segments of fewer than
    10 faces, as in the paper everywhere, the longest one of the segment's box. The node at depth d and index i holds
    leaf positions (i n) >> d .. ((i+1) n) >> d.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-BUILD.
    """
    n = len(face_vertex)
    if not 0 < n <= FACE_LIMIT:
        raise ValueError(f"an AB-Tree needs 1 to 2^30 faces, not {n}")
    corners = vertex_pos[face_vertex]
    leaf_face = _sort_leaves(corners.min(1), corners.max(1), tree_depth(n))
    leaf_node = np.empty(n, np.int32)
    leaf_node[leaf_face] = leaf_nodes(n)
    return Tree.from_leaves(leaf_node)
