"""Hits in the order of `Result.faces`, sorted on the host or on the device."""

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.radix_sort import radix_sort
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.io import sort_hits, sort_segments
from warp_abtree.query.staging import first_rows

# Rows whose sorting takes longer than packing each into one number, which sorts 20 times as fast.
ROWS_TO_PACK = 400

# Hits are sorted by a segment a pair up to so many pairs, whose starts each block sums anew, and up to so many hits a
# pair on average, which a group of threads sorts by itself.
SEGMENTS_MOST, SEGMENT_LONGEST = 2**17, 2048


def sort_rows(rows: np.ndarray) -> np.ndarray:
    """Return rows of int32 that are not negative, sorted by the first number, of equal ones by the next, and so on."""
    packs = len(rows) >= ROWS_TO_PACK
    widths = [int(column.max()).bit_length() for column in rows.T] if packs else []
    if not packs or sum(widths) > 63:
        return rows[np.lexsort(rows.T[::-1])]
    key, others = rows[:, 0].astype(np.int64), range(1, len(widths))
    for column in others:
        key <<= widths[column]
        key |= rows[:, column]
    key.sort()
    found = np.empty_like(rows)
    for column in reversed(others):
        np.bitwise_and(key, (1 << widths[column]) - 1, out=found[:, column], casting="unsafe")
        key >>= widths[column]
    found[:, 0] = key
    return found


def sort_passes(pair_room: int, face_count: int, key_bits: int) -> list:
    """Return the bits of (pair, face a, face b) that each pass of a device's sort looks at."""
    pair, face = pair_room.bit_length(), (face_count - 1).bit_length()
    if pair + 2 * face <= key_bits:
        return [(pair, face, face)]
    return [(0, 0, face), (pair, face, 0)]


def first_sort(device) -> list:
    """Return the kernel that sorts few hits, and its block size."""
    if device.is_cuda or current_regime().segments:
        return [(sort_segments.sort_segment_kernel, sort_segments.SEGMENT_THREADS)]
    return [(sort_hits.make_key_kernel, 256)]


def segment_threads(count: int, pair_room: int, chosen: bool | None) -> int:
    """Return the threads of a group that sorts the hits of one pair, `count` in all; 0 for a radix sort of them all.

    `chosen` is `Regime.segments`; None: there are few hits a pair on average.
    """
    mean, thread_max = count / pair_room, sort_segments.SEGMENT_THREADS
    if chosen is None:
        chosen = pair_room <= SEGMENTS_MOST and mean <= SEGMENT_LONGEST
    # A few keys a thread, and room in shared memory for pairs of twice as many hits as the mean.
    threads = 32 if mean <= 64 else 128 if mean <= 512 else thread_max
    return threads if chosen and count < 2**30 else 0


def make_segment_sort(hits, count: int, threads: int, key, rows, ends, launch) -> list:
    """Return what `launch` makes of the kernels that sort the first hits by a segment a pair, with so many threads.

    Args:
        hits: `Hits` whose face pairs are sorted.
        key, rows: As for `HitSort.launch`.
        ends: Device int32 (pair room + 1,), for where the hits of each pair start; int32 (1,), which becomes 0, and
            vec3i for `ChunkSums.span`, or (0,).
        launch: Takes what `wp.launch` does.
    """
    start, deferred, span = ends
    device, block, room = key.device, sort_segments.SEGMENT_THREADS, len(start) - 1
    lanes, group = (block, threads) if device.is_cuda else (1, 1)
    blocks = -(-room // block), -(-room * group // lanes)

    def make(kernel, dim, inputs):
        return launch(kernel, dim=dim, inputs=inputs, device=device, block_dim=block)

    inputs = [lanes, count, hits.total, hits.count, hits.face, start, deferred]
    made = [make(sort_segments.start_segment_kernel, blocks[0] * lanes, inputs)]
    made.append(make(sort_segments.take_place_kernel, count, [count, hits.total, hits.face, start, key]))
    inputs = [threads // group, threads, start, key, rows, span]
    return [*made, make(sort_segments.sort_segment_kernel, blocks[1] * lanes, inputs)]


class HitSort:
    """Sort of an operator's hits on the device: by a segment a pair where pairs have few, else by radix.

    Args:
        operator: Whose hits are sorted; those that are missing count as a pair of their own, the last.
    """

    def __init__(self, operator: Any):
        self.operator = operator
        self._none = tuple(wp.empty(0, dtype=dtype, device=operator.device) for dtype in (wp.int32, wp.int32, wp.vec3i))

    def launch(self, count: int, order, key, rows, staging=None, ends=None) -> bool:
        """Write the first hits to rows, device vec3i (count,), in order; return whether by segments. Launches only.

        Args:
            order, key: Scratch, device int32 and int64 (2 count,); the keys of the last pass stay.
            staging: Where there is room for the starts of pairs, if no ends are asked.
            ends: What else is written: where the hits of each pair start, device int32 (pair room + 1,); zeros for
                int32 (2,); and `ChunkSums.span`, vec3i, by segments alone.
        """
        if count == 0:
            return False
        operator = self.operator
        chosen, room = operator.regime.segments, len(operator.pairs)
        threads = segment_threads(count, room, chosen) if operator.device.is_cuda or chosen else 0
        given: tuple = count, threads, order.ptr, key.ptr, rows.ptr
        if threads:
            if ends is None:
                start = first_rows(staging.room("start", room + 1, wp.int32), room + 1)
                ends, given = (start, *self._none[1:]), (*given, start.ptr)
            make = partial(make_segment_sort, operator.hits, count, threads, key, rows, ends)
            for launch in operator.find_launches("segments", make, *given):
                launch()
            return True
        ends = self._none if ends is None else ends
        passes = sort_passes(room, int(operator.batch.models.face_count.max()), operator.regime.key_bits)
        make = partial(self._make_radix, count, passes, order, key, rows, ends)
        *makers, placer = operator.find_launches("sort", make, *given)
        for launch, widths in zip(makers, passes, strict=True):
            launch()
            radix_sort(key, order, count, sum(widths))
        placer()
        return False

    def _make_radix(self, count, passes, order, key, rows, ends, launch) -> list:
        """Make the launches of keys, behind each of which a sort lies, and of the kernel that places rows."""
        start, totals, _ = ends
        hits, device, made = self.operator.hits, self.operator.device, []
        for number, widths in enumerate(passes):
            inputs = [len(self.operator.pairs), wp.vec3i(*widths), number == 0, hits.total, hits.face, order, key]
            made.append(launch(sort_hits.make_key_kernel, count, inputs, device=device))
        inputs = [count, sum(passes[-1][1:]), hits.total, hits.face, order, key, rows, start, totals]
        return [*made, launch(sort_hits.place_row_kernel, max(count, len(start)), inputs, device=device)]
