"""Paths of objects, and the motion of B in A's frame: place, speed, and bounds of acceleration.

An object's anchor, a point of its model frame, moves on a straight line at constant speed, and the object turns about
it at constant angular velocity: x_world(t) = R E(t) (x - anchor) + start + t travel, E(t) the turn by t angle about an
axis of the model frame, t from 0 to 1. The anchor is the frame's origin, or for screws a point of the screw's axis.

With R0 = Ra^T Rb and d(t) = d0 + t d1 the way from A's anchor to B's in A's first frame, and w the angular velocities
in the model frames, B's point b lies in A's frame at R b + x, where it moves with K b + v:

    R = Ea^T R0 Eb               x = anchor_a + Ea^T d - R anchor_b
    K = R [wb] - [wa] R          v = Ea^T d1 - wa x (Ea^T d) - K anchor_b

1. Acceleration. With b' = b - anchor_b, its distance p from B's axis and y = R0 Eb b' + d, in A's frame
   x'' = Ea^T y'' - 2 wa x (Ea^T y') + wa x (wa x Ea^T y), and y' = R0 Eb (wb x b') + d1, so with |wa| = A, |wb| = B

       |x''| <= (B^2 + 2 A B) p + 2 A |d1|' + A^2 |y|'

   where ' is a distance from A's axis; the same of A's points in B's frame with the names exchanged. Where B does not
   turn, y moves straight and |y|' is largest at an end and a corner of B's box; else |y|' <= |b'| + |d|.
2. So along a unit n that is fixed in A's frame a point that is g over a plane at t is still over it at t + h if
   g + h s - M h^2 / 2 > 0, s = n . (K b + v) and M the bound of 1 (docs/exactness.md, bound 19). `step_of`
   takes the root.
3. Rounding. E errs by 20 u in each entry, u = 2^-53, R by 70 u; axes times angles by 8 u, which moves points by 16 u
   of their distance from the anchor. With S = |a'| + |b'| + |d| + |anchors| points in A's frame err by under 2^-45 S,
   and velocities by 2^-45 (S (A + B) + |d1|), but for what axes of slow turns are off: under 2^-45 S in unit time,
   for which slacks have room. What rotations are off orthonormal counts 6 k S: k the largest entry of |Ra^T Ra - I|,
   as Ra^T takes A's points to A's first frame, and that of |R0^T R0 - I|, as R^T takes them to B's.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool, StatePool, Trees
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import ROUNDING_32, SCALE_MAX, PairPose, measure_rotation, reach_box, sum_products
from warp_abtree.kernels.motion.turn import shortest_turn, turn_matrix
from warp_abtree.kernels.triangle.distance import POSE_ROUNDING, largest_coordinate, power_below

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# That bounds of accelerations grow by: their own rounding, and rotations that are not quite orthonormal.
GROW = wp.constant(wp.float64(1.0 + 2.0**-16))
# Sine of half a turn below which a screw's axis is too far away: the frame's origin moves straight then.
SCREW_LEAST = wp.constant(wp.float64(2.0**-20))
# What has no acceleration is given one, so that nothing is divided by 0.
BEND_LEAST = wp.constant(wp.float64(2.0**-80))


@wp.struct
class Path:
    """Path of an object."""

    axis: wp.vec3d  # of its turn, unit, model frame
    angle: wp.float64  # of its turn, 0 to pi; -1 where there is no shortest turn
    anchor: wp.vec3d  # the point that moves straight [model units]
    start: wp.vec3d  # where that is at first [world units]
    travel: wp.vec3d  # its way [world units]


@wp.struct
class Motion:
    """Motion of B in A's frame, with bounds over all of it."""

    first: wp.mat33d  # R0
    d0: wp.vec3d  # from A's anchor to B's, in A's first frame
    d1: wp.vec3d  # how that changes
    anchor_a: wp.vec3d  # [model units]
    anchor_b: wp.vec3d  # [model units]
    axis_a: wp.vec3d  # unit
    axis_b: wp.vec3d  # unit
    centre_a: wp.vec3d  # of A's model
    centre_b: wp.vec3d  # of B's model
    angle_a: wp.float64  # of A's turn; negative where A or B has no shortest turn
    angle_b: wp.float64  # of B's turn
    bend_size: wp.float64  # accelerations in the base's frame: so much of a point's distance from the mover's axis
    bend_rest: wp.float64  # and so much
    slack: wp.float64  # that gaps err by [model units]
    speed_slack: wp.float64  # that speeds err by
    scale: wp.float64  # power of two that boxes are scaled by
    bend_a: wp.float32  # bound of the accelerations of A's points in B's frame, scaled, twice
    bend_b: wp.float32  # of B's points in A's frame
    margin: wp.float32  # that boxes are widened by, scaled
    speed_margin: wp.float32  # that their speeds are, scaled
    base: wp.int32  # in whose frame faces are compared: 0 A's, 1 B's, in which they bend less


