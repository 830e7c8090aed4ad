"""Whether nested objects stay apart on a screw, as a nut about its bolt: profiles of one, and each face of the other.

As in `screw`, cylinder coordinates r, a, z about the axis, and k = v / w. With h = 2 pi k a point's r and, as a turns
round, the rest of u = z / h - a / (2 pi) do not change. So objects do not meet while at each u, modulo 1, all radii of
one are over all of the other's: one pass over the faces of A finds between which radii they are in each of `CELLS`
cells of u, and one pass over those of B compares. Faces that the other's heights do not reach all the way are left out.

1. Of a face, D is the longest edge seen along the axis, and q its distance from that. Where q < 3 D, any u is taken.
2. What is linear between the corners differs from a function whose second derivatives are at most M by at most
   M D^2 / 6: for x = sum l_i p_i, sum l_i |p_i - x|^2 = sum l_i l_j |p_i - p_j|^2 <= D^2 / 3. M is 1 / q for r, which
   is convex, and 1 / q^2 for a. So over the triangle of its corners' r and u, r is at most D^2 / (6 q) lower, and u off
   by D^2 / (12 pi q^2). In a cell, radii of that triangle are between those of its edges.
3. Corners' angles are that of the first, and from there x - x^3 / 3 + x^5 / 5 for the tangent x. As D < q / 3, these
   are under 0.335 and x < 1.05 D / q, so this errs by x^7 / 7 < 0.001 (D / q)^2: `SIXTH` has room for it.
4. Points off the screw by e have r and z off by e, a by asin(e / q) <= 1.1 e / q. Half of e is for rounding (`screw`).
"""

import math

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.distance.search import fold_bound, read_bound, write_bound
from warp_abtree.kernels.motion.face_pair import load_corners
from warp_abtree.kernels.motion.path import Motion
from warp_abtree.kernels.motion.screw import ASIN_SLOPE, ScrewFrame, reach_sides, screw_frame, turn_between
from warp_abtree.kernels.poses import NO_NODE, PairPose
from warp_abtree.kernels.traversal.boxes import round_down, round_up
from warp_abtree.kernels.traversal.nodes import load_node
from warp_abtree.kernels.traversal.warp_stack import warp_any, warp_lane, warp_size, warp_sync

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CELLS = wp.constant(64)
CELL = wp.constant(wp.float64(1.0 / 64.0))
# Lengths are under so many times what a revolution rises by: faces along the axis are in so many times `CELLS` cells.
LENGTH_MAX = wp.constant(wp.float64(64.0))
# Centres of boxes are so near the axis, of the least of their half widths.
NEAR_AXIS = wp.constant(wp.float64(0.125))
REVOLUTION, HALF = wp.constant(wp.float64(2.0 * math.pi)), wp.constant(wp.float64(0.5))
SIXTH, THIRD, FIFTH = wp.constant(wp.float64(0.17)), wp.constant(wp.float64(1.0 / 3.0)), wp.constant(wp.float64(0.2))


@wp.struct
class AxisFrame:
    """One object's points about the axis, in the base's frame at first."""

    home: wp.mat33d  # from the object's frame
    away: wp.vec3d  # from a point of the axis to the object's origin, in the object's frame
    axis: wp.vec3d  # unit
    first: wp.vec3d  # unit, square to it
    second: wp.vec3d  # axis x first
    rise: wp.float64  # h, signed
    off: wp.float64  # that points are off the screw, and rounding
    lower: wp.float64  # heights that the other object reaches
    upper: wp.float64  # the same


@wp.struct
class FaceImage:
    """Radii and u of a face."""

    radius: wp.vec3d  # of corners
    turned: wp.vec3d  # u of corners
    least: wp.float64  # radius of any point
    sag: wp.float64  # that radii are less than of the triangle of the corners, at most
    wide: wp.float64  # that u is off
    narrow: bool  # else any u is taken
    reached: bool  # by the other's heights


