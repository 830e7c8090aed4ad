"""Start of a traversal: the relative pose of each object pair, and its counters at 0."""

import functools
from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import record_launch
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.base.poses import PairBatch, pair_pose
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.intersect.small_trees import is_small
from warp_abtree.kernels.search.item import OUTPUT_ANY
from warp_abtree.kernels.search.load_balance import NO_UNIT, Work, note_descent, units_per_pair
from warp_abtree.kernels.triangle.distance import DISTANCE_MAX, pad_distance

MODULE_OPTIONS = native.options() | {"block_dim": WARP_SIZE}
wp.set_module_options(MODULE_OPTIONS)


@wp.func
def clear_work(count: wp.int32, work: Work):
    """Set out the units of so many pairs; none for a stale launch, whose tree states may be half changed in bounds."""
    stale = record_launch(work.record)
    work.counter[0] = 0
    work.counter[1] = 0
    work.counter[2] = wp.where(stale, 0, count * units_per_pair(work.warps_per_pair, count))
    work.counter[3] = wp.where(stale, NO_UNIT, work.warps)


@wp.func
def clear_hits(p: wp.int32, hits: Hits):
    if p == 0:
        hits.total[0] = 0
        hits.uncertain_total[0] = 0
        hits.inexact_total[0] = 0
        if hits.gap.shape[0] > 0:
            hits.apart_total[0] = 0
    hits.any_hit[p] = 0
    hits.count[p] = wp.int64(0)
    hits.node_tests[p] = wp.int64(0)
    hits.triangle_tests[p] = wp.int64(0)
    hits.float64_tests[p] = wp.int64(0)
    hits.exact_tests[p] = wp.int64(0)


@functools.cache
def pose_starter(with_distances: bool):
    """Return the function that starts the traversal of a pair: for pairs that meet, or are nearer than distances."""

    @wp.func
    def start_pose(
        p: wp.int32, output: wp.int32, trees: Trees, batch: PairBatch, within: wp.array(dtype=wp.float64), work: Work
    ):
        """Compute the pose of B in A's frame, A the smaller index."""
        a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
        b = wp.max(batch.pairs[p][0], batch.pairs[p][1])
        distance = wp.float64(0.0)
        if wp.static(with_distances):
            distance = pad_distance(trees, a, b, within[p])
        pose = pair_pose(output != OUTPUT_ANY, trees, a, b, distance)
        if wp.static(with_distances):
            if within[p] >= DISTANCE_MAX:
                # Nothing is proved where distances may overflow: every box passes, and the first faces count as near.
                pose.within = wp.float64(wp.inf)
                pose.margin = wp.inf
        if pose.margin >= 0.0 and not is_small(pose, work.small_faces):
            note_descent(work)
        pose.swapped = wp.where(batch.pairs[p][0] > batch.pairs[p][1], 1, 0)
        batch.poses[p] = pose

    return start_pose


@functools.cache
def relative_poses(with_distances: bool):
    """Return the kernel that starts a traversal, as `pose_starter`."""
    start_pose = pose_starter(with_distances)

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def relative_pose_kernel(
        output: wp.int32,
        trees: Trees,
        within: wp.array(dtype=wp.float64),
        batch_inout: PairBatch,
        hits_out: Hits,
        work_out: Work,
    ):
        """Compute the pose of B in A's frame once a pair, A the smaller index, and clear what the traversal counts.

        Args:
            within: Distances [world units] that boxes are to be widened by, shape [pair], -inf for a pair that is
                passed over; [0] for intersection.
        """
        p = wp.tid()
        count = wp.min(batch_inout.count[0], batch_inout.pairs.shape[0])
        if p < work_out.flag.shape[0]:
            work_out.flag[p] = 0
        # By the last thread, which has no pose to wait for unless there are very many.
        if p == wp.max(batch_inout.pairs.shape[0], work_out.flag.shape[0]) - 1:
            clear_work(count, work_out)
        if p >= batch_inout.pairs.shape[0]:
            return
        clear_hits(p, hits_out)
        if p >= count:
            return
        start_pose(p, output, trees, batch_inout, within, work_out)

    return relative_pose_kernel


@functools.cache
def pairs_starter(with_distances: bool):
    """Return the function by which one thread starts all pairs, as `relative_poses` do; what is found has `hits`."""
    start_pose = pose_starter(with_distances)

    @wp.func
    def start_pairs(
        output: wp.int32, trees: Trees, batch: PairBatch, within: wp.array(dtype=wp.float64), found: Any, work: Work
    ):
        room = batch.pairs.shape[0]
        count = wp.min(batch.count[0], room)
        clear_work(count, work)
        for p in range(room):
            clear_hits(p, found.hits)
        for p in range(count):
            start_pose(p, output, trees, batch, within, work)

    return start_pairs
