"""Lower bounds of the distances of posed boxes, and the expansion of a node pair into up to four.

Items are those of `search.item`. Boxes are compared along the axes of both frames, as in `base.boxes`: in
each frame the six gaps between a box and the other's image bound the distance, and the larger bound counts. Bounds are
squares of twice the distance, scaled (`frame.SearchScale`). Where there are slabs, theirs count too (`slab_bound`).
"""

import warp as wp

from warp_abtree.kernels.base.arrays import StatePool
from warp_abtree.kernels.base.boxes import PosedBox, pose_box
from warp_abtree.kernels.base.nodes import Node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.distance.frame import SearchScale
from warp_abtree.kernels.distance.slab_bound import bound_child_slabs, square_gap
from warp_abtree.kernels.search.item import Emitted, count_used, four_items, item_of, kind_of, load_node_pairs
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
    """Expand an item, as `load_node_pairs`; children whose bounds are over a limit are dropped."""
    pairs = load_node_pairs(states, pose, item, live)
    a0, a1, b0, b1, used = pairs.a0, pairs.a1, pairs.b0, pairs.b1, pairs.used
    emitted, bounds = Emitted(), wp.vec4()
    if with_slabs:
        bounds = bound_child_slabs(slabs, pose, scaling, pairs.at, a0, a1, b0, b1)
    else:
        bounds = bound_child_boxes(pose, scaling, a0, a1, b0, b1)
    emitted.kinds = wp.vec4i(
        kind_of(used[0], a0, b0, bounds[0] <= limit),
        kind_of(used[1], a0, b1, bounds[1] <= limit),
        kind_of(used[2], a1, b0, bounds[2] <= limit),
        kind_of(used[3], a1, b1, bounds[3] <= limit),
    )
    emitted.items = four_items(item_of(a0, b0), item_of(a0, b1), item_of(a1, b0), item_of(a1, b1))
    emitted.bounds = bounds
    emitted.tests = count_used(used)
    return emitted
