"""Readout of an operator: what a launch found, to the host in one transfer of each kind, or in arrays of the device."""

from contextlib import nullcontext
from functools import cached_property
from types import SimpleNamespace
from typing import Any
from weakref import proxy

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, flag
from warp_abtree.checks.regime import current_regime
from warp_abtree.checks.upload import view_memory
from warp_abtree.kernels.io import results as kernels
from warp_abtree.kernels.search.make_slabs import make_slab_kernel
from warp_abtree.query.request import APART_FOR_UNCERTAIN
from warp_abtree.query.result import COUNTERS, Found, Result, Totals
from warp_abtree.query.sorting import HitSort, first_sort, sort_rows
from warp_abtree.query.staging import Staging, first_rows

# Rows that are expected come in steps.
ROWS_STEP = 1024
FLOAT64_ROW = 1 + COUNTERS.index("float64_tests")
COLUMN_NAMES = "count", *COUNTERS
HEADER, COLUMNS = int(kernels.HEADER_WORDS), int(kernels.COUNT_COLUMNS)


def operator_kernels(device, stages, output: str) -> list:
    """Return the kernels of the first launch of an operator with these stages, as `loading` takes them."""
    regime = current_regime()
    found = [kernel for stage in stages for kernel in stage.kernels(device)]
    if regime.uses_warps(device) and regime.slabs:
        found.append((make_slab_kernel, 256))
    if regime.packs(device):
        found += [(kernels.pack_pair_kernel, kernels.BLOCK_DIM), *(first_sort(device) if output == "faces" else [])]
    return found


