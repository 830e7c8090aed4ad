"""Certified errors by several threads: merges that do not meet are covered at the same time, and registered in order.

A window holds the next merges whose rings share no face and whose triangles are not the same. None of them changes what
another reads, so their triangles are covered on the surface before all of them, in any order. The running maximum rises
seldom: triangles are covered for its value before the window. Where it rises, and where a triangle covered alone moves
to a face about a later merge, the window ends, and the merges after it are gathered again.
"""

import warp as wp

from warp_abtree.kernels.progressive.hausdorff_bound import (
    FREE_SLOTS,
    LIVE_FACES,
    NEXT_MERGE,
    STAMP,
    cover_queue,
    merge_rings,
    register_covers,
)
from warp_abtree.kernels.progressive.triangle_cover import (
    COVERS_AT_ONCE,
    FLOOR,
    SLOT_FACE,
    SLOT_NEXT,
    SLOT_SIBLING,
    SLOT_STAMP,
    SLOT_TRIANGLE,
    SLOTS,
    Covers,
    Replay,
    cover_ring,
    fetch_merge,
)
from warp_abtree.kernels.progressive.vertex_forest import count_dying, third_corner
from warp_abtree.kernels.traversal.load_balance import take_unit

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Entries of `Window.counter`; `take_unit` counts TAKEN up.
MERGES = wp.constant(0)
TRIANGLES = wp.constant(1)
BLOCKS = wp.constant(2)
TAKEN = wp.constant(3)
FIRST_STAMP = wp.constant(4)  # stamp of its first merge

MERGE_ROOM = wp.constant(512)
TRIANGLE_ROOM = wp.constant(1 << 16)  # a merge is added while there are fewer
NEAR_MOST = wp.constant(64)  # faces about a merge, at most; of others, one thread takes care
COLUMNS = wp.constant(8)  # faces that cover a triangle, at most; likewise
CONFLICT = wp.constant(-1)


@wp.struct
class Window:
    """Merges that do not meet, in order."""

    counter: wp.array(dtype=int)  # [5]
    merge: wp.array(dtype=wp.vec3i)  # [MERGE_ROOM], its two nodes and the one that it makes
    start: wp.array(dtype=int)  # [MERGE_ROOM + 1], first triangle of each merge
    near_start: wp.array(dtype=int)  # [MERGE_ROOM + 1], first face about each merge
    block_merge: wp.array(dtype=int)  # [any], merge of each block of triangles
    block_start: wp.array(dtype=int)  # [any], its first triangle
    face_mark: wp.array(dtype=int)  # [face_count], last merge that had the face in its rings
    covers: Covers  # of all merges


@wp.func
def gather_ring(replay: Replay, window: Window, merge: wp.vec3i, turn: int, span: wp.vec4i):
    """Add the triangles and the faces of one ring of a merge; the new counts, CONFLICT if an earlier merge has some.

    Args:
        span: Triangles, faces, and the stamps of the first merge of the window and of this one.
    """
    triangles = span[0]
    near = span[1]
    k = replay.rings.head[merge[turn]]
    while k >= 0:
        f = k // 3
        if replay.rings.corner_node[3 * f] >= 0:
            if window.face_mark[f] >= span[2] and window.face_mark[f] != span[3]:
                return wp.vec4i(CONFLICT, near, span[2], span[3])
            window.face_mark[f] = span[3]
            if third_corner(f, merge[0], merge[1], replay.rings.corner_node) < 0:
                window.covers.near[near] = f
                near += 1
            slot = replay.face_slot[f]
            while slot >= 0:
                t = replay.slot[slot, SLOT_TRIANGLE]
                stamp = replay.slot[t, SLOT_STAMP]
                if stamp != span[3]:
                    if stamp >= span[2]:
                        return wp.vec4i(CONFLICT, near, span[2], span[3])
                    replay.slot[t, SLOT_STAMP] = span[3]
                    window.covers.triangle[triangles] = t
                    window.covers.first[triangles] = f
                    triangles += 1
                slot = replay.slot[slot, SLOT_NEXT]
        k = replay.rings.next[k]
    return wp.vec4i(triangles, near, span[2], span[3])


@wp.func
def gather_merge(replay: Replay, window: Window, merge: wp.vec3i, first_new: int, span: wp.vec4i):
    """Add a merge to the window; the new counts, CONFLICT if it has to wait."""
    wait = wp.vec4i(CONFLICT, 0, 0, 0)
    a = merge[0]
    b = merge[1]
    if a >= first_new or b >= first_new:
        return wait
    degrees = replay.rings.degree[a] + replay.rings.degree[b]
    if degrees > NEAR_MOST or degrees == 2 * count_dying(replay.rings, a, b):
        return wait
    added = gather_ring(replay, window, merge, 0, span)
    if added[0] >= 0:
        added = gather_ring(replay, window, merge, 1, added)
    if replay.counter[FREE_SLOTS] < COLUMNS * added[0] + SLOTS:
        return wait
    return added


