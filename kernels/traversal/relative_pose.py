"""The start of a traversal: the relative pose of each object pair, and its counters at 0."""

import functools

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.generation import record_launch
from warp_abtree.kernels.poses import PairPose, pair_pose
from warp_abtree.kernels.traversal.face_pairs import OUTPUT_ANY, Hits
from warp_abtree.kernels.traversal.load_balance import NO_UNIT, Work, units_per_pair
from warp_abtree.kernels.triangle.distance import DISTANCE_MAX, pad_distance

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)


@functools.cache
def relative_poses(with_distances: bool):
    """Return the kernel that starts a traversal: for pairs that meet, or that are nearer than distances."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def relative_pose_kernel(
        output: wp.int32,
        models: ModelPool,
        states: StatePool,
        objects: ObjectPool,
        pair_count: wp.array(dtype=wp.int32),
        pairs: wp.array(dtype=wp.vec2i),
        within: wp.array(dtype=wp.float64),
        pair_pose_out: wp.array(dtype=PairPose),
        hits_out: Hits,
        work_out: Work,
    ):
        """Compute the pose of B in A's frame once a pair, A the smaller index, and clear what the traversal counts.

        A stale launch is left no work: tree states may be half changed, though in bounds.

        Args:
            within: Distances [world units] that boxes are to be widened by, shape [pair]; [0] for intersection.
        """
        p = wp.tid()
        count = wp.min(pair_count[0], pairs.shape[0])
        if p < work_out.flag.shape[0]:
            work_out.flag[p] = 0
        # By the last thread, which has no pose to wait for unless there are very many.
        if p == wp.max(pairs.shape[0], work_out.flag.shape[0]) - 1:
            stale = record_launch(work_out.record)
            work_out.counter[0] = 0
            work_out.counter[1] = 0
            work_out.counter[2] = wp.where(stale, 0, count * units_per_pair(work_out.warps_per_pair, count))
            work_out.counter[3] = wp.where(stale, NO_UNIT, work_out.warps)
        if p >= pairs.shape[0]:
            return
        if p == 0:
            hits_out.total[0] = 0
            hits_out.uncertain_total[0] = 0
        hits_out.any_hit[p] = 0
        hits_out.count[p] = wp.int64(0)
        hits_out.node_tests[p] = wp.int64(0)
        hits_out.triangle_tests[p] = wp.int64(0)
        hits_out.float64_tests[p] = wp.int64(0)
        hits_out.exact_tests[p] = wp.int64(0)
        if p >= count:
            return
        a = wp.min(pairs[p][0], pairs[p][1])
        b = wp.max(pairs[p][0], pairs[p][1])
        distance = wp.float64(0.0)
        if wp.static(with_distances):
            distance = pad_distance(models, states, objects, a, b, within[p])
        pose = pair_pose(output != OUTPUT_ANY, models, states, objects, a, b, distance)
        if wp.static(with_distances):
            if within[p] >= DISTANCE_MAX:
                # Nothing is proved where distances may overflow: every box passes, and the first faces count as near.
                pose.within = wp.float64(wp.inf)
                pose.margin = wp.inf
        pose.swapped = wp.where(pairs[p][0] > pairs[p][1], 1, 0)
        pair_pose_out[p] = pose

    return relative_pose_kernel
