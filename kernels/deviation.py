"""Certified deviation: how far the original surface lies from the surface after every merge; one serial replay.

Every original triangle is registered with up to SLOTS active faces that cover it: it is cut into convex pieces, and every
piece lies within the running maximum E of ONE of these faces. The distance to one (convex) triangle is a convex function,
so its largest value on a piece is that of a corner. A registration stays true until its face moves or dies; then the
triangle is covered anew by its other faces and by the faces about the merge. Any partition gives a bound; a good one,
cut along the prisms over the faces, gives zero where the surface has not moved.
Source: bound by convexity; closest points after Ericson, Real-Time Collision Detection, section 5.1.5.
"""

import warp as wp

from warp_abtree.kernels.forest import Rings, absorb_ring, third_corner

wp.set_module_options({"enable_backward": False})

SLOTS = wp.constant(16)
STACK = wp.constant(64)  # pieces that wait
CORNERS = wp.constant(16)  # of a piece
CUTS = wp.constant(64)  # of a triangle at one merge

# counter: what the kernel carries from launch to launch
NEXT_MERGE = wp.constant(0)
LIVE_FACES = wp.constant(1)
STAMP = wp.constant(2)

# Coordinates are within 1/2 and rounded at 2^-53: without this floor flat regions would be cut for nothing.
FLOOR = wp.constant(wp.float64(2.0**-46))
MARGIN = wp.constant(wp.float64(0.05))  # of the bound: how far a piece may reach over the edge of a prism
SLACK_SQ = wp.constant(wp.float64(1.1))  # a piece so near to the best that any candidates can do is not cut further


@wp.struct
class Replay:
    """What the replay knows of the surface."""

    pos: wp.array(dtype=wp.vec3d)  # [node_count], normalised
    triangle_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], original triangles
    face_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], active faces where they are now
    face_ball: wp.array(dtype=wp.vec4d)  # [face_count], centre and radius of a ball about each
    live_face: wp.array(dtype=int)  # [face_count], active faces in any order
    live_place: wp.array(dtype=int)  # [face_count], where each stands there
    slot_count: wp.array(dtype=int)  # [face_count], slots in use of triangle t, which owns SLOTS t ...
    slot_face: wp.array(dtype=int)  # [SLOTS face_count], face that triangle t is registered with
    slot_next: wp.array(dtype=int)  # [SLOTS face_count], doubly linked list of each face's slots
    slot_last: wp.array(dtype=int)  # [SLOTS face_count]
    face_slot: wp.array(dtype=int)  # [face_count], first slot or -1
    face_stamp: wp.array(dtype=int)  # [face_count], last candidate set that held the face
    triangle_stamp: wp.array(dtype=int)  # [face_count], last merge that queued the triangle
    queue: wp.array(dtype=int)  # [face_count], triangles to cover anew
    queue_face: wp.array(dtype=int)  # [face_count], a face that covered each: the first to try


@wp.struct
class Scratch:
    """Room for one cover."""

    near: wp.array(dtype=int)  # [face_count + SLOTS], candidates; those of the merge before those of the triangle
    used: wp.array(dtype=int)  # [SLOTS], faces that pieces stand on
    waiting: wp.array2d(dtype=wp.vec3d)  # [STACK, CORNERS], pieces
    waiting_count: wp.array(dtype=int)  # [STACK], corners of each
    piece: wp.array(dtype=wp.vec3d)  # [CORNERS], the piece in hand
    inner: wp.array(dtype=wp.vec3d)  # [CORNERS]


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
def piece_distance_sq(replay: Replay, scratch: Scratch, count: int, f: int, enough: wp.float64):
    """Return the largest corner distance of the piece in hand to face f; anything larger than `enough` once above it."""
    ball = replay.face_ball[f]
    reach = wp.length(scratch.piece[0] - wp.vec3d(ball[0], ball[1], ball[2])) - ball[3]
    worst = wp.float64(0.0)
    if reach > wp.float64(0.0) and reach * reach > wp.float64(1.001) * enough:
        return reach * reach
    i = int(0)
    while i < count and worst <= enough:
        worst = wp.max(worst, active_distance_sq(replay, f, scratch.piece[i]))
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
    before = replay.slot_last[slot]
    after = replay.slot_next[slot]
    if before >= 0:
        replay.slot_next[before] = after
    else:
        replay.face_slot[f] = after
    if after >= 0:
        replay.slot_last[after] = before


