"""The start of a traversal: the relative pose of each object pair, and its counters at 0.

A thread makes a pose, or on CUDA some lanes of a warp together, which takes half the time where pairs are few.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.generation import record_launch
from warp_abtree.kernels.poses import (
    PairPose,
    PairTrees,
    RelativePose,
    larger,
    measure_pose,
    pair_trees,
    pose_trees,
    shift_centre,
    sum_products,
)
from warp_abtree.kernels.traversal.face_pairs import OUTPUT_ANY, Hits
from warp_abtree.kernels.traversal.load_balance import NO_UNIT, Work, units_per_pair
from warp_abtree.kernels.traversal.warp_stack import warp_lane, warp_sync
from warp_abtree.kernels.triangle.distance import DISTANCE_MAX, pad_distance

MODULE_OPTIONS = {"enable_backward": False, "fuse_fp": False}
wp.set_module_options(MODULE_OPTIONS)

POSE_LANES = native.constant("POSE_LANES")
SHIFT, BACK = wp.constant(12), wp.constant(15)  # where the entries of both start


@wp.func_native(native.body("shared_pose.cuh", "pose_lanes"))
def pose_lanes() -> wp.int32: ...


@wp.func_native(native.body("shared_pose.cuh", "next_entry"))
def next_entry(k: wp.int32) -> wp.int32:
    """Return the next entry of a lane's, POSE_ENTRIES where there is none."""


@wp.func_native(native.body("shared_pose.cuh", "pose_entries"))
def pose_entries() -> wp.uint64:
    """Return where the lanes of a pose keep its entries, an address in shared memory on CUDA."""


@wp.func_native(native.body("shared_pose.cuh", "read_entry"))
def read_entry(entries: wp.uint64, i: wp.int32) -> wp.float64: ...


@wp.func_native(native.body("shared_pose.cuh", "write_entry"))
def write_entry(entries: wp.uint64, i: wp.int32, x: wp.float64): ...


@wp.func_native(native.body("shared_pose.cuh", "pose_lanes_max"))
def pose_lanes_max(x: wp.float64) -> wp.float64:
    """Return the largest of the lanes of a pose."""


@wp.func_native(native.body("shared_pose.cuh", "load_column"))
def load_column(matrices: wp.array(dtype=wp.mat33d), i: wp.int32, column: wp.int32) -> wp.vec3d: ...


@wp.func
def component(v: wp.vec3d, i: wp.int32):
    """Return v[i] without a branch."""
    return wp.where(i == 0, v[0], wp.where(i == 1, v[1], v[2]))


@wp.func
def read_three(entries: wp.uint64, first: wp.int32, step: wp.int32):
    return wp.vec3d(
        read_entry(entries, first), read_entry(entries, first + step), read_entry(entries, first + 2 * step)
    )


@wp.func
def share_pose(
    lane: wp.int32, entries: wp.uint64, objects: ObjectPool, trees: PairTrees, a: wp.int32, b: wp.int32
):
    """Return what `measure_pose` does, bit by bit: each lane makes entries, from 9 on those of t and of the shift."""
    shift = objects.position[b] - objects.position[a]
    k = wp.int32(lane)
    while k < 12:
        i = wp.where(k < 9, k / 3, k - 9)
        x = load_column(objects.rotation, a, i)
        y = load_column(objects.rotation, b, k % 3)
        y = wp.where(k < 9, y, shift)
        write_entry(entries, k, sum_products(x[0], y[0], x[1], y[1], x[2], y[2]))
        k = next_entry(k)
    warp_sync()
    pose = RelativePose()
    k = wp.int32(lane)
    while k < 12:
        i = wp.where(k < 9, k / 3, k - 9)
        if k < 9:
            one = wp.where(i == k % 3, wp.float64(1.0), wp.float64(0.0))
            x = read_three(entries, i, 3)
            y = read_three(entries, k % 3, 3)
            gram = sum_products(x[0], y[0], x[1], y[1], x[2], y[2])
            pose.skew = larger(pose.skew, wp.abs(gram - one))
        else:
            x = read_three(entries, 3 * i, 1)
            t = read_entry(entries, k)
            to = component(trees.centre_a, i)
            write_entry(entries, SHIFT + i, shift_centre(x[0], x[1], x[2], trees.centre_b, t, to))
        k = next_entry(k)
    warp_sync()
    pose.shift = read_three(entries, SHIFT, 1)
    k = wp.int32(lane)
    while k < 3:
        x = read_three(entries, k, 3)
        y = pose.shift
        write_entry(entries, BACK + k, sum_products(x[0], y[0], x[1], y[1], x[2], y[2]))
        k = next_entry(k)
    pose.skew = pose_lanes_max(pose.skew)
    warp_sync()
    pose.back = read_three(entries, BACK, 1)
    pose.translation = read_three(entries, 9, 1)
    for i in range(3):
        row = read_three(entries, 3 * i, 1)
        for j in range(3):
            pose.rotation[i, j] = row[j]
    return pose


