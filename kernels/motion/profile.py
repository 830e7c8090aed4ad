"""Whether nested objects stay apart on a screw, as a nut about its bolt: profiles of one, and each face of the other.

As in `screw`, cylinder coordinates r, a, z about the axis, and k = v / w. With h = 2 pi k a point's r and, as a turns
round, the rest of u = z / h - a / (2 pi) do not change. So objects do not meet while at each u, modulo 1, all radii of
one are over all of the other's: one pass over the faces of A finds between which radii they are in each of `CELLS`
cells of u, and one pass over those of B compares. Faces that the other's heights do not reach all the way are left out.

1. Of a face, D is the longest edge seen along the axis, r the least radius of its corners and q its distance from the
   axis. For p = sum l_i p_i, with sum l_i = 1, sum l_i |p_i - p|^2 = sum l_i l_j |p_i - p_j|^2 <= D^2 / 3, and so
   |p|^2 = sum l_i |p_i|^2 - sum l_i |p_i - p|^2 >= r^2 - D^2 / 3. Where r > 2.5 D, q > 2.43 D and q > 0.972 r. Where it
   is not, any u is taken, and q is computed.
2. What is linear between the corners differs from a function whose second derivatives are at most M by at most
   M D^2 / 6, for the same reason. M is 1 / q for r, which is convex, and 1 / q^2 for a. So over the triangle of its
   corners' r and u, with x = (D / r)^2 < 0.16, r is at most D^2 / (6 q) < (1 + x / 5) D^2 / (6 r) lower, and a off by
   D^2 / (6 q^2) < (1 + 0.36 x) x / 6.
3. The first corner's angle is a polynomial that errs by less than 2^-16, and the others' from there t - t^3 / 3 +
   t^5 / 5 for the tangent t < 1.05 D / q, so this errs by t^7 / 7 < 0.016 x^2: with (1 + x / 2) x / 6 there is room.
4. Points off the screw by e have r and z off by e, a by asin(e / q) <= 1.1 e / r, where r > 2.5 (D + e). Half of e is
   for rounding (`screw`).
5. The triangle lies in a strip between two parallel lines: along its edge of the widest u, through the corners that are
   farthest out and in. In a cell, widened by what u is off, radii are between the lines, and between those of corners.
   Bounds are kept in float32: `SINGLE` of a radius is over half a unit there.
"""

import math

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, StatePool
from warp_abtree.kernels.base.lanes import warp_any, warp_lane, warp_size, warp_sync
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import NO_NODE, PairPose
from warp_abtree.kernels.motion.face_pair import load_corners
from warp_abtree.kernels.motion.path import Motion
from warp_abtree.kernels.motion.screw import ASIN_SLOPE, ScrewFrame, reach_sides, screw_frame
from warp_abtree.kernels.search.nearest_stack import fold_bound, read_bound, write_bound

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CELLS = wp.constant(64)
CELL, CELLS_A_TURN = wp.constant(wp.float64(1.0 / 64.0)), wp.constant(wp.float64(64.0))
# Lengths are under so many times what a revolution rises by: faces along the axis are in so many times `CELLS` cells.
LENGTH_MAX = wp.constant(wp.float64(64.0))
# Centres of boxes are so near the axis, of the least of their half widths.
NEAR_AXIS = wp.constant(wp.float64(0.125))
REVOLUTION, HALF = wp.constant(wp.float64(2.0 * math.pi)), wp.constant(wp.float64(0.5))
QUARTER, PER_RADIAN = wp.constant(wp.float64(0.5 * math.pi)), wp.constant(wp.float64(0.5 / math.pi))
NARROW, SIXTH = wp.constant(wp.float64(2.5)), wp.constant(wp.float64(1.0 / 6.0))
THIRD, FIFTH = wp.constant(wp.float64(1.0 / 3.0)), wp.constant(wp.float64(0.2))
# Abramowitz and Stegun 4.4.47: factors of x, x^3 ... x^9 of the arc tangent of x from 0 to 1, and what it errs by.
ARC_TANGENT = wp.constant(wp.types.vector(5, wp.float64)(0.999866, -0.3302995, 0.180141, -0.085133, 0.0208351))
ANGLE_ERROR, SINGLE = wp.constant(wp.float64(2.0**-16)), wp.constant(wp.float64(2.0**-23))


@wp.struct
class AxisFrame:
    """One object's points about the axis, in its own frame."""

    away: wp.vec3d  # from a point of the axis to the object's origin
    axis: wp.vec3d  # unit
    first: wp.vec3d  # unit, square to it
    second: wp.vec3d  # axis x first
    per_rise: wp.float64  # 1 / h, signed
    off: wp.float64  # that points are off the screw, and rounding
    lower: wp.float64  # heights that the other object reaches
    upper: wp.float64  # the same


