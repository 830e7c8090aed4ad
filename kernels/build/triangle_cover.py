"""Cover one original triangle with active faces: cut it into convex polygons, and assign each polygon ONE face.

The distance to one triangle is a convex function, so its maximum over a polygon is at a corner: any partition gives an
upper bound. A partition along the prisms over the faces gives zero where the surface has not moved.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.build import polygon
from warp_abtree.kernels.build.vertex_forest import Rings

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

COVERS_AT_ONCE = wp.constant(native.constant("COVERS_AT_ONCE"))
CUTS = wp.constant(64)  # cuts of a triangle at one merge, at most
SLOTS = wp.constant(32)  # faces that cover a triangle, at most

# Entries of a slot, which lie side by side in memory.
SLOT_FACE = wp.constant(native.constant("SLOT_FACE"))  # the face that its triangle is registered with
SLOT_TRIANGLE = wp.constant(native.constant("SLOT_TRIANGLE"))
SLOT_SIBLING = wp.constant(native.constant("SLOT_SIBLING"))  # next slot of the same triangle, or -1
SLOT_NEXT = wp.constant(native.constant("SLOT_NEXT"))  # doubly linked list of each face's slots
SLOT_LAST = wp.constant(4)  # the other direction
SLOT_STAMP = wp.constant(5)  # last merge that queued the triangle; of a triangle's own slot
SLOT_FIELDS = wp.constant(native.constant("SLOT_FIELDS"))

# Coordinates are within 1/2 and rounded at 2^-53: smaller bounds in flat regions are noise, not worth a cut.
FLOOR = wp.constant(wp.float64(2.0**-46))
COVER_MARGIN = wp.constant(wp.float64(0.05))  # of the bound: how far a polygon may extend beyond the edge of a prism
# A face is skipped if its box is farther away than another face by more than rounding.
BOX_SLACK = wp.constant(wp.float64(1.001))
BOX_MIN = wp.constant(wp.float64(2.0**-70))
COVER_SLACK_SQ = wp.constant(wp.float64(1.1))  # of the lower bound: a polygon within this factor is not cut


@wp.struct
class Replay:
    """The surface after each merge, and which faces cover which original triangles.

    A slot registers one triangle with one face; slot t is triangle t's own. Each face has a doubly linked list of its
    slots, each triangle a singly linked one.
    """

    counter: wp.array(dtype=int)  # [6], see `hausdorff_bound`
    rings: Rings  # of the vertex forest
    scratch: polygon.Scratch  # of the current triangle
    pos: wp.array(dtype=wp.vec3d)  # [node_count], normalised
    triangle_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], original triangles
    face_pos: wp.array2d(dtype=wp.vec3d)  # [face_count, 3], corners of candidates
    face_box: wp.array2d(dtype=wp.vec3d)  # [face_count, 2], lower and upper corner of the box of each candidate
    bvh: wp.uint64  # wp.Bvh over the boxes of bvh_face; 0 until a component vanishes
    bvh_face: wp.array(dtype=int)  # [any], faces that were active when the Bvh was built
    slot: wp.array2d(dtype=int)  # [slot_count, SLOT_FIELDS]; those from face_count on are pooled
    free_slot: wp.array(dtype=int)  # [slot_count - face_count], stack of pooled slots not in use
    face_slot: wp.array(dtype=int)  # [face_count], first slot or -1
    face_stamp: wp.array(dtype=int)  # [face_count], last candidate set that held the face
    queue: wp.array(dtype=int)  # [face_count], triangles to cover again
    queue_face: wp.array(dtype=int)  # [face_count], a face that covered each: the first to try


@wp.struct
class Covers:
    """Triangles of a merge to cover, and the faces found for each."""

    triangle: wp.array(dtype=int)  # [any], triangles in order
    first: wp.array(dtype=int)  # [any], a face that covered each: the first to try
    near: wp.array(dtype=int)  # [any], faces around a merge
    count: wp.array(dtype=int)  # [rows], faces that cover each triangle
    face: wp.array2d(dtype=int)  # [rows, any], these faces
    limit: wp.array(dtype=wp.float64)  # [rows], squared running maximum after each triangle


@native.func_native(cpu=True)
def cover_ring(
    replay: Replay,
    covers: Covers,
    merge: wp.vec3i,
    near_count: wp.int32,
    begin: wp.int32,
    end: wp.int32,
    limit: wp.float64,
) -> wp.int32:
    """Cover triangles of a merge again, 8 faces at a time, number by number as `cover_triangle`.

    Args:
        merge: The two nodes of the merge and the one that it makes; the forest may be that before the merge or after.
        begin, end: Triangles, at most COVERS_AT_ONCE; what is found for the first goes to row 0.
        limit: Squared running maximum, which a triangle raises for those after it.

    Returns where it stopped: `end`, or a triangle that only `cover_triangle` can cover, as other faces may be nearer.
    """


@native.func_native(cpu=True)
def fetch_merge(replay: Replay, merge_pair: wp.array2d(dtype=int), merge_count: wp.int32, j: wp.int32):
    """Prefetch what the merges after merge j will read into the caches of this core."""


@wp.func
def place_face(replay: Replay, f: int):
    """Load an active face's corners from the forest, for candidates of one face at a time."""
    for k in range(3):
        replay.face_pos[f, k] = replay.pos[replay.rings.corner_node[3 * f + k]]
    a, b, c = replay.face_pos[f, 0], replay.face_pos[f, 1], replay.face_pos[f, 2]
    replay.face_box[f, 0] = wp.min(a, wp.min(b, c))
    replay.face_box[f, 1] = wp.max(a, wp.max(b, c))


