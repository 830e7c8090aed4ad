"""Conservative advancement of two faces along the direction in which they are nearest, and proof that they meet.

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

from typing import Any

import warp as wp

from warp_abtree.kernels.base.arrays import Trees, load_vertex
from warp_abtree.kernels.motion.path import Motion, across, place_motion, reverse_moment
from warp_abtree.kernels.triangle.distance import corners_type, scale_triangles
from warp_abtree.kernels.triangle.float64_filter import float64_filter_triangles
from warp_abtree.kernels.triangle.triangle_pair import (
    CORNERS_OF_A,
    CORNERS_OF_B,
    between_features,
    cross_exactly,
    nearest_features,
)

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
# Not ended: apart until a time, and to be gone on with.
IN_PROGRESS = wp.constant(4)
# How far a pair of faces is advanced: by a step along normals if they do, by a step, or to its end.
NORMALS, ONE_STEP, TO_THE_END = wp.constant(0), wp.constant(1), wp.constant(2)


@wp.struct
class FirstContact:
    """Outcome of a face pair's advancement, and its time."""

    end: wp.int32  # CLEAR, TOUCHES or UNDECIDED; IN_PROGRESS
    time: wp.float64  # up to which they are proved apart


@wp.struct
class PairProgress:
    """Progress of a face pair's advancement."""

    time: wp.float64  # up to which they are proved apart
    steps: wp.int32  # made
    mode: wp.int32  # NORMALS, ONE_STEP or TO_THE_END, from there on


@wp.func
def load_face(trees: Trees, at: wp.int32) -> corners_type:
    c = trees.states.face_corner[at]
    return wp.matrix_from_rows(
        load_vertex(trees.models.vertex_pos, c[0]),
        load_vertex(trees.models.vertex_pos, c[1]),
        load_vertex(trees.models.vertex_pos, c[2]),
    )


@wp.func
def mover_moment(motion: Motion, t: wp.float64):
    """Return the mover's `Moment` in the base's frame."""
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
    """Return the component of v across e."""
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
    """Return the k-th axis of the separating axis theorem (SAT) for two faces, unit.

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
    """Return a time for which a gap certainly stays open, as `node_pair.step_of`; infinite where it never closes."""
    zero, two = wp.float64(0.0), wp.float64(2.0)
    if gap <= zero or not (gap > zero):
        return zero
    root = wp.sqrt(rate * rate + two * bend * gap)
    above = wp.where(rate > zero, rate + root, two * gap)
    below = wp.where(rate > zero, bend, root - rate)
    return wp.where(below > zero, above / wp.where(below > zero, below, two) * EARLIER, wp.float64(wp.inf))


@wp.func
def time_after(t: wp.float64, step: wp.float64):
    """Return the time at the end of a step, rounded down."""
    return (t + step) * TIME_DOWN


@wp.func
def bend_of_face(motion: Motion, mover: corners_type):
    """Return a bound of the accelerations of a face of the mover in the base's frame."""
    anchor = wp.where(motion.base == 0, motion.anchor_b, motion.anchor_a)
    axis = wp.where(motion.base == 0, motion.axis_b, motion.axis_a)
    away = wp.max(across(axis, mover[0] - anchor), across(axis, mover[1] - anchor))
    return motion.bend_size * wp.max(away, across(axis, mover[2] - anchor)) + motion.bend_rest


@wp.func
def safe_step(
    motion: Motion, n: wp.vec3d, base: corners_type, at: corners_type, velocity: corners_type, bend: wp.float64
):
    """Return a time for which faces certainly stay apart along a unit vector n, from the base's to the mover's.

    Args:
        at: The mover's corners in the base's frame.
        velocity: Theirs there.
        bend: A bound of their accelerations.
    """
    top = wp.max(wp.max(wp.dot(n, base[0]), wp.dot(n, base[1])), wp.dot(n, base[2])) + motion.slack
    step = wp.float64(wp.inf)
    for k in range(3):
        rate = wp.dot(n, velocity[k]) - motion.speed_slack
        step = wp.min(step, step_along(wp.dot(n, at[k]) - top, rate, bend))
    return step


