"""Face pairs that intersect, or are nearer than a gap: policies of the search by threads."""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, Trees
from warp_abtree.kernels.base.counters import take_slots
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import (
    GAP,
    OUTPUT_ANY,
    OUTPUT_FACES,
    Hits,
    float32_bounds,
    report_hit,
    scaled_gap,
    test_faces,
)
from warp_abtree.kernels.intersect.near_faces import part_uncertain, report_near
from warp_abtree.kernels.intersect.relative_pose import pairs_starter
from warp_abtree.kernels.search.item import item_first, item_second
from warp_abtree.kernels.search.thread_search import THREAD_HEADERS, FaceTests, ThreadPolicy, thread_search

# Headers of all policies.
FILTERS = ("exact/determinant.cuh", "intersect/float32_filter.h", "intersect/float64_filter.h")
HIT_FILTERS = (*FILTERS, "intersect/near_filter.h")
wp.set_module_options(native.options(*THREAD_HEADERS, *HIT_FILTERS))


@wp.struct
class Filtered:
    """Face pairs of a filter, in front of a list each."""

    met: wp.int32  # those that meet
    uncertain: wp.int32  # those that another filter or exact signs decide
    apart: wp.int32  # those that are apart, perhaps nearer than a gap
    tested: wp.int32  # those that were looked at


@native.func_native(cpu=True)
def simd_float32_filter(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    bounds: wp.vec3,
    first_ends: bool,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    uncertain: wp.array(dtype=wp.int64),
    apart: wp.array(dtype=wp.int64),
    found: wp.ref[Filtered],
):
    """Test face pairs in float32, 16 at a time, perhaps until the first that meet. Lists have room for 16 more.

    The same as `float32_filter_triangles`. With a gap, 0 or more [scaled], also lists those that are apart, but for
    those that `gap_signs` calls separated; below 0 there is no such list.

    Args:
        bounds: (error, unit, gap), the first two of `float32_bounds`.
        found: The counts then. Those that met stand in front of the list of face pairs.
    """


@native.func_native(cpu=True)
def simd_float64_filter(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    first_ends: bool,
    lists_apart: bool,
    found: wp.ref[Filtered],
    uncertain: wp.array(dtype=wp.int64),
    faces: wp.array(dtype=wp.int64),
    apart: wp.array(dtype=wp.int64),
):
    """Test uncertain face pairs in float64, 8 at a time, perhaps until the first that meet, and list those that meet.

    The same as `float64_filter_triangles`. Lists differ, and have room for 8 more. Those that are still uncertain then
    are inexact, and stand in front of their list.

    Args:
        lists_apart: Whether those that are apart are added to a list.
    """


@wp.func
def report_hits(
    output: wp.int32, pair: wp.int32, swapped: wp.int32, count: wp.int32, faces: wp.array(dtype=wp.int64), hits: Hits
):
    """Note that an object pair meets, and report the face pairs on a list, if that is asked."""
    hits.any_hit[pair] = 1
    if output == OUTPUT_FACES:
        slot = take_slots(hits.total, count)
        for i in range(count):
            report_hit(slot + i, pair, swapped, item_first(faces[i]), item_second(faces[i]), hits)


@wp.func
def resolve_faces(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    met: wp.ref[wp.int32],
    met_inout: wp.array(dtype=wp.int64),
):
    """Decide face pairs one by one, perhaps until the first hit; add hits to a list, and return how many were decided.

    Both lists may be one: what is added stands before what is looked at.
    """
    tested = wp.int32(0)
    for i in range(waiting):
        if output != OUTPUT_ANY or met == 0:
            item = faces[i]
            tested += 1
            if test_faces(mode, trees, pose, item_first(item), item_second(item)) == 1:
                met_inout[met] = item
                met += 1
    return wp.int64(tested)


@wp.func(inline=False)
def resolve_uncertain(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    uncertain: wp.array(dtype=wp.int64),
    met_inout: wp.array(dtype=wp.int64),
    found: wp.ref[Filtered],
    tests: wp.ref[FaceTests],
):
    """Decide uncertain face pairs, as `resolve_faces`: for EXACT in float64, then the inexact ones by exact signs.

    Not inlined: compiling takes less long, and most calls of its caller have none.
    """
    if mode == EXACT:
        simd_float64_filter(
            trees.models, trees.states, pose, output == OUTPUT_ANY, False, found, uncertain, met_inout, uncertain
        )
        tests.float64 += wp.int64(found.tested)
        tests.exact += resolve_faces(mode, output, trees, pose, found.uncertain, uncertain, found.met, met_inout)
    else:
        tests.float64 += resolve_faces(mode, output, trees, pose, found.uncertain, uncertain, found.met, met_inout)


