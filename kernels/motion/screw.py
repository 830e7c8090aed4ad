"""Whether two nodes of few faces stay apart while one object slides past the other along a screw, as a nut on its bolt.

One object turns, by w a unit time, and moves by v along the axis u of its turn, seen from the other, the base. With
k = v / w and cylinder coordinates r, a, z about that axis, r and z - k a of a point that moves do not change. So
neither does f = p r + q (z - k a), whatever p and q: nodes on which f differs do not meet, however long the motion.

1. Nodes lie in balls about the centres of their boxes. Centres at radii over twice those of the balls: two balls meet
   only at times at which their angles differ by at most c = 1.1 (b0 / r0 + b1 / r1), since asin x <= 1.1 x there. As no
   turn is longer than half a revolution and c <= 1.1, one turn of the mover about the axis alone brings centres to one
   angle within c of the times of the motion.
2. Turned so, both are near one ray. X along it, Y across it: r - X is in [0, Y^2 / (2 X)], and a - Y / R less than
   |Y / X|^3 / 3 + |Y| |R - X| / (X R). So f is p X + q Z - (q k / R) Y but for that, which the slab of a node and its
   box bound, as `slabs.overlap` says: n . x = s m . x + (n - s m) . x, m the slab's direction. p and q are those of a
   slab's direction, R the radius of the base's centre.
3. Where objects also move across the axis, by e, points are off the screw by e at most, turned about it too.
4. In float64: angles err by less than 2^-46, so f by |q k| times that, and sums by less than `Motion.slack` a unit.
"""

import math

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, StatePool
from warp_abtree.kernels.base.nodes import load_constant_node
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.motion.path import Motion
from warp_abtree.kernels.motion.turn import angle_of
from warp_abtree.kernels.search.item import INDEX_MASK
from warp_abtree.kernels.search.slab_overlap import load_slab

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

HALF, DIRECTION_UNIT = wp.constant(wp.float64(0.5)), wp.constant(wp.float64(2.0**-14))
# Of slower turns the pitch would be long.
TURN_LEAST = wp.constant(wp.float64(2.0**-10))
ASIN_SLOPE, TURN_ROUNDING = wp.constant(wp.float64(1.1)), wp.constant(wp.float64(2.0**-44))
# Scaled: where more is across the axis, few nodes are found apart.
DRIFT_MAX = wp.constant(wp.float64(2.0**-5))
PI = wp.constant(wp.float64(math.pi))


@wp.struct
class Ring:
    """The faces below a node, and where they are about the axis; lengths in model units."""

    direction: wp.vec3d  # m of their slab, of about unit length
    middle: wp.float64  # of m . x, about the point of the axis
    half: wp.float64  # of the width of the slab
    centre: wp.vec3d  # of their box, about the point of the axis
    side: wp.vec3d  # half of its widths
    axis: wp.vec3d  # u
    out: wp.vec3d  # unit vector from the axis to the centre
    across: wp.vec3d  # u x out
    radius: wp.float64  # of the centre
    ball: wp.float64  # radius of a ball about the centre


@wp.struct
class Screw:
    """How near two nodes come on a screw."""

    pitch: wp.float64  # k
    rise: wp.float64  # of the mover where both have one angle
    bend: wp.float64  # r - X, at most
    twist: wp.float64  # a - Y / R of both, at most, and what angles err by
    slack: wp.float64  # that points are off, and sums err by


@wp.func
def parent_of(half: wp.int32):
    """Return the node that half an item goes down from; children are named by the first of them."""
    return wp.where(half < 0, (half & INDEX_MASK) >> 1, half)


@wp.func
def reach_sides(n: wp.vec3d, side: wp.vec3d):
    return wp.abs(n[0]) * side[0] + wp.abs(n[1]) * side[1] + wp.abs(n[2]) * side[2]