@wp.func
def longest_face_step(
    motion: Motion, tried: wp.float64, base: corners_type, at: corners_type, velocity: corners_type, bend: wp.float64
):
    """Return the longest safe step along the axes of the separating axis theorem, and the one tried before.

    What joins points that are very near errs in its direction, so that long edges seem to reach across it.
    """
    step = tried
    k = wp.int32(0)
    while k < 2 * AXIS_COUNT:
        n = axis_of(base, at, k / 2)
        step = wp.max(step, safe_step(motion, wp.where((k & 1) == 0, n, -n), base, at, velocity, bend))
        k += 1
    return step


@wp.func
def plane_step(motion: Motion, base: corners_type, at: corners_type, velocity: corners_type, bend: wp.float64):
    """Return the longer of the steps along both normals, each towards the other face's first corner."""
    n = wp.normalize(wp.cross(base[1] - base[0], base[2] - base[0]))
    n = wp.where(wp.dot(n, at[0] - base[0]) < wp.float64(0.0), -n, n)
    step = safe_step(motion, n, base, at, velocity, bend)
    n = wp.normalize(wp.cross(at[1] - at[0], at[2] - at[0]))
    n = wp.where(wp.dot(n, at[0] - base[0]) < wp.float64(0.0), -n, n)
    return wp.max(step, safe_step(motion, n, base, at, velocity, bend))


@wp.func
def advance_once(
    tolerance: wp.float64,
    motion: Motion,
    base: corners_type,
    mover: corners_type,
    bend: wp.float64,
    t: wp.float64,
    best: wp.float64,
    normals: bool,
):
    """Advance two faces that are apart until t by one safe step; IN_PROGRESS from the time that it reaches.

    With normals alone it may reach no later time, where it is cheap: IN_PROGRESS from t.
    """
    m = mover_moment(motion, t)
    at = map_corners(m.rotation, m.shift, mover)
    velocity = map_corners(m.spin, m.speed, mover)
    contact = FirstContact()
    step = plane_step(motion, base, at, velocity, bend)
    # A pair may end here for the best time so far, if it would go on after it whatever that is.
    if step >= tolerance and time_after(t, step) > best:
        contact.end = CLEAR
        return contact
    contact.time = t
    if step < LONG_STEP:
        contact.end = IN_PROGRESS
        if normals:
            return contact
        n = separating_direction(base, at)
        step = wp.max(step, safe_step(motion, n, base, at, velocity, bend))
    then = time_after(t, step)
    if then <= t:
        step = longest_face_step(motion, step, base, at, velocity, bend)
        then = time_after(t, step)
    contact.end = TOUCHES
    if then <= t:
        return contact
    if step < tolerance:
        # Whether the faces certainly intersect there, by the coordinates that float64 computes.
        soon = mover_moment(motion, wp.min(t + tolerance, wp.float64(1.0)))
        p = map_corners(soon.rotation, soon.shift, mover)
        if float64_filter_triangles(base[0], base[1], base[2], p[0], p[1], p[2]) == 1:
            return contact
    contact.time = then
    contact.end = wp.where(then > best, CLEAR, IN_PROGRESS)
    return contact


@wp.func
def advance_pair(trees: Trees, given: Any, p: wp.int32, faces: wp.vec2i, before: PairProgress, best: wp.float64):
    """Advance a face of A and one of B, of an object pair, that are apart until a time.

    They go on where `before` says that a step is enough. Returns the outcome, and the steps made.

    Args:
        given: `kinds.motion_given`.
    """
    pose, motion = given.batch.poses[p], given.motion[p]
    a = load_face(trees, pose.corner_a + faces[0])
    b = load_face(trees, pose.corner_b + faces[1])
    base, mover = wp.where(motion.base == 0, a, b), wp.where(motion.base == 0, b, a)
    bend = bend_of_face(motion, mover)
    contact = FirstContact()
    t, steps = wp.float64(0.0) + before.time, wp.int32(0) + before.steps
    going = bool(True)
    while going:
        contact = advance_once(given.tolerance, motion, base, mover, bend, t, best, before.mode == NORMALS)
        going = contact.end == IN_PROGRESS and before.mode == TO_THE_END
        if contact.end == IN_PROGRESS:
            # Normals alone may lead nowhere, which is no step.
            steps += wp.where(contact.time > t, 1, 0)
            if steps == STEPS_MAX:
                contact.time = t
                contact.end = UNDECIDED
                going = False
            t = contact.time
    return contact, steps
