"""When two faces first touch: safe steps along the direction in which they are nearest, then a proof that they meet.

The faces of the base (`path.Motion.base`) rest, those of the mover move, and gaps are compared along n, fixed in the
base's frame. ANY n proves what `path` says; the best joins the nearest points. A pair ends

* clear, at a time after the best so far;
* at t, where the next step is shorter than the tolerance and the faces intersect at t + tolerance, of which float64 is
  certain; or where no step is left along n, nor along any axis of the separating axis theorem: gaps there are no more
  than what coordinates err by (`Motion.slack`);
* undecided, at t, after `STEPS_MAX` steps.

Gaps and speeds err by `slack` and `speed_slack`, which also cover the dot products' roundings, 8 u of the sizes. The
root's is covered by `EARLIER`, 2^-40 of the step, and that of the time after it by `TIME_DOWN`.
"""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, StatePool, load_vertex
from warp_abtree.kernels.distance.triangle_pair import (
    CORNERS_OF_A,
    CORNERS_OF_B,
    between_features,
    cross_exactly,
    nearest_features,
    scale_triangles,
)
from warp_abtree.kernels.motion.path import Moment, Motion, across, place_motion, reverse_moment
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.triangle.distance import corners_type
from warp_abtree.kernels.triangle.float64_filter import float64_filter_triangles

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

STEPS_MAX, AXIS_COUNT = wp.constant(256), wp.constant(17)
EARLIER = wp.constant(wp.float64(1.0 - 2.0**-40))
# A step along a normal that is as long needs no better direction, which costs ten times as much.
LONG_STEP = wp.constant(wp.float64(2.0**-5))
TIME_DOWN = wp.constant(wp.float64(1.0 - 2.0**-50))
# How a pair of faces ended.
CLEAR, TOUCHES, UNDECIDED = wp.constant(0), wp.constant(1), wp.constant(2)
# Of faces whose corners move straight: to be gone on with in double words.
STALLED = wp.constant(3)


@wp.struct
class Contact:
    """How a pair of faces ended, and when."""

    end: wp.int32  # CLEAR, TOUCHES or UNDECIDED
    time: wp.float64  # up to which they are proved apart


@wp.func
def load_corners(models: ModelPool, states: StatePool, at: wp.int32) -> corners_type:
    c = states.face_corner[at]
    return wp.matrix_from_rows(
        load_vertex(models.vertex_pos, c[0]),
        load_vertex(models.vertex_pos, c[1]),
        load_vertex(models.vertex_pos, c[2]),
    )


@wp.func
def mover_moment(motion: Motion, t: wp.float64):
    """Return where the mover is in the base's frame."""
    m = place_motion(motion, t)
    if motion.base != 0:
        m = reverse_moment(m)
    return m


@wp.func
def map_corners(r: wp.mat33d, shift: wp.vec3d, corners: corners_type) -> corners_type:
    return wp.matrix_from_rows(r * corners[0] + shift, r * corners[1] + shift, r * corners[2] + shift)


@wp.func
def edge_of(m: corners_type, k: wp.int32):
    """Return the start and the direction of edge k."""
    start = wp.where(k == 0, m[0], wp.where(k == 1, m[1], m[2]))
    return start, wp.where(k == 0, m[1], wp.where(k == 1, m[2], m[0])) - start


@wp.func
def level(v: wp.vec3d, e: wp.vec3d):
    """Return v without what it has along e."""
    square = wp.dot(e, e)
    return v - wp.where(square > wp.float64(0.0), wp.dot(v, e) / square, wp.float64(0.0)) * e