@wp.func
def start_launch(thread: wp.int32, last: wp.int32, count: wp.int32, work: Work):
    """Clear what the traversal counts; a stale launch is left no work: tree states may be half changed, though in bounds."""
    if thread < work.flag.shape[0]:
        work.flag[thread] = 0
    # By the last thread, which has no pose to wait for unless there are very many.
    if thread == last:
        stale = record_launch(work.record)
        work.counter[0] = 0
        work.counter[1] = 0
        work.counter[2] = wp.where(stale, 0, count * units_per_pair(work.warps_per_pair, count))
        work.counter[3] = wp.where(stale, NO_UNIT, 0)


@wp.func
def clear_hits(p: wp.int32, hits: Hits):
    if p == 0:
        hits.total[0] = 0
        hits.uncertain_total[0] = 0
    hits.any_hit[p] = 0
    hits.count[p] = wp.int64(0)
    hits.node_tests[p] = wp.int64(0)
    hits.triangle_tests[p] = wp.int64(0)
    hits.float64_tests[p] = wp.int64(0)
    hits.exact_tests[p] = wp.int64(0)


@wp.func
def widen_pose(pose: PairPose, within: wp.float64):
    """Let every box pass where distances may overflow: nothing is proved then, and the first faces count as near."""
    if within >= DISTANCE_MAX:
        pose.within = wp.float64(wp.inf)
        pose.margin = wp.inf
    return pose


@wp.kernel
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
    start_launch(p, wp.max(pairs.shape[0], work_out.flag.shape[0]) - 1, count, work_out)
    if p >= pairs.shape[0]:
        return
    clear_hits(p, hits_out)
    if p >= count:
        return
    a = wp.min(pairs[p][0], pairs[p][1])
    b = wp.max(pairs[p][0], pairs[p][1])
    distance = wp.float64(0.0)
    if within.shape[0] > 0:
        distance = pad_distance(models, states, objects, a, b, within[p])
    trees = pair_trees(models, states, objects, a, b)
    relative = measure_pose(objects, trees, a, b)
    pose = pose_trees(output != OUTPUT_ANY, models, states, trees, relative, distance)
    if within.shape[0] > 0:
        pose = widen_pose(pose, within[p])
    pose.swapped = wp.where(pairs[p][0] > pairs[p][1], 1, 0)
    pair_pose_out[p] = pose


@functools.cache
def shared_pose(with_distances: bool):
    """Return the kernel that does what `relative_pose_kernel` does, some lanes a pair; with distances or without."""

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def shared_pose_kernel(
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
        """Compute relative poses, `pose_lanes` each, and clear what the traversal counts; a block is a warp."""
        thread = wp.tid()
        p = thread / pose_lanes()
        lane = thread - p * pose_lanes()
        room = pairs.shape[0]
        count = wp.min(pair_count[0], room)
        start_launch(thread, wp.max(room * pose_lanes(), work_out.flag.shape[0]) - 1, count, work_out)
        if p < room and lane == 0:
            clear_hits(p, hits_out)
        # The lanes of a warp stay together: beyond the last pair they do as that one does, and store nothing.
        if thread - warp_lane() >= count * pose_lanes():
            return
        last = wp.min(p, count - 1)
        a = wp.min(pairs[last][0], pairs[last][1])
        b = wp.max(pairs[last][0], pairs[last][1])
        trees = pair_trees(models, states, objects, a, b)
        relative = share_pose(lane, pose_entries(), objects, trees, a, b)
        distance = wp.float64(0.0)
        if wp.static(with_distances):
            distance = pad_distance(models, states, objects, a, b, within[last])
        pose = pose_trees(output != OUTPUT_ANY, models, states, trees, relative, distance)
        if wp.static(with_distances):
            pose = widen_pose(pose, within[last])
        if lane == 0 and p < count:
            pose.swapped = wp.where(pairs[last][0] > pairs[last][1], 1, 0)
            pair_pose_out[p] = pose

    return shared_pose_kernel
