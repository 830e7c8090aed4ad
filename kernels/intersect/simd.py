"""The traversal of the CPU: threads that take one object pair after the other, depth first, in vector instructions.

Number by number what warps compute on CUDA. Items do not wait for one another, so the processor works on several at
once.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, Trees
from warp_abtree.kernels.base.counters import take_slots
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.descent import (
    CPU_STACK_LENGTH,
    NEVER,
    WAITING_LENGTH,
    Descent,
    advance,
    count_repeats,
    shuffle_stack,
    start_descent,
)
from warp_abtree.kernels.intersect.face_pairs import (
    GAP,
    NEAR_LISTED,
    OUTPUT_ANY,
    OUTPUT_FACES,
    WITHIN,
    Hits,
    faces_near,
    float32_bounds,
    report_hit,
    scaled_gap,
    test_faces,
)
from warp_abtree.kernels.intersect.near_faces import list_all_apart, part_uncertain, report_near
from warp_abtree.kernels.intersect.relative_pose import ThreadSteps, pairs_starter
from warp_abtree.kernels.search.item import first_item, item_first, item_second
from warp_abtree.kernels.search.load_balance import Work, take_thread, take_unit

MODULE_OPTIONS = native.options(
    "base/counters.cuh",
    "base/lanes.cuh",
    "exact/determinant.cuh",
    "intersect/descend.h",
    "intersect/float32_filter.h",
    "intersect/float64_filter.h",
    "intersect/near_filter.h",
    "intersect/open_subtrees.h",
    "intersect/subtrees.h",
    "search/load_balance.cuh",
)
wp.set_module_options(MODULE_OPTIONS)


@wp.struct
class Filtered:
    """Face pairs of a filter, in front of a list each."""

    met: wp.int32  # those that meet
    uncertain: wp.int32  # those that another filter or exact signs decide
    apart: wp.int32  # those that are apart, perhaps nearer than a gap
    tested: wp.int32  # those that were looked at


@wp.struct
class FaceTests:
    """Counts of the face pair tests of an object pair."""

    total: wp.int64  # all of them
    float64: wp.int64  # those that were uncertain in float32
    exact: wp.int64  # those that took exact signs


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
    found: wp.ref[Filtered],
    uncertain: wp.array(dtype=wp.int64),
    faces: wp.array(dtype=wp.int64),
):
    """Test uncertain face pairs in float64, 8 at a time, perhaps until the first that meet, and list those that meet.

    The same as `float64_filter_triangles`. The two lists differ, and have room for 8 more. Those that are still
    uncertain then are inexact, and stand in front of their list.
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
            meets = wp.int32(0)
            if mode == WITHIN:
                meets = faces_near(trees, pose, item_first(item), item_second(item))
            else:
                meets = test_faces(mode, trees, pose, item_first(item), item_second(item))
            if meets == 1:
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
        simd_float64_filter(trees.models, trees.states, pose, output == OUTPUT_ANY, found, uncertain, met_inout)
        tests.float64 += wp.int64(found.tested)
        tests.exact += resolve_faces(mode, output, trees, pose, found.uncertain, uncertain, found.met, met_inout)
    else:
        tests.float64 += resolve_faces(mode, output, trees, pose, found.uncertain, uncertain, found.met, met_inout)


@wp.func
def write_counts(p: wp.int32, hit_count: wp.int64, node_tests: wp.int64, tests: FaceTests, hits: Hits):
    hits.count[p] = hit_count
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
    if mode == WITHIN:
        tests.total += resolve_faces(mode, output, trees, pose, waiting, faces, found.met, faces)
        return
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
    part_uncertain(trees, pose, found.uncertain, uncertain, found.met, found.apart, faces, apart)
    tests.total += wp.int64(found.tested)
    tests.float64 += wp.int64(found.uncertain)
    tests.exact += wp.int64(found.uncertain)


@functools.cache
def thread_traversal(mode: int):
    """Return the kernel whose threads share the object pairs, at a precision, WITHIN, GAP or NEAR_LISTED."""
    with_gap = mode in (int(GAP), int(NEAR_LISTED))
    start_pairs = pairs_starter(with_gap or mode == int(WITHIN))

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def traverse_thread_kernel(
        output: wp.int32,
        trees: Trees,
        plain_tests: wp.int32,
        steps: ThreadSteps,
        batch_inout: PairBatch,
        memory_inout: wp.array2d(dtype=wp.float32),
        hits_inout: Hits,
        work_inout: Work,
    ):
        """Start all object pairs, by one thread; take one after the other and traverse it depth first. CPU only."""
        if steps.starts:
            start_pairs(output, trees, batch_inout, steps.within, hits_inout, work_inout)
        if not steps.traverses:
            return
        count = wp.min(batch_inout.count[0], batch_inout.pairs.shape[0])
        stack = wp.zeros(shape=CPU_STACK_LENGTH, dtype=wp.int64)
        below = wp.zeros(shape=CPU_STACK_LENGTH, dtype=wp.int64)
        faces = wp.zeros(shape=WAITING_LENGTH, dtype=wp.int64)
        uncertain = wp.zeros(shape=WAITING_LENGTH, dtype=wp.int64)
        apart = wp.zeros(shape=wp.static(WAITING_LENGTH if with_gap else 1), dtype=wp.int64)
        descent = Descent()
        descent.thread = take_thread(work_inout.counter)
        p = take_unit(work_inout.counter)
        while p < count:
            pose = batch_inout.poses[p]
            stack[0] = first_item(trees.states, pose)
            slabs = descent.thread < memory_inout.shape[0] and wp.static(mode != int(WITHIN)) and pose.error < wp.inf
            plain = wp.where(slabs, wp.int64(plain_tests), NEVER)
            start_descent(output, plain, count_repeats(p, batch_inout.poses), descent)
            hit_count, near_count, tests = wp.int64(0), wp.int64(0), FaceTests()
            while descent.top > 0 or descent.deep > 0:
                waiting = advance(trees, pose, hit_count, descent, stack, below, memory_inout, faces)
                found = Filtered()
                if wp.static(with_gap):
                    test_gap_pairs(trees, pose, waiting, faces, uncertain, apart, found, tests)
                    if wp.static(mode == int(GAP)):
                        near_count += wp.int64(report_near(trees, pose, p, found.apart, apart, hits_inout))
                    else:
                        list_all_apart(p, found.apart, apart, hits_inout)
                else:
                    test_leaf_pairs(wp.static(mode), output, trees, pose, waiting, faces, uncertain, found, tests)
                if found.met > 0:
                    hit_count += wp.int64(found.met)
                    report_hits(output, p, pose.swapped, found.met, faces, hits_inout)
                if output == OUTPUT_ANY:
                    shuffle_stack(found.met, descent, stack)
            write_counts(p, hit_count + near_count, descent.tests, tests, hits_inout)
            p = take_unit(work_inout.counter)

    return traverse_thread_kernel
