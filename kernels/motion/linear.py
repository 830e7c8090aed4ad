"""Motions whose vertices move straight, from a posed mesh to the same mesh posed elsewhere: nothing bends.

In A's first frame A's point a lies at a + t (way_a a + shift_a), and B's point b at R0 b + x0 + t (way_b b + shift_b):
affine in both, so an image of a box at a time, and one of the speeds of its points, are boxes as in `base.boxes`.
They are compared along the axes of A's first frame and the columns of R0, which rest. A gap g between corners that
grows at a rate s stays open until g + s h = 0; of faces it is taken for each of nine pairs of corners. Roundings as in
`path`; in float32 both boxes have an image now, each as wide as the margin there says.
"""

from typing import Any

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, StatePool, Trees
from warp_abtree.kernels.base.nodes import Node, load_node
from warp_abtree.kernels.base.poses import ROUNDING_32, SCALE_MAX, PairPose, reach_box
from warp_abtree.kernels.motion.face_pair import (
    AXIS_COUNT,
    CLEAR,
    STALLED,
    STEPS_MAX,
    TOUCHES,
    FirstContact,
    PairProgress,
    axis_of,
    load_face,
    map_corners,
    separating_direction,
    step_along,
    time_after,
)
from warp_abtree.kernels.motion.node_pair import MovingBox, emit_later, longest_step, move_box
from warp_abtree.kernels.motion.path import BEND_LEAST
from warp_abtree.kernels.motion.stalled import plain_row, posed_row, resolve_in_double_words, words_type
from warp_abtree.kernels.search.item import load_node_pairs
from warp_abtree.kernels.triangle.distance import POSE_ROUNDING, corners_type, largest_coordinate, power_below
from warp_abtree.kernels.triangle.float64_filter import float64_filter_triangles

wp.set_module_options(native.options("exact/apart_until.cuh", "exact/determinant.cuh"))

# 9 u^2 and some, that posed corners err by of the magnitudes that they are sums of.
POSED_WORDS = wp.constant(wp.float64(2.0**-102))


@wp.struct
class LinearMotion:
    """Linear motion of the points of A and B in A's first frame, with bounds over all of it."""

    first: wp.mat33d  # R0
    offset: wp.vec3d  # x0
    way_a: wp.mat33d  # what the way of A's points has of their coordinates
    shift_a: wp.vec3d  # and what not
    way_b: wp.mat33d  # of B's points
    shift_b: wp.vec3d  # and what not
    centre_a: wp.vec3d  # of A's model
    centre_b: wp.vec3d  # of B's model
    slack: wp.float64  # that gaps between faces err by [model units]
    scale: wp.float64  # power of two that boxes are scaled by
    margin: wp.float32  # that boxes are widened by, scaled
    speed_margin: wp.float32  # that their speeds are, scaled
    objects: wp.vec2i  # A and B


@wp.struct
class Image:
    """Boxes, or speeds of their points, along three axes: matrix x + shift, of A without one."""

    a: wp.mat33  # of A's boxes about its centre
    b: wp.mat33  # of B's
    shift: wp.vec3  # of B's centre from A's


@wp.func
def start_linear_motion(ends: ObjectPool, trees: Trees, pair: wp.vec2i) -> LinearMotion:
    """Return the motion of objects a < b, but for its bounds."""
    a, b = pair[0], pair[1]
    home = wp.transpose(trees.objects.rotation[a])
    motion = LinearMotion()
    motion.objects = pair
    motion.first = home * trees.objects.rotation[b]
    motion.offset = home * (trees.objects.position[b] - trees.objects.position[a])
    motion.way_a = home * ends.rotation[a] - home * trees.objects.rotation[a]
    motion.shift_a = home * (ends.position[a] - trees.objects.position[a])
    motion.way_b = home * ends.rotation[b] - motion.first
    motion.shift_b = home * (ends.position[b] - trees.objects.position[b])
    motion.centre_a = trees.models.centre[trees.states.model[trees.objects.state[a]]]
    motion.centre_b = trees.models.centre[trees.states.model[trees.objects.state[b]]]
    return motion


@wp.func
def bound_linear_motion(before: LinearMotion, states: StatePool, pose: PairPose, skew: wp.float64) -> LinearMotion:
    """Return a motion with its bounds, of rotations off by `path.pair_skew`."""
    motion = before
    root_a = load_node(states, pose.node_a + 1)
    root_b = load_node(states, pose.node_b + 1)
    reach_a, reach_b = reach_box(root_a.lower, root_a.upper), reach_box(root_b.lower, root_b.upper)
    two = wp.float64(2.0)
    away = largest_coordinate(motion.centre_a) + largest_coordinate(motion.centre_b)
    travel = largest_coordinate(motion.shift_a) + largest_coordinate(motion.shift_b)
    sizes = ((reach_a + reach_b) + away) + (largest_coordinate(motion.offset) + travel)
    motion.slack = (two * POSE_ROUNDING + wp.float64(6.0) * skew) * sizes
    far = two * (largest_coordinate(motion.offset) + travel) + two * away
    most = wp.max(wp.max(reach_a, reach_b), far)
    motion.scale = wp.min(wp.float64(1.0) / power_below(most), SCALE_MAX)
    margin = motion.slack + two * ROUNDING_32 * ((reach_a + reach_b) + far)
    motion.margin = wp.float32(margin * motion.scale)
    # Ways differ from no matrix by more than 2 in any entry: speeds err by what coordinates do, twice.
    motion.speed_margin = wp.float32(two * margin * motion.scale)
    return motion


