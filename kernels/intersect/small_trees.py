"""Two small trees at once: the leaves of each that overlap the other's root, all against all, by tight boxes.

A descent of two trees of a few dozen leaves waits for itself at every level. Here a warp gathers the leaves of both
trees from a level of each down, and compares them (`tiles`) by boxes that overlap for less than half of the leaf
pairs that a descent finds. Several units of one object pair take every so many-th leaf of A. Nothing is given away, so
that no warp waits for another where all trees are small.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.lanes import rank_flag, warp_any, warp_lane, warp_size, warp_sync
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

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SMALL_LEAVES, SMALL_INNER = native.constant("SMALL_LEAVES"), native.constant("SMALL_INNER")
GATHER_NODES = wp.constant(32)  # of the level of a tree that leaves are gathered from: a node a lane
SIDE_B = wp.constant(-(2**31))  # the bit of an inner node of B


@wp.struct
class SmallLists:
    """The leaves of two trees that a warp has gathered."""

    leaves_a: wp.int32  # of A
    leaves_b: wp.int32  # of B
    fits: bool  # there was room for all of them


@wp.func
def is_small(pose: PairPose, faces_max: wp.int32):
    """Return whether to try both trees at once: few faces, of sizes that float32 takes, and no coincident meshes."""
    return wp.max(pose.faces_a, pose.faces_b) <= faces_max and pose.error < wp.inf


@wp.func
def append_node(items: wp.uint64, first: wp.int32, room: wp.int32, end: wp.int32, keep: bool, entry: wp.int32):
    """Append the entries that are to be kept to a list, as far as there is room; return its new end."""
    rank = rank_flag(keep)
    at = end + (rank & 0xFFFF)
    write_number(items, first + at, keep and at < room, entry)
    return end + (rank >> 16)


@wp.func
def append_nodes(items: wp.uint64, ends: wp.vec3i, live: bool, of_b: bool, node: Node):
    """Append nodes to the leaves of A, those of B or the inner nodes; return the new ends of these lists."""
    leaf = node.face >= 0
    entry = wp.where(of_b, node.skip | SIDE_B, node.skip)
    return wp.vec3i(
        append_node(items, SMALL_A, SMALL_LEAVES, ends[0], live and leaf and not of_b, node.skip),
        append_node(items, SMALL_B, SMALL_LEAVES, ends[1], live and leaf and of_b, node.skip),
        append_node(items, 0, SMALL_INNER, ends[2], live and not leaf, entry),
    )


@wp.func
def level_size(faces: wp.int32):
    """Return the number of nodes of the level to gather leaves from: complete, of at most GATHER_NODES."""
    size = wp.int32(GATHER_NODES)
    while size > 1 and size > faces:
        size /= 2
    return size


@wp.func
def gather_level(items: wp.uint64, states: StatePool, pose: PairPose):
    """List the children of the nodes of a level of both trees; return the ends of the lists."""
    size_a, size_b = level_size(pose.faces_a), level_size(pose.faces_b)
    ends = wp.vec3i(0, 0, 0)
    at = warp_lane()
    while at - warp_lane() < wp.max(size_a, size_b):
        node_a = load_constant_node(states, pose.node_a + size_a + wp.min(at, size_a - 1))
        node_b = load_constant_node(states, pose.node_b + size_b + wp.min(at, size_b - 1))
        ends = append_nodes(items, ends, at < size_a and node_a.skip >= 0, False, node_a)
        ends = append_nodes(items, ends, at < size_b and node_b.skip >= 0, True, node_b)
        at += warp_size()
    return ends


@wp.func
def gather_leaves(task: wp.vec3i, items: wp.uint64, states: StatePool, pose: PairPose):
    """List the leaves of both trees, level by level, as far as there is room.

    None where pairs are far apart, or where a part of that number has nothing to do.
    """
    lists = SmallLists()
    lists.fits = True
    if pose.margin < 0.0 or task[1] >= task[2]:
        return lists
    ends = gather_level(items, states, pose)
    head = wp.int32(0)
    while head < ends[2] and lists.fits:
        warp_sync()
        popped = wp.min(warp_size(), ends[2] - head)
        live = warp_lane() < popped
        entry = read_number(items, head + wp.min(warp_lane(), popped - 1))
        of_b = entry < 0
        at = wp.where(of_b, pose.node_b, pose.node_a) + 2 * (entry & INDEX_MASK)
        head += popped
        ends = append_nodes(items, ends, live, of_b, load_constant_node(states, at))
        ends = append_nodes(items, ends, live, of_b, load_constant_node(states, at + 1))
        lists.fits = ends[2] <= SMALL_INNER and wp.max(ends[0], ends[1]) <= SMALL_LEAVES
    lists.fits = lists.fits and wp.max(ends[0], ends[1]) <= SMALL_LEAVES
    warp_sync()
    lists.leaves_a = ends[0]
    lists.leaves_b = ends[1]
    return lists


@wp.func
def count_small(pair: wp.int32, compared: wp.int32, tests: wp.vec3i, hits: Hits):
    """Count pairs of boxes compared, and the face pair tests of `test_overlaps`. For one lane."""
    if compared > 0:
        wp.atomic_add(hits.node_tests, pair, wp.int64(compared))
    if tests[1] > 0:
        wp.atomic_add(hits.triangle_tests, pair, wp.int64(tests[1]))
    if tests[0] > 0:
        wp.atomic_add(hits.count, pair, wp.int64(tests[0]))
    if tests[2] > 0:
        wp.atomic_add(hits.float64_tests, pair, wp.int64(tests[2]))


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
    compared, tests, rows = wp.int32(0), wp.vec3i(), wp.int32(0)
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
                compared += rows * wp.min(warp_size(), count - (column - warp_lane()))
                tests += test_overlaps(output, for_any, task[0], pose, overlaps, column, items, hits)
                column += warp_size()
            if for_any:
                if tests[0] > 0 or warp_any(hits.any_hit[task[0]] != 0):
                    next_a = lists.leaves_a
                    next_b = lists.leaves_b
        else:
            rows, next_a = count, left
            next_b = wp.where(rows > 0, 0, lists.leaves_b)
    # What the warp writes next may be over the last tile.
    warp_sync()
    if tests[0] > 0:
        hits.any_hit[task[0]] = 1
    if warp_lane() == 0:
        count_small(task[0], compared, tests, hits)
