"""ACTIVE-INTERSECT for a batch: `Query` and its results."""

import math
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, to_numpy, whole_number
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels import poses as pose
from warp_abtree.kernels.arithmetic import predicates
from warp_abtree.kernels.traversal import dual_tree as traverse
from warp_abtree.kernels.traversal import face_pairs as faces
from warp_abtree.kernels.traversal import load_balance as share
from warp_abtree.kernels.traversal import relative_pose as relate
from warp_abtree.kernels.traversal import uncertain_pairs as settle
from warp_abtree.kernels.traversal.warp_stack import STACK_LENGTH, WARP_SIZE
from warp_abtree.query.broad_phase import BroadPhase, CapacityError
from warp_abtree.query.cpu_threads import core_count, launch_on_cores
from warp_abtree.state.arrays import ModelArrays, ObjectArrays, StateArrays
from warp_abtree.state.generation import LaunchGuard

OUTPUTS = {"any": faces.OUTPUT_ANY, "count": faces.OUTPUT_COUNT, "faces": faces.OUTPUT_FACES}
PRECISIONS = {"exact": predicates.EXACT, "float64": predicates.FLOAT64, "float32": predicates.FLOAT32}
# A launch of 32 threads a pair stays within 2^31.
PAIRS_MAX = 2**26

COUNTERS = ("node_tests", "triangle_tests", "float64_tests", "exact_tests")

# Face pairs that the float32 stage leaves open: about one in a hundred. The list grows as needed.
UNSURE_CAPACITY = 65536
# Entries that an int32 numbers.
LIST_MAX = 2**31 - 1
# Rows whose sorting takes longer than packing each into one number, which sorts 20 times as fast.
ROWS_TO_PACK = 1000
# Warps that one multiprocessor runs at a time by their registers: of the traversal, of float64, of exact signs.
WARPS_A_PROCESSOR = 16
FILTER_WARPS_A_PROCESSOR, EXACT_WARPS_A_PROCESSOR = 20, 12
# So that each finds a mailbox for all that it gives away at once.
WARPS_MAX = share.MAILBOX_COUNT // int(share.SHARES_AT_ONCE)

EXACT, FLOAT64 = int(predicates.EXACT), int(predicates.FLOAT64)


def check_request(output: str, precision: str):
    """Check what is asked of a query.

    Raises:
        ValueError: An unknown output or precision, or contacts, which another operator finds.
    """
    if output not in (*OUTPUTS, "contacts"):
        raise ValueError(f"output {output!r} is none of 'any', 'count', 'faces', 'contacts'")
    if precision not in tuple(PRECISIONS):
        raise ValueError(f"precision {precision!r} is none of 'exact', 'float64', 'float32'")
    if output == "contacts":
        raise ValueError("output 'contacts' is found by ab.ContactQuery, or Scene.intersect")


def check_within(within, pair_count=None) -> np.ndarray:
    """Return distances [world units] as float64, () or (p,).

    Raises:
        ValueError: Another shape (for pairs of the broad phase any but a scalar), a distance that is negative, infinite
            or no number.
    """
    within = to_numpy(within, "within").astype(np.float64)
    if within.shape != () and within.shape != (pair_count,):
        known = "pairs of the broad phase: one distance for all" if pair_count is None else f"{pair_count} pairs"
        raise ValueError(f"within: shape {within.shape} given for {known}")
    bad = np.flatnonzero(~(np.isfinite(within) & (within >= 0)))
    if len(bad):
        raise ValueError(f"within: {within.flat[bad[0]]} of pair {bad[0]} is no finite distance of 0 or more")
    return within


def sort_rows(rows: np.ndarray) -> np.ndarray:
    """Return rows of three int32 that are not negative, (k, 3), sorted by the first, the second and the third."""
    packs = len(rows) >= ROWS_TO_PACK
    widths = [int(column.max()).bit_length() for column in rows.T] if packs else []
    if not packs or sum(widths) > 63:
        return rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]
    key = rows[:, 0].astype(np.int64)
    for column in (1, 2):
        key <<= widths[column]
        key |= rows[:, column]
    key.sort()
    found = np.empty_like(rows)
    for column in (2, 1):
        np.bitwise_and(key, (1 << widths[column]) - 1, out=found[:, column], casting="unsafe")
        key >>= widths[column]
    found[:, 0] = key
    return found