@wp.func
def flat_point(frame: AxisFrame, p: wp.vec3d):
    q = frame.home * (p + frame.away)
    return wp.vec3d(wp.dot(frame.first, q), wp.dot(frame.second, q), wp.dot(frame.axis, q))


@wp.func
def edge_distance(p: wp.vec3d, q: wp.vec3d):
    """Return the distance of an edge from the axis, seen along it."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    ex, ey = q[0] - p[0], q[1] - p[1]
    square = ex * ex + ey * ey
    t = wp.where(square > zero, wp.clamp(-(p[0] * ex + p[1] * ey) / square, zero, one), zero)
    x, y = p[0] + t * ex, p[1] + t * ey
    return wp.sqrt(x * x + y * y)


@wp.func
def cross_flat(p: wp.vec3d, q: wp.vec3d):
    return p[0] * q[1] - p[1] * q[0]


@wp.func
def axis_distance(p: wp.vec3d, q: wp.vec3d, s: wp.vec3d):
    """Return the distance of a face from the axis, 0 where that goes through it."""
    zero = wp.float64(0.0)
    c0, c1, c2 = cross_flat(p, q), cross_flat(q, s), cross_flat(s, p)
    inside = (c0 >= zero and c1 >= zero and c2 >= zero) or (c0 <= zero and c1 <= zero and c2 <= zero)
    distance = wp.min(wp.min(edge_distance(p, q), edge_distance(q, s)), edge_distance(s, p))
    return wp.where(inside, zero, distance)


@wp.func
def flat_radius(p: wp.vec3d):
    return wp.sqrt(p[0] * p[0] + p[1] * p[1])


@wp.func
def flat_square(p: wp.vec3d, q: wp.vec3d):
    x, y = q[0] - p[0], q[1] - p[1]
    return x * x + y * y


@wp.func
def image_face(models: ModelPool, states: StatePool, frame: AxisFrame, at: wp.int32):
    """Return the `FaceImage` of a face; one that is not active is not reached."""
    image = FaceImage()
    if states.face_corner[at][0] < 0:
        return image
    corners = load_corners(models, states, at)
    p, q, s = flat_point(frame, corners[0]), flat_point(frame, corners[1]), flat_point(frame, corners[2])
    low, high = wp.min(wp.min(p[2], q[2]), s[2]), wp.max(wp.max(p[2], q[2]), s[2])
    image.reached = high >= frame.lower and low <= frame.upper
    if not image.reached:
        return image
    image.radius = wp.vec3d(flat_radius(p), flat_radius(q), flat_radius(s))
    square = wp.max(wp.max(flat_square(p, q), flat_square(q, s)), flat_square(s, p))
    longest = wp.sqrt(square)
    image.least = axis_distance(p, q, s)
    image.narrow = image.least > wp.float64(3.0) * (longest + frame.off)
    if not image.narrow:
        return image
    x = wp.vec2d(cross_flat(p, q) / (p[0] * q[0] + p[1] * q[1]), cross_flat(p, s) / (p[0] * s[0] + p[1] * s[1]))
    angle = turn_between(p[1] / image.radius[0], p[0] / image.radius[0])
    image.turned[0] = p[2] / frame.rise - angle / REVOLUTION
    for k in range(2):
        y = x[k] * x[k]
        turn = x[k] * (wp.float64(1.0) - y * (THIRD - y * FIFTH))
        image.turned[1 + k] = wp.where(k == 0, q[2], s[2]) / frame.rise - (angle + turn) / REVOLUTION
    image.sag = SIXTH * square / image.least
    error = (image.sag + ASIN_SLOPE * frame.off) / image.least
    image.wide = error / REVOLUTION + frame.off / wp.abs(frame.rise)
    return image


@wp.func
def radii_in_cell(r0: wp.float64, r1: wp.float64, u0: wp.float64, u1: wp.float64, cell: wp.int32, wide: wp.float64):
    """Return between which radii an edge from r0, u0 to r1, u1 is in a cell that is wider by so much."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    s, t, way = zero, one, u1 - u0
    if wp.abs(way) > CELL:
        start = wp.float64(cell) * CELL
        s = wp.clamp(((start - wide) - u0) / way, zero, one)
        t = wp.clamp(((start + (CELL + wide)) - u0) / way, zero, one)
    at_s, at_t = r0 + s * (r1 - r0), r0 + t * (r1 - r0)
    return wp.vec2d(wp.min(at_s, at_t), wp.max(at_s, at_t))


