"""Faces of two small trees in place: boxes and posed corners in a warp's shared memory, compared all against all.

A leaf has a box in the frame of either object: its own, and the one about its posed corners. Rows are leaves of A; a
lane has a leaf of B, a column, and a bit for each row.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import map_point
from warp_abtree.kernels.base.counters import reserve_slot, take_together
from warp_abtree.kernels.base.lanes import (
    count_lanes,
    first_lane,
    lowest_bit,
    next_place,
    warp_any,
    warp_lane,
    warp_size,
    warp_sync,
)
from warp_abtree.kernels.base.nodes import load_constant_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.exact.predicates import UNCERTAIN
from warp_abtree.kernels.intersect.face_pairs import Hits, report_hit, write_row
from warp_abtree.kernels.search.item import OUTPUT_FACES
from warp_abtree.kernels.search.warp_search import TraversalTests
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_near
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, are_uncertain, intersect_straddling, plane_signs
from warp_abtree.kernels.triangle.signs import SEPARATED, rotate_corners

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TILE_FACES, TILE_WORDS = native.constant("TILE_FACES"), native.constant("TILE_WORDS")
TILE_CORNERS = native.constant("TILE_CORNERS")
TILE_PAIRS, TILE_HITS = native.constant("TILE_PAIRS"), native.constant("TILE_HITS")
SMALL_A, SMALL_B = native.constant("SMALL_A"), native.constant("SMALL_B")


@native.func_native()
def read_number(items: wp.uint64, i: wp.int32) -> wp.int32: ...


@native.func_native()
def write_number(items: wp.uint64, i: wp.int32, flag: bool, x: wp.int32): ...


@native.func_native()
def read_half(items: wp.uint64, i: wp.int32) -> wp.int32: ...


@native.func_native()
def push_half(items: wp.uint64, end: wp.int32, flag: bool, x: wp.int32):
    """Append the half words whose flag is set to a list that ends there."""


@native.func_native()
def spans_overlap(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3) -> bool:
    """Return whether the boxes from a to b and from c to d overlap, without branches."""


@native.func_native()
def compare_boxes(
    items: wp.uint64, rows: wp.int32, lower: wp.vec3, upper: wp.vec3, posed_lower: wp.vec3, posed_upper: wp.vec3
) -> wp.uint32:
    """Return a bit for each of the first leaves of A in place whose boxes overlap those of a leaf of B."""


@native.func_native()
def read_quarter(items: wp.uint64, i: wp.int32) -> wp.vec4: ...


@native.func_native()
def write_quarter(items: wp.uint64, i: wp.int32, flag: bool, x: wp.vec4): ...


@wp.struct
class PosedLeaf:
    """A leaf's box in its own frame and the box of its corners in the other object's, and its scaled corners in A's."""

    lower: wp.vec3  # least corner
    upper: wp.vec3  # greatest corner
    posed_lower: wp.vec3  # least corner in the other frame
    posed_upper: wp.vec3  # greatest corner in the other frame
    p: wp.vec3  # first corner
    q: wp.vec3  # second corner
    r: wp.vec3  # third corner
    face: wp.int32  # face number


@wp.func
def pose_leaf(trees: Trees, pose: PairPose, node: wp.int32, of_b: bool):
    """Return the boxes and corners of a leaf."""
    leaf = PosedLeaf()
    record = load_constant_node(trees.states, wp.where(of_b, pose.node_b, pose.node_a) + node)
    leaf.lower = record.lower
    leaf.upper = record.upper
    leaf.face = record.face
    corners = load_corner_ids(trees.states, wp.where(of_b, pose.corner_b, pose.corner_a) + record.face)
    rotation = pose.rotation32
    shift = pose.translation32
    if not of_b:
        rotation = wp.transpose(rotation)
        shift = pose.back32
    near_p, near_q, near_r = (
        load_near(trees.models, corners[0]),
        load_near(trees.models, corners[1]),
        load_near(trees.models, corners[2]),
    )
    p, q, r = map_point(rotation, shift, near_p), map_point(rotation, shift, near_q), map_point(rotation, shift, near_r)
    # Corners are rounded where boxes are not: docs/exactness.md, bound 10.
    margin = pose.margin + pose.margin
    leaf.posed_lower = wp.min(p, wp.min(q, r)) - wp.vec3(margin, margin, margin)
    leaf.posed_upper = wp.max(p, wp.max(q, r)) + wp.vec3(margin, margin, margin)
    scale = wp.float32(pose.scale)
    leaf.p = wp.where(of_b, p, near_p) * scale
    leaf.q = wp.where(of_b, q, near_q) * scale
    leaf.r = wp.where(of_b, r, near_r) * scale
    return leaf