class Result:
    """What a query found, on the host.

    Attributes:
        pairs: Object pairs asked, int32 (p, 2).
        any: Whether each pair intersects, bool (p,).
        count: Intersecting face pairs of each, int64 (p,); None for output "any".
        faces: (pair, face of the pair's first object, face of its second), int32 (k, 3), sorted; None unless output
            is "faces" or "contacts".
        contacts, pair_contacts: Structured arrays (k,) and (p,), see `warp_abtree.query.contacts`; None unless
            output is "contacts".
        apart: Whether each pair is proved farther apart than `within`, bool (p,); None without within.
        node_tests, triangle_tests, float64_tests, exact_tests: Work done for each pair, int64 (p,): pairs of boxes,
            pairs of faces, those of them that float32 left open, and of these those that took exact arithmetic.
    """

    node_tests: np.ndarray
    triangle_tests: np.ndarray
    float64_tests: np.ndarray
    exact_tests: np.ndarray

    def __init__(self, pairs, output, pair_demand, pair_room, hits, near=None):
        self.pairs = pairs
        self._pair_demand, self._pair_room = pair_demand, pair_room
        self._hit_demand, self._hit_room = 0, len(hits.face)
        self._unsure_room = len(hits.unsure)
        p = len(pairs)
        self.any = hits.any_hit.numpy()[:p] != 0
        # Any: who asked for them knows that they are not None.
        self.apart: Any = None if near is None else near.any_hit.numpy()[:p] == 0
        # On the CPU numpy() shares the memory that the next launch writes.
        for name in COUNTERS:
            setattr(self, name, getattr(hits, name).numpy()[:p].copy())
        self.count: Any = hits.count.numpy()[:p].copy() if output != "any" else None
        self.faces: Any = None
        self.contacts: Any = None
        self.pair_contacts: Any = None
        if output == "faces" and self.count is not None:
            self._hit_demand = int(self.count.sum())
            faces = hits.face.numpy()[: min(self._hit_demand, self._hit_room)].reshape(-1, 3)
            self.faces = sort_rows(faces)

    def check(self):
        """Raise where anything was lost.

        Raises:
            CapacityError: A buffer overflowed; the message names the demand.
        """
        if self._pair_demand > self._pair_room:
            raise CapacityError(
                f"the broad phase found {self._pair_demand} pairs, the query has room for {self._pair_room}"
            )
        unsure = int(self.float64_tests.sum())
        if self._unsure_room and unsure > self._unsure_room:
            raise CapacityError(
                f"{unsure} face pairs need more than float32, the query has room for {self._unsure_room}: "
                f"make it with unsure_capacity={unsure}"
            )
        if self._hit_demand > self._hit_room:
            raise CapacityError(
                f"{self._hit_demand} face pairs intersect, the query has room for {self._hit_room}: "
                f"make it with capacity={self._hit_demand}"
            )