@wp.func
def cells_of(image: FaceImage, k: wp.int32):
    """Return the first and the last cell of edge k, before they are taken modulo `CELLS`."""
    u0, u1 = image.turned[k], image.turned[(k + 1) % 3]
    if not image.narrow:
        # The first edge stands for all.
        return 0, wp.where(k == 0, CELLS - 1, -1)
    low, high = wp.min(u0, u1) - image.wide, wp.max(u0, u1) + image.wide
    return wp.int32(wp.floor(low / CELL)), wp.int32(wp.floor(high / CELL))


@wp.func
def radii_of(frame: AxisFrame, image: FaceImage, k: wp.int32, cell: wp.int32):
    """Return between which radii edge k, and what of the face is about it, is in a cell."""
    radii = wp.vec2d(image.least, wp.max(image.radius))
    if image.narrow:
        n = (k + 1) % 3
        u0, u1 = image.turned[k], image.turned[n]
        radii = radii_in_cell(image.radius[k], image.radius[n], u0, u1, cell, image.wide)
        radii[0] = radii[0] - image.sag
    return wp.vec2d(wp.max(radii[0] - frame.off, wp.float64(0.0)), radii[1] + frame.off)


@wp.func
def profile_faces(
    items: wp.uint64, models: ModelPool, states: StatePool, frame: AxisFrame, start: wp.int32, count: wp.int32
):
    """Write the greatest and the least radius in each cell, of faces of A that B reaches; a face a lane."""
    cell = warp_lane()
    while cell < CELLS:
        write_bound(items, cell, 0.0)
        write_bound(items, CELLS + cell, wp.float32(wp.inf))
        cell += warp_size()
    warp_sync()
    face = warp_lane()
    while face < count:
        image = image_face(models, states, frame, start + face)
        if image.reached:
            for k in range(3):
                cell, last = cells_of(image, k)
                while cell <= last:
                    radii = radii_of(frame, image, k, cell)
                    at = cell & (CELLS - 1)
                    fold_bound(items, at, round_up(radii[1]), True)
                    fold_bound(items, CELLS + at, wp.max(round_down(radii[0]), wp.float32(0.0)), False)
                    cell += 1
        face += warp_size()
    warp_sync()


@wp.func
def clears_profile(items: wp.uint64, frame: AxisFrame, image: FaceImage):
    """Return whether a face is over all radii of the profile in its cells, and whether it is under."""
    over, under = bool(True), bool(True)
    for k in range(3):
        cell, last = cells_of(image, k)
        while cell <= last:
            radii = radii_of(frame, image, k, cell)
            at = cell & (CELLS - 1)
            over = over and radii[0] > wp.float64(read_bound(items, at))
            under = under and radii[1] < wp.float64(read_bound(items, CELLS + at))
            cell += 1
    return over, under


@wp.func
def faces_clear_profile(
    items: wp.uint64, models: ModelPool, states: StatePool, frame: AxisFrame, start: wp.int32, count: wp.int32
):
    """Return whether all faces of B that A reaches are over the profile of A, or all under."""
    over, under = bool(True), bool(True)
    first = wp.int32(0)
    while first < count:
        face = first + warp_lane()
        if face < count:
            image = image_face(models, states, frame, start + face)
            if image.reached:
                is_over, is_under = clears_profile(items, frame, image)
                over, under = over and is_over, under and is_under
        over, under = not warp_any(not over), not warp_any(not under)
        first = wp.where(over or under, first + warp_size(), count)
    return over or under