@wp.func
def nearest_face(replay: Replay, scratch: Scratch, count: int, near_count: int, limit: wp.float64):
    """Return the candidate that bounds the piece in hand best, or the first that does within `limit`; -1 if none."""
    best = int(-1)
    best_bound = wp.float64(wp.inf)
    i = int(0)
    while i < near_count and best_bound > limit:
        bound = piece_distance_sq(replay, scratch, count, scratch.near[i], best_bound)
        if bound < best_bound:
            best = scratch.near[i]
            best_bound = bound
        i += 1
    return best


@wp.func
def point_nearest_face(replay: Replay, scratch: Scratch, near_count: int, p: wp.vec3d):
    best = int(-1)
    best_distance = wp.float64(wp.inf)
    for i in range(near_count):
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
    replay: Replay, scratch: Scratch, rings: Rings, near_count: int, shared: int, own: int, p: wp.vec3d, limit: wp.float64
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
    replay: Replay, scratch: Scratch, rings: Rings, count: int, near_count: int, shared: int, own: int, limit: wp.float64
):
    """Walk towards every corner of the piece in hand.

    Returns what no partition over the candidates can go below (squared), and their new count.
    """
    least = wp.float64(0.0)
    for i in range(count):
        distance, near_count = approach_point(
            replay, scratch, rings, near_count, shared, own, scratch.piece[i], limit
        )
        least = wp.max(least, distance)
    return least, near_count


@wp.func
def load_piece(scratch: Scratch, row: int):
    for i in range(scratch.waiting_count[row]):
        scratch.piece[i] = scratch.waiting[row, i]
    return scratch.waiting_count[row]


@wp.func
def store_piece(scratch: Scratch, row: int, count: int):
    for i in range(count):
        scratch.waiting[row, i] = scratch.piece[i]
    scratch.waiting_count[row] = count


@wp.func
def cut_piece(scratch: Scratch, count: int, row: int, normal: wp.vec3d, origin: wp.vec3d, margin: wp.float64):
    """Cut the piece in hand by a plane; keep what lies along the normal, put the rest into a row of the stack.

    Returns the corners kept, 0 if none. Corners within `margin` count for either side, lest slivers come off.
    """
    above = int(0)
    below = int(0)
    for i in range(count):
        height = wp.dot(normal, scratch.piece[i] - origin)
        above += int(height > margin)
        below += int(height < -margin)
    if below == 0:
        scratch.waiting_count[row] = 0
        return count
    if above == 0:
        store_piece(scratch, row, count)
        return int(0)
    kept = int(0)
    rest = int(0)
    for i in range(count):
        p = scratch.piece[i]
        q = scratch.piece[(i + 1) % count]
        sp = wp.dot(normal, p - origin)
        sq = wp.dot(normal, q - origin)
        if sp >= -margin:
            scratch.inner[kept] = p
            kept += 1
        else:
            scratch.waiting[row, rest] = p
            rest += 1
        if (sp >= -margin) != (sq >= -margin):
            t = wp.min(wp.max(sp / (sp - sq), wp.float64(0.0)), wp.float64(1.0))
            x = p + (q - p) * t
            scratch.inner[kept] = x
            kept += 1
            scratch.waiting[row, rest] = x
            rest += 1
    scratch.waiting_count[row] = rest
    for i in range(kept):
        scratch.piece[i] = scratch.inner[i]
    return kept


@wp.func
def halve_piece(scratch: Scratch, count: int, top: int):
    """Cut the piece in hand across its longest edge; stack both parts, return the new top."""
    longest = wp.float64(-1.0)
    edge = int(0)
    for i in range(count):
        size = wp.length_sq(scratch.piece[(i + 1) % count] - scratch.piece[i])
        if size > longest:
            longest = size
            edge = i
    p = scratch.piece[edge]
    q = scratch.piece[(edge + 1) % count]
    kept = cut_piece(scratch, count, top, wp.normalize(q - p), p + (q - p) * wp.float64(0.5), wp.float64(0.0))
    if scratch.waiting_count[top] > 0:
        top += 1
    if kept > 0:
        store_piece(scratch, top, kept)
        top += 1
    return top