@wp.func
def separating_direction(base: corners_type, at: corners_type):
    """Return the unit vector along which faces are nearest, from the base's to the mover's.

    Where they are near, what joins the nearest points is short and its direction rounded; the normal of the features
    that they lie inside is not.
    """
    t = scale_triangles(base[0], base[1], base[2], at[0], at[1], at[2])
    near = nearest_features(t)
    v = between_features(t, near)
    zero, one = wp.float64(0.0), wp.float64(1.0)
    n, way, e, f = v, v, v, v
    a = wp.matrix_from_rows(wp.vec3d(), t.a1, t.a2)
    b = wp.matrix_from_rows(t.b0, t.b1, t.b2)
    crosses = bool(True)
    if near.kind < CORNERS_OF_B:
        p, along_a = edge_of(a, near.kind / 3)
        q, along_b = edge_of(b, near.kind % 3)
        inside_a, inside_b = near.x > zero and near.x < one, near.y > zero and near.y < one
        n = wp.where(inside_a, level(v, along_a), wp.where(inside_b, level(v, along_b), v))
        crosses = inside_a and inside_b
        way, e, f = q - p, along_a, along_b
    elif near.kind < CORNERS_OF_A:
        way, _ = edge_of(b, near.kind - CORNERS_OF_B)
        _, e = edge_of(a, 0)
        _, f = edge_of(a, 1)
    else:
        corner, _ = edge_of(a, near.kind - CORNERS_OF_A)
        start, e = edge_of(b, 0)
        _, f = edge_of(b, 1)
        way = start - corner
    normal = cross_exactly(e, f)
    # Its direction errs by rounding over the height of what e and f span, that of v by rounding over the distance.
    if crosses and wp.dot(normal, normal) > near.square * wp.max(wp.dot(e, e), wp.dot(f, f)):
        n = wp.where(wp.dot(normal, way) < zero, -normal, normal)
    return wp.normalize(n)


@wp.func
def axis_of(base: corners_type, at: corners_type, k: wp.int32):
    """Return the k-th unit vector of the separating axis theorem.

    Cross products of two edges; then for either face what is level and square to an edge, and the normal.
    """
    if k < 9:
        _, e = edge_of(base, k / 3)
        _, f = edge_of(at, k % 3)
        return wp.normalize(cross_exactly(e, f))
    face = wp.where(k < 13, base, at)
    _, e = edge_of(face, 0)
    _, f = edge_of(face, 1)
    n = wp.normalize(cross_exactly(e, f))
    i = (k - 9) & 3
    if i < 3:
        _, edge = edge_of(face, i)
        n = wp.normalize(cross_exactly(n, edge))
    return n


@wp.func
def step_along(gap: wp.float64, rate: wp.float64, bend: wp.float64):
    """Return how long a gap stays open for certain, as `node_pair.step_of`; infinite where it does for ever."""
    zero, two = wp.float64(0.0), wp.float64(2.0)
    if gap <= zero or not (gap > zero):
        return zero
    root = wp.sqrt(rate * rate + two * bend * gap)
    if rate > zero:
        return wp.where(bend > zero, (rate + root) / wp.where(bend > zero, bend, two) * EARLIER, wp.float64(wp.inf))
    return wp.where(root > rate, two * gap / wp.where(root > rate, root - rate, two) * EARLIER, wp.float64(wp.inf))


@wp.func
def time_after(t: wp.float64, step: wp.float64):
    """Return the time that a step leads to, rounded down."""
    return (t + step) * TIME_DOWN


@wp.func
def safe_step(motion: Motion, n: wp.vec3d, base: corners_type, m: Moment, mover: corners_type, at: corners_type):
    """Return how long faces stay apart for certain along a unit vector n, from the base's to the mover's.

    Args:
        mover: The mover's corners in its own frame.
        at: The same in the base's frame.
    """
    top = wp.max(wp.max(wp.dot(n, base[0]), wp.dot(n, base[1])), wp.dot(n, base[2])) + motion.slack
    anchor = wp.where(motion.base == 0, motion.anchor_b, motion.anchor_a)
    axis = wp.where(motion.base == 0, motion.axis_b, motion.axis_a)
    step = wp.float64(wp.inf)
    for k in range(3):
        rate = wp.dot(n, m.spin * mover[k] + m.speed) - motion.speed_slack
        bend = motion.bend_size * across(axis, mover[k] - anchor) + motion.bend_rest
        step = wp.min(step, step_along(wp.dot(n, at[k]) - top, rate, bend))
    return step