@wp.func
def place_leaf(items: wp.uint64, row: wp.int32, of_b: bool, keep: bool, leaf: PosedLeaf):
    """Put a leaf in place: in words, its boxes, lower and upper in either frame; its corners, each with the face."""
    box = wp.where(of_b, TILE_WORDS / 4, 0) + 3 * row
    lower, upper, near, far = leaf.lower, leaf.upper, leaf.posed_lower, leaf.posed_upper
    write_quarter(items, box, keep, wp.vec4(lower[0], lower[1], lower[2], upper[0]))
    write_quarter(items, box + 1, keep, wp.vec4(upper[1], upper[2], near[0], near[1]))
    write_quarter(items, box + 2, keep, wp.vec4(near[2], far[0], far[1], far[2]))
    corner = box + TILE_CORNERS / 4
    p, q, r, face = leaf.p, leaf.q, leaf.r, wp.cast(leaf.face, wp.float32)
    write_quarter(items, corner, keep, wp.vec4(p[0], p[1], p[2], face))
    write_quarter(items, corner + 1, keep, wp.vec4(q[0], q[1], q[2], face))
    write_quarter(items, corner + 2, keep, wp.vec4(r[0], r[1], r[2], face))


@wp.func
def place_leaves(
    items: wp.uint64, of_b: bool, first: wp.int32, step: wp.int32, end: wp.int32, trees: Trees, pose: PairPose
):
    """Put the next leaves of a list in place, every so many-th, but for those beyond the other's root.

    Return how many, and the first leaf that had no room.
    """
    # Lanes may still read the tile before: a vote, which is all that lies between, orders no memory.
    warp_sync()
    root = load_constant_node(trees.states, wp.where(of_b, pose.node_a, pose.node_b) + 1)
    list = wp.where(of_b, SMALL_B, SMALL_A)
    count = wp.int32(0)
    at = wp.int32(first)
    while at < end and count < TILE_FACES:
        mine = at + step * warp_lane()
        leaf = pose_leaf(trees, pose, read_number(items, list + wp.min(mine, end - 1)), of_b)
        keep = mine < end and spans_overlap(leaf.posed_lower, leaf.posed_upper, root.lower, root.upper)
        row = next_place(count, keep)
        place_leaf(items, row, of_b, keep and row < TILE_FACES, leaf)
        at += step * first_lane(keep and row >= TILE_FACES)
        count = wp.min(count, TILE_FACES)
    warp_sync()
    return count, at


@wp.func
def compare_column(items: wp.uint64, rows: wp.int32, column: wp.int32, columns: wp.int32):
    """Return a bit for each leaf of A in place whose boxes overlap those of one of B."""
    box = TILE_WORDS / 4 + 3 * wp.min(column, columns - 1)
    x = read_quarter(items, box)
    y = read_quarter(items, box + 1)
    z = read_quarter(items, box + 2)
    bits = compare_boxes(
        items,
        rows,
        wp.vec3(x[0], x[1], x[2]),
        wp.vec3(x[3], y[0], y[1]),
        wp.vec3(y[2], y[3], z[0]),
        wp.vec3(z[1], z[2], z[3]),
    )
    return wp.where(column < columns, bits, wp.uint32(0))


@wp.func
def corner_at(items: wp.uint64, quarter: wp.int32):
    x = read_quarter(items, quarter)
    return wp.vec3(x[0], x[1], x[2])


@wp.func
def face_in_place(items: wp.uint64, quarter: wp.int32):
    return read_number(items, 4 * quarter + 3)


@wp.func
def corners_of_a(pair: wp.int32):
    return TILE_CORNERS / 4 + 3 * (pair & 0xFF)


@wp.func
def corners_of_b(pair: wp.int32):
    return (TILE_CORNERS + TILE_WORDS) / 4 + 3 * (pair >> 8)


