"""Two small trees at once: the leaves of each that overlap the other's root, all against all, by tight boxes.

A descent of two trees of a few dozen leaves waits for itself at every level. Here a warp gathers the leaves of both
trees from a level of each down, and compares them (`tiles`) by boxes that overlap for less than half of the leaf
pairs that a descent finds. Several units of one object pair take every so many-th leaf of A. Nothing is given away, so
that no warp waits for another where all trees are small.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.lanes import next_place, warp_any, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.nodes import Node, load_constant_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.intersect.small_tree_tiles import (
    SMALL_A,
    SMALL_B,
    compare_column,
    place_leaves,
    read_number,
    test_overlaps,
    write_number,
)
from warp_abtree.kernels.search.item import INDEX_MASK
from warp_abtree.kernels.search.warp_search import TraversalTests

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SMALL_LEAVES, SMALL_INNER = native.constant("SMALL_LEAVES"), native.constant("SMALL_INNER")
GATHER_NODES = wp.constant(32)  # of the level of a tree that leaves are gathered from: a node a lane
SIDE_B = wp.constant(-(2**31))  # the bit of an inner node of B


@wp.struct
class SmallLists:
    """The leaves of two trees that a warp has gathered."""

    leaves_a: wp.int32  # of A
    leaves_b: wp.int32  # of B
    inner: wp.int32  # the inner nodes of both that were met
    fits: bool  # there was room for all of them


@wp.func
def is_small(pose: PairPose, faces_max: wp.int32):
    """Return whether to try both trees at once: few faces, of sizes that float32 takes, and no coincident meshes."""
    return wp.max(pose.faces_a, pose.faces_b) <= faces_max and pose.error < wp.inf


@wp.func
def append_node(items: wp.uint64, first: wp.int32, room: wp.int32, end: wp.ref[wp.int32], keep: bool, entry: wp.int32):
    """Append the entries that are to be kept to a list, as far as there is room."""
    at = next_place(end, keep)
    write_number(items, first + at, keep and at < room, entry)


@wp.func
def append_nodes(items: wp.uint64, lists: wp.ref[SmallLists], live: bool, of_b: bool, node: Node):
    """Append nodes to the leaves of A, those of B or the inner nodes."""
    leaf = node.face >= 0
    entry = wp.where(of_b, node.skip | SIDE_B, node.skip)
    append_node(items, SMALL_A, SMALL_LEAVES, lists.leaves_a, live and leaf and not of_b, node.skip)
    append_node(items, SMALL_B, SMALL_LEAVES, lists.leaves_b, live and leaf and of_b, node.skip)
    append_node(items, 0, SMALL_INNER, lists.inner, live and not leaf, entry)


@wp.func
def level_size(faces: wp.int32):
    """Return the number of nodes of the level to gather leaves from: complete, of at most GATHER_NODES."""
    size = wp.int32(GATHER_NODES)
    while size > 1 and size > faces:
        size /= 2
    return size


@wp.func
def gather_level(items: wp.uint64, states: StatePool, pose: PairPose, lists: wp.ref[SmallLists]):
    """List the children of the nodes of a level of both trees."""
    size_a, size_b = level_size(pose.faces_a), level_size(pose.faces_b)
    at = warp_lane()
    while at - warp_lane() < wp.max(size_a, size_b):
        node_a = load_constant_node(states, pose.node_a + size_a + wp.min(at, size_a - 1))
        node_b = load_constant_node(states, pose.node_b + size_b + wp.min(at, size_b - 1))
        append_nodes(items, lists, at < size_a and node_a.skip >= 0, False, node_a)
        append_nodes(items, lists, at < size_b and node_b.skip >= 0, True, node_b)
        at += warp_size()


@wp.func
def gather_leaves(task: wp.vec3i, items: wp.uint64, states: StatePool, pose: PairPose):
    """List the leaves of both trees, level by level, as far as there is room.

    None where pairs are far apart, or where a part of that number has nothing to do.
    """
    lists = SmallLists()
    lists.fits = True
    if pose.margin < 0.0 or task[1] >= task[2]:
        return lists
    gather_level(items, states, pose, lists)
    head = wp.int32(0)
    while head < lists.inner and lists.fits:
        warp_sync()
        popped = wp.min(warp_size(), lists.inner - head)
        live = warp_lane() < popped
        entry = read_number(items, head + wp.min(warp_lane(), popped - 1))
        of_b = entry < 0
        at = wp.where(of_b, pose.node_b, pose.node_a) + 2 * (entry & INDEX_MASK)
        head += popped
        append_nodes(items, lists, live, of_b, load_constant_node(states, at))
        append_nodes(items, lists, live, of_b, load_constant_node(states, at + 1))
        lists.fits = lists.inner <= SMALL_INNER and wp.max(lists.leaves_a, lists.leaves_b) <= SMALL_LEAVES
    lists.fits = lists.fits and wp.max(lists.leaves_a, lists.leaves_b) <= SMALL_LEAVES
    warp_sync()
    return lists


@wp.func
def count_small(pair: wp.int32, tests: TraversalTests, hits: Hits):
    """Add the tests of a warp to the counts. For one lane."""
    if tests.nodes > 0:
        wp.atomic_add(hits.node_tests, pair, wp.int64(tests.nodes))
    if tests.faces > 0:
        wp.atomic_add(hits.triangle_tests, pair, wp.int64(tests.faces))
    if tests.hits > 0:
        wp.atomic_add(hits.count, pair, wp.int64(tests.hits))
    if tests.uncertain > 0:
        wp.atomic_add(hits.float64_tests, pair, wp.int64(tests.uncertain))


@wp.func
def test_small_trees(
    output: wp.int32,
    for_any: bool,
    task: wp.vec3i,
    lists: SmallLists,
    trees: Trees,
    pose: PairPose,
    items: wp.uint64,
    hits: Hits,
):
    """Compare the leaves that were gathered and test the leaf pairs in float32, and count all that.

    Args:
        for_any: One hit ends a pair.
        task: Object pair, part and parts.
    """
    tests, rows = TraversalTests(), wp.int32(0)
    next_a, next_b = wp.int32(task[1]), wp.int32(lists.leaves_b)
    # Tiles of A, and with each those of B, by one piece of code: what runs once waits for its instructions.
    while next_a < lists.leaves_a or next_b < lists.leaves_b:
        of_b = next_b < lists.leaves_b
        first, step = wp.where(of_b, next_b, next_a), wp.where(of_b, 1, task[2])
        end = wp.where(of_b, lists.leaves_b, lists.leaves_a)
        count, left = place_leaves(items, of_b, first, step, end, trees, pose)
        if of_b:
            next_b = left
            column = warp_lane()
            while column - warp_lane() < count:
                overlaps = compare_column(items, rows, column, count)
                tests.nodes += rows * wp.min(warp_size(), count - (column - warp_lane()))
                test_overlaps(output, for_any, task[0], pose, overlaps, column, items, hits, tests)
                column += warp_size()
            if for_any:
                if tests.hits > 0 or warp_any(hits.any_hit[task[0]] != 0):
                    next_a = lists.leaves_a
                    next_b = lists.leaves_b
        else:
            rows, next_a = count, left
            next_b = wp.where(rows > 0, 0, lists.leaves_b)
    # What the warp writes next may be over the last tile.
    warp_sync()
    if tests.hits > 0:
        hits.any_hit[task[0]] = 1
    if warp_lane() == 0:
        count_small(task[0], tests, hits)
