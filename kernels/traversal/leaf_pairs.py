"""Face pairs that wait on a warp's stack, in two parts: planes first, and only of those that are left the edges.

All threads of a warp come here together.
"""

import warp as wp

from warp_abtree.kernels.arithmetic.predicates import UNSURE
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.traversal.face_pairs import OUTPUT_FACES, Hits, defer_faces, part_faces, report_hit, try_faces
from warp_abtree.kernels.traversal.warp_stack import (
    CROSSING_START,
    STACK_LENGTH,
    item_first,
    item_second,
    push_crossing,
    read_item,
    read_signs,
    reserve_slot,
    warp_lane,
    warp_sync,
)
from warp_abtree.kernels.triangle.float32_filter import PARTED

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def part_candidates(
    mode: wp.int32,
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    crossing: wp.int32,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
):
    """Look which of the face pairs that waited a plane parts, one a thread; return how many wait that none does."""
    lane = warp_lane()
    item = read_item(items, STACK_LENGTH + first + wp.min(lane, popped - 1))
    signs = part_faces(mode, models, states, pose, item_first(item), item_second(item))
    signs = wp.where(lane < popped, signs, PARTED)
    crossing = push_crossing(items, crossing, signs != PARTED, item, signs)
    warp_sync()
    return crossing


@wp.func
def test_crossing(
    output: wp.int32,
    mode: wp.int32,
    items: wp.uint64,
    first: wp.int32,
    popped: wp.int32,
    pair: wp.int32,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    hits: Hits,
):
    """Test face pairs that no plane parts, one a thread; return whether this one met, and whether that is open."""
    lane = warp_lane()
    at = first + wp.min(lane, popped - 1)
    item = read_item(items, CROSSING_START + at)
    meet = try_faces(mode, models, states, pose, item_first(item), item_second(item), read_signs(items, at))
    meet = wp.where(lane < popped, meet, 0)
    warp_sync()
    found = meet == 1
    if output == OUTPUT_FACES:
        slot = reserve_slot(hits.total, found)
        if found:
            report_hit(slot, pair, pose.swapped, item_first(item), item_second(item), hits)
    if found:
        hits.any_hit[pair] = 1
    slot = reserve_slot(hits.unsure_total, meet == UNSURE)
    if meet == UNSURE:
        defer_faces(slot, pair, item_first(item), item_second(item), hits)
    return found, meet == UNSURE
