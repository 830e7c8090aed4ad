"""Face pairs that intersect, or are nearer than a gap: policies of the search by threads."""

import functools
from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.counters import take_slots
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import (
    GAP,
    FoundHits,
    Hits,
    float32_bounds,
    report_hit,
    scaled_gap,
    test_faces,
)
from warp_abtree.kernels.intersect.near_faces import part_uncertain, report_near
from warp_abtree.kernels.intersect.relative_pose import pairs_starter
from warp_abtree.kernels.search.item import OUTPUT_ANY, OUTPUT_FACES, item_first, item_second
from warp_abtree.kernels.search.thread_search import THREAD_HEADERS, FaceLists, FaceTests, ThreadPolicy, thread_search

# Headers of all policies.
FILTERS = ("exact/determinant.cuh", "intersect/float32_filter.h", "intersect/float64_filter.h")
HIT_FILTERS = (*FILTERS, "intersect/near_filter.h")
wp.set_module_options(native.options(*THREAD_HEADERS, *HIT_FILTERS))


@native.func_native(cpu=True)
def simd_float32_filter(trees: Trees, pose: PairPose, bounds: wp.vec3, first_ends: bool, lists: wp.ref[FaceLists]):
    """Test leaf pairs in float32, 16 at a time, perhaps until the first that meet.

    The same as `float32_filter_triangles`. With a gap, 0 or more [scaled], also lists those that are apart, but for
    those that `gap_signs` calls separated; below 0 there is no such list.

    Args:
        bounds: (error, unit, gap), the first two of `float32_bounds`.
    """


@native.func_native(cpu=True)
def simd_float64_filter(trees: Trees, pose: PairPose, first_ends: bool, lists_apart: bool, lists: wp.ref[FaceLists]):
    """Test uncertain face pairs in float64, 8 at a time, perhaps until the first that meet, and add to the other lists.

    The same as `float64_filter_triangles`. Those that are still uncertain then are inexact, and stand in front of their
    list.

    Args:
        lists_apart: Whether those that are apart are added to their list.
    """


@wp.func
def resolve_faces(mode: wp.int32, output: wp.int32, trees: Trees, pose: PairPose, lists: wp.ref[FaceLists]):
    """Decide uncertain face pairs one by one, perhaps until the first hit, and add hits; return how many it decided."""
    tested = wp.int32(0)
    for i in range(lists.uncertain):
        if output != OUTPUT_ANY or lists.met == 0:
            item = lists.uncertain_faces[i]
            tested += 1
            if test_faces(mode, trees, pose, item_first(item), item_second(item)) == 1:
                lists.faces[lists.met] = item
                lists.met += 1
    return wp.int64(tested)


@wp.func(inline=False)
def resolve_uncertain(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    lists: wp.ref[FaceLists],
    tests: wp.ref[FaceTests],
):
    """Decide uncertain face pairs, as `resolve_faces`: for EXACT in float64, then the inexact ones by exact signs.

    Not inlined: compiling takes less long, and most calls of its caller have none.
    """
    if mode == EXACT:
        simd_float64_filter(trees, pose, output == OUTPUT_ANY, False, lists)
        tests.float64 += wp.int64(lists.tested)
        tests.exact += resolve_faces(mode, output, trees, pose, lists)
    else:
        tests.float64 += resolve_faces(mode, output, trees, pose, lists)


@wp.func
def write_counts(p: wp.int32, node_tests: wp.int64, tests: FaceTests, found: Any):
    """Write the counts of a pair to the hits of what is found."""
    found.hits.count[p] = tests.hits + tests.near
    found.hits.node_tests[p] = node_tests
    found.hits.triangle_tests[p] = tests.total
    found.hits.float64_tests[p] = tests.float64
    found.hits.exact_tests[p] = tests.exact


@wp.func
def test_leaf_pairs(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    lists: wp.ref[FaceLists],
    tests: wp.ref[FaceTests],
):
    """Test leaf pairs in all stages."""
    error, unit = float32_bounds(mode, pose)
    for_any = output == OUTPUT_ANY
    simd_float32_filter(trees, pose, wp.vec3(error, unit, -1.0), for_any, lists)
    tests.total += wp.int64(lists.tested)
    if lists.uncertain > 0 and not (for_any and lists.met > 0):
        resolve_uncertain(mode, output, trees, pose, lists, tests)


@wp.func
def test_gap_pairs(trees: Trees, pose: PairPose, lists: wp.ref[FaceLists], tests: wp.ref[FaceTests]):
    """Test leaf pairs as `test_leaf_pairs` and list those that are apart."""
    error, unit = float32_bounds(EXACT, pose)
    simd_float32_filter(trees, pose, wp.vec3(error, unit, scaled_gap(pose)), False, lists)
    tests.total += wp.int64(lists.tested)
    if lists.uncertain > 0:
        tests.float64 += wp.int64(lists.uncertain)
        simd_float64_filter(trees, pose, False, True, lists)
        tests.exact += wp.int64(lists.uncertain)
        part_uncertain(trees, pose, lists)


@wp.func
def report_met(
    output: wp.int32, pair: wp.int32, swapped: wp.int32, lists: FaceLists, hits: Hits, tests: wp.ref[FaceTests]
):
    """Count the face pairs that met, and report them if that is asked; return how many."""
    count = lists.met
    if count > 0:
        tests.hits += wp.int64(count)
        hits.any_hit[pair] = 1
        if output == OUTPUT_FACES:
            slot = take_slots(hits.total, count)
            for i in range(count):
                report_hit(slot + i, pair, swapped, item_first(lists.faces[i]), item_second(lists.faces[i]), hits)
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
        lists: wp.ref[FaceLists],
        found: FoundHits,
        tests: wp.ref[FaceTests],
    ):
        pose = batch.poses[pair]
        if wp.static(with_gap):
            test_gap_pairs(trees, pose, lists, tests)
            tests.near += wp.int64(report_near(trees, pose, pair, lists, found.hits))
        else:
            test_leaf_pairs(wp.static(mode), output, trees, pose, lists, tests)
        return report_met(output, pair, pose.swapped, lists, found.hits, tests)

    start = pairs_starter(with_gap)
    return ThreadPolicy(HIT_FILTERS, True, with_gap, FoundHits, start, test, write_counts)


def thread_traversal(mode: int):
    """Return the kernel whose threads share the object pairs, at a precision, or for GAP."""
    return thread_search(thread_policy(mode))