@wp.func
def write_counts(p: wp.int32, node_tests: wp.int64, tests: FaceTests, hits: Hits):
    hits.count[p] = tests.hits + tests.near
    hits.node_tests[p] = node_tests
    hits.triangle_tests[p] = tests.total
    hits.float64_tests[p] = tests.float64
    hits.exact_tests[p] = tests.exact


@wp.func
def test_leaf_pairs(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    uncertain: wp.array(dtype=wp.int64),
    found: wp.ref[Filtered],
    tests: wp.ref[FaceTests],
):
    """Test leaf pairs in all stages; those that met stand in front of the list then."""
    error, unit = float32_bounds(mode, pose)
    bounds, for_any = wp.vec3(error, unit, -1.0), output == OUTPUT_ANY
    simd_float32_filter(trees.models, trees.states, pose, bounds, for_any, waiting, faces, uncertain, uncertain, found)
    tests.total += wp.int64(found.tested)
    if found.uncertain > 0 and not (for_any and found.met > 0):
        resolve_uncertain(mode, output, trees, pose, uncertain, faces, found, tests)


@wp.func
def test_gap_pairs(
    trees: Trees,
    pose: PairPose,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    uncertain: wp.array(dtype=wp.int64),
    apart: wp.array(dtype=wp.int64),
    found: wp.ref[Filtered],
    tests: wp.ref[FaceTests],
):
    """Test leaf pairs as `test_leaf_pairs` and list those that are apart."""
    error, unit = float32_bounds(EXACT, pose)
    bounds = wp.vec3(error, unit, scaled_gap(pose))
    simd_float32_filter(trees.models, trees.states, pose, bounds, False, waiting, faces, uncertain, apart, found)
    tests.total += wp.int64(found.tested)
    if found.uncertain > 0:
        tests.float64 += wp.int64(found.uncertain)
        simd_float64_filter(trees.models, trees.states, pose, False, True, found, uncertain, faces, apart)
        tests.exact += wp.int64(found.uncertain)
        part_uncertain(trees, pose, found.uncertain, uncertain, found.met, found.apart, faces, apart)


@wp.func
def report_met(
    output: wp.int32,
    pair: wp.int32,
    swapped: wp.int32,
    count: wp.int32,
    faces: wp.array(dtype=wp.int64),
    hits: Hits,
    tests: wp.ref[FaceTests],
):
    """Count and report the face pairs that met, which stand in front of a list; return how many."""
    if count > 0:
        tests.hits += wp.int64(count)
        report_hits(output, pair, swapped, count, faces, hits)
    return count


@functools.cache
def thread_policy(mode: int) -> ThreadPolicy:
    """Return the policy at a precision, or for GAP."""
    with_gap = mode == int(GAP)

    @wp.func
    def test(
        output: wp.int32,
        trees: Trees,
        batch: PairBatch,
        pair: wp.int32,
        waiting: wp.int32,
        faces: wp.array(dtype=wp.int64),
        uncertain: wp.array(dtype=wp.int64),
        apart: wp.array(dtype=wp.int64),
        hits: Hits,
        tests: wp.ref[FaceTests],
    ):
        pose, found = batch.poses[pair], Filtered()
        if wp.static(with_gap):
            test_gap_pairs(trees, pose, waiting, faces, uncertain, apart, found, tests)
            tests.near += wp.int64(report_near(trees, pose, pair, found.apart, apart, hits))
        else:
            test_leaf_pairs(wp.static(mode), output, trees, pose, waiting, faces, uncertain, found, tests)
        return report_met(output, pair, pose.swapped, found.met, faces, hits, tests)

    start = pairs_starter(with_gap)
    return ThreadPolicy(HIT_FILTERS, True, with_gap, Hits, start, test, write_counts)


def thread_traversal(mode: int):
    """Return the kernel whose threads share the object pairs, at a precision, or for GAP."""
    return thread_search(thread_policy(mode), int(OUTPUT_ANY))
