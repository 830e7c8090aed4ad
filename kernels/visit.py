"""One visit of the dual-tree traversal: two skip nodes, up to four pairs of boxes, and what follows of each.

An item is a pair of heap indices, each negative where the visit goes down to that node's two children. Children lie
side by side, and each record says what its subtree goes on with, so a coarse LOD costs no more visits than a tree built
for it. A box is posed once a visit, for both boxes that it is compared with.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import warp as wp

from warp_abtree.kernels.boxes import PosedBox, boxes_overlap, pose_box, widen_box
from warp_abtree.kernels.nodes import Node, load_constant_node
from warp_abtree.kernels.pools import StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.warps import four_items, item_first, item_second, pack_item

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Branch:
    """A child in a visit: its box in both frames, and what it stands for.

    down: what an item holds that goes on with its children, if it has any. span: minus the sum of the box's extents;
    not negative at a leaf, whose face number its bits are.
    """

    box: PosedBox
    span: wp.float32
    skip: wp.int32
    down: wp.int32
    face: wp.int32


@wp.func
def make_branch(box: PosedBox, node: Node):
    branch = Branch()
    branch.box = box
    branch.span = wp.cast(node.face, wp.float32)
    branch.skip = node.skip
    branch.down = wp.where(node.face >= 0, node.skip, -node.skip)
    branch.face = node.face
    return branch


@wp.func
def branch_of_a(pose: PairPose, node: Node):
    branch = make_branch(pose_box(node.lower, node.upper, wp.transpose(pose.rotation32), pose.back32), node)
    branch.box = widen_box(branch.box, pose.margin)
    return branch


@wp.func
def branch_of_b(pose: PairPose, node: Node):
    return make_branch(pose_box(node.lower, node.upper, pose.rotation32, pose.translation32), node)


@wp.func
def next_item(a: Branch, b: Branch):
    """Return the item that two overlapping branches leave: their faces, where both are leaves.

    Else the visit goes down both, or only the one that is more than twice as large as the other, or no leaf.
    """
    # The sign of a union of bits: both are leaves unless one has none.
    leaves = (a.face | b.face) >= 0
    x = wp.where(leaves, a.face, wp.where(a.span + a.span <= b.span, a.down, a.skip))
    y = wp.where(leaves, b.face, wp.where(b.span + b.span <= a.span, b.down, b.skip))
    return pack_item(x, y)


@wp.func
def overlap_bit(used: bool, a: Branch, b: Branch, k: wp.int32):
    """Return bit k of a mask if two branches in use overlap, bit k + 4 if they do as two leaves."""
    bit = wp.where((a.face | b.face) >= 0, 16 << k, 1 << k)
    return wp.where(boxes_overlap(a.box, b.box), wp.where(used, bit, 0), 0)


@wp.func
def visit_item(states: StatePool, pose: PairPose, item: wp.int64):
    """Compare what an item names; return the items that follow, a mask of those in use, and the pairs compared.

    Bits 0 to 3 of the mask stand for items to visit, bits 4 to 7 for pairs of faces to test. No branches: the threads
    of a warp stay together, and all loads are under way at once. A node without a second child is its own.
    """
    x = item_first(item)
    y = item_second(item)
    two_a = wp.where(x < 0, 1, 0)
    two_b = wp.where(y < 0, 1, 0)
    at_a = pose.node_a + wp.where(x < 0, -2 * x, x)
    at_b = pose.node_b + wp.where(y < 0, -2 * y, y)
    node_a0 = load_constant_node(states, at_a)
    node_a1 = load_constant_node(states, at_a + two_a)
    node_b0 = load_constant_node(states, at_b)
    node_b1 = load_constant_node(states, at_b + two_b)
    a0 = branch_of_a(pose, node_a0)
    a1 = branch_of_a(pose, node_a1)
    b0 = branch_of_b(pose, node_b0)
    b1 = branch_of_b(pose, node_b1)
    mask = overlap_bit(True, a0, b0, 0) | overlap_bit(y < 0, a0, b1, 1)
    mask = mask | overlap_bit(x < 0, a1, b0, 2) | overlap_bit((x & y) < 0, a1, b1, 3)
    items = four_items(next_item(a0, b0), next_item(a0, b1), next_item(a1, b0), next_item(a1, b1))
    return items, mask, (1 + two_a) * (1 + two_b)
