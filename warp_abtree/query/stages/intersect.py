"""ACTIVE-INTERSECT for a batch: `Query`, and the stages that find which object pairs intersect, or are proved apart."""

from weakref import proxy

import numpy as np
import warp as wp

from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.distance.within import PROVED_APART, Question
from warp_abtree.kernels.intersect import face_pairs, near_faces
from warp_abtree.kernels.search import item
from warp_abtree.query.operator import Operator
from warp_abtree.query.request import APART_FOR_UNCERTAIN, OUTPUTS, PRECISIONS, check_gap, check_request
from warp_abtree.query.result import COUNTERS, Found
from warp_abtree.query.stage import Array, PairDistance, Rooms, Stage
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.traversal import AskedHits, AskedVisits, Traversal, traversal_kernels


class HitStage(Stage):
    """A stage that counts hits of each pair: `hits`, and `counts`, rows of its counters, as `Operator` has them."""

    counts: wp.array

    def __init__(self, asked: AskedHits | AskedVisits):
        self.hits, self._asked = face_pairs.Hits(), asked

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        for name in ("total", "uncertain_total", "inexact_total"):
            setattr(self.hits, name, wp.zeros(1, dtype=wp.int32, device=operator.device))

    def kernels(self, device) -> list:
        """Return the kernels of the traversal."""
        return traversal_kernels(device, current_regime(), self._asked)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a pair."""
        counts = Array(self, "counts", wp.int64, (1 + len(COUNTERS), max(1, rooms.pairs)), 0)
        return [Array(self.hits, "any_hit", wp.int32, rooms.pairs, 0), counts]

    def link(self):
        """Make rows of the counters anew, and give them to the operator whose hits they count."""
        for k, name in enumerate(("count", *COUNTERS)):
            setattr(self.hits, name, self.counts[k])
        if self.operator.hits is self.hits:
            self.operator.counts = self.counts


class IntersectStage(HitStage):
    """Find the faces of each pair that intersect, and with a gap those that are nearer than it.

    Args:
        output, precision: As for `Query`.
        with_gap: Whether the hits have gaps.
        reads: Whether results have the hits as rows.
        slots: `SlotStage` that reduces what is apart, or None where it is reported.
        resting: `MemoryStage` of pairs that are passed over, or None.
    """

    traversal: Traversal

    def __init__(self, output="any", precision="exact", with_gap=False, reads=True, slots=None, resting=None):
        self._slots, self._resting = slots if with_gap else None, resting
        self._is_exact, self._with_gap, self._reads = precision == "exact", with_gap, reads and output == "faces"
        mode = int(face_pairs.GAP if with_gap else PRECISIONS[precision])
        super().__init__(AskedHits(mode, int(OUTPUTS[output]), self._slots is not None))

    def attach(self, operator: Operator):
        """Take the operator, and give it the hits."""
        super().attach(operator)
        if self._with_gap:
            self.hits.apart_total = wp.zeros(1, dtype=wp.int32, device=operator.device)
        self.traversal = Traversal(self.operator, self._asked.output == int(item.OUTPUT_ANY))
        self._no_distance = wp.empty(0, dtype=wp.float64, device=operator.device)
        operator.hits, operator.traversal, operator.lists_hits = self.hits, self.traversal, self._reads
        operator.lists_apart = self._slots is not None

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the arrays of hits, and the lists of face pairs that wait."""
        apart = rooms.uncertain if self.operator.uses_warps() else 0
        waiting = apart if self._slots is None else -(-apart // APART_FOR_UNCERTAIN)
        lists = {"face": rooms.hits, "uncertain": waiting, "inexact": waiting if self._is_exact else 0}
        lists |= {"apart": apart} if self._with_gap else {}
        made = [Array(self.hits, name, wp.vec3i, room) for name, room in lists.items()]
        return [*super().arrays(rooms), *self.traversal.arrays(rooms), *made]

    def search(self):
        """Traverse the pairs in place. Launches only."""
        if self._with_gap and not self.operator.device.is_capturing:
            self.operator.batch.fit_slabs()
        within = self.hits.gap if self._with_gap else self._no_distance
        within = within if self._resting is None else self._resting.asked
        slots = None
        if self._slots is not None:
            self._slots.start()
            slots = self._slots.slots
        self.traversal.launch("pairs", self._asked, within, self.hits, slots)

    def read(self, found: Found, device: bool, with_rows: bool):
        """Read the hits as rows."""
        if self._reads and with_rows:
            self.operator.readout.read_hits(found, device)


class VisitStage(HitStage):
    """Visit the face pairs of each pair that are not proved farther apart than a distance.

    Attributes:
        within: Distances [world units], see `PairDistance`, device float64 (pair,).
        question: What visits ask, of what they are given: `own`.
    """

    within: wp.array

    def __init__(self, within, question: Question, own):
        super().__init__(AskedVisits(question))
        self.distance = PairDistance("within", within, proxy(self))
        self.question, self._own = question, own

    def boxes(self, boxes):
        """Return boxes that are wider by half of the distance."""
        boxes.wide = 0.5 * float(self.distance.value)
        return boxes

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the distances, and the arrays of hits."""
        return [*super().arrays(rooms), Array(self, "within", wp.float64, rooms.pairs)]

    def search(self):
        """Visit them. Launches only."""
        self.operator.traversal.launch("within", self._asked, self.within, self.hits, self._own)


class ApartStage(VisitStage):
    """Find the pairs that are not proved farther apart than a distance: their any_hit is not 0."""

    def __init__(self, within):
        super().__init__(within, PROVED_APART, 0)

    def attach(self, operator: Operator):
        """Take the operator, and give it the proofs."""
        super().attach(operator)
        operator.near = self.hits


class GapStage(Stage):
    """Distances within which faces of a pair count as near: given, or the sum of what each of its objects has."""

    def __init__(self, gap):
        self._gap, self._hits = gap, face_pairs.Hits()
        self._reach: wp.array | None = None  # part of each object, where the broad phase makes pairs

    def give_to(self, hits, precision: str):
        """Let hits have the gap of each pair; raise ValueError for another precision than "exact"."""
        if precision != "exact":
            raise ValueError(f"gap: needs precision 'exact', not {precision!r}")
        self._hits = hits
        self.distance = PairDistance("gap", None, hits, lambda value, count: check_gap(value, count, 0))

    def attach(self, operator: Operator):
        """Take the operator, and check the gap; what the broad phase reads of it goes to the device."""
        super().attach(operator)
        gap, count = self._gap, operator.batch.object_count
        if operator.given is not None:
            self.distance.value = check_gap(gap, len(operator.given), count)
        elif isinstance(gap, wp.array) and gap.shape == (count,) and gap.dtype is wp.vec4d:
            self._reach = gap
        else:
            parts, rows = check_gap(gap, None, count, operator.batch.removed), np.zeros((count, 4))
            rows[:, 3] = 0.5 * parts if parts.ndim == 0 else parts
            self._reach = wp.array(rows, dtype=wp.vec4d, device=operator.device)

    def boxes(self, boxes):
        """Return boxes that reach as far."""
        if self._reach is not None:
            boxes.reach = self._reach
        return boxes

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the gaps."""
        return [Array(self._hits, "gap", wp.float64, max(1, rooms.pairs))]

    def search(self):
        """Add what the objects of each pair have. Launches only."""
        if self._reach is not None:
            operator = self.operator
            inputs = [operator.pair_batch, self._reach, self._hits.gap]
            operator.launch_kernel(near_faces.add_reach_kernel, operator.rooms.pairs, inputs)


class Query(Operator):
    """Intersection of many object pairs as an operator: allocates once, launches many times.

    `launch()` only launches, so that a CUDA graph can capture it, the first launch too. Make a new query after adding
    objects to the scene, or filtering pairs where the query runs the broad phase. A captured graph holds until arrays
    that it uses are replaced: by these, by a change of LODs that takes more tree states than the scene had room for,
    and by a buffer that grows. `result()` refuses what a stale graph has left. Keep the query as long as its graphs.

    Args:
        scene: `Scene` or `Batch` whose poses and LODs hold at the time of each launch.
        output: "any", "count" or "faces".
        pairs: Object pairs to query, (p, 2); None runs the broad phase in every launch.
        capacity: `Buffers`, or the face pairs that `faces` has room for.
        precision: "exact": the sign of every determinant is right. "float32": the sign of the rounded one.
        within: Distances [world units], one for all pairs or (p,) beside given pairs: tell also which pairs are farther
            apart. The proof covers all rounding: pairs beyond by less than about 1e-13 of their size stay unproved, by
            less than 6 s where a rotation is off orthonormal by s, and all for distances from 2^1000 on.
        sort_pairs: Whether pairs of the broad phase are sorted by their objects.

    Attributes:
        batch: `Batch` that is queried.
        hits: Device arrays of the last launch (`kernels.intersect.face_pairs.Hits`), faces in no order.
        pairs, pair_count: The pairs queried, device vec2i and int32 (1,).
        near: As `hits` for `within`: any_hit is 0 where a pair is proved apart; None without within.

    Raises:
        ValueError: An unknown output or precision, bad pairs or distances, a capacity out of range, an empty scene.
        RuntimeError: A graph is being captured.
    """

    def __init__(
        self, scene, output="faces", pairs=None, capacity=None, precision="exact", within=None, sort_pairs=False
    ):
        super().__init__(scene, self.plan(output, precision, within), pairs, capacity, output, sort_pairs)

    @staticmethod
    def plan(output="faces", precision="exact", within=None) -> list[Stage]:
        """Return the stages of a query; raise ValueError for an unknown output or precision."""
        check_request(output, precision)
        first = [] if within is None else [ApartStage(within)]
        return [*first, IntersectStage(output, precision), InsideStage()]
