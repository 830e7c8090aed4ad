"""Certified deviation: how far the original surface lies from the surface after every merge; one serial replay.

Every original triangle is registered with up to SLOTS active faces that cover it: it is cut into convex pieces, and every
piece lies within the running maximum E of ONE of these faces. The distance to one (convex) triangle is a convex function,
so its largest value on a piece is that of a corner. A registration stays true until its face moves or dies; then the
triangle is covered anew by its other faces and by the faces about the merge. Any partition gives a bound; a good one,
cut along the prisms over the faces, gives zero where the surface has not moved.
Source: bound by convexity; closest points after Ericson, Real-Time Collision Detection, section 5.1.5.
"""

import warp as wp

from warp_abtree.kernels.forest import Rings, absorb_ring

wp.set_module_options({"enable_backward": False})

SLOTS = wp.constant(6)
CANDIDATES = wp.constant(96)  # faces that a cover chooses from at most; fewer only loosen the bound
STACK = wp.constant(48)  # pieces that wait
CORNERS = wp.constant(16)  # of a piece
CUTS = wp.constant(24)  # covers by prism per triangle and merge at most

# counter: what the kernel carries from launch to launch
LIVE = wp.constant(0)
STAMP = wp.constant(1)

# Distances are rounded at 2^-52 of the unit extent or so; without this floor flat regions would be cut for nothing.
FLOOR = wp.constant(wp.float64(2.0**-46))
SLACK = wp.constant(wp.float64(1.05))  # a piece within so much of the best any candidate can do is not cut further


@wp.struct
class Replay:
    """What the replay knows of the surface."""

    pos: wp.array(dtype=wp.vec3d)  # [node_count], normalised
    face_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], active faces where they are now
    face_ball: wp.array(dtype=wp.vec4d)  # [face_count], centre and radius of a ball about each
    live_face: wp.array(dtype=int)  # [face_count], active faces in any order
    live_place: wp.array(dtype=int)  # [face_count], where each stands there
    slot_face: wp.array(dtype=int)  # [SLOTS face_count], face that triangle t is registered with, or -1
    slot_next: wp.array(dtype=int)  # [SLOTS face_count], doubly linked list of each face's slots
    slot_last: wp.array(dtype=int)  # [SLOTS face_count]
    face_slot: wp.array(dtype=int)  # [face_count], first slot or -1
    face_stamp: wp.array(dtype=int)  # [face_count], last merge that moved the face or made it a candidate
    triangle_stamp: wp.array(dtype=int)  # [face_count], last merge that queued the triangle
    queue: wp.array(dtype=int)  # [face_count], triangles to cover anew


@wp.struct
class Scratch:
    """Room for one cover."""

    near: wp.array(dtype=int)  # [CANDIDATES], the first ones shared by all triangles of a merge
    bound: wp.array(dtype=wp.float64)  # [CANDIDATES]
    used: wp.array(dtype=int)  # [SLOTS], faces that pieces have used
    corner: wp.array2d(dtype=wp.vec3d)  # [STACK, CORNERS]
    corners: wp.array(dtype=int)  # [STACK]
    ring: wp.array(dtype=wp.vec3d)  # [2 CORNERS], the piece in hand, and its inner part


@wp.func
def segment_distance_sq(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    ab = b - a
    size = wp.dot(ab, ab)
    t = wp.float64(0.0)
    if size > wp.float64(0.0):
        t = wp.min(wp.max(wp.dot(p - a, ab) / size, wp.float64(0.0)), wp.float64(1.0))
    return wp.length_sq(p - (a + ab * t))


@wp.func
def face_distance_sq(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the squared distance to a point of the triangle: the closest, and never less than that.

    A triangle so thin that its barycentrics are noise is measured by its edges.
    """
    zero = wp.float64(0.0)
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= zero and d2 <= zero:
        return wp.length_sq(ap)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= zero and d4 <= d3:
        return wp.length_sq(bp)
    vc = d1 * d4 - d3 * d2
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= zero and d5 <= d6:
        return wp.length_sq(cp)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    total = va + vb + vc
    if va > zero and vb > zero and vc > zero and total > wp.float64(1.0e-12) * wp.dot(ab, ab) * wp.dot(ac, ac):
        v = vb / total
        w = vc / total
        return wp.length_sq(p - (a + ab * v + ac * w))
    return wp.min(segment_distance_sq(p, a, b), wp.min(segment_distance_sq(p, b, c), segment_distance_sq(p, c, a)))


@wp.func
def active_distance_sq(replay: Replay, f: int, p: wp.vec3d):
    return face_distance_sq(p, replay.face_pos[f, 0], replay.face_pos[f, 1], replay.face_pos[f, 2])


@wp.func
def piece_distance_sq(replay: Replay, scratch: Scratch, start: int, count: int, f: int, enough: wp.float64):
    """Return the largest corner distance of a piece to face f; stop once it is above `enough`."""
    worst = wp.float64(0.0)
    i = int(0)
    while i < count and worst <= enough:
        worst = wp.max(worst, active_distance_sq(replay, f, scratch.ring[start + i]))
        i += 1
    return worst


@wp.func
def set_face(replay: Replay, corner_node: wp.array(dtype=int), f: int):
    """Take an active face's corners from the forest."""
    a = replay.pos[corner_node[3 * f]]
    b = replay.pos[corner_node[3 * f + 1]]
    c = replay.pos[corner_node[3 * f + 2]]
    replay.face_pos[f, 0] = a
    replay.face_pos[f, 1] = b
    replay.face_pos[f, 2] = c
    centre = (a + b + c) / wp.float64(3.0)
    radius = wp.sqrt(wp.max(wp.length_sq(a - centre), wp.max(wp.length_sq(b - centre), wp.length_sq(c - centre))))
    replay.face_ball[f] = wp.vec4d(centre[0], centre[1], centre[2], radius)


@wp.func
def register_slot(replay: Replay, slot: int, f: int):
    first = replay.face_slot[f]
    replay.slot_face[slot] = f
    replay.slot_next[slot] = first
    replay.slot_last[slot] = -1
    if first >= 0:
        replay.slot_last[first] = slot
    replay.face_slot[f] = slot


@wp.func
def release_slot(replay: Replay, slot: int):
    f = replay.slot_face[slot]
    if f >= 0:
        before = replay.slot_last[slot]
        after = replay.slot_next[slot]
        if before >= 0:
            replay.slot_next[before] = after
        else:
            replay.face_slot[f] = after
        if after >= 0:
            replay.slot_last[after] = before
        replay.slot_face[slot] = -1


@wp.func
def use_face(scratch: Scratch, used: int, f: int):
    """Note that a piece stands on face f; return how many faces are used, SLOTS + 1 if there is no room for f."""
    i = int(0)
    while i < used:
        if scratch.used[i] == f:
            return used
        i += 1
    if used < SLOTS:
        scratch.used[used] = f
    return used + 1