@wp.func(inline=False)
def cover_distance_sq(replay: Replay, count: int, f: int, enough: wp.float64):
    """Return the largest squared distance of the current polygon to active face f, or any value above `enough`.

    The face's box comes first: a corner farther than `enough` from it decides.
    """
    beyond = wp.max(BOX_SLACK * enough, BOX_MIN)
    for i in range(count):
        least = polygon.box_distance_sq(replay.scratch.polygon[i], replay.face_box[f, 0], replay.face_box[f, 1])
        if least > beyond:
            return least
    return polygon.polygon_distance_sq(replay.face_pos, replay.scratch, count, f, enough)


@wp.func
def nearest_candidate(replay: Replay, count: int, near_count: int, limit: wp.float64):
    """Return the candidate with the least bound for the current polygon, or the first within `limit`, and its bound.

    -1 and infinity if there is no candidate.
    """
    best = int(-1)
    best_bound = wp.float64(wp.inf)
    i = int(0)
    while i < near_count and best_bound > limit:
        bound = cover_distance_sq(replay, count, replay.scratch.near[i], best_bound)
        if bound < best_bound:
            best = replay.scratch.near[i]
            best_bound = bound
        i += 1
    return best, best_bound


@wp.func
def point_nearest_face(replay: Replay, near_count: int, p: wp.vec3d):
    best = int(-1)
    best_distance = wp.float64(wp.inf)
    for i in range(near_count):
        f = replay.scratch.near[i]
        gap = polygon.box_distance_sq(p, replay.face_box[f, 0], replay.face_box[f, 1])
        if gap <= wp.max(BOX_SLACK * best_distance, BOX_MIN):
            distance = polygon.face_distance_sq(replay.face_pos, f, p)
            if distance < best_distance:
                best = f
                best_distance = distance
    return best


@wp.func
def add_near(replay: Replay, near_count: int, shared: int, own: int, f: int):
    """Make face f a candidate unless it is one: `own` stamps those of this triangle, `shared` those of the merge."""
    if replay.face_stamp[f] == shared or replay.face_stamp[f] == own:
        return near_count
    place_face(replay, f)
    replay.face_stamp[f] = own
    replay.scratch.near[near_count] = f
    return near_count + 1


