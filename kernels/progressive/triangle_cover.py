"""Cover one original triangle with active faces: it is cut into convex pieces, and each piece stands on ONE face.

The distance to one triangle is a convex function, so its largest value on a piece is that of a corner: any partition
gives a bound. A good one, cut along the prisms over the faces, gives zero where the surface has not moved.
"""

import warp as wp

from warp_abtree.kernels.progressive.polygon import (
    CORNERS,
    STACK,
    Scratch,
    face_distance_sq,
    load_piece,
    split_piece,
    store_piece,
)
from warp_abtree.kernels.progressive.vertex_forest import Rings

wp.set_module_options({"enable_backward": False})

CUTS = wp.constant(64)  # of a triangle at one merge
SLOTS = wp.constant(32)  # faces that a triangle is registered with at most

# Coordinates are within 1/2 and rounded at 2^-53: without this floor flat regions would be cut for nothing.
FLOOR = wp.constant(wp.float64(2.0**-46))
MARGIN = wp.constant(wp.float64(0.05))  # of the bound: how far a piece may reach over the edge of a prism
# A box farther away than another face, by more than rounding can hide, spares the distance to the face in it.
BOX_SLACK = wp.constant(wp.float64(1.001))
BOX_MIN = wp.constant(wp.float64(2.0**-70))
SLACK_SQ = wp.constant(wp.float64(1.1))  # a piece so near to the best that any candidates can do is not cut further


@wp.struct
class Replay:
    """What the replay knows of the surface."""

    pos: wp.array(dtype=wp.vec3d)  # [node_count], normalised
    triangle_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], original triangles
    face_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], active faces where they are now
    face_box: wp.array2d(dtype=wp.vec3d)  # [face_count, 2], lower and upper corner of the box of each
    bvh: wp.uint64  # wp.Bvh over the boxes of the faces in bvh_face; 0 until a piece vanishes
    bvh_face: wp.array(dtype=int)  # [any]
    slot_face: wp.array(dtype=int)  # [slot_count], face that the slot's triangle is registered with
    slot_triangle: wp.array(dtype=int)  # [slot_count]; slot t is triangle t's own, those after face_count are pooled
    slot_sibling: wp.array(dtype=int)  # [slot_count], next slot of the same triangle, or -1
    slot_next: wp.array(dtype=int)  # [slot_count], doubly linked list of each face's slots
    slot_last: wp.array(dtype=int)  # [slot_count]
    free_slot: wp.array(dtype=int)  # [slot_count - face_count], stack of pooled slots not in use
    face_slot: wp.array(dtype=int)  # [face_count], first slot or -1
    face_stamp: wp.array(dtype=int)  # [face_count], last candidate set that held the face
    triangle_stamp: wp.array(dtype=int)  # [face_count], last merge that queued the triangle
    queue: wp.array(dtype=int)  # [face_count], triangles to cover anew
    queue_face: wp.array(dtype=int)  # [face_count], a face that covered each: the first to try


@wp.func
def active_distance_sq(replay: Replay, f: int, p: wp.vec3d):
    return face_distance_sq(p, replay.face_pos[f, 0], replay.face_pos[f, 1], replay.face_pos[f, 2])


@wp.func
def outside(p: wp.float64, lower: wp.float64, upper: wp.float64):
    """Return how far a coordinate lies outside an interval."""
    below = lower - p
    above = p - upper
    most = wp.where(below > above, below, above)
    return wp.where(most > wp.float64(0.0), most, wp.float64(0.0))


@wp.func
def box_distance_sq(replay: Replay, f: int, p: wp.vec3d):
    """Return the squared distance to the box of face f."""
    lower = replay.face_box[f, 0]
    upper = replay.face_box[f, 1]
    x = outside(p[0], lower[0], upper[0])
    y = outside(p[1], lower[1], upper[1])
    z = outside(p[2], lower[2], upper[2])
    return x * x + y * y + z * z


@wp.func
def piece_distance_sq(replay: Replay, scratch: Scratch, count: int, f: int, enough: wp.float64):
    """Return the largest corner distance of the piece in hand to face f, or anything above `enough` once it is."""
    worst = wp.float64(0.0)
    i = int(0)
    beyond = wp.max(BOX_SLACK * enough, BOX_MIN)
    while i < count:
        least = box_distance_sq(replay, f, scratch.piece[i])
        if least > beyond:
            return least
        i += 1
    i = int(0)
    while i < count and worst <= enough:
        worst = wp.max(worst, active_distance_sq(replay, f, scratch.piece[i]))
        i += 1
    return worst


@wp.func
def nearest_face(replay: Replay, scratch: Scratch, count: int, near_count: int, limit: wp.float64):
    """Return the candidate that bounds the piece in hand best, or the first that does within `limit`, and its bound.

    -1 and infinity if there is none.
    """
    best = int(-1)
    best_bound = wp.float64(wp.inf)
    i = int(0)
    while i < near_count and best_bound > limit:
        bound = piece_distance_sq(replay, scratch, count, scratch.near[i], best_bound)
        if bound < best_bound:
            best = scratch.near[i]
            best_bound = bound
        i += 1
    return best, best_bound


