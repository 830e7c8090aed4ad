"""Summary of a frame, in one array that one transfer brings over, and the tests of every object."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import add_lanes, ends_launch
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.intersect.face_pairs import Hits, read_total
from warp_abtree.kernels.update.levels import LEVEL_STAYED, LEVEL_TURNED

wp.set_module_options(native.options("base/counters.cuh"))

FRAMES, LAUNCHED, PAIRS, HITS, UNCERTAIN_PAIRS, APART, INTERSECTING, NODE_TESTS, TRIANGLE_TESTS = range(9)
REFITTED, CHANGED, TURNED, WITNESSES = 9, 10, 11, 12
"""Words of a summary: frames so far, what became of the query's launch (`LaunchRecord`), object pairs, face pairs that
intersect, that are uncertain, and that may be within a gap, pairs that intersect, pairs of boxes and of faces tested,
nodes refitted, objects whose level changed, those that turned back, and rows that face pairs are reduced to."""

HEAD = wp.constant(13)
"""Words before those that count the objects at each level."""

TRIANGLE_WORK = wp.constant(wp.int64(4))
"""Cost of a test of two triangles in tests of two boxes, about."""


@wp.kernel
def summarise_frame_kernel(
    batch: PairBatch,
    hits: Hits,
    marked_count: wp.array(dtype=wp.int32),
    change: wp.array(dtype=wp.int32),
    level_count: wp.array(dtype=wp.int32),
    threads: wp.int32,
    sums_inout: wp.array(dtype=wp.int64),
    ended_inout: wp.array(dtype=wp.int32),
    tests_out: wp.array(dtype=wp.int64),
    summary_out: wp.array(dtype=wp.int64),
):
    """Sum the counts of all object pairs, a pair a thread; warps are whole. The last thread writes the sums.

    Args:
        marked_count: Nodes refitted of each tree state, shape [state]; [0] where none is updated.
        change: As `Levels` has it, shape [object]; [0] without levels.
        level_count: Objects at each level, shape [level]; [0] without levels.
        threads: Of the launch.
        sums_inout: Words that are sums, 0 before and after, but for frames so far, shape [HEAD].
        ended_inout: See `ends_launch`.
        tests_out: Tests of each object, of all its pairs, 0 before, shape [object]; [0] if they are not asked.
        summary_out: Words as above, perhaps in memory of the host.
    """
    i = wp.tid()
    hit_count = wp.int64(0)
    uncertain = wp.int64(0)
    met = wp.int64(0)
    node_tests = wp.int64(0)
    triangle_tests = wp.int64(0)
    refitted = wp.int64(0)
    if i < wp.min(batch.count[0], batch.pairs.shape[0]):
        hit_count = hits.count[i]
        uncertain = hits.float64_tests[i]
        node_tests = hits.node_tests[i]
        triangle_tests = hits.triangle_tests[i]
        met = wp.int64(wp.where(hits.any_hit[i] != 0, 1, 0))
        if tests_out.shape[0] > 0:
            tests = node_tests + TRIANGLE_WORK * triangle_tests
            wp.atomic_add(tests_out, batch.pairs[i][0], tests)
            wp.atomic_add(tests_out, batch.pairs[i][1], tests)
    if i < marked_count.shape[0]:
        refitted = wp.int64(marked_count[i])
    changed = bool(False)
    turned = bool(False)
    if i < change.shape[0]:
        changed = change[i] != LEVEL_STAYED
        turned = change[i] == LEVEL_TURNED
    add_lanes(sums_inout, wp.static(HITS), hit_count)
    add_lanes(sums_inout, wp.static(UNCERTAIN_PAIRS), uncertain)
    add_lanes(sums_inout, wp.static(INTERSECTING), met)
    add_lanes(sums_inout, wp.static(NODE_TESTS), node_tests)
    add_lanes(sums_inout, wp.static(TRIANGLE_TESTS), triangle_tests)
    add_lanes(sums_inout, wp.static(REFITTED), refitted)
    add_lanes(sums_inout, wp.static(CHANGED), wp.int64(wp.where(changed, 1, 0)))
    add_lanes(sums_inout, wp.static(TURNED), wp.int64(wp.where(turned, 1, 0)))
    if i < level_count.shape[0]:
        summary_out[HEAD + i] = wp.int64(level_count[i])
    if ends_launch(ended_inout, threads):
        frames = sums_inout[wp.static(FRAMES)] + wp.int64(1)
        for k in range(HEAD):
            summary_out[k] = sums_inout[k]
            sums_inout[k] = wp.int64(0)
        sums_inout[wp.static(FRAMES)] = frames
        summary_out[wp.static(FRAMES)] = frames
        summary_out[wp.static(LAUNCHED)] = wp.int64(batch.launched[0])
        summary_out[wp.static(PAIRS)] = wp.int64(batch.count[0])
        summary_out[wp.static(APART)] = read_total(hits.apart_total)
        summary_out[wp.static(WITNESSES)] = read_total(hits.witness_total)
