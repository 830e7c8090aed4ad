"""Face pairs of an object pair: the stages that decide them, and the report of those that meet."""

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, Trees
from warp_abtree.kernels.base.boxes import map_point
from warp_abtree.kernels.base.counters import reserve_slot
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import FLOAT32, UNCERTAIN
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_face_pair, load_near
from warp_abtree.kernels.triangle.float32_filter import (
    FLOAT32_UNIT,
    are_uncertain,
    gap_signs,
    intersect_straddling,
    plane_signs,
)
from warp_abtree.kernels.triangle.float64_filter import decide_triangles
from warp_abtree.kernels.triangle.signs import have_one_side, rotate_corners

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# In place of a precision: EXACT, and face pairs that are apart by less than a gap are listed too.
GAP = wp.constant(-2)

# On the pair of a face pair in `Hits.face`: it is apart.
NEAR_BIT = wp.constant(1 << 30)
PAIR_MASK = wp.constant((1 << 30) - 1)
# In float32 a gap is no larger, so that its products with lengths are finite; and rounded up.
GAP_MAX_32, GAP_ROUNDING_32 = wp.constant(2.0**60), wp.constant(1.0 + 2.0**-20)


@wp.struct
class PairTests:
    """Tests of one object pair."""

    nodes: wp.int32  # pairs of boxes compared
    faces: wp.int32  # pairs of faces measured


@wp.struct
class Hits:
    """Results of a batch of pairs. Lists are full where their total is beyond their shape, which is then the demand."""

    any_hit: wp.array(dtype=wp.int32)  # 0, 1 where the surfaces meet, more where a solid holds the other, shape [pair]
    count: wp.array(dtype=wp.int64)  # face pairs that intersect, shape [pair]
    face: wp.array(dtype=wp.vec3i)  # (pair, face of its first object, face of its second), shape [capacity]
    total: wp.array(dtype=wp.int32)  # numbers `face` and may wrap: the demand is the sum of `count`
    node_tests: wp.array(dtype=wp.int64)  # pairs of boxes compared, shape [pair]
    triangle_tests: wp.array(dtype=wp.int64)  # face pairs tested, shape [pair]
    float64_tests: wp.array(dtype=wp.int64)  # those that are uncertain in float32, shape [pair]
    exact_tests: wp.array(dtype=wp.int64)  # those that are inexact in float64 and took exact signs, shape [pair]
    uncertain: wp.array(dtype=wp.vec3i)  # (pair, face of the lower object, face of the higher), shape [capacity]
    uncertain_total: wp.array(dtype=wp.int32)  # numbers `uncertain`
    inexact: wp.array(dtype=wp.vec3i)  # as `uncertain`, of the same shape where there is an exact stage
    inexact_total: wp.array(dtype=wp.int32)  # numbers `inexact`
    gap: wp.array(dtype=wp.float64)  # under which face pairs are near [world units], shape [pair]; [0] for no gap
    apart: wp.array(dtype=wp.vec3i)  # as `uncertain`: pairs that are apart and may be near, shape [capacity]
    apart_total: wp.array(dtype=wp.int32)  # numbers `apart`
    witness_total: wp.array(dtype=wp.int32)  # rows that face pairs are reduced to, shape [1]; [0] where they are not


@wp.struct
class FoundHits:
    """What a search for hits finds; searches for more have such a struct of their own."""

    hits: Hits  # of each pair


@wp.func
def near_of_b(models: ModelPool, pose: PairPose, vertex: wp.int32):
    return map_point(pose.rotation32, pose.translation32, load_near(models, vertex))


@wp.func
def near_corners(models: ModelPool, pose: PairPose, a: wp.vec4i, b: wp.vec4i):
    """Return the corners of a face of A and of one of B in A's frame, about its centre and scaled, a row each."""
    scale, m = wp.float32(pose.scale), models
    return (
        wp.matrix_from_rows(load_near(m, a[0]) * scale, load_near(m, a[1]) * scale, load_near(m, a[2]) * scale),
        wp.matrix_from_rows(
            near_of_b(m, pose, b[0]) * scale, near_of_b(m, pose, b[1]) * scale, near_of_b(m, pose, b[2]) * scale
        ),
    )


@wp.func
def float32_bounds(mode: wp.int32, pose: PairPose):
    """Return the error of coordinates and of arithmetic that signs allow for; none for FLOAT32."""
    return wp.where(mode == FLOAT32, 0.0, pose.error), wp.where(mode == FLOAT32, 0.0, FLOAT32_UNIT)


@wp.func
def scaled_gap(pose: PairPose):
    """Return the distance that boxes are widened by at the scale of float32, not too small."""
    return wp.min(wp.float32(pose.within * pose.scale) * GAP_ROUNDING_32, GAP_MAX_32)


