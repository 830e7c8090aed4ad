"""Certified errors by several threads: merges that do not meet are covered at the same time, and registered in order.

A window holds the next merges whose rings share no face and whose triangles are not the same. None of them changes what
another reads, so their triangles are covered on the surface before all of them, in any order. One thread leads: it
gathers merges, and registers them in order as soon as their triangles are covered. The others cover blocks of triangles
from the moment they are gathered. The running maximum rises
seldom: triangles are covered for its value before the window. Where it rises, and where a triangle covered alone moves
to a face about a later merge, the window ends, and the merges after it are gathered again.
"""

import warp as wp

from warp_abtree.kernels.build.block_queue import BLOCKS_ADDED, ENDED, THREADS, count_up, pause, read_flag, take_block, withdraw_blocks, write_flag
from warp_abtree.kernels.build.hausdorff_bound import FREE_SLOTS, LIVE_FACES, NEXT_MERGE, STAMP, cover_queue, merge_rings, register_covers
from warp_abtree.kernels.build.triangle_cover import COVERS_AT_ONCE, Covers, FLOOR, Replay, SLOTS, SLOT_FACE, SLOT_NEXT, SLOT_SIBLING, SLOT_STAMP, SLOT_TRIANGLE, cover_ring, fetch_merge
from warp_abtree.kernels.build.vertex_forest import count_dying, third_corner

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Entries of `Window.counter`. The first belong to the thread that leads.
MERGES = wp.constant(0)
TRIANGLES = wp.constant(1)
FIRST_STAMP = wp.constant(2)  # stamp of its first merge
FIRST_BLOCK = wp.constant(3)  # number of its first block
# Those of `block_queue` follow.

MERGE_ROOM = wp.constant(512)
TRIANGLE_ROOM = wp.constant(1 << 16)  # a merge is added while there are fewer
NEAR_MOST = wp.constant(64)  # faces about a merge, at most; of others, one thread takes care
COLUMNS = wp.constant(8)  # faces that cover a triangle, at most; likewise
CONFLICT = wp.constant(-1)
PAUSES = wp.constant(1 << 17)  # until a thread without work gives up


@wp.struct
class Window:
    """Merges that do not meet, in order."""

    counter: wp.array(dtype=int)  # [COUNTER_COUNT], see above
    merge: wp.array(dtype=wp.vec3i)  # [MERGE_ROOM], its two nodes and the one that it makes
    start: wp.array(dtype=int)  # [MERGE_ROOM + 1], first triangle of each merge
    near_start: wp.array(dtype=int)  # [MERGE_ROOM + 1], first face about each merge
    first_block: wp.array(dtype=int)  # [MERGE_ROOM + 1], first block of each merge, from that of the window on
    block_merge: wp.array(dtype=int)  # [any], merge of each block of triangles
    block_start: wp.array(dtype=int)  # [any], its first triangle
    block_done: wp.array(dtype=int)  # [any], whether it is covered
    face_mark: wp.array(dtype=int)  # [face_count], last merge that had the face in its rings
    limit: wp.array(dtype=wp.float64)  # [1], squared running maximum before the window
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


@wp.func
def add_merge(window: Window, merge: wp.vec3i, span: wp.vec4i, added: wp.vec4i):
    """Hand out the triangles of a merge that was gathered, in blocks."""
    w = window.counter[MERGES]
    first = window.counter[FIRST_BLOCK]
    block = window.first_block[w]
    window.merge[w] = merge
    window.start[w + 1] = added[0]
    window.near_start[w + 1] = added[1]
    i = span[0]
    while i < added[0]:
        window.block_merge[block] = w
        window.block_start[block] = i
        window.block_done[block] = 0
        block += 1
        i += COVERS_AT_ONCE
    window.first_block[w + 1] = block
    window.counter[MERGES] = w + 1
    window.counter[TRIANGLES] = added[0]
    write_flag(window.counter, BLOCKS_ADDED, first + block)


@wp.func
def gather_window(
    vertex_count: int, merge_count: int, merge_pair: wp.array2d(dtype=int), replay: Replay, window: Window
):
    """Gather the next merges until one meets an earlier one; other threads cover their triangles meanwhile."""
    j = replay.counter[NEXT_MERGE]
    first_new = vertex_count + j
    stamp = replay.counter[STAMP] + 1
    window.counter[MERGES] = 0
    window.counter[TRIANGLES] = 0
    window.counter[FIRST_STAMP] = stamp
    window.counter[FIRST_BLOCK] = window.counter[BLOCKS_ADDED]
    window.start[0] = 0
    window.near_start[0] = 0
    window.first_block[0] = 0
    span = wp.vec4i(0, 0, stamp, stamp)
    gathering = bool(True)
    while gathering and j < merge_count and window.counter[MERGES] < MERGE_ROOM and span[0] < TRIANGLE_ROOM:
        merge = wp.vec3i(merge_pair[j, 0], merge_pair[j, 1], vertex_count + j)
        fetch_merge(replay, merge_pair, merge_count, j)
        added = gather_merge(replay, window, merge, first_new, span)
        gathering = added[0] >= 0
        stamp += 1
        if gathering:
            add_merge(window, merge, span, added)
            span = wp.vec4i(added[0], added[1], added[2], stamp)
            j += 1
    replay.counter[STAMP] = stamp