@wp.func
def box_heights(states: StatePool, node: wp.int32, away: wp.vec3d, axis: wp.vec3d):
    """Return the heights of a root box along the axis, and whether it is about it.

    Args:
        away: From a point of the axis to the centre of the model.
    """
    box = load_node(states, node)
    centre = HALF * (wp.vec3d(box.upper) + wp.vec3d(box.lower)) + away
    side = HALF * (wp.vec3d(box.upper) - wp.vec3d(box.lower))
    middle, reach = wp.dot(axis, centre), reach_sides(axis, side)
    about = wp.length(centre - middle * axis) <= NEAR_AXIS * wp.min(side)
    return wp.vec2d(middle - reach, middle + reach), about


@wp.func
def is_nested(frame: ScrewFrame, a: wp.vec2d, b: wp.vec2d):
    """Return whether profiles are worth their while: heights a and b overlap by half of either all the way."""
    rise = frame.rise / frame.turn * REVOLUTION
    length = wp.max(wp.max(wp.abs(a)), wp.max(wp.abs(b))) + wp.abs(frame.rise)
    common = wp.min(a[1], b[1]) - wp.max(a[0], b[0]) - wp.abs(frame.rise)
    half = HALF * wp.min(a[1] - a[0], b[1] - b[0])
    return common >= half and length + frame.off < LENGTH_MAX * wp.abs(rise)


@wp.func
def frame_of_a(motion: Motion, screw: ScrewFrame, b: wp.vec2d):
    """Return the `AxisFrame` of A; B's root box has heights b."""
    frame = AxisFrame()
    frame.home = wp.identity(n=3, dtype=wp.float64)
    frame.away = screw.away_a - motion.centre_a
    frame.axis = screw.axis_a
    x = wp.where(wp.abs(frame.axis[0]) < HALF, wp.float64(1.0), wp.float64(0.0))
    frame.first = wp.normalize(wp.cross(frame.axis, wp.vec3d(x, wp.float64(1.0) - x, wp.float64(0.0))))
    frame.second = wp.cross(frame.axis, frame.first)
    # What turns seen from the other, B or A, turns that way: A's points rise against B's.
    frame.rise = wp.where(screw.a_turns, -screw.rise, screw.rise) / screw.turn * REVOLUTION
    frame.off = screw.off
    reach = wp.abs(screw.rise) + frame.off
    frame.lower = b[0] - reach
    frame.upper = b[1] + reach
    return frame


@wp.func
def frame_of_b(motion: Motion, screw: ScrewFrame, of_a: AxisFrame, a: wp.vec2d):
    """Return the same of B; A's root box has heights a."""
    frame = of_a
    frame.home = motion.first
    frame.away = screw.away_b - motion.centre_b
    reach = wp.abs(screw.rise) + frame.off
    frame.lower = a[0] - reach
    frame.upper = a[1] + reach
    return frame


@wp.func
def profiles_apart(items: wp.uint64, models: ModelPool, states: StatePool, pose: PairPose, motion: Motion):
    """Return whether profiles prove the objects of a screw (`screw.is_screw`) apart for all of it."""
    if pose.floor[0] == NO_NODE:
        return False
    screw = screw_frame(motion)
    heights_a, about_a = box_heights(states, pose.node_a + 1, screw.away_a, screw.axis_a)
    heights_b, about_b = box_heights(states, pose.node_b + 1, screw.away_b, screw.axis_b)
    if not (about_a and about_b and is_nested(screw, heights_a, heights_b)):
        return False
    frame = frame_of_a(motion, screw, heights_b)
    profile_faces(items, models, states, frame, pose.corner_a, pose.faces_a)
    frame = frame_of_b(motion, screw, frame, heights_a)
    return faces_clear_profile(items, models, states, frame, pose.corner_b, pose.faces_b)