class Query:
    """Intersection of many object pairs as an operator: allocates once, launches many times.

    `launch()` only launches, so that a CUDA graph can capture it, the first launch too. Objects added to the scene ask
    for a new query; so do pairs filtered out of it, where the query runs the broad phase. A captured graph holds until
    arrays that it uses are replaced: by these, by a change of LODs that takes more tree states than the scene had room
    for, and by a buffer that grows. `result()` refuses what a stale graph has left. Keep the query as long as its
    graphs.

    Args:
        scene: `Scene` whose poses and LODs hold at the time of each launch.
        output: "any", "count" or "faces".
        pairs: Object pairs to ask, (p, 2); None runs the broad phase in every launch.
        capacity: Face pairs that `faces` has room for.
        pair_capacity: Pairs that there is room for; by default those given, or a guess for the broad phase.
        precision: "exact": the sign of every determinant is right. "float64", "float32": the sign of the rounded one.
        within: Distances [world units], one for all pairs or (p,) beside given pairs: ask also which pairs are farther
            apart. The proof covers all rounding: pairs beyond by less than about 1e-13 of their size stay unproved, by
            less than 6 s where a rotation is off orthonormal by s, and all for distances from 2^1000 on.
        unsure_capacity: Face pairs that there is room for between float32 and the later stages; not needed on the CPU.

    Attributes:
        hits: Device arrays of the last launch (`kernels.faces.Hits`), faces in no order.
        pairs, pair_count: The pairs asked, device vec2i and int32 (1,).
        near: As `hits` for `within`: any_hit is 0 where a pair is proved apart; None without within.
    """

    pairs: wp.array
    pair_poses: wp.array
    within: wp.array  # where asked
    broad_phase: BroadPhase | None

    def __init__(
        self,
        scene,
        output="faces",
        pairs=None,
        capacity=None,
        pair_capacity=None,
        precision="exact",
        within=None,
        unsure_capacity=None,
    ):
        check_request(output, precision)
        check_device(scene.device, f"making a {type(self).__name__}")
        if within is not None:
            within = check_within(within, None if pairs is None else len(scene.check_pairs(pairs)))
        if capacity is not None:
            capacity = whole_number(capacity, "capacity", 1, LIST_MAX)
        if pair_capacity is not None:
            pair_capacity = whole_number(pair_capacity, "pair_capacity", 1, PAIRS_MAX)
        if unsure_capacity is not None:
            unsure_capacity = whole_number(unsure_capacity, "unsure_capacity", 1, LIST_MAX)
        self._regime = current_regime()
        self.scene = scene
        self.output = output
        self.precision = precision
        self.arrays: tuple[ModelArrays, StateArrays, ObjectArrays] = scene.arrays()
        self.device = scene.device
        self._torn = False
        self.guard = LaunchGuard(
            self.device, self.arrays[1].generation, self.arrays[2].filter_generation if pairs is None else None
        )
        self.broad_phase = None
        if pairs is None:
            models, states, objects = self.arrays
            self._excluded = scene.excluded_keys()
            self.broad_phase = BroadPhase(models, states, objects, self._excluded, pair_capacity)
            self.broad_phase.guard = self.guard
            self.pairs, self.pair_count = self.broad_phase.pairs, self.broad_phase.pair_count
        else:
            self.pair_count = wp.zeros(1, dtype=wp.int32, device=self.device)
            self.pairs = wp.empty(pair_capacity or 0, dtype=wp.vec2i, device=self.device)
        self.hits = faces.Hits()
        self.hits.total = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.hits.unsure_total = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.hits.hard_total = wp.zeros(1, dtype=wp.int32, device=self.device)
        self.near = None if within is None else self._make_near()
        self.work = share.Work()
        boxes = share.MAILBOX_COUNT if self.uses_warps() else 0
        self.work.counter = wp.zeros(share.COUNTER_COUNT, dtype=wp.int32, device=self.device)
        self.work.flag = wp.zeros(boxes, dtype=wp.int32, device=self.device)
        self.work.owner = wp.empty(boxes, dtype=wp.vec2i, device=self.device)
        self.work.item = wp.empty(boxes * share.MAILBOX_ITEMS, dtype=wp.int64, device=self.device)
        self.work.record = self.guard.record()
        self.guard.write_to(self.work.record)
        self._no_distance = wp.empty(0, dtype=wp.float64, device=self.device)
        self._within = within
        self._resize_unsure((unsure_capacity or UNSURE_CAPACITY) if self.uses_warps() else 0)
        self._take_pairs(self.pairs)
        if pairs is not None:
            self.set_pairs(pairs)
        self.resize((capacity or max(1024, 16 * len(self.pairs))) if output == "faces" else 0)

    def set_pairs(self, pairs, within=None):
        """Ask other pairs from now on, in the room there is if they fit; within None keeps the distances.

        Raises:
            ValueError: Bad pairs or distances, a query that runs the broad phase, or distances for one made without.
        """
        if self.broad_phase is not None:
            raise ValueError("this query takes its pairs from the broad phase")
        check_device(self.device, "giving a query other pairs")
        self._check_whole()
        pairs = self.scene.check_pairs(pairs)
        if within is not None and self.near is None:
            raise ValueError("this query was made without within")
        if self.near is not None:
            within = check_within(self._within if within is None else within, len(pairs))
        # What may fail for lack of memory comes before anything that changes the query.
        rows = wp.array(pairs, dtype=wp.vec2i, device=self.device)
        distances = self._upload_within(within)
        made = []
        if len(pairs) > len(self.pairs):
            made = self._make_room(wp.empty(len(pairs), dtype=wp.vec2i, device=self.device))
        with self._changing():
            if made:
                self._replace(made)
            self.guard.forget()
            if len(pairs):
                wp.copy(self.pairs, rows, count=len(pairs))
            self.pair_count.fill_(len(pairs))
            self._given = pairs
            self._within = within
            self._fill_within(distances)

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
            for owner, name, array in made:
                setattr(owner, name, array)

    def _pair_arrays(self, room: int) -> list:
        """Return (owner, attribute, new array) of whatever has an entry a pair."""
        made = [(self, "pair_poses", wp.empty(room, dtype=pose.PairPose, device=self.device))]
        for hits in (self.hits, self.near):
            if hits is not None:
                made.append((hits, "any_hit", wp.zeros(room, dtype=wp.int32, device=self.device)))
                for name in ("count", *COUNTERS):
                    made.append((hits, name, wp.zeros(room, dtype=wp.int64, device=self.device)))
        if self.near is not None:
            made.append((self, "within", wp.empty(room, dtype=wp.float64, device=self.device)))
        return made

    def _make_room(self, pairs) -> list:
        """Return (owner, attribute, new array) of a device list of pairs, and of whatever belongs to a pair."""
        if len(pairs) > PAIRS_MAX:
            raise CapacityError(f"{len(pairs)} object pairs at a time, more than 2^26; ask them in parts")
        made = [*self._pair_arrays(len(pairs)), (self, "pairs", pairs)]
        if self.broad_phase is not None:
            made.append((self.broad_phase, "pairs", pairs))
        return made

    def _take_pairs(self, pairs):
        """Take a device list of pairs and make room for whatever belongs to a pair: all of it, or nothing changes."""
        made = self._make_room(pairs)
        with self._changing():
            self._replace(made)
            if self.broad_phase is not None:
                self._fill_within(None)

    def _make_near(self):
        near = faces.Hits()
        near.total = near.unsure_total = near.hard_total = wp.zeros(1, dtype=wp.int32, device=self.device)
        return near

    def _upload_within(self, within):
        """Return distances of pairs on the device, None where there are none or one for all."""
        if self.near is None or within.ndim == 0 or not len(within):
            return None
        return wp.array(within, dtype=wp.float64, device=self.device)

    def _fill_within(self, distances):
        if distances is not None:
            wp.copy(self.within, distances, count=len(distances))
        elif self.near is not None and self._within.ndim == 0:
            self.within.fill_(float(self._within))

    def _resize_unsure(self, capacity: int):
        hard = capacity if self.precision == "exact" else 0
        made = [("unsure", capacity), ("hard", hard)]
        self._replace([(self.hits, name, wp.empty(room, dtype=wp.vec3i, device=self.device)) for name, room in made])

    def uses_warps(self) -> bool:
        """Return whether warps work on the pairs; on the CPU each thread takes one pair after the other."""
        warps = self._regime.warps
        return self.device.is_cuda if warps is None else warps

    def resize(self, capacity: int):
        """Make room for a number of intersecting face pairs."""
        self._replace([(self.hits, "face", wp.empty(capacity, dtype=wp.vec3i, device=self.device))])

    def launch(self):
        """Run broad phase (unless pairs were given) and narrow phase. Launches only.

        Raises:
            RuntimeError: The scene's objects changed since the query was made, or its filter where the broad phase
                runs; or a change of the query's buffers was interrupted.
        """
        self._check_scene()
        with self.guard.launching(self):
            self._launch()

    def _launch(self):
        if self.broad_phase is not None:
            self.broad_phase.launch()
        self.prove_apart()
        self.traverse()

    def _check_scene(self):
        check_device(self.device)
        self._check_whole()
        if self.arrays != self.scene.arrays():
            raise RuntimeError("objects were added to the scene since this query was made; make a new one")
        if self.broad_phase is not None and len(self.scene.excluded_keys()) > len(self._excluded):
            raise RuntimeError("pairs were filtered out of the scene since this query was made; make a new one")

    def prove_apart(self):
        """Find the pairs that are not proved farther apart than `within`, if that is asked. Launches only."""
        room = len(self.pairs)
        if self.near is None or room == 0:
            return
        self._launch_traversal(self.within, self.near, int(faces.WITHIN), int(faces.OUTPUT_ANY))

    def _launch_traversal(self, within, hits, mode, output):
        pools = [arrays.pool for arrays in self.arrays]
        room = len(self.pairs)
        parts_max = self._regime.warps_per_pair
        inputs = [parts_max, output, *pools, self.pair_count, self.pairs, within]
        self.guard.record()
        inputs += [self.pair_poses, hits, self.work]
        dim = max(room, len(self.work.flag))
        wp.launch(relate.relate_pair_kernel, dim=dim, inputs=inputs, device=self.device)
        inputs = [output, *pools[:2], self.pair_count, self.pair_poses, hits]
        if not self.uses_warps():
            cores = current_regime().cpu_threads or core_count()
            # A launch on a further core costs some 50 us: the work of many pairs apart, of less than one in contact.
            least = 32 if output == int(faces.OUTPUT_ANY) else 1
            launch_on_cores(traverse.thread_traversal(mode), room, [*inputs, self.work], self.device, cores, least)
            return
        # More than there are parts: those that find none wait for shares.
        warps = max(room, int(4 * parts_max * math.sqrt(room)) + 1)
        warps = min(warps, WARPS_MAX, WARPS_A_PROCESSOR * self.device.sm_count) if self.device.is_cuda else 1
        wp.launch(
            traverse.warp_traversal(EXACT if mode == FLOAT64 else mode, output == int(faces.OUTPUT_ANY)),
            dim=warps * (WARP_SIZE if self.device.is_cuda else 1),
            inputs=[parts_max, self._stack_length(), *inputs, self.work],
            block_dim=WARP_SIZE,
            device=self.device,
        )

    def _stack_length(self) -> int:
        length = self._regime.stack_length
        return STACK_LENGTH if length is None else min(length, STACK_LENGTH)

    def traverse(self):
        """Run the narrow phase over the pairs in place. Launches only."""
        if not len(self.pairs):
            return
        output, mode = int(OUTPUTS[self.output]), int(PRECISIONS[self.precision])
        self._launch_traversal(self._no_distance, self.hits, mode, output)
        if len(self.hits.unsure):
            first = settle.filter_faces_kernel if mode == EXACT else settle.settle_traversal(mode)
            passes = [(first, FILTER_WARPS_A_PROCESSOR)]
            if mode == EXACT:
                passes.append((settle.settle_hard_kernel, EXACT_WARPS_A_PROCESSOR))
            models, states = (arrays.pool for arrays in self.arrays[:2])
            for kernel, warps in passes:
                threads = warps * self.device.sm_count * WARP_SIZE if self.device.is_cuda else 1
                inputs = [threads, output, models, states, self.pair_poses, self.hits]
                wp.launch(kernel, dim=threads, inputs=inputs, block_dim=WARP_SIZE, device=self.device)

    def result(self) -> Result:
        """Return the results of the last launch on the host, sorted. Waits for the device.

        Raises:
            RuntimeError: There are none: nothing was launched, a launch was interrupted, or it was the replay of a
                graph whose arrays were replaced.
        """
        pairs, demand = self._asked()
        return Result(pairs, self.output, demand, len(self.pairs), self.hits, self.near)

    def _asked(self):
        """Return the pairs of the last launch on the host, those there was room for, and how many there were.

        Raises:
            RuntimeError: As `result`.
        """
        check_device(self.device, "reading results")
        self._check_whole()
        if len(self.pairs):  # without room for pairs there are no launches
            self.guard.check()
        if self.broad_phase is None:
            return self._given, len(self._given)
        found = self.broad_phase.count_found()
        return self.pairs.numpy()[: min(found, len(self.pairs))].reshape(-1, 2).copy(), found

    def run(self) -> Result:
        """Launch, grow buffers that were too small, and return the whole result. Waits for the device."""
        check_device(self.device, "Query.run (launch can)")
        self._check_scene()
        with self.guard.launching(self):
            self._launch()
            if self.broad_phase is not None and self.broad_phase.count_found() > len(self.pairs):
                self._take_pairs(wp.empty(self.broad_phase.count_found(), dtype=wp.vec2i, device=self.device))
                self._launch()
            self.grow_unsure()
            if self.output == "faces" and self._sum(self.hits.count) > len(self.hits.face):
                self.resize(self._sum(self.hits.count))
                self.traverse()
        result = self.result()
        result.check()
        return result

    def grow_unsure(self):
        """Make room for the face pairs that wait, as far as there can be, and traverse again until all find it."""
        # How many wait varies for `any`, where the first hit of a pair ends its traversal.
        while 0 < len(self.hits.unsure) < min(LIST_MAX, demand := self._sum(self.hits.float64_tests)):
            self._resize_unsure(min(2 * demand, LIST_MAX))
            self.traverse()

    @staticmethod
    def _sum(counts) -> int:
        return int(counts.numpy().sum())