@wp.struct
class FaceImage:
    """In which cells a face is, and between which radii: those of a strip, cut off at the least and the greatest."""

    first: wp.int32  # cell, before they are taken modulo `CELLS`
    last: wp.int32  # the same
    start: wp.float64  # radius of a line where the first cell begins
    step: wp.float64  # that this rises by in a cell
    above: wp.float64  # that radii of a cell are over the line where the cell begins, at most
    below: wp.float64  # that they are under it
    least: wp.float64  # radius of any point
    most: wp.float64  # the same
    reached: bool  # by the other's heights


@wp.func
def flat_point(frame: AxisFrame, p: wp.vec3d):
    """Return where a point is seen along the axis."""
    return wp.vec2d(wp.dot(frame.first, p), wp.dot(frame.second, p))


@wp.func
def edge_distance(p: wp.vec2d, q: wp.vec2d):
    """Return the distance of an edge from the axis, seen along it."""
    zero, one = wp.float64(0.0), wp.float64(1.0)
    ex, ey = q[0] - p[0], q[1] - p[1]
    square = ex * ex + ey * ey
    t = wp.where(square > zero, wp.clamp(-(p[0] * ex + p[1] * ey) / square, zero, one), zero)
    x, y = p[0] + t * ex, p[1] + t * ey
    return wp.sqrt(x * x + y * y)


@wp.func
def cross_flat(p: wp.vec2d, q: wp.vec2d):
    return p[0] * q[1] - p[1] * q[0]


@wp.func
def axis_distance(p: wp.vec2d, q: wp.vec2d, s: wp.vec2d):
    """Return the distance of a face from the axis, 0 where that goes through it."""
    zero = wp.float64(0.0)
    c0, c1, c2 = cross_flat(p, q), cross_flat(q, s), cross_flat(s, p)
    inside = (c0 >= zero and c1 >= zero and c2 >= zero) or (c0 <= zero and c1 <= zero and c2 <= zero)
    distance = wp.min(wp.min(edge_distance(p, q), edge_distance(q, s)), edge_distance(s, p))
    return wp.where(inside, zero, distance)


@wp.func
def flat_radius(p: wp.vec2d):
    return wp.sqrt(p[0] * p[0] + p[1] * p[1])


@wp.func
def flat_square(p: wp.vec2d, q: wp.vec2d):
    x, y = q[0] - p[0], q[1] - p[1]
    return x * x + y * y


@wp.func
def least_of(a: wp.float64, b: wp.float64, c: wp.float64):
    least = wp.where(b < a, b, a)
    return wp.where(c < least, c, least)


@wp.func
def most_of(a: wp.float64, b: wp.float64, c: wp.float64):
    return -least_of(-a, -b, -c)


@wp.func
def angle_near(x: wp.float64, y: wp.float64):
    """Return the angle of a point from -pi to pi, within `ANGLE_ERROR`."""
    zero, along, across = wp.float64(0.0), wp.abs(x), wp.abs(y)
    steep = across > along
    t = wp.where(steep, along, across) / wp.where(steep, across, along)
    square, a = t * t, ARC_TANGENT[4]
    for k in range(1, 5):
        a = ARC_TANGENT[4 - k] + square * a
    a = t * a
    a = wp.where(steep, QUARTER - a, a)
    a = wp.where(x < zero, HALF * REVOLUTION - a, a)
    return wp.where(y < zero, -a, a)


@wp.func
def turn_near(p: wp.vec2d, q: wp.vec2d):
    """Return the angle from one corner to another of the same face, see 3."""
    x = cross_flat(p, q) / (p[0] * q[0] + p[1] * q[1])
    y = x * x
    return x * (wp.float64(1.0) - y * (THIRD - y * FIFTH))


@wp.func
def lay_strip(image: FaceImage, r: wp.vec3d, u: wp.vec3d, sag: wp.float64, wide: wp.float64, off: wp.float64):
    """Return the image of a face whose corners have these r and u, see 5.

    Args:
        sag: That radii are less than of the triangle of the corners, at most.
        wide: That u is off.
        off: That radii are off.
    """
    zero = wp.float64(0.0)
    u1, u2, r1, r2 = u[1] - u[0], u[2] - u[0], r[1] - r[0], r[2] - r[0]
    farther = wp.abs(u2) > wp.abs(u1)
    way, gain = wp.where(farther, u2, u1), wp.where(farther, r2, r1)
    farther = wp.abs(u2 - u1) > wp.abs(way)
    way, gain = wp.where(farther, u2 - u1, way), wp.where(farther, r2 - r1, gain)
    slope = wp.where(wp.abs(way) > CELL, gain / way, zero)
    e1, e2 = r1 - slope * u1, r2 - slope * u2
    low, high = u[0] + least_of(zero, u1, u2) - wide, u[0] + most_of(zero, u1, u2) + wide
    image.first = wp.int32(wp.floor(low * CELLS_A_TURN))
    image.last = wp.int32(wp.floor(high * CELLS_A_TURN))
    image.start = r[0] + slope * (wp.float64(image.first) * CELL - u[0])
    image.step = slope * CELL
    rest = wp.abs(slope) * wide + off + SINGLE * image.most
    image.above = most_of(zero, e1, e2) + rest + wp.where(slope > zero, image.step, zero)
    image.below = sag + rest - least_of(zero, e1, e2) - wp.where(slope < zero, image.step, zero)
    return image


