"""Summary of a frame, in one array that one transfer brings over, and the tests of every object."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import add_lanes
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.intersect.face_pairs import Hits, read_total

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
    changed: wp.array(dtype=wp.int32),
    level_count: wp.array(dtype=wp.int32),
    frames_inout: wp.array(dtype=wp.int64),
    tests_out: wp.array(dtype=wp.int64),
    summary_out: wp.array(dtype=wp.int64),
):
    """Sum the counts of all object pairs, a pair a thread; warps are whole.

    Args:
        marked_count: Nodes refitted of each tree state, shape [state]; [0] where none is updated.
        changed: Objects that changed level, and those that turned back, shape [2].
        level_count: Objects at each level, shape [level]; [0] without levels.
        tests_out: Tests of each object, of all its pairs, 0 before, shape [object]; [0] if they are not asked.
        summary_out: Words as above, 0 before.
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
    add_lanes(summary_out, wp.static(HITS), hit_count)
    add_lanes(summary_out, wp.static(UNCERTAIN_PAIRS), uncertain)
    add_lanes(summary_out, wp.static(INTERSECTING), met)
    add_lanes(summary_out, wp.static(NODE_TESTS), node_tests)
    add_lanes(summary_out, wp.static(TRIANGLE_TESTS), triangle_tests)
    add_lanes(summary_out, wp.static(REFITTED), refitted)
    if i < level_count.shape[0]:
        summary_out[HEAD + i] = wp.int64(level_count[i])
    if i == 0:
        frames_inout[0] = frames_inout[0] + wp.int64(1)
        summary_out[wp.static(FRAMES)] = frames_inout[0]
        summary_out[wp.static(LAUNCHED)] = wp.int64(batch.launched[0])
        summary_out[wp.static(PAIRS)] = wp.int64(batch.count[0])
        summary_out[wp.static(APART)] = read_total(hits.apart_total)
        summary_out[wp.static(WITNESSES)] = read_total(hits.witness_total)
        summary_out[wp.static(CHANGED)] = wp.int64(changed[0])
        summary_out[wp.static(TURNED)] = wp.int64(changed[1])
