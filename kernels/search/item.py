"""The node pair test of the dual-tree traversal: two skip nodes, up to four pairs of boxes, and the items they emit.

An item is a pair of nodes to test, or, in lists of their own, of the faces of two leaves; the same on both backends:

    63 62                    32 31 30                     0
    [s|        node of A       |s|        node of B       ]    s: this node and the next one, its sibling
    [0|        face of A       |0|        face of B       ]

Nodes are heap indices. Each record says what its subtree goes on with, so a coarse LOD costs no more tests than a tree
built for it. A box is posed once a test, for both boxes that it is compared with.
Source: Liu et al. 2006, section 3.2.2, ACTIVE-INTERSECT.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool
from warp_abtree.kernels.base.boxes import PosedBox, boxes_overlap, pose_box
from warp_abtree.kernels.base.nodes import Node, load_constant_node, load_node
from warp_abtree.kernels.base.poses import PairPose

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# What a pair of children is: dropped, to go on with, or two faces.
DROPPED, NODES, FACES = wp.constant(0), wp.constant(1), wp.constant(2)

# What is asked of an object pair: whether there is a hit, how many, or which face pairs.
OUTPUT_ANY, OUTPUT_COUNT, OUTPUT_FACES = wp.constant(0), wp.constant(1), wp.constant(2)

INDEX_MASK = wp.constant(2**31 - 1)
# The lists of a warp that overlapping children are for, see `push_children`.
TO_STACK, TO_LEAF_PAIRS = native.constant("STACK_LIST"), native.constant("LEAF_PAIR_LIST")
TO_SLAB_PAIRS, TO_NONE = native.constant("SLAB_PAIR_LIST"), native.constant("NO_LIST")

four_items = wp.types.vector(length=4, dtype=wp.int64)


@wp.func_native("return ((long long)x << 32) | (unsigned int)y;")
def pack_item(x: wp.int32, y: wp.int32) -> wp.int64: ...


@wp.func_native("return (int)(item >> 32);")
def item_first(item: wp.int64) -> wp.int32: ...


@wp.func_native("return (int)item;")
def item_second(item: wp.int64) -> wp.int32: ...


@native.func_native()
def children_of(node: wp.int32) -> wp.int32:
    """Return the half of an item that names both children of a node."""


@wp.func
def first_item(states: StatePool, pose: PairPose):
    """Return the item that compares the roots."""
    return pack_item(load_node(states, pose.node_a + 1).skip, load_node(states, pose.node_b + 1).skip)


@wp.func
def item_of(a: Node, b: Node):
    """Return the item of two nodes: their faces, where both are leaves.

    Else the next step goes down both, or only the one that is more than twice as large as the other, or no leaf.
    """
    # `face` is negative for inner nodes, so the OR of both is negative unless both are leaves. A leaf beside a larger
    # box, whose span is negative, never goes down.
    leaves = (a.face | b.face) >= 0
    span_a, span_b = wp.cast(a.face, wp.float32), wp.cast(b.face, wp.float32)
    x = wp.where(leaves, a.face, wp.where(span_a + span_a <= span_b, children_of(a.skip), a.skip))
    y = wp.where(leaves, b.face, wp.where(span_b + span_b <= span_a, children_of(b.skip), b.skip))
    return pack_item(x, y)


@wp.func
def list_of_pair(used: wp.int32, inner: wp.int32, faces: wp.int32, a: PosedBox, b: PosedBox):
    """Return the list that a pair of children goes to, TO_NONE unless they overlap and `used` is negative."""
    to = wp.where(faces >= 0, TO_LEAF_PAIRS, inner)
    return wp.where(boxes_overlap(a, b), wp.where(used < 0, to, TO_NONE), TO_NONE)


@wp.func
def have_slabs(floor: wp.vec2i, item: wp.int64):
    """Return whether the nodes that an item names have slabs, as all below them."""
    above_a = (item_first(item) & INDEX_MASK) - floor[0]
    above_b = (item_second(item) & INDEX_MASK) - floor[1]
    return (above_a | above_b) >= 0


@wp.func
def compare_node_pair(states: StatePool, pose: PairPose, floor: wp.vec2i, item: wp.int64, live: wp.int32):
    """Expand an item; return the items that follow, their lists, and the pairs of boxes compared.

    No branches: the lanes of a warp stay together, and all loads are under way at once. A node compared alone is its
    own sibling.

    Args:
        floor: `PairPose.floor`, or NO_NODE.
        live: -1, or 0 where nothing is asked of the item, which still names nodes.
    """
    x = item_first(item)
    y = item_second(item)
    two_a = wp.where(x < 0, 1, 0)
    two_b = wp.where(y < 0, 1, 0)
    at_a = pose.node_a + (x & INDEX_MASK)
    at_b = pose.node_b + (y & INDEX_MASK)
    a0 = load_constant_node(states, at_a)
    a1 = load_constant_node(states, at_a + two_a)
    b0 = load_constant_node(states, at_b)
    b1 = load_constant_node(states, at_b + two_b)
    # Before the boxes: behind them the search for any hit spills registers.
    items = four_items(item_of(a0, b0), item_of(a0, b1), item_of(a1, b0), item_of(a1, b1))
    back = wp.transpose(pose.rotation32)
    box_a0 = pose_box(a0.lower, a0.upper, back, pose.back32, pose.margin)
    box_a1 = pose_box(a1.lower, a1.upper, back, pose.back32, pose.margin)
    box_b0 = pose_box(b0.lower, b0.upper, pose.rotation32, pose.translation32, pose.margin)
    box_b1 = pose_box(b1.lower, b1.upper, pose.rotation32, pose.translation32, pose.margin)
    used = wp.vec4i(live, y & live, x & live, x & y & live)
    inner = wp.where(have_slabs(floor, item), TO_SLAB_PAIRS, TO_STACK)
    lists = wp.vec4i(
        list_of_pair(used[0], inner, a0.face | b0.face, box_a0, box_b0),
        list_of_pair(used[1], inner, a0.face | b1.face, box_a0, box_b1),
        list_of_pair(used[2], inner, a1.face | b0.face, box_a1, box_b0),
        list_of_pair(used[3], inner, a1.face | b1.face, box_a1, box_b1),
    )
    # Of one node or two of A times one or two of B.
    return items, lists, live & ((1 + two_a) << two_b)


@wp.struct
class NodePairs:
    """The one or two nodes of A and of B that an item names; a node that is named alone is its own sibling."""

    at: wp.vec4i  # where they lie in the pool
    a0: Node  # of A
    a1: Node  # its sibling
    b0: Node  # of B
    b1: Node  # its sibling
    used: wp.vec4i  # negative for pairs that the item asks for, of a0 and then of a1 with b0 and b1


@wp.func
def load_node_pairs(states: StatePool, pose: PairPose, item: wp.int64, live: wp.int32):
    """Return the nodes of an item; live is -1, or 0 where nothing is asked of it: it still names nodes.

    `compare_node_pair` has the same in its lines: as a struct it spills registers there.
    """
    x, y = item_first(item), item_second(item)
    at_a, at_b = pose.node_a + (x & INDEX_MASK), pose.node_b + (y & INDEX_MASK)
    pairs = NodePairs()
    pairs.at = wp.vec4i(at_a, at_a + wp.where(x < 0, 1, 0), at_b, at_b + wp.where(y < 0, 1, 0))
    pairs.a0 = load_constant_node(states, pairs.at[0])
    pairs.a1 = load_constant_node(states, pairs.at[1])
    pairs.b0 = load_constant_node(states, pairs.at[2])
    pairs.b1 = load_constant_node(states, pairs.at[3])
    pairs.used = wp.vec4i(live, y & live, x & live, x & y & live)
    return pairs


@wp.struct
class Emitted:
    """Items that follow one: of up to four pairs of nodes."""

    items: four_items  # pairs of nodes, or of faces
    kinds: wp.vec4i  # DROPPED, NODES or FACES
    bounds: wp.vec4  # see `best_first`
    tests: wp.int32  # pairs that were compared


@wp.func
def kind_of(used: wp.int32, a: Node, b: Node, goes_on: bool):
    """Return what two nodes emit, DROPPED unless they go on."""
    kind = wp.where((a.face | b.face) >= 0, FACES, NODES)
    return wp.where(used < 0 and goes_on, kind, DROPPED)


@wp.func
def count_used(used: wp.vec4i):
    return -((used[0] >> 31) + (used[1] >> 31) + (used[2] >> 31) + (used[3] >> 31))