@wp.func
def compare(a: MovingBox, b: MovingBox, before: wp.vec2) -> wp.vec2:
    """Return the longest step and the widest gap along three axes, and of those found before."""
    between, reach = b.at.posed_sum - a.at.posed_sum, a.at.posed_size + b.at.posed_size
    return longest_step(between, reach, b.speed - a.speed, a.spread + b.spread, wp.float32(BEND_LEAST), before)


@wp.func
def image_of(a: wp.mat33d, b: wp.mat33d, shift: wp.vec3d, scale: wp.float64) -> Image:
    image = Image()
    image.a = wp.mat33(a)
    image.b = wp.mat33(b)
    image.shift = wp.vec3(shift * scale)
    return image


@wp.func
def steps_along(
    motion: LinearMotion, at: Image, way: Image, a0: Node, a1: Node, b0: Node, b1: Node, s: wp.vec4, g: wp.vec4
):
    """Return the longest steps and widest gaps of four pairs of boxes along three axes, and of those before."""
    o = wp.vec3()
    x0, x1 = move_box(a0, motion, at.a, o, way.a, o), move_box(a1, motion, at.a, o, way.a, o)
    y0 = move_box(b0, motion, at.b, at.shift, way.b, way.shift)
    y1 = move_box(b1, motion, at.b, at.shift, way.b, way.shift)
    p00, p01 = compare(x0, y0, wp.vec2(s[0], g[0])), compare(x0, y1, wp.vec2(s[1], g[1]))
    p10, p11 = compare(x1, y0, wp.vec2(s[2], g[2])), compare(x1, y1, wp.vec2(s[3], g[3]))
    return wp.vec4(p00[0], p01[0], p10[0], p11[0]), wp.vec4(p00[1], p01[1], p10[1], p11[1])


@wp.func
def advance_linear_children(
    states: StatePool,
    pose: PairPose,
    motion: LinearMotion,
    t: wp.float32,
    best: wp.float64,
    item: wp.int64,
    live: wp.int32,
):
    """Expand an item from time t on, as `node_pair.advance_children`."""
    pairs = load_node_pairs(states, pose, item, live)
    a0, a1, b0, b1 = pairs.a0, pairs.a1, pairs.b0, pairs.b1
    time = wp.float64(t)
    p = wp.identity(n=3, dtype=wp.float64) + time * motion.way_a
    q = motion.first + time * motion.way_b
    speed = (motion.way_b * motion.centre_b + motion.shift_b) - (motion.way_a * motion.centre_a + motion.shift_a)
    shift = ((motion.first * motion.centre_b + motion.offset) - motion.centre_a) + time * speed
    back = wp.transpose(motion.first)
    s, g = steps_along(
        motion,
        image_of(p, q, shift, motion.scale),
        image_of(motion.way_a, motion.way_b, speed, motion.scale),
        a0, a1, b0, b1, wp.vec4(), wp.vec4(),
    )  # fmt: skip
    s, g = steps_along(
        motion,
        image_of(back * p, back * q, back * shift, motion.scale),
        image_of(back * motion.way_a, back * motion.way_b, back * speed, motion.scale),
        a0, a1, b0, b1, s, g,
    )  # fmt: skip
    return emit_later(pairs, wp.float32(motion.scale), g, t, s, best)


@wp.func
def straight_step(
    slack: wp.float64, n: wp.vec3d, a: corners_type, b: corners_type, way_a: corners_type, way_b: corners_type
):
    """Return a time for which corners certainly stay apart along a unit n, from A's to B's; motions err by slack."""
    step = wp.float64(wp.inf)
    for j in range(3):
        place, speed = wp.dot(n, a[j]) + slack, wp.dot(n, way_a[j]) + slack
        for k in range(3):
            step = wp.min(step, step_along(wp.dot(n, b[k]) - place, wp.dot(n, way_b[k]) - speed, wp.float64(0.0)))
    return step


