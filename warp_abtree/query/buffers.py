"""Buffers of a query: pairs, what belongs to each, and lists of face pairs; replaced whole, or not at all."""

from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.cpu_threads import core_count
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.regime import Regime, current_regime
from warp_abtree.kernels.base import poses
from warp_abtree.kernels.intersect import descent, face_pairs
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.request import check_gap, check_pair_room, check_within
from warp_abtree.query.result import COUNTERS
from warp_abtree.state.batch import Batch
from warp_abtree.state.generation import LaunchGuard


class HostViews:
    """NumPy's views of a query's arrays, where these are the host's memory."""

    def __init__(self, query):
        self.pairs = query.pairs.numpy().reshape(-1, 2)
        self.pair_count = query.pair_count.numpy()
        self.any_hit = query.hits.any_hit.numpy()
        self.near_hit = None if query.near is None else query.near.any_hit.numpy()
        self.counts = query.counts.numpy()
        # The pairs of a query in the making come before room for hits.
        self.faces: Any = None if query.hits.face is None else query.hits.face.numpy().reshape(-1, 3)


class QueryBuffers(DeviceMemory):
    """Device lists of an operator about object pairs; see `Query` for the attributes that users read."""

    batch: Batch
    device: wp.Device
    precision: str
    guard: LaunchGuard
    broad_phase: BroadPhase | None
    hits: Any  # `Hits`
    near: Any
    pair_batch: poses.PairBatch
    counts: wp.array  # rows: hits.count, then COUNTERS
    within: wp.array  # where asked
    contained: wp.array  # face of what is inside, where there are solids
    _within: np.ndarray
    _gap: Any = None  # beside given pairs; of the broad phase's pairs that of each object
    _asked_gap: Any = None  # of operators that take one
    _reach: wp.array | None = None  # part of each object in the gap, where the broad phase makes pairs
    _given: np.ndarray  # pairs on the host
    slab_memory: wp.array
    _regime: Regime
    _torn: bool
    _made_views: HostViews | None = None

    @property
    def pairs(self) -> wp.array:
        """The pairs queried, device vec2i; as many as there is room for."""
        return self.pair_batch.pairs

    @property
    def pair_count(self) -> wp.array:
        """How many pairs there are, device int32 (1,)."""
        return self.pair_batch.count

    @property
    def pair_poses(self) -> wp.array:
        """The pose of each pair, device `PairPose`."""
        return self.pair_batch.poses

    def uses_warps(self) -> bool:
        """Return whether warps work on the pairs; on the CPU each thread takes one pair after the other."""
        return self._regime.uses_warps(self.device)

    def _take_gap(self, pair_count: int | None):
        """Check the gap that is asked, if any; what the broad phase reads of it goes to the device."""
        gap, count = self._asked_gap, self.batch.object_count
        if gap is None:
            return
        if self.precision != "exact":
            raise ValueError(f"gap: needs precision 'exact', not {self.precision!r}")
        if pair_count is None and isinstance(gap, wp.array) and gap.shape == (count,) and gap.dtype is wp.vec4d:
            self._gap, self._reach = np.zeros(count), gap
            return
        self._gap = check_gap(gap, pair_count, count)
        if pair_count is None:
            rows = np.zeros((count, 4))
            rows[:, 3] = 0.5 * self._gap if self._gap.ndim == 0 else self._gap
            self._reach = wp.array(rows, dtype=wp.vec4d, device=self.device)

    def _make_broad_phase(self, capacity, sorts: bool) -> BroadPhase:
        return BroadPhase(self.batch, capacity, sorts, self._reach)

    def _make_hits(self, with_gap=False):
        hits = face_pairs.Hits()
        for name in ("total", "uncertain_total", "inexact_total", *(["apart_total"] if with_gap else [])):
            setattr(hits, name, wp.zeros(1, dtype=wp.int32, device=self.device))
        return hits

    def set_pairs(self, pairs, within=None):
        """Query other pairs from now on, in the room there is if they fit; within None keeps the distances.

        Raises:
            ValueError: Bad pairs or distances, a query that runs the broad phase, or distances for one made without.
        """
        self._set_pairs(pairs, within, None)

    def _set_pairs(self, pairs, within, gap):
        if self.broad_phase is not None:
            raise ValueError("this query takes its pairs from the broad phase")
        check_device(self.device, "giving a query other pairs")
        self._check_whole()
        pairs = self.batch.check_pairs(pairs)
        if within is not None and self.near is None:
            raise ValueError("this query was made without within")
        if self.near is not None:
            within = check_within(self._within if within is None else within, len(pairs))
        if gap is not None and self._gap is None:
            raise ValueError("this query was made without gap")
        if self._gap is not None:
            gap = check_gap(self._gap if gap is None else gap, len(pairs), 0)
        self.replace_pairs(pairs, within, gap)

    def replace_pairs(self, pairs: np.ndarray, within, gap=None):
        """Do what `set_pairs` does, with pairs and distances that are checked, None without."""
        self._check_whole()
        # What may fail for lack of memory comes before anything that changes the query.
        made = []
        if len(pairs) > len(self.pairs):
            made = self._make_room(wp.empty(len(pairs), dtype=wp.vec2i, device=self.device))
        with self._changing():
            if made:
                self._replace(made)
            self.guard.forget()
            if self.device.is_cpu:
                self._views.pairs[: len(pairs)] = pairs
                self._views.pair_count[0] = len(pairs)
            else:
                if len(pairs):
                    rows = wp.array(pairs, dtype=wp.vec2i, device="cpu", copy=False)
                    wp.copy(self.pairs, rows, count=len(pairs))
                self.pair_count.fill_(len(pairs))
            self._given = pairs
            self._within, self._gap = within, gap
            self._fill_within()
            self._fill_gap()

    def is_asked(self, pairs: np.ndarray, within, gap=None) -> bool:
        """Return whether pairs and distances, checked, None without, are those in place."""
        same = len(pairs) == len(self._given) and pairs.tobytes() == self._given.tobytes()
        same = same and (within is None or within is self._within or np.array_equal(within, self._within))
        return same and (gap is None or np.array_equal(gap, self._gap))

    @contextmanager
    def _changing(self):
        """Refuse the query for good where a change of what belongs together is interrupted."""
        before, self._torn = self._torn, True
        yield
        self._torn = before

    def _check_whole(self):
        if self._torn:
            raise RuntimeError("this query was interrupted while its buffers changed; make a new one")

    def _replace(self, made):
        """Put new arrays, (owner, attribute, array), in the place of old ones."""
        self.guard.buffers.advance()
        with self._changing():
            self._made_views = None
            for owner, name, array in made:
                setattr(owner, name, array)

    @property
    def _views(self) -> HostViews:
        if self._made_views is None:
            self._made_views = HostViews(self)
        return self._made_views

    def _pair_arrays(self, room: int) -> list:
        """Return (owner, attribute, new array) of whatever has an entry a pair."""
        made = [(self.pair_batch, "poses", wp.empty(room, dtype=poses.PairPose, device=self.device))]
        made.append((self, "slab_memory", self._make_slab_memory(room)))
        for hits in (self.hits, self.near):
            if hits is not None:
                made.append((hits, "any_hit", wp.zeros(room, dtype=wp.int32, device=self.device)))
                counts = wp.zeros((1 + len(COUNTERS), max(1, room)), dtype=wp.int64, device=self.device)
                made += [(hits, name, counts[k]) for k, name in enumerate(("count", *COUNTERS))]
                if hits is self.hits:
                    made.append((self, "counts", counts))
        if self.near is not None:
            made.append((self, "within", wp.empty(room, dtype=wp.float64, device=self.device)))
        if self._gap is not None:
            made.append((self.hits, "gap", wp.empty(max(1, room), dtype=wp.float64, device=self.device)))
        if self.batch.solids is not None:
            made.append((self, "contained", wp.empty(room, dtype=wp.int32, device=self.device)))
        return made

    def _make_slab_memory(self, room: int):
        """Return what each thread of the CPU keeps slabs in; the system gives it only what it touches."""
        if self.uses_warps():
            return wp.empty((0, 0), dtype=wp.float32, device=self.device)
        threads = min(room, current_regime().cpu_threads or core_count())
        words = descent.slab_memory_words(int(self.batch.models.depth.max()))
        memory = wp.empty((threads, words), dtype=wp.float32, device=self.device)
        memory.numpy()[:, : descent.SLAB_ZEROS] = 0.0
        return memory

    def _make_room(self, pairs) -> list:
        """Return (owner, attribute, new array) of a device list of pairs, and of whatever belongs to a pair."""
        check_pair_room(len(pairs))
        made = [*self._pair_arrays(len(pairs)), (self.pair_batch, "pairs", pairs)]
        return made if self.broad_phase is None else made + self.broad_phase.make_room(pairs)

    def _take_pairs(self, pairs):
        """Take a device list of pairs and make room for whatever belongs to a pair: all of it, or nothing changes."""
        made = self._make_room(pairs)
        with self._changing():
            self._replace(made)
            if self.broad_phase is not None:
                self._fill_within()

    def _fill_gap(self):
        """Write the gaps of given pairs to the device."""
        if self._gap is not None and self._gap.ndim == 0:
            self.hits.gap.fill_(float(self._gap))
        elif self._gap is not None and len(self._gap):
            wp.copy(self.hits.gap, wp.array(self._gap, dtype=wp.float64, device="cpu"), count=len(self._gap))

    def _fill_within(self):
        if self.near is None:
            return
        if self._within.ndim == 0:
            self.within.fill_(float(self._within))
        elif len(self._within):
            distances = wp.array(self._within, dtype=wp.float64, device="cpu", copy=False)
            wp.copy(self.within, distances, count=len(distances))

    def _resize_uncertain(self, capacity: int):
        inexact = capacity if self.precision == "exact" else 0
        made = [("uncertain", capacity), ("inexact", inexact)]
        if self._gap is not None:
            made.append(("apart", capacity))
        self._replace([(self.hits, name, wp.empty(room, dtype=wp.vec3i, device=self.device)) for name, room in made])

    def resize(self, capacity: int):
        """Make room for a number of intersecting face pairs."""
        self._replace([(self.hits, "face", wp.empty(capacity, dtype=wp.vec3i, device=self.device))])