@wp.func
def cover_block(replay: Replay, window: Window, number: int):
    """Cover a block of triangles, on any thread. Those not covered get a count of 0."""
    block = number - window.counter[FIRST_BLOCK]
    w = window.block_merge[block]
    i = window.block_start[block]
    end = wp.min(i + COVERS_AT_ONCE, window.start[w + 1])
    near = window.near_start[w]
    near_count = window.near_start[w + 1] - near
    limit = window.limit[0]
    while i < end:
        i = cover_ring(replay, window.covers, window.merge[w], near, near_count, i, end, i, limit, False)
        if i < end:
            window.covers.count[i] = 0
            i += 1
    write_flag(window.block_done, block, 1)


@wp.func
def is_covered(window: Window, begin: int, end: int):
    """Tell whether blocks of the window are covered."""
    for block in range(begin, end):
        if read_flag(window.block_done, block) == 0:
            return False
    return True


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


@wp.func
def register_window(replay: Replay, window: Window, covers: Covers, bound_sq: wp.array(dtype=wp.float64)):
    """Apply the merges of a window in order and register their triangles, as far as what was found holds.

    Blocks that no other thread has are covered on the way.
    """
    limit = window.limit[0]
    j = replay.counter[NEXT_MERGE]
    w = int(0)
    holds = bool(True)
    while holds and w < window.counter[MERGES]:
        if is_covered(window, window.first_block[w], window.first_block[w + 1]):
            merge = window.merge[w]
            stamp = replay.counter[STAMP] + 1
            replay.counter[STAMP] = stamp
            dying = count_dying(replay.rings, merge[0], merge[1])
            near_count = merge_rings(replay, merge, 0)
            limit, holds = register_merge(replay, window, covers, w, near_count, stamp, limit)
            replay.counter[LIVE_FACES] = replay.counter[LIVE_FACES] - dying
            bound_sq[j + w] = limit
            w += 1
        else:
            number = take_block(window.counter)
            if number >= 0:
                cover_block(replay, window, number)
            else:
                pause()
    replay.counter[NEXT_MERGE] = j + w
    taken = withdraw_blocks(window.counter) - window.counter[FIRST_BLOCK]
    while not is_covered(window, 0, taken):
        pause()


@wp.func
def help_windows(replay: Replay, window: Window):
    """Cover blocks until there are no more windows, or none for a while."""
    left = int(PAUSES)
    while left > 0 and read_flag(window.counter, ENDED) == 0:
        number = take_block(window.counter)
        if number >= 0:
            cover_block(replay, window, number)
            left = int(PAUSES)
        else:
            pause()
            left -= 1


@wp.kernel
def work_windows_kernel(
    vertex_count: int,
    merge_count: int,
    cover_budget: int,
    merge_pair: wp.array2d(dtype=int),
    # In and out:
    replay_inout: Replay,
    window_inout: Window,
    covers_inout: Covers,
    bound_sq_inout: wp.array(dtype=wp.float64),
):
    """Bound merges window by window until `cover_budget` triangles are covered, or the next merge can be in no window.

    Launched once a thread of the CPU, dim=1: the one that comes first leads, the others cover blocks for it. The last
    window has no merges where it ended for want of one.
    """
    if count_up(window_inout.counter, THREADS) > 0:
        help_windows(replay_inout, window_inout)
        return
    covered = int(0)
    gathered = bool(True)
    while gathered and covered < cover_budget and replay_inout.counter[NEXT_MERGE] < merge_count:
        j = replay_inout.counter[NEXT_MERGE]
        window_inout.limit[0] = FLOOR * FLOOR
        if j > 0:
            window_inout.limit[0] = bound_sq_inout[j - 1]
        gather_window(vertex_count, merge_count, merge_pair, replay_inout, window_inout)
        gathered = window_inout.counter[MERGES] > 0
        if gathered:
            register_window(replay_inout, window_inout, covers_inout, bound_sq_inout)
            covered += window_inout.counter[TRIANGLES]
    write_flag(window_inout.counter, ENDED, 1)