@wp.func
def load_ring(
    models: ModelPool,
    states: StatePool,
    node_start: wp.int32,
    slab_start: wp.int32,
    node: wp.int32,
    away: wp.vec3d,
    axis: wp.vec3d,
    off: wp.float64,
):
    """Return the `Ring` of a node.

    Args:
        away: From a point of the axis to the centre of the model.
        off: That points are off.
    """
    slab = load_slab(models, slab_start + node)
    box = load_constant_node(states, node_start + node)
    ring = Ring()
    ring.direction = DIRECTION_UNIT * wp.vec3d(slab.direction)
    ring.centre = HALF * (wp.vec3d(box.upper) + wp.vec3d(box.lower)) + away
    ring.side = HALF * (wp.vec3d(box.upper) - wp.vec3d(box.lower))
    ring.middle = HALF * DIRECTION_UNIT * wp.float64(slab.sum) + wp.dot(ring.direction, away)
    ring.half = HALF * DIRECTION_UNIT * wp.float64(slab.size)
    ring.axis = axis
    radial = ring.centre - wp.dot(ring.centre, axis) * axis
    ring.radius = wp.length(radial)
    ring.out = wp.normalize(radial)
    ring.across = wp.cross(axis, ring.out)
    ring.ball = wp.length(ring.side) + off
    return ring


@wp.func
def reach_along(ring: Ring, p: wp.float64, tangent: wp.float64, q: wp.float64):
    """Return the middle of p X + tangent Y + q Z of a node's faces, and how far they reach from that."""
    n = p * ring.out + tangent * ring.across + q * ring.axis
    m = ring.direction
    part = wp.dot(n, m) / wp.dot(m, m)
    rest = n - part * m
    return part * ring.middle + wp.dot(rest, ring.centre), wp.abs(part) * ring.half + reach_sides(rest, ring.side)


@wp.func
def differs(screw: Screw, base: Ring, mover: Ring, p: wp.float64, q: wp.float64):
    """Return whether f is different on both nodes for certain."""
    tangent = -(q * screw.pitch) / base.radius
    middle, reach = reach_along(base, p, tangent, q)
    moved, moved_reach = reach_along(mover, p, tangent, q)
    size = wp.abs(p) + wp.abs(q) + wp.abs(tangent)
    error = wp.abs(p) * screw.bend + wp.abs(q * screw.pitch) * screw.twist + size * screw.slack
    return wp.abs((moved + q * screw.rise) - middle) > (reach + moved_reach) + error


@wp.func
def turn_between(s: wp.float64, c: wp.float64):
    """Return the angle from 0 to 2 pi with this sine and cosine."""
    a = HALF * angle_of(wp.abs(s), wp.abs(c))
    a = wp.where(c < wp.float64(0.0), PI - a, a)
    return wp.where(s < wp.float64(0.0), wp.float64(2.0) * PI - a, a)


@wp.func
def part_on_screw(
    base: Ring, mover: Ring, home: wp.mat33d, turn: wp.float64, rise: wp.float64, t: wp.float64, off: wp.float64
):
    """Return whether two nodes stay apart from t on, while the mover turns about the axis and rises along it.

    Args:
        home: The mover's frame to the base's.
        turn, rise: In unit time.
        off: That points are off the screw.
    """
    two = wp.float64(2.0)
    if not (base.radius > two * base.ball and mover.radius > two * mover.ball):
        return False
    width = ASIN_SLOPE * (base.ball / base.radius + mover.ball / mover.radius)
    start = home * mover.out
    angle = turn_between(wp.dot(base.axis, wp.cross(start, base.out)), wp.dot(start, base.out))
    angle = wp.where(angle > PI + width, angle - two * PI, angle)
    error = TURN_ROUNDING + off / base.radius
    if angle + width + error < t * turn or angle - width - error > turn:
        return True
    screw = Screw()
    screw.pitch = rise / turn
    screw.rise = screw.pitch * angle
    y0, y1 = reach_sides(base.across, base.side) + off, reach_sides(mover.across, mover.side) + off
    x0, x1 = reach_sides(base.out, base.side) + off, reach_sides(mover.out, mover.side) + off
    least0, least1 = base.radius - x0, mover.radius - x1
    screw.bend = wp.max(y0 * y0 / least0, y1 * y1 / least1) * HALF
    q0, q1 = y0 / least0, y1 / least1
    away = wp.abs(mover.radius - base.radius) + x1
    screw.twist = (q0 * q0 * q0 + q1 * q1 * q1) * HALF + (q0 * x0 + q1 * away) / base.radius + error
    screw.slack = off
    n, m = base.direction, mover.direction
    if differs(screw, base, mover, wp.dot(n, base.out), wp.dot(n, base.axis)):
        return True
    return differs(screw, base, mover, wp.dot(m, mover.out), wp.dot(m, mover.axis))