class Readout:
    """Brings results of the launches of an operator to the host, or into device arrays.

    On a GPU kernels pack them into memory that one copy brings over: first a header of demands with whatever has an
    entry a pair, then the rows, whose number is known by then. On the CPU the arrays are the host's memory already.

    Attributes:
        staging: `Staging`, made at the first use.
    """

    def __init__(self, operator: Any):
        self.operator, self.device = proxy(operator), operator.device
        self.packs = operator.regime.packs(self.device)
        self._last_read = 0, 0  # pairs of the last result, and its hits

    @cached_property
    def staging(self) -> Staging:
        """Return the memory that results pass through."""
        return Staging(self.device)

    @cached_property
    def sort(self) -> HitSort:
        """Return what sorts the hits of a result on the device."""
        return HitSort(self.operator)

    @cached_property
    def views(self) -> SimpleNamespace:
        """Return NumPy's views of the operator's arrays, where these are the host's memory."""
        operator, hits = self.operator, self.operator.hits
        return SimpleNamespace(
            pairs=operator.pairs.numpy().reshape(-1, 2),
            pair_count=operator.pair_count.numpy(),
            any_hit=hits.any_hit.numpy(),
            near_hit=None if operator.near is None else operator.near.any_hit.numpy(),
            counts=operator.counts.numpy(),
            faces=hits.face.numpy().reshape(-1, 3),
        )

    def link(self):
        """Take note of new arrays."""
        vars(self).pop("views", None)

    def write_pairs(self, pairs: np.ndarray):
        """Bring given pairs to the operator, which has room for them."""
        asked = self.operator.pair_batch
        if self.device.is_cpu:
            self.views.pairs[: len(pairs)] = pairs
            self.views.pair_count[0] = len(pairs)
            return
        if len(pairs):
            wp.copy(asked.pairs, wp.array(pairs, dtype=wp.vec2i, device="cpu", copy=False), count=len(pairs))
        asked.count.fill_(len(pairs))

    def read(self, device: bool, with_rows: bool = True) -> Result:
        """Return the result of the last launch, on any stream, perhaps without what has an entry a hit."""
        device = flag(device, "device")
        check_device(self.device, "reading results")
        self.operator.check_whole()
        # The default stream waits for those that the query may have been launched on.
        whole = wp.ScopedStream(self.device.null_stream, sync_exit=True) if self.device.is_cuda else nullcontext()
        with whole:
            return self.make_result(self.read_pairs(device), device, with_rows)

    def make_result(self, found: Any, device: bool, with_rows: bool = True) -> Result:
        """Check that there was a launch, as `Operator.result` does, and read what the stages have found."""
        operator = self.operator
        if operator.rooms.pairs:  # without room for pairs there are no launches
            operator.guard.check(found.totals.launched)
        for read in operator.readers:
            read(found, device, with_rows)
        return Result(found, operator.list_rooms, operator.output, operator.batch.names)

    def read_totals(self) -> Totals:
        """Read what the last launch needed of each list. Waits for the device."""
        operator = self.operator
        if self.packs:
            return self.totals(self.staging.fetch_words(self._pack_pairs(0), HEADER))
        views, hits = self.views, operator.hits
        apart, witnesses = self._read_count(hits.apart_total), self._read_count(hits.witness_total)
        lists = int(views.counts[0].sum()), int(views.counts[FLOAT64_ROW].sum()), apart, witnesses
        return self.totals([operator.guard.outcome(), int(views.pair_count[0]), *lists])

    def read_demand(self) -> Found:
        """Read `read_totals` alone of what was found. Waits for the device."""
        return Found(totals=self.read_totals())

    @staticmethod
    def _read_count(count) -> int:
        """Return a counter, read as uint32; 0 where there is none. Waits for the device."""
        return 0 if count is None else int(count.numpy().view(np.uint32)[0])

    def totals(self, header) -> Totals:
        """Return the demands in a header; those of lists that the operator lacks are 0."""
        launched, found, total, uncertain, apart, witnesses = map(int, header[:HEADER])
        operator, hits = self.operator, self.operator.hits
        if operator.parts is not None:  # the lists have held those of one part at a time
            total, uncertain = self._read_count(hits.total), self._read_count(hits.uncertain_total)
        pairs = len(operator.given) if operator.broad_phase is None else operator.broad_phase.check_found(found)
        waiting = max(apart, uncertain * (APART_FOR_UNCERTAIN if operator.lists_apart else 1))
        waiting = waiting if operator.list_rooms.uncertain else 0
        return Totals(launched, pairs, max(total, witnesses) if operator.output == "faces" else 0, waiting)

    def read_pairs(self, device: bool) -> Found:
        """Read demands, and what there is an entry a pair of. Waits for the device."""
        if not (self.packs or device):
            return self._copy_pairs()
        operator = self.operator
        n = len(operator.given) if operator.broad_phase is None else min(self.read_totals().pairs, operator.rooms.pairs)
        if device:
            return self._keep_pairs(n)
        self._pack_pairs(n)
        return self._bring(n, self._sort_expected(n))

    def repeats_calls(self, device: bool) -> bool:
        """Return whether the launches of `run` can be the same at every call."""
        return self.device.is_cuda and self.packs and not device and self.operator.broad_phase is None

    def launch_and_bring(self, launch) -> Found:
        """Launch and pack, by a graph where a call repeats the one before, and read. Waits for the device."""
        n = len(self.operator.given)
        words = self.staging.room("words", self._block_length(n), wp.int64)

        def launch_all():
            launch()
            self._pack_pairs(n)

        given = *self.operator.guard.given(), n, words.ptr
        self.operator.commands.repeat_call(given, self.device, launch_all)
        # Not in the graph: Warp's sort fails without an exception there once memory has run out.
        return self._bring(n, self._sort_expected(n))

    def _sort_expected(self, n: int) -> int:
        """Sort as many hits as are likely after the last result, while the host still launches; return how many."""
        pairs, hits = self._last_read
        if not self.operator.lists_hits or pairs != n or hits == 0:
            return 0
        # A little more, in steps, so that hits that vary find room and launches stay the same.
        expected = min(-(-hits * 17 // 16 // ROWS_STEP) * ROWS_STEP, self.operator.rooms.hits)
        self._sort_hits(expected)
        return expected

    def _bring(self, n: int, expected: int) -> Found:
        """Bring over what was packed, and as many sorted hits. Waits for the device."""
        staging, rows, operator = self.staging, None, self.operator
        words = staging.send_words(staging.words, self._block_length(n))
        if expected:
            rows = self._send_sorted_hits(expected)
        staging.wait()
        columns, end = words[HEADER : HEADER + COLUMNS * n].reshape(COLUMNS, n), HEADER + COLUMNS * n
        if operator.broad_phase is None:
            pairs = operator.given.copy()
        else:
            pairs, end = words[end : end + n].view(np.int32).reshape(n, 2), end + n
        flags = words[end:].view(bool)
        apart = None if operator.near is None else flags[n : 2 * n]
        found = Found(pairs, flags[:n], apart, **dict(zip(COLUMN_NAMES, columns)), totals=self.totals(words))
        self._last_read = n, found.totals.hits
        if rows is not None and found.totals.hits <= len(rows):
            found.faces = rows[: found.totals.hits]
        return found

    def _copy_pairs(self) -> Found:
        """Copy from arrays that are the host's memory, which the next launch writes."""
        views, totals, operator = self.views, self.read_totals(), self.operator
        n = min(totals.pairs, operator.rooms.pairs)
        pairs = (operator.given if operator.broad_phase is None else views.pairs[:n]).copy()
        apart = None if views.near_hit is None else views.near_hit[:n] == 0
        columns = views.counts[:, :n].copy()
        return Found(pairs, views.any_hit[:n] != 0, apart, **dict(zip(COLUMN_NAMES, columns)), totals=totals)

    def _keep_pairs(self, n: int) -> Found:
        """Return arrays on the device, parts of a block of their own."""
        operator = self.operator
        block = wp.empty(self._block_length(n), dtype=wp.int64, device=self.device)
        totals = self.totals(self.staging.fetch_words(self._pack_pairs(n, block), HEADER))

        def part(at, dtype):
            return view_memory(block.ptr + at, dtype, (n,), self.device, block)

        column, words = 8 * n, [part(8 * HEADER + 8 * n * k, wp.int64) for k in range(COLUMNS)]
        flags = 8 * HEADER + column * COLUMNS
        if operator.broad_phase is None:
            pairs = wp.clone(first_rows(operator.pairs, n))
        else:
            pairs, flags = part(flags, wp.vec2i), flags + column
        apart = None if operator.near is None else part(flags + n, wp.bool)
        return Found(pairs, part(flags, wp.bool), apart, **dict(zip(COLUMN_NAMES, words)), totals=totals)

    def _block_length(self, n: int) -> int:
        """Return the words of a block of n pairs."""
        return HEADER + (COLUMNS + (self.operator.broad_phase is not None)) * n + (2 * n + 7) // 8

    def _pack_pairs(self, n: int, words=None) -> wp.array:
        """Write a block of n pairs, to the staging memory by default, and return it. Launches only."""
        operator = self.operator
        if words is None:
            words = self.staging.room("words", self._block_length(n), wp.int64)
        words.zero_()
        near = self.staging.no_flags if operator.near is None else operator.near.any_hit
        threads = max(1, -(-operator.rooms.pairs // kernels.BLOCK_DIM)) * kernels.BLOCK_DIM
        inputs = [n, operator.broad_phase is not None, operator.pair_batch, operator.hits, near, words]
        operator.launch_kernel(kernels.pack_pair_kernel, threads, inputs, kernels.BLOCK_DIM, (n, words.ptr))
        return words

    def read_hits(self, found: Any, device: bool):
        """Read the hits as rows. Waits for the device, unless they stay there."""
        if found.faces is not None:
            return
        count = min(found.totals.hits, self.operator.rooms.hits)
        if not (self.packs or device):
            found.faces = sort_rows(self.views.faces[:count])
        elif device:
            found.faces = self._sort_hits(count, wp.empty(count, dtype=wp.vec3i, device=self.device))
        else:
            self._sort_hits(count)
            found.faces = self._send_sorted_hits(count)
            self.staging.wait()

    def _send_sorted_hits(self, count: int) -> np.ndarray:
        """Bring hits over that were sorted into the staging memory. Does not wait."""
        staging = self.staging
        return staging.send_rows(staging.row_pool.take(12 * count), staging.rows, count)[0]

    def _sort_hits(self, count: int, rows: Any = None):
        """Write the first hits in order to rows, by default to the staging memory, and return these. Launches only."""
        rows = self.staging.room("rows", count, wp.vec3i) if rows is None else rows
        order = self.staging.room("order", 2 * count, wp.int32)
        key = self.staging.room("key", 2 * count, wp.int64)
        self.sort.launch(count, order, key, rows, self.staging)
        return rows
