"""Certified one-sided Hausdorff distance of the original surface from the surface after every merge; a serial replay.

Every original triangle is registered with up to SLOTS active faces that cover it within the running maximum
(`triangle_cover`). A registration is valid until its face moves or dies; then the triangle is covered again by its
other faces and by those around the merge.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.build import triangle_cover as cover
from warp_abtree.kernels.build.triangle_cover import Covers, Replay
from warp_abtree.kernels.build.vertex_forest import absorb_ring, count_dying, third_corner, third_vertices_live

wp.set_module_options(native.options("build/cover_ring.h", "build/fetch_merge.h", "build/one_polygon.h"))

# Entries of `Replay.counter`, kept between launches.
NEXT_MERGE = wp.constant(0)
LIVE_FACES = wp.constant(1)
STAMP = wp.constant(2)
FREE_SLOTS = wp.constant(3)
QUEUED = wp.constant(4)  # triangles covered again at the last merge
INDEXED = wp.constant(5)  # active faces when the Bvh was built; 0: not yet; -1: the next merge needs a new one

SEARCH_REACH = wp.constant(wp.float64(2.0**-10))


@wp.func
def register_slot(replay: Replay, slot: int, f: int):
    first = replay.face_slot[f]
    replay.slot[slot, cover.SLOT_FACE] = f
    replay.slot[slot, cover.SLOT_NEXT] = first
    replay.slot[slot, cover.SLOT_LAST] = -1
    if first >= 0:
        replay.slot[first, cover.SLOT_LAST] = slot
    replay.face_slot[f] = slot


@wp.func
def release_triangle(replay: Replay, t: int, face_count: int, free: int):
    """End every registration of triangle t; return how many pooled slots are free."""
    slot = t
    while slot >= 0:
        before = replay.slot[slot, cover.SLOT_LAST]
        after = replay.slot[slot, cover.SLOT_NEXT]
        if before >= 0:
            replay.slot[before, cover.SLOT_NEXT] = after
        else:
            replay.face_slot[replay.slot[slot, cover.SLOT_FACE]] = after
        if after >= 0:
            replay.slot[after, cover.SLOT_LAST] = before
        if slot >= face_count:
            replay.free_slot[free] = slot
            free += 1
        slot = replay.slot[slot, cover.SLOT_SIBLING]
    replay.slot[t, cover.SLOT_SIBLING] = -1
    return free


@wp.func
def register_triangle(replay: Replay, t: int, used: int, free: int):
    """Register triangle t with the faces in replay.scratch.used; return how many pooled slots are left."""
    register_slot(replay, t, replay.scratch.used[0])
    for k in range(1, used):
        free -= 1
        slot = replay.free_slot[free]
        replay.slot[slot, cover.SLOT_TRIANGLE] = t
        replay.slot[slot, cover.SLOT_SIBLING] = replay.slot[t, cover.SLOT_SIBLING]
        replay.slot[t, cover.SLOT_SIBLING] = slot
        register_slot(replay, slot, replay.scratch.used[k])
    return free


@wp.func
def search_all(replay: Replay, limit: wp.float64):
    """Return the active face with the least bound for the current triangle, or any within `limit`.

    The Bvh is of an earlier surface and proposes faces only, dead ones too; their bounds are measured.
    """
    lower = wp.min(replay.scratch.polygon[0], wp.min(replay.scratch.polygon[1], replay.scratch.polygon[2]))
    upper = wp.max(replay.scratch.polygon[0], wp.max(replay.scratch.polygon[1], replay.scratch.polygon[2]))
    best = int(-1)
    bound = wp.float64(wp.inf)
    reach = wp.max(wp.sqrt(limit), SEARCH_REACH)
    searching = bool(True)
    while searching:
        r = wp.vec3d(reach, reach, reach)
        query = wp.bvh_query_aabb(replay.bvh, wp.vec3(lower - r), wp.vec3(upper + r))
        i = int(0)
        while bound > limit and wp.bvh_query_next(query, i):
            f = replay.bvh_face[i]
            if replay.rings.corner_node[3 * f] >= 0:
                cover.place_face(replay, f)
                distance = cover.cover_distance_sq(replay, 3, f, bound)
                if distance < bound:
                    best = f
                    bound = distance
        # Invariant: a face with a bound within `reach` overlaps the box of this query.
        searching = bound > limit and bound > reach * reach
        reach = wp.where(best < 0, reach * wp.float64(2.0), wp.sqrt(bound) * wp.float64(1.001))
    return best


@wp.func
def component_vanishes(replay: Replay, a: int, b: int):
    """Tell whether merging a and b removes the last faces of their connected component."""
    if replay.rings.degree[a] + replay.rings.degree[b] > 2 * count_dying(replay.rings, a, b):
        return False
    return not third_vertices_live(replay.rings, a, b)


@wp.func
def queue_ring(replay: Replay, queued: int, node: int, stamp: int):
    """Queue every triangle registered with a live face at a node; return the new count."""
    k = replay.rings.head[node]
    while k >= 0:
        f = k // 3
        if replay.rings.corner_node[3 * f] >= 0:
            slot = replay.face_slot[f]
            while slot >= 0:
                t = replay.slot[slot, cover.SLOT_TRIANGLE]
                if replay.slot[t, cover.SLOT_STAMP] != stamp:
                    replay.slot[t, cover.SLOT_STAMP] = stamp
                    replay.queue[queued] = t
                    replay.queue_face[queued] = f
                    queued += 1
                slot = replay.slot[slot, cover.SLOT_NEXT]
        k = replay.rings.next[k]
    return queued


@wp.func
def third_rings(replay: Replay, a: int, b: int, stamp: int):
    """Make the faces around the third corners of the faces that die with (a, b) candidates; return their count."""
    near_count = int(0)
    k = replay.rings.head[a]
    while k >= 0:
        f = k // 3
        if replay.rings.corner_node[3 * f] >= 0:
            third = third_corner(f, a, b, replay.rings.corner_node)
            if third >= 0:
                other = replay.rings.head[third]
                while other >= 0:
                    g = other // 3
                    if replay.rings.corner_node[3 * g] >= 0:
                        if third_corner(g, a, b, replay.rings.corner_node) < 0:
                            near_count = cover.add_near(replay, near_count, stamp, stamp, g)
                    other = replay.rings.next[other]
        k = replay.rings.next[k]
    return near_count


@wp.kernel
def start_replay_kernel(face_count: int, face_vertex: wp.array2d(dtype=int), replay_inout: Replay):
    """Register every original triangle with itself (serial, dim=1); `face_slot` and `face_stamp` must hold -1."""
    live = int(0)
    for f in range(face_count):
        for k in range(3):
            replay_inout.triangle_pos[f, k] = replay_inout.pos[face_vertex[f, k]]
        if replay_inout.rings.corner_node[3 * f] >= 0:
            replay_inout.slot[f, cover.SLOT_TRIANGLE] = f
            replay_inout.slot[f, cover.SLOT_SIBLING] = -1
            replay_inout.slot[f, cover.SLOT_STAMP] = -1
            register_slot(replay_inout, f, f)
            live += 1
    replay_inout.counter[LIVE_FACES] = live
    pooled = replay_inout.free_slot.shape[0]
    for k in range(pooled):
        replay_inout.free_slot[k] = face_count + pooled - 1 - k
    replay_inout.counter[FREE_SLOTS] = pooled


@wp.func(inline=False)
def cover_queued(replay: Replay, t: int, first: int, near_count: int, shared: int, limit: wp.float64):
    """Cover triangle t again, with faces around the merge and its other faces; return its squared bound."""
    for k in range(3):
        replay.scratch.polygon[k] = replay.triangle_pos[t, k]
    face_count = replay.face_slot.shape[0]
    free = replay.counter[FREE_SLOTS]
    replay.scratch.used[0] = first
    used = int(0)
    if replay.rings.corner_node[3 * first] >= 0:
        cover.place_face(replay, first)
        if cover.cover_distance_sq(replay, 3, first, limit) <= limit:
            used = int(1)
    if used == 0:
        own = replay.counter[STAMP] + 1
        replay.counter[STAMP] = own
        for i in range(near_count):
            cover.place_face(replay, replay.scratch.near[i])
            replay.face_stamp[replay.scratch.near[i]] = shared
        slot = t
        while slot >= 0:
            f = replay.slot[slot, cover.SLOT_FACE]
            if replay.rings.corner_node[3 * f] >= 0:
                near_count = cover.add_near(replay, near_count, shared, own, f)
            slot = replay.slot[slot, cover.SLOT_SIBLING]
        if near_count == 0:
            f = search_all(replay, limit)
            for k in range(3):
                near_count = cover.add_ring(replay, near_count, shared, own, replay.rings.corner_node[3 * f + k])
        free = release_triangle(replay, t, face_count, free)
        room = wp.min(cover.SLOTS, 1 + free)
        limit, used = cover.cover_triangle(replay, near_count, shared, own, room, limit)
    else:
        free = release_triangle(replay, t, face_count, free)
    replay.counter[FREE_SLOTS] = register_triangle(replay, t, used, free)
    return limit


@wp.func
def register_covers(replay: Replay, covers: Covers, begin: int, end: int):
    """Register triangles with the faces that were found to cover them, for the first in row 0."""
    face_count = replay.face_slot.shape[0]
    free = replay.counter[FREE_SLOTS]
    for i in range(begin, end):
        t = covers.triangle[i]
        free = release_triangle(replay, t, face_count, free)
        used = covers.count[i - begin]
        for k in range(used):
            replay.scratch.used[k] = covers.face[i - begin, k]
        free = register_triangle(replay, t, used, free)
    replay.counter[FREE_SLOTS] = free


@wp.func
def cover_queue(
    replay: Replay,
    covers: Covers,
    merge: wp.vec3i,
    queued: int,
    near_count: int,
    shared: int,
    limit: wp.float64,
):
    """Cover every queued triangle again, 8 faces at a time where that does it; return the squared bound."""
    i = int(0)
    while i < queued:
        end = i
        if replay.counter[FREE_SLOTS] >= cover.COVERS_AT_ONCE * cover.SLOTS:
            end = wp.min(i + cover.COVERS_AT_ONCE, queued)
            end = cover.cover_ring(replay, covers, merge, near_count, i, end, limit)
            if end > i:
                limit = covers.limit[end - i - 1]
            register_covers(replay, covers, i, end)
        if end < wp.min(i + cover.COVERS_AT_ONCE, queued):
            limit = cover_queued(replay, replay.queue[end], replay.queue_face[end], near_count, shared, limit)
            end += 1
        i = end
    return limit


@wp.func
def replay_merge(replay: Replay, covers: Covers, a: int, b: int, c: int, limit: wp.float64):
    """Merge nodes a and b into c and cover the triangles of their faces again; return the squared bound."""
    stamp = replay.counter[STAMP] + 1
    replay.counter[STAMP] = stamp
    queued = queue_ring(replay, 0, a, stamp)
    queued = queue_ring(replay, queued, b, stamp)
    dying = count_dying(replay.rings, a, b)
    near_count = int(0)
    if replay.rings.degree[a] + replay.rings.degree[b] == 2 * dying:
        near_count = third_rings(replay, a, b, stamp)
    tail = absorb_ring(replay.rings, a, a, b, c, -1)
    tail = absorb_ring(replay.rings, b, a, b, c, tail)
    k = replay.rings.head[c]
    while k >= 0:
        replay.scratch.near[near_count] = k // 3
        near_count += 1
        k = replay.rings.next[k]
    limit = cover_queue(replay, covers, wp.vec3i(a, b, c), queued, near_count, stamp, limit)
    replay.counter[LIVE_FACES] = replay.counter[LIVE_FACES] - dying
    replay.counter[QUEUED] = queued
    return limit


@wp.kernel
def replay_merges_kernel(
    vertex_count: int,
    merge_count: int,
    cover_budget: int,
    merge_pair: wp.array2d(dtype=int),
    replay_inout: Replay,
    covers_inout: Covers,
    bound_sq_out: wp.array(dtype=wp.float64),
):
    """Apply merges until `cover_budget` triangles have been covered again (serial, dim=1).

    Args:
        merge_pair: The two nodes of each merge, shape [m, 2].
        bound_sq_out: Squared running maximum after each merge, normalised, shape [m].
    Invariant: every registered triangle lies within the running maximum of the faces that it is registered with.
    """
    j = replay_inout.counter[NEXT_MERGE]
    limit = cover.FLOOR * cover.FLOOR
    if j > 0:
        limit = bound_sq_out[j - 1]
    covers = int(0)
    searchable = bool(True)
    while searchable and j < merge_count and covers < cover_budget:
        a = merge_pair[j, 0]
        b = merge_pair[j, 1]
        if 2 * replay_inout.counter[LIVE_FACES] < replay_inout.counter[INDEXED] or replay_inout.counter[INDEXED] == 0:
            searchable = not component_vanishes(replay_inout, a, b)
        if not searchable:
            replay_inout.counter[INDEXED] = -1
            break
        c = vertex_count + j
        cover.fetch_merge(replay_inout, merge_pair, merge_count, j)
        limit = replay_merge(replay_inout, covers_inout, a, b, c, limit)
        covers += replay_inout.counter[QUEUED] + 1
        bound_sq_out[j] = limit
        j += 1
    replay_inout.counter[NEXT_MERGE] = j
