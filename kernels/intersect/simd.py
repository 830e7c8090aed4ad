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
    three_numbers,
)
from warp_abtree.kernels.intersect.face_pairs import (
    GAP,
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
from warp_abtree.kernels.intersect.near_faces import part_uncertain, report_near
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

long_counts = wp.types.vector(length=4, dtype=wp.int64)


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
) -> long_counts:
    """Test face pairs in float32, 16 at a time, perhaps until the first that meet. Lists have room for 16 more.

    The same as `float32_filter_triangles`. With a gap, 0 or more [scaled], also lists those that are apart, but for
    those that `gap_signs` calls separated; below 0 there is no such list.

    Args:
        bounds: (error, unit, gap), the first two of `float32_bounds`.

    Returns how many met, which stand in front of the list then, how many are uncertain, how many were tested, and how
    many are listed as apart.
    """


@native.func_native(cpu=True)
def simd_float64_filter(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    first_ends: bool,
    met: wp.int32,
    waiting: wp.int32,
    uncertain: wp.array(dtype=wp.int64),
    faces: wp.array(dtype=wp.int64),
) -> three_numbers:
    """Test uncertain face pairs in float64, 8 at a time, perhaps until the first that meet, and list those that meet.

    The same as `float64_filter_triangles`. The two lists differ, and have room for 8 more.

    Returns how many have met then, how many are inexact, which stand in front of their list then, and how many were
    tested.
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
    met: wp.int32,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    met_inout: wp.array(dtype=wp.int64),
):
    """Decide face pairs one by one, perhaps until the first hit, and add hits to those on a list that have met.

    Returns how many have met then, and how many were decided. Both lists may be one: what is added stands before what
    is looked at.
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
    return met, tested


@wp.func(inline=False)
def resolve_uncertain(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    met: wp.int32,
    count: wp.int32,
    uncertain: wp.array(dtype=wp.int64),
    met_inout: wp.array(dtype=wp.int64),
):
    """Decide uncertain face pairs, as `resolve_faces`: for EXACT in float64, then the inexact ones by exact signs.

    Not inlined: compiling takes less long, and most calls of its caller have none.

    Returns how many have met then, how many were decided, and how many of these took exact signs.
    """
    if mode != EXACT:
        met, tested = resolve_faces(mode, output, trees, pose, met, count, uncertain, met_inout)
        return met, tested, 0
    counts = simd_float64_filter(
        trees.models, trees.states, pose, output == OUTPUT_ANY, met, count, uncertain, met_inout
    )
    met, inexact = resolve_faces(
        mode, output, trees, pose, wp.int32(counts[0]), wp.int32(counts[1]), uncertain, met_inout
    )
    return met, wp.int32(counts[2]), inexact


@wp.func
def write_counts(p: wp.int32, hit_count: wp.int64, tests: long_counts, hits: Hits):
    """Write the counts of an object pair: tests of boxes, of faces, those in float64 and those with exact signs."""
    hits.count[p] = hit_count
    hits.node_tests[p] = tests[0]
    hits.triangle_tests[p] = tests[1]
    hits.float64_tests[p] = tests[2]
    hits.exact_tests[p] = tests[3]


@wp.func
def test_leaf_pairs(
    mode: wp.int32,
    output: wp.int32,
    trees: Trees,
    pose: PairPose,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    uncertain: wp.array(dtype=wp.int64),
):
    """Test leaf pairs in all stages; return how many met, put in front of the list, and the counts of tests."""
    if mode == WITHIN:
        near, decided = resolve_faces(mode, output, trees, pose, 0, waiting, faces, faces)
        return near, long_counts(wp.int64(0), wp.int64(decided), wp.int64(0), wp.int64(0))
    error, unit = float32_bounds(mode, pose)
    filtered = simd_float32_filter(
        trees.models,
        trees.states,
        pose,
        wp.vec3(error, unit, -1.0),
        output == OUTPUT_ANY,
        waiting,
        faces,
        uncertain,
        uncertain,
    )
    met, count = wp.int32(filtered[0]), wp.int32(filtered[1])
    resolved, inexact = wp.int32(0), wp.int32(0)
    if count > 0 and not (output == OUTPUT_ANY and met > 0):
        met, resolved, inexact = resolve_uncertain(mode, output, trees, pose, met, count, uncertain, faces)
    return met, long_counts(wp.int64(0), filtered[2], wp.int64(resolved), wp.int64(inexact))


@wp.func
def test_gap_pairs(
    trees: Trees,
    pose: PairPose,
    waiting: wp.int32,
    faces: wp.array(dtype=wp.int64),
    uncertain: wp.array(dtype=wp.int64),
    apart: wp.array(dtype=wp.int64),
):
    """Test leaf pairs as `test_leaf_pairs` and list those that are apart; return how many, after how many met."""
    error, unit = float32_bounds(EXACT, pose)
    bounds = wp.vec3(error, unit, scaled_gap(pose))
    filtered = simd_float32_filter(trees.models, trees.states, pose, bounds, False, waiting, faces, uncertain, apart)
    count = wp.int32(filtered[1])
    met, clear = part_uncertain(
        trees, pose, wp.int32(filtered[0]), count, uncertain, wp.int32(filtered[3]), faces, apart
    )
    return met, clear, long_counts(wp.int64(0), filtered[2], wp.int64(count), wp.int64(count))


@functools.cache
def thread_traversal(mode: int):
    """Return the kernel whose threads share the object pairs, at a precision, WITHIN or GAP."""
    start_pairs = pairs_starter(mode in (int(WITHIN), int(GAP)))

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
        apart = wp.zeros(shape=wp.static(WAITING_LENGTH if mode == int(GAP) else 1), dtype=wp.int64)
        descent = Descent()
        descent.thread = take_thread(work_inout.counter)
        p = take_unit(work_inout.counter)
        while p < count:
            pose = batch_inout.poses[p]
            stack[0] = first_item(trees.states, pose)
            slabs = descent.thread < memory_inout.shape[0] and wp.static(mode != int(WITHIN)) and pose.error < wp.inf
            plain = wp.where(slabs, wp.int64(plain_tests), NEVER)
            descent = start_descent(output, plain, count_repeats(p, batch_inout.poses), descent)
            hit_count, near_count, tests = wp.int64(0), wp.int64(0), long_counts()
            while descent.top > 0 or descent.deep > 0:
                descent, waiting, compared = advance(
                    trees, pose, hit_count, tests[0], descent, stack, below, memory_inout, faces
                )
                met, clear, stages = wp.int32(0), wp.int32(0), long_counts()
                if wp.static(mode == int(GAP)):
                    met, clear, stages = test_gap_pairs(trees, pose, waiting, faces, uncertain, apart)
                    near_count += wp.int64(report_near(trees, pose, p, clear, apart, hits_inout))
                else:
                    met, stages = test_leaf_pairs(wp.static(mode), output, trees, pose, waiting, faces, uncertain)
                tests += stages
                tests[0] += compared
                if met > 0:
                    hit_count += wp.int64(met)
                    report_hits(output, p, pose.swapped, met, faces, hits_inout)
                if output == OUTPUT_ANY:
                    descent = shuffle_stack(met, tests[0], descent, stack)
            write_counts(p, hit_count + near_count, tests, hits_inout)
            p = take_unit(work_inout.counter)

    return traverse_thread_kernel