@wp.func
def longest_step(
    motion: Motion, tried: wp.float64, base: corners_type, m: Moment, mover: corners_type, at: corners_type
):
    """Return the longest step along any axis, and the one tried before.

    What joins points that are very near errs in its direction, so that long edges seem to reach across it.
    """
    step = tried
    k = wp.int32(0)
    while k < AXIS_COUNT:
        n = axis_of(base, at, k)
        step = wp.max(step, safe_step(motion, n, base, m, mover, at))
        step = wp.max(step, safe_step(motion, -n, base, m, mover, at))
        k += 1
    return step


@wp.func
def plane_step(motion: Motion, base: corners_type, m: Moment, mover: corners_type, at: corners_type):
    """Return the longer of the steps along both normals, each towards the other face's first corner."""
    n = wp.normalize(wp.cross(base[1] - base[0], base[2] - base[0]))
    n = wp.where(wp.dot(n, at[0] - base[0]) < wp.float64(0.0), -n, n)
    step = safe_step(motion, n, base, m, mover, at)
    n = wp.normalize(wp.cross(at[1] - at[0], at[2] - at[0]))
    n = wp.where(wp.dot(n, at[0] - base[0]) < wp.float64(0.0), -n, n)
    return wp.max(step, safe_step(motion, n, base, m, mover, at))


@wp.func
def meet_at(motion: Motion, t: wp.float64, base: corners_type, mover: corners_type):
    """Return whether faces intersect at a time, as float64 is certain of the coordinates that it computes."""
    m = mover_moment(motion, t)
    at = map_corners(m.rotation, m.shift, mover)
    return float64_filter_triangles(base[0], base[1], base[2], at[0], at[1], at[2]) == 1


@wp.func
def advance_faces(
    tolerance: wp.float64, motion: Motion, base: corners_type, mover: corners_type, start: wp.float64, best: wp.float64
):
    """Return when two faces that are apart until a start first touch, if not after the best time so far."""
    contact = Contact()
    t = start
    steps = wp.int32(0)
    while steps < STEPS_MAX:
        steps += 1
        m = mover_moment(motion, t)
        at = map_corners(m.rotation, m.shift, mover)
        step = plane_step(motion, base, m, mover, at)
        # A pair may end here for the best time so far, if it would go on after it whatever that is.
        if step >= tolerance and time_after(t, step) > best:
            contact.end = CLEAR
            return contact
        if step < LONG_STEP:
            n = separating_direction(base, at)
            step = wp.max(step, safe_step(motion, n, base, m, mover, at))
        contact.time = t
        contact.end = UNDECIDED
        then = time_after(t, step)
        if then <= t:
            step = longest_step(motion, step, base, m, mover, at)
            then = time_after(t, step)
        if then <= t:
            contact.end = TOUCHES
            return contact
        if step < tolerance:
            if meet_at(motion, wp.min(t + tolerance, wp.float64(1.0)), base, mover):
                contact.end = TOUCHES
                return contact
        if then > best:
            contact.end = CLEAR
            return contact
        t = then
    return contact


@wp.func
def advance_pair(
    tolerance: wp.float64,
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    motion: Motion,
    face_a: wp.int32,
    face_b: wp.int32,
    start: wp.float64,
    best: wp.float64,
):
    """Return the `Contact` of a face of A and one of B."""
    a = load_corners(models, states, pose.corner_a + face_a)
    b = load_corners(models, states, pose.corner_b + face_b)
    if motion.base != 0:
        return advance_faces(tolerance, motion, b, a, start, best)
    return advance_faces(tolerance, motion, a, b, start, best)
