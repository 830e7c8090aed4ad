"""Face pairs that are apart: which of them are nearer than the gap of their object pair, in float64.

Traversals drop none that is: boxes and planes are proved farther apart than `pad_distance`, which is more than the gap
by what `triangle_distance` errs by. So what is found depends on its bits alone, the same on every device.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import ROUNDING_UP
from warp_abtree.kernels.base.counters import count_flags, reserve_slot, take_slots
from warp_abtree.kernels.base.lanes import warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits, report_hit, test_faces
from warp_abtree.kernels.search.item import item_first, item_second
from warp_abtree.kernels.search.thread_search import FaceLists
from warp_abtree.kernels.search.warp_stack import push_signed_pair, read_signed_pair, signed_pairs
from warp_abtree.kernels.triangle.corners import load_triangles
from warp_abtree.kernels.triangle.distance_bounds import bound_faces, load_points
from warp_abtree.kernels.triangle.triangle_pair import triangle_distance

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

ERROR_MAX, NEAR_GAP_MAX = wp.constant(wp.float32(2.0**20)), wp.constant(wp.float32(2.0**40))


@native.func_native(cpu=True)
def simd_near_filter(trees: Trees, pose: PairPose, waiting: wp.int32, faces: wp.array(dtype=wp.int64)) -> wp.int32:
    """Drop the face pairs that float32 proves farther apart than `within`, 16 at a time; return how many are left."""


@wp.func
def are_near(trees: Trees, pose: PairPose, gap: wp.float64, face_a: wp.int32, face_b: wp.int32):
    """Return whether two faces that do not intersect are nearer than a gap, in A's frame."""
    return triangle_distance(load_triangles(trees, pose, face_a, face_b)) < gap


@wp.func
def part_uncertain(trees: Trees, pose: PairPose, lists: wp.ref[FaceLists]):
    """Decide inexact face pairs by exact signs, and add each to those that have met or to those that are apart."""
    for i in range(lists.uncertain):
        item = lists.uncertain_faces[i]
        if test_faces(EXACT, trees, pose, item_first(item), item_second(item)) == 1:
            lists.faces[lists.met] = item
            lists.met += 1
        else:
            lists.apart_faces[lists.apart] = item
            lists.apart += 1


@wp.func(inline=False)
def report_near(trees: Trees, pose: PairPose, pair: wp.int32, lists: FaceLists, hits: Hits):
    """Report the face pairs that are apart and nearer than the gap; return how many. For threads of the CPU."""
    apart = lists.apart_faces
    left = simd_near_filter(trees, pose, lists.apart, apart)
    near = wp.int32(0)
    for i in range(left):
        item = apart[i]
        if are_near(trees, pose, hits.gap[pair], item_first(item), item_second(item)):
            apart[near] = item
            near += 1
    slot = take_slots(hits.total, near)
    for i in range(near):
        report_hit(slot + i, pair | NEAR_BIT, pose.swapped, item_first(apart[i]), item_second(apart[i]), hits)
    return near


@wp.func
def may_be_near(trees: Trees, pose: PairPose, face_a: wp.int32, face_b: wp.int32):
    """Return False only where float32 proves two faces farther apart than `within`, as `simd_near_filter`."""
    scale, gap = wp.float32(pose.scale), wp.float32(pose.within * pose.scale)
    # Beyond these numbers float32 has no squares, or no bounds.
    if not (pose.error < ERROR_MAX and gap < NEAR_GAP_MAX):
        return True
    a, b = load_points(trees, pose, pose.translation32 * scale, scale, face_a, face_b)
    # Differences of corners err by `error` along an axis.
    lower, upper = wp.float32(0.0), wp.float32(0.0)
    bound_faces(2.0 * pose.error, a, b, lower, upper)
    return not (lower > gap * ROUNDING_UP)


@wp.func
def report_waiting(
    list: wp.uint64, first: wp.int32, popped: wp.int32, trees: Trees, pair_poses: wp.array(dtype=PairPose), hits: Hits
):
    """Report which of the face pairs that wait are nearer than the gap, one a lane."""
    item = wp.vec3i()
    read_signed_pair(list, first + wp.min(warp_lane(), popped - 1), item)
    p = item[0]
    near = warp_lane() < popped
    if near:
        near = are_near(trees, pair_poses[p], hits.gap[p], item[1], item[2])
    warp_sync()
    count_flags(hits.count, p, near)
    slot = reserve_slot(hits.total, near)
    if near:
        report_hit(slot, p | NEAR_BIT, pair_poses[p].swapped, item[1], item[2], hits)


@wp.kernel(
    module="unique",
    module_options=native.options(
        "base/counters.cuh", "base/lanes.cuh", "distance/bound_faces.cuh", "search/warp_stack.cuh"
    ),
    cuda_max_registers=128,
)
def find_near_kernel(threads: wp.int32, trees: Trees, batch: PairBatch, hits_inout: Hits):
    """Report the face pairs that are apart and nearer than the gap, in a grid-stride loop; a block is a warp.

    Float32 drops most; those it leaves wait for float64 until a warp of them does.
    """
    list, waiting = signed_pairs(), wp.int32(0)
    end = wp.min(hits_inout.apart_total[0], hits_inout.apart.shape[0])
    first = wp.tid() - warp_lane()
    while first < end or waiting > 0:
        if first < end:
            item = hits_inout.apart[wp.min(first + warp_lane(), end - 1)]
            kept = first + warp_lane() < end
            if kept:
                kept = may_be_near(trees, batch.poses[item[0]], item[1], item[2])
            push_signed_pair(list, waiting, kept, item, 0)
            warp_sync()
            first += wp.min(threads, end - first)
        if waiting >= warp_size() or (first >= end and waiting > 0):
            popped = wp.min(waiting, warp_size())
            waiting -= popped
            report_waiting(list, waiting, popped, trees, batch.poses, hits_inout)


@wp.kernel
def add_reach_kernel(batch: PairBatch, reach: wp.array(dtype=wp.vec4d), gap_out: wp.array(dtype=wp.float64)):
    """Find the gap of one pair a thread, of the motion and the reach of both objects."""
    p = wp.tid()
    if p < batch.count[0]:
        a, b = reach[batch.pairs[p][0]], reach[batch.pairs[p][1]]
        motion = wp.vec3d(a[0] - b[0], a[1] - b[1], a[2] - b[2])
        gap_out[p] = (a[3] + b[3]) + wp.length(motion)