@wp.func
def advance_straight(
    tolerance: wp.float64,
    slack: wp.float64,
    a: corners_type,
    b: corners_type,
    way_a: corners_type,
    way_b: corners_type,
    start: wp.float64,
    best: wp.float64,
):
    """Advance two faces whose corners move straight to first contact, or STALLED, as `face_pair.advance_pair`."""
    contact = FirstContact()
    t, steps = wp.float64(start), wp.int32(0)
    while steps < STEPS_MAX:
        steps += 1
        x, y = a + t * way_a, b + t * way_b
        n = separating_direction(x, y)
        step = straight_step(slack, n, x, y, way_a, way_b)
        contact.time = t
        contact.end = STALLED
        then = time_after(t, step)
        if then <= t:
            k = wp.int32(0)
            while k < AXIS_COUNT:
                n = axis_of(x, y, k)
                step = wp.max(step, straight_step(slack, n, x, y, way_a, way_b))
                step = wp.max(step, straight_step(slack, -n, x, y, way_a, way_b))
                k += 1
            then = time_after(t, step)
        if then <= t:
            return contact
        # At the end itself faces may be as near as coordinates err, and meet where those are rounded.
        soon = t + tolerance
        if step < tolerance and soon < wp.float64(1.0):
            p, q = a + soon * way_a, b + soon * way_b
            if float64_filter_triangles(p[0], p[1], p[2], q[0], q[1], q[2]) == 1:
                contact.end = TOUCHES
                return contact
        if then > best:
            contact.end = CLEAR
            return contact
        t = then
    return contact


@wp.func
def posed_corners(
    rotation: wp.array(dtype=wp.mat33d),
    position: wp.array(dtype=wp.vec3d),
    pair: wp.vec2i,
    a: corners_type,
    b: corners_type,
):
    """Return corners of A's face and of B's in the world, and what magnitudes they are sums of."""
    corners = words_type()
    size = wp.float64(0.0)
    for k in range(3):
        corners[k] = posed_row(rotation[pair[0]], position[pair[0]], a[k])
        corners[3 + k] = posed_row(rotation[pair[1]], position[pair[1]], b[k])
        size = wp.max(size, wp.max(largest_coordinate(a[k]), largest_coordinate(b[k])))
    away = wp.max(largest_coordinate(position[pair[0]]), largest_coordinate(position[pair[1]]))
    return corners, wp.float64(4.0) * size + away


@wp.func(inline=False)
def resolve_in_world(
    rotation: wp.array(dtype=wp.mat33d),
    position: wp.array(dtype=wp.vec3d),
    end_rotation: wp.array(dtype=wp.mat33d),
    end_position: wp.array(dtype=wp.vec3d),
    pair: wp.vec2i,
    a: corners_type,
    b: corners_type,
    start: wp.float64,
    best: wp.float64,
):
    """Return the `FirstContact` of faces of models, see `stalled`."""
    starts, first = posed_corners(rotation, position, pair, a, b)
    ends, last = posed_corners(end_rotation, end_position, pair, a, b)
    return resolve_in_double_words(starts, ends, POSED_WORDS * wp.max(first, last), start, best)


@wp.func
def advance_linear_pair(trees: Trees, given: Any, p: wp.int32, faces: wp.vec2i, before: PairProgress, best: wp.float64):
    """Advance a face of A and one of B to the end, as `face_pair.advance_pair`; steps are not counted."""
    pose, motion = given.batch.poses[p], given.motion[p]
    a = load_face(trees, pose.corner_a + faces[0])
    b = load_face(trees, pose.corner_b + faces[1])
    way_a = map_corners(motion.way_a, motion.shift_a, a)
    way_b = map_corners(motion.way_b, motion.shift_b, b)
    at_b = map_corners(motion.first, motion.offset, b)
    contact = advance_straight(given.tolerance, motion.slack, a, at_b, way_a, way_b, before.time, best)
    if contact.end == STALLED:
        objects, ends = trees.objects, given.ends
        contact = resolve_in_world(
            objects.rotation,
            objects.position,
            ends.rotation,
            ends.position,
            motion.objects,
            a,
            b,
            contact.time,
            best,
        )
    return contact, wp.int32(0)


@wp.kernel
def advance_corners_kernel(
    tolerance: wp.float64,
    rounding: wp.float64,
    starts: wp.array2d(dtype=wp.vec3d),
    ends: wp.array2d(dtype=wp.vec3d),
    contact_out: wp.array(dtype=FirstContact),
):
    """Find first contacts of faces whose corners, A's and then B's, move straight, a pair a thread."""
    i = wp.tid()
    a = wp.matrix_from_rows(starts[i, 0], starts[i, 1], starts[i, 2])
    b = wp.matrix_from_rows(starts[i, 3], starts[i, 4], starts[i, 5])
    c = wp.matrix_from_rows(ends[i, 0], ends[i, 1], ends[i, 2])
    d = wp.matrix_from_rows(ends[i, 3], ends[i, 4], ends[i, 5])
    size = wp.float64(0.0)
    for k in range(6):
        size = wp.max(size, wp.max(largest_coordinate(starts[i, k]), largest_coordinate(ends[i, k])))
    zero, one = wp.float64(0.0), wp.float64(1.0)
    contact = advance_straight(tolerance, rounding * size, a, b, c - a, d - b, zero, one)
    if contact.end == STALLED:
        first, last = words_type(), words_type()
        for k in range(6):
            first[k] = plain_row(starts[i, k])
            last[k] = plain_row(ends[i, k])
        contact = resolve_in_double_words(first, last, zero, contact.time, one)
    if contact.end == CLEAR:
        contact.time = one
    contact_out[i] = contact