@wp.func
def point_nearest_face(replay: Replay, scratch: Scratch, near_count: int, p: wp.vec3d):
    best = int(-1)
    best_distance = wp.float64(wp.inf)
    for i in range(near_count):
        if box_distance_sq(replay, scratch.near[i], p) <= wp.max(BOX_SLACK * best_distance, BOX_MIN):
            distance = active_distance_sq(replay, scratch.near[i], p)
            if distance < best_distance:
                best = scratch.near[i]
                best_distance = distance
    return best


@wp.func
def add_near(replay: Replay, scratch: Scratch, near_count: int, shared: int, own: int, f: int):
    """Make face f a candidate unless it is one; `own` marks those of a triangle, `shared` those of the merge."""
    if replay.face_stamp[f] == shared or replay.face_stamp[f] == own:
        return near_count
    replay.face_stamp[f] = own
    scratch.near[near_count] = f
    return near_count + 1


@wp.func
def add_ring(replay: Replay, scratch: Scratch, rings: Rings, near_count: int, shared: int, own: int, node: int):
    """Make every live face at a node a candidate; return the new count."""
    k = rings.head[node]
    while k >= 0:
        if rings.corner_node[3 * (k // 3)] >= 0:
            near_count = add_near(replay, scratch, near_count, shared, own, k // 3)
        k = rings.next[k]
    return near_count


@wp.func
def approach_point(
    replay: Replay,
    scratch: Scratch,
    rings: Rings,
    near_count: int,
    shared: int,
    own: int,
    p: wp.vec3d,
    limit: wp.float64,
):
    """Walk over the active surface towards p, from its nearest candidate until within `limit` or no ring is nearer.

    Faces passed become candidates. Without this, a triangle that had to lean on a face as far away as the bound allows
    would have only that face's neighbours to go to, and the bound would creep.
    Returns the squared distance and the new count.
    """
    f = point_nearest_face(replay, scratch, near_count, p)
    distance = active_distance_sq(replay, f, p)
    moving = bool(True)
    while moving and distance > limit:
        moving = bool(False)
        i = near_count
        for k in range(3):
            near_count = add_ring(replay, scratch, rings, near_count, shared, own, rings.corner_node[3 * f + k])
        while i < near_count:
            other = active_distance_sq(replay, scratch.near[i], p)
            if other < distance:
                distance = other
                f = scratch.near[i]
                moving = bool(True)
            i += 1
    return distance, near_count


@wp.func
def approach_piece(
    replay: Replay,
    scratch: Scratch,
    rings: Rings,
    count: int,
    near_count: int,
    shared: int,
    own: int,
    limit: wp.float64,
):
    """Walk towards every corner of the piece in hand.

    Returns what no partition over the candidates can go below (squared), and their new count.
    """
    least = wp.float64(0.0)
    for i in range(count):
        distance, near_count = approach_point(replay, scratch, rings, near_count, shared, own, scratch.piece[i], limit)
        least = wp.max(least, distance)
    return least, near_count


@wp.func
def use_face(replay: Replay, scratch: Scratch, count: int, used: int, room: int, f: int):
    """Note that the piece in hand stands on face f, or on a face already used where there is no room for f.

    Returns how many faces are used; the last entry is exchanged with the one chosen, so that it is known.
    """
    at = int(-1)
    for i in range(used):
        if scratch.used[i] == f:
            at = i
    if at < 0 and used < room:
        scratch.used[used] = f
        return used + 1
    if at < 0:
        best = wp.float64(wp.inf)
        for i in range(used):
            bound = piece_distance_sq(replay, scratch, count, scratch.used[i], best)
            if bound < best:
                best = bound
                at = i
    other = scratch.used[at]
    scratch.used[at] = scratch.used[used - 1]
    scratch.used[used - 1] = other
    return used


@wp.func
def cover_triangle(
    replay: Replay, scratch: Scratch, rings: Rings, near_count: int, shared: int, own: int, room: int, limit: wp.float64
):
    """Cut the triangle in hand into pieces that each lie near one candidate; note these faces in scratch.used.

    Returns the square of the bound, at least `limit`, and how many faces are used.
    """
    store_piece(scratch, 0, 3)
    top = int(1)
    cuts = int(0)
    used = int(0)
    while top > 0:
        top -= 1
        count = load_piece(scratch, top)
        best, bound = nearest_face(replay, scratch, count, near_count, limit)
        final = bound <= limit
        if not final:
            before = near_count
            least, near_count = approach_piece(replay, scratch, rings, count, near_count, shared, own, limit)
            if near_count > before:
                best, bound = nearest_face(replay, scratch, count, near_count, limit)
            final = bound <= wp.max(SLACK_SQ * least, limit) or cuts >= CUTS
            final = final or top + 4 >= STACK or count + 4 > CORNERS
        if final:
            used = use_face(replay, scratch, count, used, room, best)
            if scratch.used[used - 1] != best:
                bound = piece_distance_sq(replay, scratch, count, scratch.used[used - 1], wp.float64(wp.inf))
            limit = wp.max(limit, bound)
        else:
            cuts += 1
            middle = wp.vec3d()
            for i in range(count):
                middle = middle + scratch.piece[i]
            middle = middle / wp.float64(count)
            over = point_nearest_face(replay, scratch, near_count, middle)
            top = split_piece(replay.face_pos, scratch, count, top, over, FLOOR + MARGIN * wp.sqrt(limit))
    return limit, used
