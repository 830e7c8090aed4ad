"""One visit of the dual-tree traversal: two skip nodes, up to four pairs of boxes, and what follows of each.

An item is a pair of heap indices, each with its sign bit set where the visit compares that node and the next one, its
sibling. Each record says what its subtree goes on with, so a coarse LOD costs no more visits than a tree built for it.
A box is posed once a visit, for both boxes that it is compared with.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import warp as wp

from warp_abtree.kernels.arrays import StatePool
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.boxes import PosedBox, boxes_overlap, pose_box
from warp_abtree.kernels.traversal.nodes import Node, load_constant_node
from warp_abtree.kernels.traversal.warp_stack import four_items, item_first, item_second, pack_item

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

INDEX_BITS = wp.constant(2**31 - 1)
# What a visit leaves is counted in one number: items to visit in the low half, face pairs in the high half.
ITEM_STEP, FACE_STEP = wp.constant(1), wp.constant(1 << 16)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // One operation, as which the compiler does not see that the sum is a union of bits.
    int down;
    asm("mad.lo.s32 %0, %1, 2, %2;" : "=r"(down) : "r"(node), "r"(1 << 31));
    return down;
#else
    return (node * 2) | (1 << 31);
#endif
""")
def children_of(node: wp.int32) -> wp.int32:
    """Return what an item holds that compares the children of a node."""
    ...


@wp.struct
class Branch:
    """A child in a visit: its box in both frames, and what it stands for.

    down: what an item holds that compares its children; not for a leaf. span: minus the sum of the box's extents;
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
    branch.down = children_of(node.skip)
    branch.face = node.face
    return branch


@wp.func
def branch_of_a(pose: PairPose, node: Node):
    back = wp.transpose(pose.rotation32)
    return make_branch(pose_box(node.lower, node.upper, back, pose.back32, pose.margin), node)


@wp.func
def branch_of_b(pose: PairPose, node: Node):
    return make_branch(pose_box(node.lower, node.upper, pose.rotation32, pose.translation32, pose.margin), node)


@wp.func
def next_item(a: Branch, b: Branch):
    """Return the item that two overlapping branches leave: their faces, where both are leaves.

    Else the visit goes down both, or only the one that is more than twice as large as the other, or no leaf.
    """
    # The sign of a union of bits: both are leaves unless one has none. A leaf beside a larger box, whose span is
    # negative, never goes down.
    leaves = (a.face | b.face) >= 0
    x = wp.where(leaves, a.face, wp.where(a.span + a.span <= b.span, a.down, a.skip))
    y = wp.where(leaves, b.face, wp.where(b.span + b.span <= a.span, b.down, b.skip))
    return pack_item(x, y)


@wp.func
def step_of_pair(used: wp.int32, a: Branch, b: Branch):
    """Return what two branches add to the count of what follows if they overlap and `used` is negative."""
    step = wp.where((a.face | b.face) >= 0, FACE_STEP, ITEM_STEP)
    return wp.where(boxes_overlap(a.box, b.box), wp.where(used < 0, step, 0), 0)


@wp.func
def count_used(used: wp.vec4i):
    tests = wp.int32(0)
    for k in range(4):
        tests -= used[k] >> 31
    return tests


@wp.func
def visit_item(states: StatePool, pose: PairPose, item: wp.int64, live: wp.int32):
    """Compare what an item names; return the items that follow, the step of each, and the pairs compared.

    live is -1, or 0 where nothing is asked of the item, which still names nodes. No branches: the threads of a warp
    stay together, and all loads are under way at once. A node that is compared alone is its own sibling.
    """
    x = item_first(item)
    y = item_second(item)
    two_a = wp.where(x < 0, 1, 0)
    two_b = wp.where(y < 0, 1, 0)
    at_a = pose.node_a + (x & INDEX_BITS)
    at_b = pose.node_b + (y & INDEX_BITS)
    node_a0 = load_constant_node(states, at_a)
    node_a1 = load_constant_node(states, at_a + two_a)
    node_b0 = load_constant_node(states, at_b)
    node_b1 = load_constant_node(states, at_b + two_b)
    a0 = branch_of_a(pose, node_a0)
    a1 = branch_of_a(pose, node_a1)
    b0 = branch_of_b(pose, node_b0)
    b1 = branch_of_b(pose, node_b1)
    used = wp.vec4i(live, y & live, x & live, x & y & live)
    steps = wp.vec4i(
        step_of_pair(used[0], a0, b0),
        step_of_pair(used[1], a0, b1),
        step_of_pair(used[2], a1, b0),
        step_of_pair(used[3], a1, b1),
    )
    items = four_items(next_item(a0, b0), next_item(a0, b1), next_item(a1, b0), next_item(a1, b1))
    return items, steps, count_used(used)