@wp.func
def is_screw(motion: Motion):
    """Return whether one object alone turns, and moves little across the axis of its turn."""
    turn = wp.max(motion.angle_a, motion.angle_b)
    if wp.min(motion.angle_a, motion.angle_b) != wp.float64(0.0) or turn < TURN_LEAST:
        return False
    axis = motion.first * motion.axis_b
    if motion.angle_a > wp.float64(0.0):
        axis = motion.axis_a
    return wp.length(motion.d1 - wp.dot(motion.d1, axis) * axis) * motion.scale < DRIFT_MAX


@wp.struct
class ScrewFrame:
    """The screw of a motion in the frames of both objects."""

    axis_a: wp.vec3d  # unit
    axis_b: wp.vec3d  # the same in B's frame
    away_a: wp.vec3d  # from a point of the axis to the centre of A's model at first
    away_b: wp.vec3d  # the same of B's
    turn: wp.float64  # of what turns, in unit time
    rise: wp.float64  # of B along the axis, seen from A
    off: wp.float64  # that points are off the screw, and err by
    a_turns: bool  # else B does


@wp.func
def screw_frame(motion: Motion):
    """Return the screw of a motion for which `is_screw` holds."""
    s = ScrewFrame()
    s.a_turns = motion.angle_a > wp.float64(0.0)
    s.turn = wp.max(motion.angle_a, motion.angle_b)
    back = wp.transpose(motion.first)
    s.axis_a = wp.where(s.a_turns, motion.axis_a, motion.first * motion.axis_b)
    s.axis_b = wp.where(s.a_turns, back * motion.axis_a, motion.axis_b)
    # The axis goes through the anchor of what turns; seen from the base it is where that is at first.
    away_a = motion.centre_a - motion.anchor_a
    away_b = motion.centre_b - motion.anchor_b
    s.away_a = wp.where(s.a_turns, away_a, away_a - motion.d0)
    s.away_b = wp.where(s.a_turns, away_b + back * motion.d0, away_b)
    s.rise = wp.dot(motion.d1, s.axis_a)
    s.off = wp.length(motion.d1 - s.rise * s.axis_a) + wp.float64(2.0) * motion.slack
    return s


@wp.func
def slides_apart(
    models: ModelPool, states: StatePool, pose: PairPose, motion: Motion, t: wp.float64, x: wp.int32, y: wp.int32
):
    """Return whether nodes x of A and y of B stay apart from t on for sure; one object moves nearly on a screw."""
    s = screw_frame(motion)
    a = load_ring(models, states, pose.node_a, pose.slab[0], x, s.away_a, s.axis_a, s.off)
    b = load_ring(models, states, pose.node_b, pose.slab[1], y, s.away_b, s.axis_b, s.off)
    if s.a_turns:
        return part_on_screw(b, a, wp.transpose(motion.first), s.turn, -s.rise, t, s.off)
    return part_on_screw(a, b, motion.first, s.turn, s.rise, t, s.off)
