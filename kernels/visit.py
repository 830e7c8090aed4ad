"""One visit of the dual-tree traversal: two skip nodes, up to four pairs of boxes, and what follows of each.

An item is a pair of heap indices, each negative where the visit goes down to that node's two children. Children lie
side by side, and each record says what its subtree goes on with, so a coarse LOD costs no more visits than a tree built
for it. A box is posed once a visit, for both boxes that it is compared with.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import warp as wp

from warp_abtree.kernels.boxes import PosedBox, boxes_overlap, pose_box
from warp_abtree.kernels.faces import PairTrees
from warp_abtree.kernels.nodes import load_constant_node
from warp_abtree.kernels.pools import StatePool
from warp_abtree.kernels.pose import PairPose
from warp_abtree.kernels.warps import item_first, item_second, pack_item

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
class Branch:
    """A child in a visit: its box in both frames, and what it stands for."""

    box: PosedBox
    skip: wp.int32
    face: wp.int32


four_items = wp.types.vector(length=4, dtype=wp.int64)


@wp.func
def load_branch_a(states: StatePool, pose: PairPose, at: wp.int32):
    node = load_constant_node(states, at)
    branch = Branch()
    branch.box = pose_box(node.lower, node.upper, wp.transpose(pose.rotation32), pose.back32)
    branch.skip = node.skip
    branch.face = node.face
    return branch


@wp.func
def load_branch_b(states: StatePool, pose: PairPose, at: wp.int32):
    node = load_constant_node(states, at)
    branch = Branch()
    branch.box = pose_box(node.lower, node.upper, pose.rotation32, pose.translation32)
    branch.skip = node.skip
    branch.face = node.face
    return branch


@wp.func
def next_item(a: Branch, b: Branch):
    """Return the item that two overlapping branches leave: their faces, where both are leaves.

    Else the visit goes down both, or only the one that is twice as large as the other, or no leaf.
    """
    if a.face >= 0 and b.face >= 0:
        return pack_item(a.face, b.face)
    size_a = a.box.size[0] + a.box.size[1] + a.box.size[2]
    size_b = b.box.size[0] + b.box.size[1] + b.box.size[2]
    x = a.skip
    y = b.skip
    if a.face < 0 and (b.face >= 0 or size_a + size_a >= size_b):
        x = -x
    if b.face < 0 and (a.face >= 0 or size_b + size_b >= size_a):
        y = -y
    return pack_item(x, y)


@wp.func
def compare_branches(pose: PairPose, a: Branch, b: Branch, k: wp.int32):
    """Return what follows of two branches: an item, and bit k of a mask if they overlap, bit k + 4 if as two leaves."""
    item = wp.int64(0)
    mask = wp.int32(0)
    if boxes_overlap(a.box, b.box, pose.margin):
        item = next_item(a, b)
        mask = wp.where(a.face >= 0 and b.face >= 0, 16 << k, 1 << k)
    return item, mask


@wp.func
def visit_item(states: StatePool, trees: PairTrees, pose: PairPose, item: wp.int64):
    """Compare what an item names; return the items that follow, a mask of those in use, and the pairs compared.

    Bits 0 to 3 of the mask stand for items to visit, bits 4 to 7 for pairs of faces to test.
    """
    x = item_first(item)
    y = item_second(item)
    at_a = trees.node_a + wp.where(x < 0, -2 * x, x)
    at_b = trees.node_b + wp.where(y < 0, -2 * y, y)
    items = four_items()
    a = load_branch_a(states, pose, at_a)
    b = load_branch_b(states, pose, at_b)
    first, mask = compare_branches(pose, a, b, 0)
    items[0] = first
    tests = wp.int32(1)
    second = wp.int32(0)
    if y < 0:
        c = load_branch_b(states, pose, at_b + 1)
        next, second = compare_branches(pose, a, c, 1)
        items[1] = next
        mask += second
        tests += 1
        if x < 0:
            a = load_branch_a(states, pose, at_a + 1)
            next, second = compare_branches(pose, a, c, 2)
            items[2] = next
            mask += second
            next, second = compare_branches(pose, a, b, 3)
            items[3] = next
            mask += second
            tests += 2
    elif x < 0:
        a = load_branch_a(states, pose, at_a + 1)
        next, second = compare_branches(pose, a, b, 3)
        items[3] = next
        mask += second
        tests += 1
    return items, mask, tests