@wp.func(inline=False)
def add_ring(replay: Replay, near_count: int, shared: int, own: int, node: int):
    """Make every live face at a node a candidate; return the new count."""
    k = replay.rings.head[node]
    while k >= 0:
        if replay.rings.corner_node[3 * (k // 3)] >= 0:
            near_count = add_near(replay, near_count, shared, own, k // 3)
        k = replay.rings.next[k]
    return near_count


@wp.func(inline=False)
def approach_point(replay: Replay, near_count: int, shared: int, own: int, p: wp.vec3d, limit: wp.float64):
    """Walk over the active surface towards p, from the nearest candidate until within `limit` or at a local minimum.

    Visited faces become candidates. Otherwise a triangle covered by a face at the limit could move to that face's
    neighbours only, and the bound would grow merge by merge.
    Returns the squared distance and the new count.
    """
    f = point_nearest_face(replay, near_count, p)
    distance = polygon.face_distance_sq(replay.face_pos, f, p)
    moving = bool(True)
    while moving and distance > limit:
        moving = bool(False)
        i = near_count
        for k in range(3):
            near_count = add_ring(replay, near_count, shared, own, replay.rings.corner_node[3 * f + k])
        while i < near_count:
            other = polygon.face_distance_sq(replay.face_pos, replay.scratch.near[i], p)
            if other < distance:
                distance = other
                f = replay.scratch.near[i]
                moving = bool(True)
            i += 1
    return distance, near_count


@wp.func
def approach_polygon(replay: Replay, count: int, near_count: int, shared: int, own: int, limit: wp.float64):
    """Walk towards every corner of the current polygon.

    Returns a squared lower bound for any partition over the candidates, and their new count.
    """
    least = wp.float64(0.0)
    for i in range(count):
        distance, near_count = approach_point(replay, near_count, shared, own, replay.scratch.polygon[i], limit)
        least = wp.max(least, distance)
    return least, near_count


@wp.func
def use_face(replay: Replay, count: int, used: int, room: int, f: int):
    """Assign the current polygon to face f, or to a face already used if there is no room for f.

    Returns how many faces are used; the chosen one becomes the last entry of `scratch.used`.
    """
    at = int(-1)
    for i in range(used):
        if replay.scratch.used[i] == f:
            at = i
    if at < 0 and used < room:
        replay.scratch.used[used] = f
        return used + 1
    if at < 0:
        best = wp.float64(wp.inf)
        for i in range(used):
            bound = cover_distance_sq(replay, count, replay.scratch.used[i], best)
            if bound < best:
                best = bound
                at = i
    other = replay.scratch.used[at]
    replay.scratch.used[at] = replay.scratch.used[used - 1]
    replay.scratch.used[used - 1] = other
    return used


@wp.func
def cover_triangle(replay: Replay, near_count: int, shared: int, own: int, room: int, limit: wp.float64):
    """Cut the current triangle into polygons that each lie near one candidate; list these faces in `scratch.used`.

    Returns the squared bound, at least `limit`, and how many faces are used.
    """
    polygon.store_polygon(replay.scratch, 0, 3)
    top = int(1)
    cuts = int(0)
    used = int(0)
    while top > 0:
        top -= 1
        count = polygon.load_polygon(replay.scratch, top)
        best, bound = nearest_candidate(replay, count, near_count, limit)
        final = bound <= limit
        if not final:
            before = near_count
            least, near_count = approach_polygon(replay, count, near_count, shared, own, limit)
            if near_count > before:
                best, bound = nearest_candidate(replay, count, near_count, limit)
            final = bound <= wp.max(COVER_SLACK_SQ * least, limit) or cuts >= CUTS
            final = final or top + 4 >= polygon.STACK or count + 4 > polygon.POLYGON_CORNERS
        if final:
            used = use_face(replay, count, used, room, best)
            if replay.scratch.used[used - 1] != best:
                bound = cover_distance_sq(replay, count, replay.scratch.used[used - 1], wp.float64(wp.inf))
            limit = wp.max(limit, bound)
        else:
            cuts += 1
            over = point_nearest_face(replay, near_count, polygon.polygon_middle(replay.scratch, count))
            margin = FLOOR + COVER_MARGIN * wp.sqrt(limit)
            top = polygon.split_polygon(replay.face_pos, replay.scratch, count, top, over, margin)
    return limit, used