@wp.struct
class Moment:
    """Pose and velocity of B in A's frame at a time: x = rotation b + shift, x' = spin b + speed."""

    rotation: wp.mat33d  # R
    shift: wp.vec3d  # of points in the model frames
    spin: wp.mat33d  # K
    speed: wp.vec3d  # of points in the model frames


@wp.func
def place_motion(motion: Motion, t: wp.float64):
    """Return the `Moment` at a time."""
    d = motion.d0 + t * motion.d1
    r = motion.first
    travel = motion.d1
    moment = Moment()
    if motion.angle_b > wp.float64(0.0):
        r = r * turn_matrix(motion.axis_b, t * motion.angle_b)
    if motion.angle_a > wp.float64(0.0):
        back = wp.transpose(turn_matrix(motion.axis_a, t * motion.angle_a))
        r = back * r
        d = back * d
        travel = back * travel
    turn_a = motion.angle_a * motion.axis_a
    # R [wb] and [wa] R by rows, without the products with 0.
    turn_b = motion.angle_b * motion.axis_b
    k = wp.matrix_from_rows(
        wp.cross(r[0], turn_b) - (turn_a[1] * r[2] - turn_a[2] * r[1]),
        wp.cross(r[1], turn_b) - (turn_a[2] * r[0] - turn_a[0] * r[2]),
        wp.cross(r[2], turn_b) - (turn_a[0] * r[1] - turn_a[1] * r[0]),
    )
    moment.rotation = r
    moment.shift = (motion.anchor_a + d) - r * motion.anchor_b
    moment.spin = k
    moment.speed = (travel - wp.cross(turn_a, d)) - k * motion.anchor_b
    return moment


@wp.func
def reverse_moment(m: Moment):
    """Return the pose of A in B's frame, and its velocity."""
    back = Moment()
    back.rotation = wp.transpose(m.rotation)
    back.shift = -(back.rotation * m.shift)
    back.spin = wp.transpose(m.spin)
    back.speed = -(back.spin * m.shift + back.rotation * m.speed)
    return back


@wp.func
def across(axis: wp.vec3d, p: wp.vec3d):
    """Return the distance of a point from an axis through the origin."""
    return wp.length(p - wp.dot(p, axis) * axis)


@wp.func
def corner_of(lower: wp.vec3d, upper: wp.vec3d, k: wp.int32):
    return wp.vec3d(
        wp.where((k & 1) != 0, upper[0], lower[0]),
        wp.where((k & 2) != 0, upper[1], lower[1]),
        wp.where((k & 4) != 0, upper[2], lower[2]),
    )


@wp.func
def bend_of(
    lower: wp.vec3d,
    upper: wp.vec3d,
    r: wp.mat33d,
    own_axis: wp.vec3d,
    own: wp.float64,
    other_axis: wp.vec3d,
    other: wp.float64,
    d0: wp.vec3d,
    d1: wp.vec3d,
):
    """Return bounds of 1. for the points of a box about its anchor in the other's frame, to which r and d take them.

    Returns the factor of a point's distance from its own axis, the rest, and the whole for the farthest point.
    """
    far, most = wp.float64(0.0), wp.float64(0.0)
    d = wp.max(wp.length(d0), wp.length(d0 + d1))
    for k in range(8):
        p = corner_of(lower, upper, k)
        most = wp.max(most, across(own_axis, p))
        if own > wp.float64(0.0):
            far = wp.max(far, wp.length(p) + d)
        else:
            y = r * p + d0
            far = wp.max(far, wp.max(across(other_axis, y), across(other_axis, y + d1)))
    size = (own * own + wp.float64(2.0) * own * other) * GROW
    rest = (wp.float64(2.0) * other * across(other_axis, d1) + other * other * far) * GROW
    return size, rest, size * most + rest


@wp.func
def start_motion(paths: wp.array(dtype=Path), trees: Trees, pair: wp.vec2i):
    """Return the `Motion` of objects a < b; its base, bounds and margins are those of `bound_motion`."""
    a, b = pair[0], pair[1]
    ra, rb = trees.objects.rotation[a], trees.objects.rotation[b]
    of_a, of_b = paths[a], paths[b]
    shift, travel = of_b.start - of_a.start, of_b.travel - of_a.travel
    motion = Motion()
    for i in range(3):
        motion.d0[i] = sum_products(ra[0, i], shift[0], ra[1, i], shift[1], ra[2, i], shift[2])
        motion.d1[i] = sum_products(ra[0, i], travel[0], ra[1, i], travel[1], ra[2, i], travel[2])
        for j in range(3):
            motion.first[i, j] = sum_products(ra[0, i], rb[0, j], ra[1, i], rb[1, j], ra[2, i], rb[2, j])
    motion.anchor_a = of_a.anchor
    motion.anchor_b = of_b.anchor
    motion.axis_a = of_a.axis
    motion.axis_b = of_b.axis
    motion.angle_a = of_a.angle
    motion.angle_b = of_b.angle
    if motion.angle_b < wp.float64(0.0):
        motion.angle_a = motion.angle_b
    motion.centre_a = trees.models.centre[trees.states.model[trees.objects.state[a]]]
    motion.centre_b = trees.models.centre[trees.states.model[trees.objects.state[b]]]
    return motion


