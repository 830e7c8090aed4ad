"""Conservative advancement of two moving boxes, and the expansion of a node pair.

Items are those of `search.item`, each with a time up to which its boxes are proved apart. At that time boxes
are compared along the axes of both frames, as in `base.boxes`; along each the gap g, the least speed s at which it
grows and the bound M of accelerations (`path`) give a time to which it stays open, and the latest counts. All numbers
but times are twice what they say, and scaled.

An axis of A's frame is fixed there, and B's points move: their speeds along it are those of a box whose coordinates are
K b + v, as their coordinates are R b + x. So one function poses boxes and speeds, and float32 errs in speeds as it does
in coordinates, by 9 u of the sizes added up; twice that is allowed for. The root is a sum, products and quotients of
numbers that are not negative, so it errs by 8 u of itself, and `LATER` takes off 16 u.
"""

from typing import Any

import warp as wp

from warp_abtree.kernels.base.arrays import StatePool
from warp_abtree.kernels.base.boxes import PosedBox, pose_box
from warp_abtree.kernels.base.nodes import Node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.motion.path import Moment, Motion, place_motion
from warp_abtree.kernels.search.item import (
    DROPPED,
    FACES,
    NODES,
    Emitted,
    NodePairs,
    count_used,
    four_items,
    item_of,
    load_node_pairs,
    pack_item,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LATER, SUM_DOWN = wp.constant(wp.float32(1.0 - 2.0**-20)), wp.constant(wp.float32(1.0 - 2.0**-22))
# Boxes farther apart than so much of the larger one are compared again at the later time; else their children are.
AGAIN = wp.constant(wp.float32(0.5))


@wp.struct
class BoxMotion:
    """A `Moment` for boxes: float32, about the models' centres, scaled."""

    rotation: wp.mat33  # of B in A's frame
    shift: wp.vec3  # of B to A
    back: wp.vec3  # of A to B
    spin: wp.mat33  # speeds of B's points in A's frame; the transpose of A's in B's
    speed: wp.vec3  # the same, of B's centre
    back_speed: wp.vec3  # of A's centre


@wp.struct
class MovingBox:
    """A box in its own frame, in the other's, and the speeds of its points there."""

    at: PosedBox  # in both frames
    speed: wp.vec3  # twice that of its centre, other frame
    spread: wp.vec3  # twice what speeds of its points differ from that


@wp.func
def box_motion(motion: Motion, m: Moment):
    """Return a moment for boxes."""
    r, k = m.rotation, m.spin
    shift = (r * motion.centre_b + m.shift) - motion.centre_a
    speed = k * motion.centre_b + m.speed
    back = wp.transpose(r)
    boxes = BoxMotion()
    boxes.rotation = wp.mat33(r)
    boxes.spin = wp.mat33(k)
    boxes.shift = wp.vec3(shift * motion.scale)
    boxes.back = wp.vec3(-(back * shift) * motion.scale)
    boxes.speed = wp.vec3(speed * motion.scale)
    boxes.back_speed = wp.vec3(-(wp.transpose(k) * shift + back * speed) * motion.scale)
    return boxes


@wp.func
def move_box(node: Node, motion: Any, rotation: wp.mat33, shift: wp.vec3, spin: wp.mat33, speed: wp.vec3):
    """Return a node's box in motion, from its pose and the speeds of its points about the models' centres."""
    s = wp.float32(motion.scale)
    lower, upper = node.lower * s, node.upper * s
    moved = pose_box(lower, upper, spin, speed, motion.speed_margin)
    box = MovingBox()
    box.at = pose_box(lower, upper, rotation, shift, motion.margin)
    box.speed = moved.posed_sum
    box.spread = moved.posed_size
    return box


@wp.func
def step_of(gap: wp.float32, rate: wp.float32, bend: wp.float32):
    """Return a time for which a gap stays open under a rate and a deceleration of at most bend; 0 without a gap."""
    zero, two = wp.float32(0.0), wp.float32(2.0)
    root = wp.sqrt(rate * rate + two * bend * gap)
    above = wp.where(rate > zero, rate + root, two * gap)
    below = wp.where(rate > zero, bend, root - rate)
    return wp.where(gap > zero, above / below, zero)


@wp.func
def longest_step(
    between: wp.vec3, reach: wp.vec3, speed: wp.vec3, spread: wp.vec3, bend: wp.float32, best: wp.vec2
) -> wp.vec2:
    """Return the longest step and the widest gap along three axes, and of those found before."""
    step, widest = best[0], best[1]
    for i in range(3):
        gap = wp.abs(between[i]) - reach[i]
        rate = wp.where(between[i] > wp.float32(0.0), speed[i], -speed[i]) - spread[i]
        step = wp.max(step, step_of(gap, rate, bend))
        widest = wp.max(widest, gap)
    return wp.vec2(step, widest)


@wp.func
def step_boxes(a: MovingBox, b: MovingBox, motion: Motion):
    """Return a time for which two boxes stay apart, 0 if they may overlap, and the widest gap between them."""
    first = longest_step(
        b.at.posed_sum - a.at.sum, b.at.posed_size + a.at.size, b.speed, b.spread, motion.bend_b, wp.vec2()
    )
    return longest_step(a.at.posed_sum - b.at.sum, a.at.posed_size + b.at.size, a.speed, a.spread, motion.bend_a, first)


@wp.func
def later(t: wp.float32, step: wp.float32):
    """Return the time at the end of a step, rounded down; t where the step is lost to rounding."""
    return wp.max(t, (t + step * LATER) * SUM_DOWN)


@wp.func
def go_on(
    used: wp.int32,
    a: Node,
    b: Node,
    scale: wp.float32,
    gap: wp.float32,
    t: wp.float32,
    then: wp.float32,
    best: wp.float64,
):
    """Return the item that two nodes apart from t to a later time emit, and its kind.

    Themselves again where they are far apart at t and there is a later time, else as `item_of`.
    """
    size = wp.max(wp.max(a.upper - a.lower), wp.max(b.upper - b.lower)) * scale
    again = gap > AGAIN * size and then > t
    kind = wp.where((a.face | b.face) >= 0 and not again, FACES, NODES)
    kind = wp.where(used < 0 and wp.float64(then) <= best, kind, DROPPED)
    return wp.where(again, pack_item(a.skip, b.skip), item_of(a, b)), kind


@wp.func
def emit_later(pairs: NodePairs, scale: wp.float32, gaps: wp.vec4, t: wp.float32, steps: wp.vec4, best: wp.float64):
    """Return what the pairs of nodes emit that stay apart for steps from t on; times after `best` are dropped."""
    a0, a1, b0, b1, used = pairs.a0, pairs.a1, pairs.b0, pairs.b1, pairs.used
    times = wp.vec4(later(t, steps[0]), later(t, steps[1]), later(t, steps[2]), later(t, steps[3]))
    i00, k00 = go_on(used[0], a0, b0, scale, gaps[0], t, times[0], best)
    i01, k01 = go_on(used[1], a0, b1, scale, gaps[1], t, times[1], best)
    i10, k10 = go_on(used[2], a1, b0, scale, gaps[2], t, times[2], best)
    i11, k11 = go_on(used[3], a1, b1, scale, gaps[3], t, times[3], best)
    emitted = Emitted()
    emitted.items = four_items(i00, i01, i10, i11)
    emitted.kinds = wp.vec4i(k00, k01, k10, k11)
    emitted.bounds = times
    emitted.tests = count_used(used)
    return emitted


@wp.func
def advance_children(
    states: StatePool,
    pose: PairPose,
    motion: Motion,
    t: wp.float32,
    best: wp.float64,
    item: wp.int64,
    live: wp.int32,
):
    """Expand an item from time t on, as `load_node_pairs` and `emit_later`."""
    boxes = box_motion(motion, place_motion(motion, wp.float64(t)))
    pairs = load_node_pairs(states, pose, item, live)
    home, spin = wp.transpose(boxes.rotation), wp.transpose(boxes.spin)
    box_a0 = move_box(pairs.a0, motion, home, boxes.back, spin, boxes.back_speed)
    box_a1 = move_box(pairs.a1, motion, home, boxes.back, spin, boxes.back_speed)
    box_b0 = move_box(pairs.b0, motion, boxes.rotation, boxes.shift, boxes.spin, boxes.speed)
    box_b1 = move_box(pairs.b1, motion, boxes.rotation, boxes.shift, boxes.spin, boxes.speed)
    s00, s01 = step_boxes(box_a0, box_b0, motion), step_boxes(box_a0, box_b1, motion)
    s10, s11 = step_boxes(box_a1, box_b0, motion), step_boxes(box_a1, box_b1, motion)
    steps, gaps = wp.vec4(s00[0], s01[0], s10[0], s11[0]), wp.vec4(s00[1], s01[1], s10[1], s11[1])
    return emit_later(pairs, wp.float32(motion.scale), gaps, t, steps, best)