@wp.kernel
def gather_window_kernel(
    vertex_count: int,
    merge_count: int,
    merge_pair: wp.array2d(dtype=int),
    # In and out:
    replay_inout: Replay,
    window_inout: Window,
):
    """Gather the next merges until one meets an earlier one (serial, dim=1)."""
    j = replay_inout.counter[NEXT_MERGE]
    first_new = vertex_count + j
    stamp = replay_inout.counter[STAMP] + 1
    span = wp.vec4i(0, 0, stamp, stamp)
    merges = int(0)
    blocks = int(0)
    gathering = bool(True)
    while gathering and j < merge_count and merges < MERGE_ROOM and span[0] < TRIANGLE_ROOM:
        merge = wp.vec3i(merge_pair[j, 0], merge_pair[j, 1], vertex_count + j)
        fetch_merge(replay_inout, merge_pair, merge_count, j)
        added = gather_merge(replay_inout, window_inout, merge, first_new, span)
        gathering = added[0] >= 0
        stamp += 1
        if gathering:
            window_inout.merge[merges] = merge
            window_inout.start[merges] = span[0]
            window_inout.near_start[merges] = span[1]
            i = span[0]
            while i < added[0]:
                window_inout.block_merge[blocks] = merges
                window_inout.block_start[blocks] = i
                blocks += 1
                i += COVERS_AT_ONCE
            span = wp.vec4i(added[0], added[1], added[2], stamp)
            merges += 1
            window_inout.start[merges] = span[0]
            window_inout.near_start[merges] = span[1]
            j += 1
    replay_inout.counter[STAMP] = stamp
    window_inout.counter[MERGES] = merges
    window_inout.counter[TRIANGLES] = span[0]
    window_inout.counter[BLOCKS] = blocks
    window_inout.counter[TAKEN] = 0
    window_inout.counter[FIRST_STAMP] = span[2]


@wp.kernel
def cover_window_kernel(
    replay: Replay,
    bound_sq: wp.array(dtype=wp.float64),
    # Out:
    window_out: Window,
):
    """Take one block of triangles after the other; CPU only, a thread a core. Those not covered get a count of 0."""
    limit = FLOOR * FLOOR
    j = replay.counter[NEXT_MERGE]
    if j > 0:
        limit = bound_sq[j - 1]
    u = take_unit(window_out.counter)
    while u < window_out.counter[BLOCKS]:
        w = window_out.block_merge[u]
        i = window_out.block_start[u]
        end = wp.min(i + COVERS_AT_ONCE, window_out.start[w + 1])
        near = window_out.near_start[w]
        near_count = window_out.near_start[w + 1] - near
        while i < end:
            i = cover_ring(replay, window_out.covers, window_out.merge[w], near, near_count, i, end, i, limit, False)
            if i < end:
                window_out.covers.count[i] = 0
                i += 1
        u = take_unit(window_out.counter)


@wp.func
def meets_later(replay: Replay, window: Window, w: int, begin: int, end: int):
    """Tell whether triangles of a merge are now registered with faces about a later merge of the window."""
    last = window.counter[FIRST_STAMP] + w
    for i in range(begin, end):
        slot = window.covers.triangle[i]
        while slot >= 0:
            if window.face_mark[replay.slot[slot, SLOT_FACE]] > last:
                return True
            slot = replay.slot[slot, SLOT_SIBLING]
    return False


@wp.func
def register_merge(
    replay: Replay, window: Window, covers: Covers, w: int, near_count: int, stamp: int, limit: wp.float64
):
    """Register the triangles of a merge of the window; the squared bound after it, and whether the window goes on."""
    before = limit
    begin = window.start[w]
    end = window.start[w + 1]
    i = begin
    while i < end and limit == before and window.covers.count[i] > 0:
        limit = window.covers.limit[i]
        i += 1
    register_covers(replay, window.covers, begin, i, begin)
    holds = limit == before
    if i < end:
        # The rest of this merge, as if there were no window.
        for k in range(i, end):
            replay.queue[k - i] = window.covers.triangle[k]
            replay.queue_face[k - i] = window.covers.first[k]
        limit = cover_queue(replay, covers, window.merge[w], end - i, near_count, stamp, limit)
        holds = limit == before and not meets_later(replay, window, w, i, end)
        # Slots as for all merges that were gathered.
        holds = holds and replay.counter[FREE_SLOTS] >= COLUMNS * (window.counter[TRIANGLES] - end) + SLOTS
    return limit, holds


@wp.kernel
def register_window_kernel(
    window: Window,
    # In and out:
    replay_inout: Replay,
    covers_inout: Covers,
    bound_sq_inout: wp.array(dtype=wp.float64),
):
    """Apply the merges of a window in order and register their triangles, as far as what was found holds (dim=1)."""
    limit = FLOOR * FLOOR
    j = replay_inout.counter[NEXT_MERGE]
    if j > 0:
        limit = bound_sq_inout[j - 1]
    w = int(0)
    holds = bool(True)
    while holds and w < window.counter[MERGES]:
        merge = window.merge[w]
        stamp = replay_inout.counter[STAMP] + 1
        replay_inout.counter[STAMP] = stamp
        dying = count_dying(replay_inout.rings, merge[0], merge[1])
        near_count = merge_rings(replay_inout, merge, 0)
        limit, holds = register_merge(replay_inout, window, covers_inout, w, near_count, stamp, limit)
        replay_inout.counter[LIVE_FACES] = replay_inout.counter[LIVE_FACES] - dying
        bound_sq_inout[j + w] = limit
        w += 1
    replay_inout.counter[NEXT_MERGE] = j + w