@wp.func
def split_piece(replay: Replay, scratch: Scratch, count: int, top: int, f: int, margin: wp.float64):
    """Cut the piece in hand by the prism over face f, or across if that leaves it whole; return the new top."""
    a = replay.face_pos[f, 0]
    normal = wp.cross(replay.face_pos[f, 1] - a, replay.face_pos[f, 2] - a)
    bottom = top
    kept = count
    if wp.length_sq(normal) > wp.float64(0.0):
        normal = wp.normalize(normal)
        for k in range(3):
            if kept > 0:
                p = replay.face_pos[f, k]
                side = wp.normalize(wp.cross(normal, replay.face_pos[f, (k + 1) % 3] - p))
                kept = cut_piece(scratch, kept, top, side, p, margin)
                if scratch.waiting_count[top] > 0:
                    top += 1
    if kept > 0:
        store_piece(scratch, top, kept)
        top += 1
    if top - bottom == 1:
        top = halve_piece(scratch, load_piece(scratch, bottom), bottom)
    return top


@wp.func
def use_face(replay: Replay, scratch: Scratch, count: int, used: int, f: int):
    """Note that the piece in hand stands on face f, or on a face already used where there is no room for f.

    Returns how many faces are used; the last entry is exchanged with the one chosen, so that it is known.
    """
    at = int(-1)
    for i in range(used):
        if scratch.used[i] == f:
            at = i
    if at < 0 and used < SLOTS:
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
    replay: Replay, scratch: Scratch, rings: Rings, near_count: int, shared: int, own: int, limit: wp.float64
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
        best = nearest_face(replay, scratch, count, near_count, limit)
        bound = piece_distance_sq(replay, scratch, count, best, wp.float64(wp.inf))
        final = bound <= limit
        if not final:
            least, near_count = approach_piece(replay, scratch, rings, count, near_count, shared, own, limit)
            best = nearest_face(replay, scratch, count, near_count, limit)
            bound = piece_distance_sq(replay, scratch, count, best, wp.float64(wp.inf))
            final = bound <= wp.max(SLACK_SQ * least, limit) or cuts >= CUTS
            final = final or top + 4 >= STACK or count + 4 > CORNERS
        if final:
            used = use_face(replay, scratch, count, used, best)
            limit = wp.max(
                limit, piece_distance_sq(replay, scratch, count, scratch.used[used - 1], wp.float64(wp.inf))
            )
        else:
            cuts += 1
            middle = wp.vec3d()
            for i in range(count):
                middle = middle + scratch.piece[i]
            middle = middle / wp.float64(count)
            over = point_nearest_face(replay, scratch, near_count, middle)
            top = split_piece(replay, scratch, count, top, over, FLOOR + MARGIN * wp.sqrt(limit))
    return limit, used


@wp.func
def search_all(replay: Replay, scratch: Scratch, live: int, first: int):
    """Return the active face that bounds the triangle in hand best; `first` is tried first."""
    best = first
    bound = piece_distance_sq(replay, scratch, 3, best, wp.float64(wp.inf))
    for i in range(live):
        f = replay.live_face[i]
        distance = piece_distance_sq(replay, scratch, 3, f, bound)
        if distance < bound:
            best = f
            bound = distance
    return best


@wp.func
def queue_ring(replay: Replay, rings: Rings, queued: int, node: int, stamp: int):
    """Queue every triangle registered with a live face at a node; return the new count."""
    k = rings.head[node]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            slot = replay.face_slot[f]
            while slot >= 0:
                t = slot // SLOTS
                if replay.triangle_stamp[t] != stamp:
                    replay.triangle_stamp[t] = stamp
                    replay.queue[queued] = t
                    replay.queue_face[queued] = f
                    queued += 1
                slot = replay.slot_next[slot]
        k = rings.next[k]
    return queued


@wp.func
def retire_faces(replay: Replay, scratch: Scratch, rings: Rings, live: int, a: int, b: int, stamp: int):
    """Take the faces that have a and b off the live list; make those at their third corners candidates.

    Returns the live faces and the candidates.
    """
    near_count = int(0)
    k = rings.head[a]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            third = third_corner(f, a, b, rings.corner_node)
            if third >= 0:
                live -= 1
                place = replay.live_place[f]
                moved = replay.live_face[live]
                replay.live_face[place] = moved
                replay.live_place[moved] = place
                other = rings.head[third]
                while other >= 0:
                    g = other // 3
                    if rings.corner_node[3 * g] >= 0:
                        if third_corner(g, a, b, rings.corner_node) < 0:
                            near_count = add_near(replay, scratch, near_count, stamp, stamp, g)
                    other = rings.next[other]
        k = rings.next[k]
    return live, near_count


