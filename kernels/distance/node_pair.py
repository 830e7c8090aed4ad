"""Lower bounds of the distances of posed boxes, and the expansion of a node pair into up to four.

Items are those of `search.item`. Boxes are compared along the axes of both frames, as in `base.boxes`: in
each frame the six gaps between a box and the other's image bound the distance, and the larger bound counts. Bounds are
squares of twice the distance, scaled (`frame.SearchScale`). Where there are slabs, theirs count too (`slab_bound`).
"""

import warp as wp

from warp_abtree.kernels.base.arrays import StatePool
from warp_abtree.kernels.base.boxes import PosedBox, pose_box
from warp_abtree.kernels.base.nodes import Node, load_constant_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.distance.frame import SearchScale
from warp_abtree.kernels.distance.slab_bound import bound_child_slabs, square_gap
from warp_abtree.kernels.search.item import (
    DROPPED,
    FACES,
    INDEX_MASK,
    NODES,
    four_items,
    item_first,
    item_of,
    item_second,
)
from warp_abtree.kernels.search.mean_slabs import Slabs

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def bound_boxes(a: PosedBox, b: PosedBox):
    """Return a lower bound of the squared distance of two boxes, see this module."""
    return wp.max(
        square_gap(a.sum - b.posed_sum, a.size + b.posed_size), square_gap(a.posed_sum - b.sum, a.posed_size + b.size)
    )


@wp.func
def limit_of(scaling: SearchScale, terms: wp.vec4, upper: wp.float32, has_candidate: wp.bool):
    """Return the pruning bound of a search, negative where nothing can improve it.

    Args:
        terms: See `frame.tolerance_terms`; counts where there are faces at most as far as upper.
        upper: Scaled distance that the nearest faces are not beyond.
        has_candidate: Whether there are such faces.
    """
    cut = upper
    if has_candidate:
        part = wp.max(terms[1] * upper - terms[2], terms[0])
        cut = upper - wp.max(part - terms[3] * upper, 0.0)
    if cut < 0.0:
        return wp.float32(-1.0)
    x = 2.0 * (cut * scaling.grow + scaling.least)
    return x * x


@wp.func
def kind_of(used: wp.int32, a: Node, b: Node, bound: wp.float32, limit: wp.float32):
    kind = wp.where((a.face | b.face) >= 0, FACES, NODES)
    return wp.where(used < 0 and bound <= limit, kind, DROPPED)


@wp.func
def bound_child_boxes(pose: PairPose, scaling: SearchScale, a0: Node, a1: Node, b0: Node, b1: Node):
    """Return lower bounds of the squared distances of the four pairs of two nodes of A and two of B."""
    home = wp.transpose(pose.rotation32)
    s = scaling.scale
    box_a0 = pose_box(a0.lower * s, a0.upper * s, home, scaling.back, scaling.margin)
    box_a1 = pose_box(a1.lower * s, a1.upper * s, home, scaling.back, scaling.margin)
    box_b0 = pose_box(b0.lower * s, b0.upper * s, pose.rotation32, scaling.translation, scaling.margin)
    box_b1 = pose_box(b1.lower * s, b1.upper * s, pose.rotation32, scaling.translation, scaling.margin)
    return wp.vec4(
        bound_boxes(box_a0, box_b0),
        bound_boxes(box_a0, box_b1),
        bound_boxes(box_a1, box_b0),
        bound_boxes(box_a1, box_b1),
    )


@wp.func
def bound_children(
    with_slabs: wp.bool,
    states: StatePool,
    slabs: Slabs,
    pose: PairPose,
    scaling: SearchScale,
    limit: wp.float32,
    item: wp.int64,
    live: wp.int32,
):
    """Expand an item; return the items that follow, their kinds, their bounds, and how many were compared.

    live is -1, or 0 where nothing is asked of the item, which still names nodes.
    """
    x = item_first(item)
    y = item_second(item)
    at_a = pose.node_a + (x & INDEX_MASK)
    at_b = pose.node_b + (y & INDEX_MASK)
    at = wp.vec4i(at_a, at_a + wp.where(x < 0, 1, 0), at_b, at_b + wp.where(y < 0, 1, 0))
    a0, a1 = load_constant_node(states, at[0]), load_constant_node(states, at[1])
    b0, b1 = load_constant_node(states, at[2]), load_constant_node(states, at[3])
    bounds = wp.vec4()
    if with_slabs:
        bounds = bound_child_slabs(slabs, pose, scaling, at, a0, a1, b0, b1)
    else:
        bounds = bound_child_boxes(pose, scaling, a0, a1, b0, b1)
    kinds = wp.vec4i(
        kind_of(live, a0, b0, bounds[0], limit),
        kind_of(y & live, a0, b1, bounds[1], limit),
        kind_of(x & live, a1, b0, bounds[2], limit),
        kind_of(x & y & live, a1, b1, bounds[3], limit),
    )
    items = four_items(item_of(a0, b0), item_of(a0, b1), item_of(a1, b0), item_of(a1, b1))
    tests = -((live >> 31) + ((y & live) >> 31) + ((x & live) >> 31) + ((x & y & live) >> 31))
    return items, kinds, bounds, tests
