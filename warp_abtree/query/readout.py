"""Reading what a launch found: to the host in one transfer of each kind, or into arrays that stay on the device."""

from contextlib import nullcontext
from functools import cached_property

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.regime import Regime
from warp_abtree.kernels.io import results as kernels
from warp_abtree.query.buffers import QueryBuffers
from warp_abtree.query.commands import Commands
from warp_abtree.query.result import COUNTERS, Found, Result, Totals
from warp_abtree.query.sorting import (
    make_segment_sort,
    make_sort,
    segment_threads,
    sort_on_device,
    sort_passes,
    sort_rows,
)
from warp_abtree.query.staging import Staging, first_rows, view_memory

# Rows that are expected come in steps.
ROWS_STEP = 1024
FLOAT64_ROW = 1 + COUNTERS.index("float64_tests")
HEADER, COLUMNS = int(kernels.HEADER_WORDS), int(kernels.COUNT_COLUMNS)


class QueryReadout(QueryBuffers):
    """Readout of a query: brings results of its launches to the host or into device arrays.

    On a GPU kernels pack it into memory that one copy brings over: first a header of demands with whatever has an entry
    a pair, then the rows, whose number is known by then. On the CPU the query's arrays are the host's memory already.
    """

    output: str
    _regime: Regime
    _commands: Commands
    _made_staging: Staging | None = None
    _last_read = 0, 0  # pairs of the last result, and its hits

    @property
    def _staging(self) -> Staging:
        if self._made_staging is None:
            self._made_staging = Staging(self.device)
        return self._made_staging

    def _packs(self) -> bool:
        return self._regime.packs(self.device)

    def _read(self, device: bool, with_rows: bool = True) -> Result:
        """Return the result of the last launch, on any stream, perhaps without what has an entry a hit."""
        check_device(self.device, "reading results")
        self._check_whole()
        # The default stream waits for those that the query may have been launched on.
        whole = wp.ScopedStream(self.device.null_stream, sync_exit=True) if self.device.is_cuda else nullcontext()
        with whole:
            return self._make_result(self._read_pairs(device), device, with_rows)

    def _make_result(self, found: Found, device: bool, with_rows: bool = True) -> Result:
        """Check that there was a launch, and read the rows that it found.

        Raises:
            RuntimeError: As `Query.result`.
        """
        if len(self.pairs):  # without room for pairs there are no launches
            self.guard.check(found.totals.launched)
        if self.output == "faces" and with_rows:
            self._read_rows(found, min(found.totals.hits, len(self.hits.face)), device)
        return Result(found, (len(self.pairs), len(self.hits.face), len(self.hits.uncertain)), self.output)

    def _read_totals(self) -> Totals:
        """Read what the last launch needed of each list. Waits for the device."""
        if self._packs():
            return self._totals(self._staging.fetch_words(self._pack_pairs(0), HEADER))
        views, total, uncertain = self._views, 0, 0
        if self.broad_phase is None:
            found = len(self._given)
        else:
            found = self.broad_phase.check_found(int(views.pair_count[0]))
        if self.output == "faces":
            total = int(views.counts[0].sum())
        if len(self.hits.uncertain):
            apart = 0 if self._gap is None else int(self.hits.apart_total.numpy().view(np.uint32)[0])
            uncertain = max(apart, int(views.counts[FLOAT64_ROW].sum()))
        return Totals(self.guard.outcome(), found, total, uncertain)

    def _totals(self, words) -> Totals:
        """Return the demands in a header; those of lists that the query lacks are 0."""
        launched, found, hits, uncertain, apart = words[:HEADER].tolist()
        uncertain = max(uncertain, apart)
        found = len(self._given) if self.broad_phase is None else self.broad_phase.check_found(found)
        return Totals(
            launched, found, hits if self.output == "faces" else 0, uncertain if len(self.hits.uncertain) else 0
        )

    def _read_pairs(self, device: bool) -> Found:
        """Read demands, and what there is an entry a pair of. Waits for the device."""
        if not (self._packs() or device):
            return self._copy_pairs()
        n = len(self._given) if self.broad_phase is None else min(self._read_totals().pairs, len(self.pairs))
        if device:
            return self._keep_pairs(n)
        self._pack_pairs(n)
        expected = self._expected_hits(n)
        self._sort_hits(expected, self._sort_room(expected))
        return self._bring(n, expected)

    def _repeats_calls(self, device: bool) -> bool:
        """Return whether the launches of `run` can be the same at every call."""
        return self.device.is_cuda and self._packs() and not device and self.broad_phase is None

    def _launch_and_bring(self, launch) -> Found:
        """Launch and pack, by a graph where a call repeats the one before, and read. Waits for the device."""
        n = len(self._given)
        words = self._staging.room("words", self._block_length(n), wp.int64)

        def launch_all():
            launch()
            self._pack_pairs(n)

        self._commands.repeat_call((*self.guard.given(), n, words.ptr), self.device, launch_all)
        # Not in the graph: Warp's sort fails without an exception there once memory has run out.
        expected = self._expected_hits(n)
        self._sort_hits(expected, self._sort_room(expected))
        return self._bring(n, expected)

    def _expected_hits(self, n: int) -> int:
        """Return as many hits as the last result of so many pairs makes likely.

        So the device sorts them while the host still launches, and a loop over poses waits once a call.
        """
        pairs, hits = self._last_read
        if self.output != "faces" or pairs != n or hits == 0:
            return 0
        # A little more, in steps, so that hits that vary find room and launches stay the same.
        return min(-(-hits * 17 // 16 // ROWS_STEP) * ROWS_STEP, len(self.hits.face))

    def _bring(self, n: int, expected: int) -> Found:
        """Bring over what was packed. Waits for the device."""
        staging, rows = self._staging, None
        words = staging.send_words(staging.words, self._block_length(n))
        if expected:
            rows = self._send_sorted_hits(expected)
        staging.wait()
        columns, end = words[HEADER : HEADER + COLUMNS * n].reshape(COLUMNS, n), HEADER + COLUMNS * n
        if self.broad_phase is None:
            pairs = self._given.copy()
        else:
            pairs, end = words[end : end + n].view(np.int32).reshape(n, 2), end + n
        flags = words[end:].view(bool)
        apart = None if self.near is None else flags[n : 2 * n]
        found = Found(self._totals(words), pairs, flags[:n], apart, columns[0], dict(zip(COUNTERS, columns[1:])))
        self._last_read = n, found.totals.hits
        if rows is not None and found.totals.hits <= len(rows):
            found.faces = rows[: found.totals.hits]
        return found

    def _copy_pairs(self) -> Found:
        """Copy from arrays that are the host's memory, which the next launch writes."""
        views, totals = self._views, self._read_totals()
        n = min(totals.pairs, len(self.pairs))
        pairs = (self._given if self.broad_phase is None else views.pairs[:n]).copy()
        apart = None if views.near_hit is None else views.near_hit[:n] == 0
        count, *tests = views.counts[:, :n].copy()
        return Found(totals, pairs, views.any_hit[:n] != 0, apart, count, dict(zip(COUNTERS, tests)))

    def _keep_pairs(self, n: int) -> Found:
        """Return arrays on the device, parts of a block of their own."""
        block = wp.empty(self._block_length(n), dtype=wp.int64, device=self.device)
        totals = self._totals(self._staging.fetch_words(self._pack_pairs(n, block), HEADER))

        def part(at, dtype):
            return view_memory(block.ptr + at, dtype, n, self.device, block)

        column, words = 8 * n, [part(8 * HEADER + 8 * n * k, wp.int64) for k in range(COLUMNS)]
        flags = 8 * HEADER + column * COLUMNS
        if self.broad_phase is None:
            pairs = wp.clone(first_rows(self.pairs, n))
        else:
            pairs, flags = part(flags, wp.vec2i), flags + column
        apart = None if self.near is None else part(flags + n, wp.bool)
        return Found(totals, pairs, part(flags, wp.bool), apart, words[0], dict(zip(COUNTERS, words[1:])))

    def _block_length(self, n: int) -> int:
        """Return the words of a block of n pairs."""
        return HEADER + (COLUMNS + (self.broad_phase is not None)) * n + (2 * n + 7) // 8

    def _pack_pairs(self, n: int, words=None) -> wp.array:
        """Write a block of n pairs, to the staging memory by default, and return it. Launches only."""
        staging = self._staging
        if words is None:
            words = staging.room("words", self._block_length(n), wp.int64)
        words.zero_()
        near = staging.no_flags if self.near is None else self.near.any_hit
        threads = max(1, -(-len(self.pairs) // kernels.BLOCK_DIM)) * kernels.BLOCK_DIM
        inputs = [n, self.broad_phase is not None, self.pair_batch, self.hits, near, words]

        self._repeat((n, words.ptr), kernels.pack_pair_kernel, threads, inputs, kernels.BLOCK_DIM)
        return words

    def _repeat(self, given: tuple, kernel, dim, inputs, block_dim=256):
        """Launch a kernel, recorded until the query's arrays are replaced, or whatever else is given changes."""

        def make(launch):
            return [launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)]

        given = *self.guard.given(), dim, *given
        for launch in self._commands.find_callables(kernel.key, given, self.device, make):
            launch()

    def _read_rows(self, found: Found, count: int, device: bool):
        """Read what there is an entry a hit of. Waits for the device, unless it stays there."""
        if found.faces is not None:
            return
        if not (self._packs() or device):
            found.faces = sort_rows(self._views.faces[:count])
        elif device:
            found.faces = self._sort_hits(count, wp.empty(count, dtype=wp.vec3i, device=self.device))
        else:
            self._sort_hits(count, self._sort_room(count))
            found.faces = self._send_sorted_hits(count)
            self._staging.wait()

    def _send_sorted_hits(self, count: int) -> np.ndarray:
        """Bring hits over that were sorted into the staging memory. Does not wait."""
        staging = self._staging
        return staging.send_rows(staging.row_pool.take(12 * count), staging.rows, count)[0]

    def _sort_room(self, count: int) -> wp.array:
        """Return the staging memory that so many hits are sorted into."""
        return self._staging.room("rows", count, wp.vec3i)

    def _sort_hits(self, count: int, rows):
        """Write the first hits to rows in order, and return these. Launches only."""
        order = self._staging.room("order", 2 * count, wp.int32)
        key = self._staging.room("key", 2 * count, wp.int64)
        self._sort_into(count, order, key, rows)
        return rows

    def _sort_into(self, count: int, order, key, rows) -> bool:
        """Write the first hits to rows in order, with such scratch; return whether by segments. Launches only."""
        if count == 0:
            return False
        chosen = self._regime.segments
        if self.device.is_cuda or chosen:
            threads = segment_threads(count, len(self.pairs), chosen)
            if threads:
                self._sort_segments(count, threads, key, rows)
                return True
        passes = self._sort_passes()
        made = self.hits, count, len(self.pairs), passes, order, key, rows

        def make(launch):
            return make_sort(*made, self._sorted_ends()[:2], launch)

        given = *self.guard.given(), count, order.ptr, key.ptr, rows.ptr
        sort_on_device(self._commands.find_callables("sort", given, self.device, make), count, passes, order, key)
        return False

    def _sort_segments(self, count: int, threads: int, key, rows):
        """Write the first hits to rows in order by a segment a pair, with such scratch. Launches only."""
        start, *ends = self._sorted_ends()
        if not len(start):
            length = len(self.pairs) + 1
            start = first_rows(self._staging.room("start", length, wp.int32), length)

        def make(launch):
            return make_segment_sort(self.hits, count, threads, key, rows, (start, *ends), launch)

        given = *self.guard.given(), count, threads, key.ptr, rows.ptr, start.ptr
        for launch in self._commands.find_callables("segments", given, self.device, make):
            launch()

    def _sorted_ends(self) -> tuple:
        """Return what the sort writes beside rows, see `make_segment_sort`."""
        return self._no_ends

    @cached_property
    def _no_ends(self) -> tuple:
        none = wp.empty(0, dtype=wp.int32, device=self.device)
        return none, none, wp.empty(0, dtype=wp.vec3i, device=self.device)

    def _sort_passes(self) -> list:
        return sort_passes(len(self.pairs), int(self.batch.models.face_count.max()), self._regime.key_bits)