@wp.func
def corners_at(items: wp.uint64, p: wp.int32, q: wp.int32, r: wp.int32):
    return wp.matrix_from_rows(corner_at(items, p), corner_at(items, q), corner_at(items, r))


@wp.func
def test_faces_in_place(items: wp.uint64, error: wp.float32, pair: wp.int32, live: bool):
    """Return whether two faces in place meet in float32: 1, 0 or UNCERTAIN; what `float32_filter_triangles` does."""
    a = corners_of_a(pair)
    b = corners_of_b(pair)
    signs = plane_signs(error, FLOAT32_UNIT, corners_at(items, a, a + 1, a + 2), corners_at(items, b, b + 1, b + 2))
    if signs == SEPARATED or not live:
        return 0
    if are_uncertain(FLOAT32_UNIT, signs):
        return UNCERTAIN
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, wp.vec3i(a, a + 1, a + 2), wp.vec3i(b, b + 1, b + 2))
    return intersect_straddling(error, FLOAT32_UNIT, corners_at(items, p1, q1, r1), corners_at(items, p2, q2, r2))


@wp.func
def report_tile_hits(items: wp.uint64, first: wp.int32, count: wp.int32, pair: wp.int32, swapped: wp.int32, hits: Hits):
    """Report so many of the hits that wait, one a lane."""
    warp_sync()
    slot = take_together(hits.total, 0, count) + warp_lane()
    if warp_lane() < count:
        faces = read_half(items, TILE_HITS + first + warp_lane())
        face_a, face_b = face_in_place(items, corners_of_a(faces)), face_in_place(items, corners_of_b(faces))
        report_hit(slot, pair, swapped, face_a, face_b, hits)
    warp_sync()


@wp.func
def defer_faces(items: wp.uint64, uncertain: bool, faces: wp.int32, pair: wp.int32, hits: Hits):
    """Put uncertain face pairs on their list. For all lanes."""
    slot = reserve_slot(hits.uncertain_total, uncertain)
    if uncertain:
        face_a, face_b = face_in_place(items, corners_of_a(faces)), face_in_place(items, corners_of_b(faces))
        write_row(slot, wp.vec3i(pair, face_a, face_b), hits.uncertain)


@wp.func
def test_overlaps(
    output: wp.int32,
    for_any: bool,
    pair: wp.int32,
    pose: PairPose,
    overlaps: wp.uint32,
    column: wp.int32,
    items: wp.uint64,
    hits: Hits,
    tests: wp.ref[TraversalTests],
):
    """Test the faces in place whose bits are set, and report and count hits."""
    bits = wp.uint32(overlaps)
    waiting, hit_end = wp.int32(0), wp.int32(0)
    added = count_lanes(bits != wp.uint32(0))
    while added > 0 or waiting > 0 or hit_end > 0:
        while added > 0 and waiting < warp_size():
            push_half(items, TILE_PAIRS + waiting, bits != wp.uint32(0), lowest_bit(wp.int32(bits)) | (column << 8))
            waiting += added
            bits = bits & (bits - wp.uint32(1))
            added = count_lanes(bits != wp.uint32(0))
        if waiting > 0:
            warp_sync()
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            faces = read_half(items, TILE_PAIRS + waiting + wp.min(warp_lane(), popped - 1))
            meet = test_faces_in_place(items, pose.error, faces, warp_lane() < popped)
            warp_sync()
            found = count_lanes(meet == 1)
            tests.faces += popped
            tests.hits += found
            tests.uncertain += count_lanes(meet == UNCERTAIN)
            defer_faces(items, meet == UNCERTAIN, faces, pair, hits)
            if output == OUTPUT_FACES:
                push_half(items, TILE_HITS + hit_end, meet == 1, faces)
                hit_end += found
            if for_any:
                if found > 0 or warp_any(hits.any_hit[pair] != 0):
                    bits = wp.uint32(0)
                    added = 0
                    waiting = 0
        if hit_end >= warp_size() or (hit_end > 0 and added == 0 and waiting == 0):
            reported = wp.min(hit_end, warp_size())
            hit_end -= reported
            report_tile_hits(items, hit_end, reported, pair, pose.swapped, hits)