@wp.func
def image_face(models: ModelPool, states: StatePool, frame: AxisFrame, at: wp.int32):
    """Return the `FaceImage` of a face; one that is not active is not reached."""
    image = FaceImage()
    if states.face_corner[at][0] < 0:
        return image
    corners = load_corners(models, states, at)
    a, b, c = corners[0] + frame.away, corners[1] + frame.away, corners[2] + frame.away
    z = wp.vec3d(wp.dot(frame.axis, a), wp.dot(frame.axis, b), wp.dot(frame.axis, c))
    image.reached = most_of(z[0], z[1], z[2]) >= frame.lower and least_of(z[0], z[1], z[2]) <= frame.upper
    if not image.reached:
        return image
    p, q, s = flat_point(frame, a), flat_point(frame, b), flat_point(frame, c)
    r = wp.vec3d(flat_radius(p), flat_radius(q), flat_radius(s))
    zero, one, off = wp.float64(0.0), wp.float64(1.0), frame.off
    square = most_of(flat_square(p, q), flat_square(q, s), flat_square(s, p))
    least = least_of(r[0], r[1], r[2])
    image.most = (most_of(r[0], r[1], r[2]) + off) * (one + SINGLE)
    room = least - NARROW * off
    if room <= zero or room * room <= NARROW * NARROW * square:
        image.last = CELLS - 1
        image.start = image.most
        image.below = image.most
        image.least = wp.max((axis_distance(p, q, s) - off) * (one - SINGLE), zero)
        return image
    near = one / least
    sag = SIXTH * (one + HALF * square * near * near) * square * near
    image.least = wp.max((least - sag - off) * (one - SINGLE), zero)
    wide = ((sag + ASIN_SLOPE * off) * near + ANGLE_ERROR) * PER_RADIAN + off * wp.abs(frame.per_rise)
    angle = angle_near(p[0], p[1])
    turned = wp.vec3d(angle, angle + turn_near(p, q), angle + turn_near(p, s))
    return lay_strip(image, r, frame.per_rise * z - PER_RADIAN * turned, sag, wide, off)


@wp.func
def radii_of(image: FaceImage, cell: wp.int32):
    """Return between which radii a face is in a cell from `first` to `last`."""
    line = image.start + wp.float64(cell - image.first) * image.step
    low, high = line - image.below, line + image.above
    return wp.vec2d(wp.where(low > image.least, low, image.least), wp.where(high < image.most, high, image.most))


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
        cell = image.first
        while image.reached and cell <= image.last:
            radii = radii_of(image, cell)
            at = cell & (CELLS - 1)
            fold_bound(items, at, wp.float32(radii[1]), True)
            fold_bound(items, CELLS + at, wp.float32(radii[0]), False)
            cell += 1
        face += warp_size()
    warp_sync()


@wp.func
def clears_profile(items: wp.uint64, image: FaceImage):
    """Return whether a face is over all radii of the profile in its cells, and whether it is under."""
    over, under = bool(True), bool(True)
    cell = image.first
    while cell <= image.last:
        radii = radii_of(image, cell)
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
                is_over, is_under = clears_profile(items, image)
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
    frame.away = screw.away_a - motion.centre_a
    frame.axis = screw.axis_a
    x = wp.where(wp.abs(frame.axis[0]) < HALF, wp.float64(1.0), wp.float64(0.0))
    frame.first = wp.normalize(wp.cross(frame.axis, wp.vec3d(x, wp.float64(1.0) - x, wp.float64(0.0))))
    frame.second = wp.cross(frame.axis, frame.first)
    # What turns seen from the other, B or A, turns that way: A's points rise against B's.
    rise = wp.where(screw.a_turns, -screw.rise, screw.rise) / screw.turn * REVOLUTION
    frame.per_rise = wp.float64(1.0) / rise
    frame.off = screw.off
    reach = wp.abs(screw.rise) + frame.off
    frame.lower = b[0] - reach
    frame.upper = b[1] + reach
    return frame


@wp.func
def frame_of_b(motion: Motion, screw: ScrewFrame, of_a: AxisFrame, a: wp.vec2d):
    """Return the same of B; A's root box has heights a."""
    frame, back = of_a, wp.transpose(motion.first)
    frame.away = screw.away_b - motion.centre_b
    frame.axis = back * of_a.axis
    frame.first = back * of_a.first
    frame.second = back * of_a.second
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
