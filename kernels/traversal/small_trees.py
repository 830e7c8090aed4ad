"""Two small trees at once: the leaves of each that overlap the other's root, all against all, by tight boxes.

A descent of two trees of a few dozen leaves waits for itself at every level. Here a warp gathers the leaves of both
trees level by level, and then compares all of them, a leaf of A at a time with one of B a lane: each has a box in the
frame of either object, its own and the one about its posed corners. These overlap for less than half of the leaf pairs
that a descent finds. Several units of one object pair take every so many-th leaf of A.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arithmetic.predicates import EXACT
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.boxes import map_point
from warp_abtree.kernels.traversal.face_pairs import Hits, load_corner_ids, load_near
from warp_abtree.kernels.traversal.leaf_pairs import separate_leaf_pairs, test_straddling
from warp_abtree.kernels.traversal.node_pair import INDEX_MASK
from warp_abtree.kernels.traversal.nodes import Node, load_constant_node
from warp_abtree.kernels.traversal.warp_stack import warp_any, warp_lane, warp_size, warp_sync

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SMALL_LEAVES, SMALL_INNER = native.constant("SMALL_LEAVES"), native.constant("SMALL_INNER")
SMALL_ROWS, SMALL_FACES = native.constant("SMALL_ROWS"), native.constant("SMALL_FACES")
SMALL_A, SMALL_B = native.constant("SMALL_A"), native.constant("SMALL_B")
# An early hit ends a pair for `any`, so few leaf pairs wait.
LEAF_PAIRS_FOR_ANY = wp.constant(8)
SIDE_B = wp.constant(-(2**31))  # the bit of an inner node of B


@wp.func_native(native.body("small_trees.cuh", "rank_flag"))
def rank_flag(flag: bool) -> wp.int32:
    """Return how many lanes have set their flag, and in the low half how many before this one."""


@wp.func_native(native.body("small_trees.cuh", "read_number"))
def read_number(items: wp.uint64, i: wp.int32) -> wp.int32: ...


@wp.func_native(native.body("small_trees.cuh", "write_number"))
def write_number(items: wp.uint64, i: wp.int32, flag: bool, x: wp.int32): ...


@wp.func_native(native.body("small_trees.cuh", "read_quarter"))
def read_quarter(items: wp.uint64, i: wp.int32) -> wp.vec4: ...


@wp.func_native(native.body("small_trees.cuh", "write_quarter"))
def write_quarter(items: wp.uint64, i: wp.int32, flag: bool, x: wp.vec4): ...


@wp.func_native(native.body("small_trees.cuh", "spans_overlap"))
def spans_overlap(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3) -> bool:
    """Return whether the boxes from a to b and from c to d overlap, without branches."""


@wp.func_native(native.body("small_trees.cuh", "push_leaf_pair"))
def push_leaf_pair(items: wp.uint64, end: wp.int32, flag: bool, face_a: wp.int32, face_b: wp.int32) -> wp.int32:
    """Append the leaf pairs whose flag is set; return the new end."""


@wp.struct
class SmallLists:
    """The leaves of two trees that a warp has gathered."""

    leaves_a: wp.int32  # of A
    leaves_b: wp.int32  # of B
    fits: bool  # there was room for all of them


@wp.struct
class LeafBox:
    """A leaf's box in its own frame, and the box of its corners in the other object's."""

    lower: wp.vec3  # least corner
    upper: wp.vec3  # greatest corner
    posed_lower: wp.vec3  # least corner in the other frame
    posed_upper: wp.vec3  # greatest corner in the other frame
    face: wp.int32  # face number


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
def gather_leaves(task: wp.vec3i, items: wp.uint64, states: StatePool, pose: PairPose):
    """List the leaves of both trees, level by level, as far as there is room.

    None where pairs are far apart, or where a part of that number has nothing to do.
    """
    lists = SmallLists()
    lists.fits = True
    if pose.margin < 0.0 or task[1] >= task[2]:
        return lists
    first = warp_lane() == 0
    ends = append_nodes(items, wp.vec3i(0, 0, 0), first, False, load_constant_node(states, pose.node_a + 1))
    ends = append_nodes(items, ends, first, True, load_constant_node(states, pose.node_b + 1))
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
    warp_sync()
    lists.leaves_a = ends[0]
    lists.leaves_b = ends[1]
    return lists


@wp.func
def box_leaf(models: ModelPool, states: StatePool, pose: PairPose, node: wp.int32, of_b: bool):
    """Return the boxes of a leaf in both frames."""
    leaf = LeafBox()
    record = load_constant_node(states, wp.where(of_b, pose.node_b, pose.node_a) + node)
    leaf.lower = record.lower
    leaf.upper = record.upper
    leaf.face = record.face
    corners = load_corner_ids(states, wp.where(of_b, pose.corner_b, pose.corner_a) + record.face)
    rotation = pose.rotation32
    shift = pose.translation32
    if not of_b:
        rotation = wp.transpose(rotation)
        shift = pose.back32
    p = map_point(rotation, shift, load_near(models, corners[0]))
    q = map_point(rotation, shift, load_near(models, corners[1]))
    r = map_point(rotation, shift, load_near(models, corners[2]))
    # Corners are rounded where boxes are not; docs/exactness.md has the terms.
    margin = pose.margin + pose.margin
    leaf.posed_lower = wp.min(p, wp.min(q, r)) - wp.vec3(margin, margin, margin)
    leaf.posed_upper = wp.max(p, wp.max(q, r)) + wp.vec3(margin, margin, margin)
    return leaf


@wp.func
def keep_rows(
    items: wp.uint64,
    task: wp.vec3i,
    first: wp.int32,
    lists: SmallLists,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
):
    """Put the boxes of this part's next leaves of A in place, but for those beyond B's root; return how many."""
    root = load_constant_node(states, pose.node_b + 1)
    rows = wp.int32(0)
    done = wp.int32(0)
    while done < SMALL_ROWS and first + task[2] * done < lists.leaves_a:
        at = first + task[2] * (done + warp_lane())
        live = at < lists.leaves_a
        leaf = box_leaf(models, states, pose, read_number(items, SMALL_A + wp.min(at, lists.leaves_a - 1)), False)
        keep = live and spans_overlap(leaf.posed_lower, leaf.posed_upper, root.lower, root.upper)
        rank = rank_flag(keep)
        row = rows + (rank & 0xFFFF)
        lower, upper, near, far = leaf.lower, leaf.upper, leaf.posed_lower, leaf.posed_upper
        write_quarter(items, 3 * row, keep, wp.vec4(lower[0], lower[1], lower[2], upper[0]))
        write_quarter(items, 3 * row + 1, keep, wp.vec4(upper[1], upper[2], near[0], near[1]))
        write_quarter(items, 3 * row + 2, keep, wp.vec4(near[2], far[0], far[1], far[2]))
        write_number(items, SMALL_FACES + row, keep, leaf.face)
        rows += rank >> 16
        done += warp_size()
    warp_sync()
    return rows


@wp.func
def compare_leaf(items: wp.uint64, row: wp.int32, live: bool, waiting: wp.int32, b: LeafBox):
    """Compare the boxes of a leaf of A with one of B a lane, and append the leaf pairs that overlap."""
    x = read_quarter(items, 3 * row)
    y = read_quarter(items, 3 * row + 1)
    z = read_quarter(items, 3 * row + 2)
    own = spans_overlap(wp.vec3(x[0], x[1], x[2]), wp.vec3(x[3], y[0], y[1]), b.posed_lower, b.posed_upper)
    posed = spans_overlap(wp.vec3(y[2], y[3], z[0]), wp.vec3(z[1], z[2], z[3]), b.lower, b.upper)
    return push_leaf_pair(items, waiting, live and own and posed, read_number(items, SMALL_FACES + row), b.face)


@wp.struct
class Place:
    """Where a warp is among all pairs of leaves."""

    next: wp.int32  # the next leaf of A that has no row
    rows: wp.int32  # leaves of A in place
    row: wp.int32  # the next of them
    column: wp.int32  # the leaf of B of the first lane
    more: bool  # there are pairs left


@wp.func
def advance(
    items: wp.uint64, task: wp.vec3i, at: Place, lists: SmallLists, models: ModelPool, states: StatePool, pose: PairPose
):
    """Return the next place whose row is there: of the next leaves of B after the last row, then of the next rows."""
    place = Place()
    place.next = at.next
    place.rows = at.rows
    place.row = at.row + 1
    place.column = at.column
    place.more = at.more
    if place.row >= place.rows:
        place.row = 0
        place.column += warp_size()
    while place.more and (place.rows == 0 or place.column >= lists.leaves_b):
        place.more = place.next < lists.leaves_a and lists.leaves_b > 0
        place.rows = keep_rows(items, task, place.next, lists, models, states, pose)
        place.next += task[2] * SMALL_ROWS
        place.column = 0
    return place


@wp.func
def test_small_trees(
    # static
    output: wp.int32,
    for_any: bool,
    task: wp.vec3i,
    lists: SmallLists,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    # state
    items: wp.uint64,
    # out
    hits: Hits,
):
    """Compare the leaves that were gathered and test the leaf pairs in float32; return as `traverse_items`.

    Args:
        for_any: One hit ends a pair.
        task: Object pair, part and parts.
    """
    ready = wp.where(for_any, wp.min(LEAF_PAIRS_FOR_ANY, warp_size()), warp_size())
    ready_straddling = wp.where(for_any, 1, warp_size())
    node_tests, hit_count, uncertain_count, tested = wp.int32(0), wp.int32(0), wp.int32(0), wp.int32(0)
    waiting, straddling = wp.int32(0), wp.int32(0)
    b = LeafBox()
    place = Place()
    place.next = task[1]
    place.more = True
    place = advance(items, task, place, lists, models, states, pose)
    while place.more or waiting > 0 or straddling > 0:
        found = False
        while place.more and waiting < ready:
            column = place.column + warp_lane()
            if place.row == 0:
                node = read_number(items, SMALL_B + wp.min(column, lists.leaves_b - 1))
                b = box_leaf(models, states, pose, node, True)
            waiting = compare_leaf(items, place.row, column < lists.leaves_b, waiting, b)
            node_tests += wp.where(column < lists.leaves_b, 1, 0)
            place = advance(items, task, place, lists, models, states, pose)
        warp_sync()
        if waiting >= ready or (not place.more and waiting > 0):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            straddling = separate_leaf_pairs(EXACT, items, waiting, popped, straddling, models, states, pose)
            tested += popped
        if straddling >= ready_straddling or (not place.more and waiting == 0 and straddling > 0):
            popped = wp.min(straddling, warp_size())
            straddling -= popped
            found, uncertain = test_straddling(
                output, EXACT, items, straddling, popped, task[0], models, states, pose, hits
            )
            hit_count += wp.where(found, 1, 0)
            uncertain_count += wp.where(uncertain, 1, 0)
        if for_any:
            if warp_any(found or hits.any_hit[task[0]] != 0):
                place.more = False
                waiting = 0
                straddling = 0
    return node_tests, wp.vec3i(hit_count, wp.where(warp_lane() == 0, tested, 0), uncertain_count)