@wp.kernel
def start_replay_kernel(
    face_count: int,
    face_vertex: wp.array2d(dtype=int),
    corner_node: wp.array(dtype=int),
    # In and out:
    replay_inout: Replay,
    counter_inout: wp.array(dtype=int),
):
    """Register every original triangle with itself (serial, dim=1).

    Args:
        replay_inout: `face_slot` and the stamps must hold -1.
    """
    live = int(0)
    for f in range(face_count):
        for k in range(3):
            replay_inout.triangle_pos[f, k] = replay_inout.pos[face_vertex[f, k]]
        if corner_node[3 * f] >= 0:
            set_face(replay_inout, corner_node, f)
            register_slot(replay_inout, SLOTS * f, f)
            replay_inout.slot_count[f] = 1
            replay_inout.live_face[live] = f
            replay_inout.live_place[f] = live
            live += 1
    counter_inout[LIVE_FACES] = live


@wp.func
def cover_queued(
    replay: Replay,
    scratch: Scratch,
    rings: Rings,
    counter: wp.array(dtype=int),
    t: int,
    first: int,
    near_count: int,
    live: int,
    shared: int,
    limit: wp.float64,
):
    """Register triangle t anew, about the merge or wherever its other faces are; return the square of its bound."""
    for k in range(3):
        scratch.piece[k] = replay.triangle_pos[t, k]
    used = int(0)
    if rings.corner_node[3 * first] >= 0:
        if piece_distance_sq(replay, scratch, 3, first, limit) <= limit:
            scratch.used[0] = first
            used = int(1)
    if used == 0:
        own = counter[STAMP] + 1
        counter[STAMP] = own
        for k in range(replay.slot_count[t]):
            f = replay.slot_face[SLOTS * t + k]
            if rings.corner_node[3 * f] >= 0:
                near_count = add_near(replay, scratch, near_count, shared, own, f)
        if near_count == 0:
            f = search_all(replay, scratch, live, replay.live_face[0])
            for k in range(3):
                near_count = add_ring(replay, scratch, rings, near_count, shared, own, rings.corner_node[3 * f + k])
        limit, used = cover_triangle(replay, scratch, rings, near_count, shared, own, limit)
    for k in range(replay.slot_count[t]):
        release_slot(replay, SLOTS * t + k)
    replay.slot_count[t] = used
    for k in range(used):
        register_slot(replay, SLOTS * t + k, scratch.used[k])
    return limit


@wp.kernel
def replay_merges_kernel(
    vertex_count: int,
    merge_count: int,
    cover_budget: int,
    merge_pair: wp.array2d(dtype=int),
    # In and out:
    replay_inout: Replay,
    scratch_inout: Scratch,
    rings_inout: Rings,
    counter_inout: wp.array(dtype=int),
    # Out:
    bound_sq_out: wp.array(dtype=wp.float64),
):
    """Apply merges until `cover_budget` triangles have been covered anew (serial, dim=1).

    Args:
        merge_pair: The two nodes of each merge, shape [m, 2].
        bound_sq_out: Square of the running maximum after each merge, normalised, shape [m].
    Invariant: every registered triangle lies within the running maximum of the faces that it is registered with.
    """
    j = counter_inout[NEXT_MERGE]
    live = counter_inout[LIVE_FACES]
    limit = FLOOR * FLOOR
    if j > 0:
        limit = bound_sq_out[j - 1]
    covers = int(0)
    while j < merge_count and covers < cover_budget:
        a = merge_pair[j, 0]
        b = merge_pair[j, 1]
        c = vertex_count + j
        stamp = counter_inout[STAMP] + 1
        counter_inout[STAMP] = stamp
        queued = queue_ring(replay_inout, rings_inout, 0, a, stamp)
        queued = queue_ring(replay_inout, rings_inout, queued, b, stamp)
        live, near_count = retire_faces(replay_inout, scratch_inout, rings_inout, live, a, b, stamp)
        tail = absorb_ring(rings_inout, a, a, b, c, -1)
        tail = absorb_ring(rings_inout, b, a, b, c, tail)
        near_count = add_ring(replay_inout, scratch_inout, rings_inout, near_count, stamp, stamp, c)
        k = rings_inout.head[c]
        while k >= 0:
            set_face(replay_inout, rings_inout.corner_node, k // 3)
            k = rings_inout.next[k]
        for i in range(queued):
            limit = cover_queued(
                replay_inout, scratch_inout, rings_inout, counter_inout, replay_inout.queue[i],
                replay_inout.queue_face[i], near_count, live, stamp, limit,
            )
        bound_sq_out[j] = limit
        covers += queued + 1
        j += 1
    counter_inout[NEXT_MERGE] = j
    counter_inout[LIVE_FACES] = live