@wp.func
def pair_skew(objects: ObjectPool, a: wp.int32, first: wp.mat33d):
    """Return the errors of orthonormality of the rotations of A, and of B in its frame."""
    own, _ = measure_rotation(objects.rotation[a])
    skew, _ = measure_rotation(first)
    return own + skew


@wp.func
def bound_motion(before: Motion, states: StatePool, pose: PairPose, skew: wp.float64):
    """Return a motion with its bounds, of rotations off by `pair_skew`."""
    motion = before
    root_a = load_node(states, pose.node_a + 1)
    root_b = load_node(states, pose.node_b + 1)
    away_a, away_b = motion.centre_a - motion.anchor_a, motion.centre_b - motion.anchor_b
    low_a, high_a = wp.vec3d(root_a.lower) + away_a, wp.vec3d(root_a.upper) + away_a
    low_b, high_b = wp.vec3d(root_b.lower) + away_b, wp.vec3d(root_b.upper) + away_b
    back = wp.transpose(motion.first)
    turn_a, turn_b = motion.angle_a, motion.angle_b
    size_b, rest_b, bend_b = bend_of(
        low_b, high_b, motion.first, motion.axis_b, turn_b, motion.axis_a, turn_a, motion.d0, motion.d1
    )
    size_a, rest_a, bend_a = bend_of(
        low_a, high_a, back, motion.axis_a, turn_a, motion.axis_b, turn_b, -(back * motion.d0), -(back * motion.d1)
    )
    motion.base = wp.where(bend_b <= bend_a, 0, 1)
    motion.bend_size = wp.where(bend_b <= bend_a, size_b, size_a)
    motion.bend_rest = wp.where(bend_b <= bend_a, rest_b, rest_a)
    reach_a, reach_b = reach_box(root_a.lower, root_a.upper), reach_box(root_b.lower, root_b.upper)
    way = wp.max(largest_coordinate(motion.d0), largest_coordinate(motion.d0 + motion.d1))
    anchors = largest_coordinate(motion.anchor_a) + largest_coordinate(motion.anchor_b)
    away = largest_coordinate(away_a) + largest_coordinate(away_b)
    sizes = ((reach_a + reach_b) + away) + (way + anchors)
    turn, travel = turn_a + turn_b, largest_coordinate(motion.d1)
    six, two = wp.float64(6.0), wp.float64(2.0)
    motion.slack = (two * POSE_ROUNDING + six * skew) * sizes
    speed = turn * sizes + travel
    motion.speed_slack = (two * POSE_ROUNDING + six * skew) * speed
    # As `distance.frame.make_scale`, but for the whole way: centres are at most so far apart, and move so fast.
    far = two * (way + away)
    most = wp.max(wp.max(reach_a, reach_b), wp.max(far, travel))
    scale = wp.min(wp.float64(1.0) / power_below(most), SCALE_MAX)
    margin = motion.slack + ROUNDING_32 * ((reach_a + reach_b) + far)
    speed_margin = motion.speed_slack + two * ROUNDING_32 * (turn * ((reach_a + reach_b) + far) + two * travel)
    motion.scale = scale
    motion.margin = wp.float32(margin * scale)
    motion.speed_margin = wp.float32(speed_margin * scale)
    motion.bend_a = wp.float32(two * bend_a * scale * GROW + BEND_LEAST)
    motion.bend_b = wp.float32(two * bend_b * scale * GROW + BEND_LEAST)
    return motion


@wp.func
def make_path(screw: bool, objects: ObjectPool, ends: ObjectPool, i: wp.int32) -> Path:
    """Return an object's path from its pose to that of `ends`, as a screw if asked."""
    r = objects.rotation[i]
    axis, angle, half = shortest_turn(wp.transpose(r) * ends.rotation[i])
    travel = ends.position[i] - objects.position[i]
    anchor = wp.vec3d()
    if screw and half[0] > SCREW_LEAST and angle > wp.float64(0.0):
        k = r * axis
        along = wp.dot(travel, k) * k
        side = travel - along
        anchor = wp.float64(0.5) * (side + (half[1] / half[0]) * wp.cross(k, side))
        travel = along
    path = Path()
    path.axis = axis
    path.angle = angle
    path.anchor = wp.transpose(r) * anchor
    path.start = objects.position[i] + anchor
    path.travel = travel
    return path


@wp.kernel
def prepare_path_kernel(screw: bool, objects: ObjectPool, ends: ObjectPool, paths_out: wp.array(dtype=Path)):
    """Prepare an object's path a thread."""
    i = wp.tid()
    paths_out[i] = make_path(screw, objects, ends, i)
