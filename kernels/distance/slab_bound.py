"""Lower bounds of the distances of two nodes by slabs and boxes together, for a lane of a warp.

Along a direction, a node reaches no farther than its slab and its box do; across it, no farther than a ball about its
box's centre: docs/exactness.md, bounds 17 and 18. The direction joins the nodes' middles, turned a little towards their
mean normals: where small nodes face each other it is the one in which they are nearest, but for an angle like their
size, so that such bounds err by the square of the size, where boxes err by the size.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.boxes import fuse32, map_point, reach_there
from warp_abtree.kernels.base.nodes import Node, load_constant
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.base.quotients import normalize32, root32
from warp_abtree.kernels.distance.frame import SearchScale
from warp_abtree.kernels.search.mean_slabs import Slabs
from warp_abtree.kernels.search.slab_overlap import add_product, take_multiple

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Margins of boxes that a bound leaves off, of twice the distance.
BOUND_MARGINS = wp.constant(wp.float32(native.constant("SLAB_MARGINS")))
# How much the sums of two nodes' normals count for the direction, beside what joins their middles; as was counted.
NORMAL_WEIGHT = wp.constant(wp.float32(0.0625))


@wp.struct
class Body:
    """A node's box and slab, scaled; twice all lengths but the size."""

    sum: wp.vec3  # twice the centre, own frame
    size: wp.vec3  # whole width, own frame
    normal: wp.vec3  # of the slab, own frame
    low: wp.float32  # least along the normal
    high: wp.float32  # greatest
    ball: wp.float32  # radius about the centre


@wp.func
def square_gap(x: wp.vec3, reach: wp.vec3):
    """Return the squared length of the excess of |x| over a reach."""
    zero = wp.float32(0.0)
    a = wp.max(wp.abs(x[0]) - reach[0], zero)
    b = wp.max(wp.abs(x[1]) - reach[1], zero)
    c = wp.max(wp.abs(x[2]) - reach[2], zero)
    return (a * a + b * b) + c * c


@wp.func
def square_over(x: wp.float32, margin: wp.float32):
    over = wp.max(x - margin, 0.0)
    return over * over


@wp.func
def load_body(slabs: Slabs, at: wp.int32, node: Node, scale: wp.float32):
    i = wp.int64(2) * wp.int64(at)
    first, second = load_constant(slabs.record, i), load_constant(slabs.record, i + wp.int64(1))
    lower, upper, twice = node.lower * scale, node.upper * scale, 2.0 * scale
    body = Body()
    body.sum = upper + lower
    body.size = upper - lower
    body.normal = wp.vec3(first[0], first[1], first[2])
    body.low = first[3] * twice
    body.high = second[0] * twice
    body.ball = second[2] * twice
    return body


@wp.func
def body_top(body: Body, n: wp.vec3):
    """Return twice an upper bound of n . x for the points x of a node, in its own frame."""
    along = add_product(n, body.normal, 0.0)
    rest = take_multiple(n, along, body.normal)
    by_slab = fuse32(
        along,
        wp.where(along > 0.0, body.high, body.low),
        add_product(rest, body.sum, add_product(wp.abs(rest), body.size, 0.0)),
    )
    return wp.min(by_slab, add_product(n, body.sum, add_product(wp.abs(n), body.size, 0.0)))


@wp.func
def direction_of(apart: wp.vec3, a: wp.vec3, b: wp.vec3):
    """Return the unit direction in which two nodes are compared, in A's frame.

    Args:
        apart: Between their middles.
        a, b: Sums of unit normals, turned either way.
    """
    c = normalize32(apart)
    c = take_multiple(take_multiple(c, -NORMAL_WEIGHT * wp.dot(a, c), a), -NORMAL_WEIGHT * wp.dot(b, c), b)
    return normalize32(c)


@wp.func
def bound_pair(n: wp.vec3, gap: wp.float32, margin: wp.float32, apart: wp.vec3, balls: wp.float32, boxes: wp.float32):
    """Return a lower bound of the square of twice the distance of two nodes.

    Args:
        gap: Twice their gap along n.
        boxes: The lower bound by boxes.
    """
    d = add_product(apart, n, 0.0)
    across = take_multiple(apart, d, n)
    beside = root32(add_product(across, across, 0.0)) - balls
    return wp.max(square_over(gap, margin) + square_over(beside, margin), boxes)


@wp.func
def bound_child_slabs(
    slabs: Slabs,
    pose: PairPose,
    scaling: SearchScale,
    at: wp.vec4i,
    node_a0: Node,
    node_a1: Node,
    node_b0: Node,
    node_b1: Node,
):
    """Return lower bounds of the squares of twice the distances of the four pairs of nodes of A and B.

    Args:
        at: Where the nodes lie in the pool.
    """
    s, rotation, margin = scaling.scale, pose.rotation32, BOUND_MARGINS * scaling.margin
    a0, a1 = load_body(slabs, at[0], node_a0, s), load_body(slabs, at[1], node_a1, s)
    b0, b1 = load_body(slabs, at[2], node_b0, s), load_body(slabs, at[3], node_b1, s)
    shift = scaling.translation + scaling.translation
    there0, there1 = map_point(rotation, shift, b0.sum), map_point(rotation, shift, b1.sum)
    normal_b = map_point(rotation, wp.vec3(), b0.normal + b1.normal)
    n = direction_of((there0 + there1) - (a0.sum + a1.sum), a0.normal + a1.normal, normal_b)
    back = -map_point(wp.transpose(rotation), wp.vec3(), n)
    far = wp.dot(shift, n)
    far0, far1 = far - body_top(b0, back), far - body_top(b1, back)
    top0, top1 = body_top(a0, n), body_top(a1, n)
    reach0, reach1 = reach_there(rotation, b0.size, scaling.margin), reach_there(rotation, b1.size, scaling.margin)
    d00, d01, d10, d11 = there0 - a0.sum, there1 - a0.sum, there0 - a1.sum, there1 - a1.sum
    return wp.vec4(
        bound_pair(n, far0 - top0, margin, d00, a0.ball + b0.ball, square_gap(d00, a0.size + reach0)),
        bound_pair(n, far1 - top0, margin, d01, a0.ball + b1.ball, square_gap(d01, a0.size + reach1)),
        bound_pair(n, far0 - top1, margin, d10, a1.ball + b0.ball, square_gap(d10, a1.size + reach0)),
        bound_pair(n, far1 - top1, margin, d11, a1.ball + b1.ball, square_gap(d11, a1.size + reach1)),
    )