@wp.func
def face_plane_signs(mode: wp.int32, trees: Trees, pose: PairPose, face_a: wp.int32, face_b: wp.int32):
    """Return SEPARATED where the plane of one of two active faces separates them in float32, else the signs."""
    if mode != FLOAT32 and pose.error == wp.inf:
        return 0
    a = load_corner_ids(trees.states, pose.corner_a + face_a)
    b = load_corner_ids(trees.states, pose.corner_b + face_b)
    error, unit = float32_bounds(mode, pose)
    near_a, near_b = near_corners(trees.models, pose, a, b)
    if mode == GAP:
        return gap_signs(error, unit, scaled_gap(pose), near_a, near_b)
    return plane_signs(error, unit, near_a, near_b)


@wp.func
def intersect_straddling_faces(
    mode: wp.int32, trees: Trees, pose: PairPose, face_a: wp.int32, face_b: wp.int32, signs: wp.int32
):
    """Test straddling faces in float32, with the signs of `face_plane_signs`; return 1, 0 or UNCERTAIN."""
    error, unit = float32_bounds(mode, pose)
    if mode == GAP and have_one_side(signs):
        return 0
    if are_uncertain(unit, signs):
        return UNCERTAIN
    a = load_corner_ids(trees.states, pose.corner_a + face_a)
    b = load_corner_ids(trees.states, pose.corner_b + face_b)
    p1, q1, r1, p2, q2, r2 = rotate_corners(signs, a, b)
    near_a, near_b = near_corners(trees.models, pose, wp.vec4i(p1, q1, r1, 0), wp.vec4i(p2, q2, r2, 0))
    return intersect_straddling(error, unit, near_a, near_b)


@wp.func
def test_faces(mode: wp.int32, trees: Trees, pose: PairPose, face_a: wp.int32, face_b: wp.int32):
    """Test one active face of A against one of B in float64, in A's frame; return 1, 0 or UNCERTAIN."""
    a = trees.states.face_corner[pose.corner_a + face_a]
    b = trees.states.face_corner[pose.corner_b + face_b]
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    if mode == FLOAT32:
        # A power of two brings the model to unit size, so that no product leaves float32's range.
        s = pose.scale
        return decide_triangles(mode, a0 * s, a1 * s, a2 * s, b0 * s, b1 * s, b2 * s)
    return decide_triangles(mode, a0, a1, a2, b0, b1, b2)


@wp.func
def write_row(slot: wp.int32, row: wp.vec3i, rows: wp.array(dtype=wp.vec3i)):
    """Put a face pair on a list, if there is room."""
    if slot >= 0 and slot < rows.shape[0]:
        rows[slot] = row


@wp.func
def append_row(flag: bool, row: wp.vec3i, total: wp.array(dtype=wp.int32), rows: wp.array(dtype=wp.vec3i)):
    """Put the face pairs whose flag is set on a list, one a lane, as far as there is room. For all lanes of a warp."""
    slot = reserve_slot(total, flag)
    if flag:
        write_row(slot, row, rows)


@wp.func
def report_hit(slot: wp.int32, pair: wp.int32, swapped: wp.int32, face_a: wp.int32, face_b: wp.int32, hits: Hits):
    """Write a hit in the order in which the pair names its objects, if there is room."""
    row = wp.where(swapped != 0, wp.vec3i(pair, face_b, face_a), wp.vec3i(pair, face_a, face_b))
    write_row(slot, row, hits.face)


@wp.func
def read_total(total: wp.array(dtype=wp.int32)):
    """Return a counter of rows, [1] or [0] for none, read as uint32: an overflowed one still tells the demand."""
    count = wp.int64(0)
    if total.shape[0] > 0:
        count = wp.int64(wp.uint32(total[0]))
    return count


@wp.func
def is_whole(batch: PairBatch, hits: Hits):
    """Return whether a launch ran, and lost nothing for lack of room."""
    whole = batch.launched[0] >= 0 and wp.uint32(batch.count[0]) <= wp.uint32(batch.pairs.shape[0])
    whole = whole and wp.uint32(hits.total[0]) <= wp.uint32(hits.face.shape[0])
    whole = whole and read_total(hits.witness_total) <= wp.int64(hits.face.shape[0])
    if hits.uncertain.shape[0] > 0:
        whole = whole and wp.uint32(hits.uncertain_total[0]) <= wp.uint32(hits.uncertain.shape[0])
    if hits.apart.shape[0] > 0:
        whole = whole and wp.uint32(hits.apart_total[0]) <= wp.uint32(hits.apart.shape[0])
    return whole
