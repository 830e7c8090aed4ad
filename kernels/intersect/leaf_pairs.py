"""Leaf pairs that wait in a warp's lists, in two passes: planes first, and only of straddling pairs the edges.

A pair is separated where the plane of one face has the other on one side, else it straddles. All lanes of a warp come
here together.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.counters import reserve_slot
from warp_abtree.kernels.base.lanes import warp_lane, warp_sync
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.exact.predicates import UNCERTAIN
from warp_abtree.kernels.intersect.face_pairs import (
    GAP,
    FoundHits,
    append_row,
    face_plane_signs,
    intersect_straddling_faces,
    report_hit,
)
from warp_abtree.kernels.search.item import OUTPUT_FACES, item_first, item_second
from warp_abtree.kernels.search.warp_stack import (
    STACK_LENGTH,
    STRADDLING_START,
    WarpLists,
    push_straddling,
    read_item,
    read_signs,
)
from warp_abtree.kernels.triangle.signs import SEPARATED

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def separate_leaf_pairs(
    mode: wp.int32,
    own: wp.ref[WarpLists],
    popped: wp.int32,
    trees: Trees,
    pose: PairPose,
):
    """Drop the leaf pairs that a plane separates, one a lane; what is left waits as straddling pairs."""
    lane = warp_lane()
    own.leaf_pairs -= popped
    item = read_item(own.items, STACK_LENGTH + own.leaf_pairs + wp.min(lane, popped - 1))
    signs = face_plane_signs(mode, trees, pose, item_first(item), item_second(item))
    signs = wp.where(lane < popped, signs, SEPARATED)
    push_straddling(own.items, own.straddling, signs != SEPARATED, item, signs)
    warp_sync()


@wp.func
def test_straddling(
    mode: wp.int32,
    output: wp.int32,
    own: wp.ref[WarpLists],
    popped: wp.int32,
    pair: wp.int32,
    trees: Trees,
    pose: PairPose,
    found: FoundHits,
):
    """Test straddling pairs, one a lane; return whether this lane's meets, and whether it is uncertain.

    With a gap pairs straddle that no plane parts by more than that, and those that are apart are listed.
    """
    lane, hits = warp_lane(), found.hits
    own.straddling -= popped
    at = own.straddling + wp.min(lane, popped - 1)
    item = read_item(own.items, STRADDLING_START + at)
    signs = read_signs(own.items, at)
    meet = intersect_straddling_faces(mode, trees, pose, item_first(item), item_second(item), signs)
    row = wp.vec3i(pair, item_first(item), item_second(item))
    if mode == GAP:
        append_row(meet == 0 and lane < popped, row, hits.apart_total, hits.apart)
    meet = wp.where(lane < popped, meet, 0)
    warp_sync()
    meets = meet == 1
    if output == OUTPUT_FACES:
        slot = reserve_slot(hits.total, meets)
        if meets:
            report_hit(slot, pair, pose.swapped, row[1], row[2], hits)
    if meets:
        hits.any_hit[pair] = 1
    append_row(meet == UNCERTAIN, row, hits.uncertain_total, hits.uncertain)
    return meets, meet == UNCERTAIN
