"""ACTIVE-INTERSECT for a batch: `Query`."""

import math
from functools import partial
from typing import Any

import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.cpu_threads import cores_for, launch_on_cores
from warp_abtree.checks.kernel_loading import loading
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.inside.containment import find_contained_kernel
from warp_abtree.kernels.intersect import dual_tree, face_pairs, near_faces, relative_pose, simd, uncertain_pairs
from warp_abtree.kernels.io.results import BLOCK_DIM as PACK_DIM
from warp_abtree.kernels.io.results import pack_pair_kernel
from warp_abtree.kernels.search import load_balance
from warp_abtree.kernels.search.make_slabs import make_slab_kernel
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH
from warp_abtree.query.commands import Commands
from warp_abtree.query.readout import QueryReadout
from warp_abtree.query.request import LIST_MAX, OUTPUTS, PRECISIONS, check_capacity, check_request, check_within
from warp_abtree.query.result import Found, Result
from warp_abtree.query.sorting import first_sort
from warp_abtree.state.batch import Batch
from warp_abtree.state.generation import LaunchGuard

# Face pairs that the float32 stage leaves uncertain: about one in a hundred. The list grows as needed.
UNCERTAIN_ROOM = 65536
# Warps that one multiprocessor runs at a time by their registers: of the traversal, of float64, of exact signs.
WARPS_A_PROCESSOR = 16
FILTER_WARPS_A_PROCESSOR, EXACT_WARPS_A_PROCESSOR = 20, 12
# So that each finds a slot for all that it gives away at once.
WARPS_MAX = load_balance.SLOT_COUNT // int(load_balance.DONATIONS_AT_ONCE)


def _mode(precision, with_gap: bool) -> int:
    return int(face_pairs.GAP if with_gap else PRECISIONS[precision])


def _passes(precision, with_gap: bool) -> list:
    """Return the passes over the traversal's lists: kernels, their warps a multiprocessor, threads of a block."""
    if int(PRECISIONS[precision]) != int(EXACT):
        return [(uncertain_pairs.resolve_rounded_kernel, FILTER_WARPS_A_PROCESSOR, uncertain_pairs.RESOLVE_THREADS)]
    return [
        (uncertain_pairs.float64_filter_kernel, FILTER_WARPS_A_PROCESSOR, uncertain_pairs.RESOLVE_THREADS),
        (uncertain_pairs.resolve_inexact_kernel, EXACT_WARPS_A_PROCESSOR, uncertain_pairs.RESOLVE_THREADS),
        *([(near_faces.find_near_kernel, EXACT_WARPS_A_PROCESSOR, WARP_SIZE)] if with_gap else []),
    ]


class Query(QueryReadout):
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

    growth = 1  # room that `run` makes, over the demand

    def __init__(
        self, scene, output="faces", pairs=None, capacity=None, precision="exact", within=None, sort_pairs=False
    ):
        check_request(output, precision)
        check_device(scene.device, f"making a {type(self).__name__}")
        room = check_capacity(capacity)
        self._regime = current_regime()
        self.output, self.precision, self.device = output, precision, scene.device
        with loading(self.device, self._kernels(within is not None)):
            self.batch = batch = scene if isinstance(scene, Batch) else scene.batch()
            if self.uses_warps() and self._regime.slabs:
                batch.models.make_slabs()
        if pairs is not None:
            pairs = batch.check_pairs(pairs)
        if within is not None:
            within = check_within(within, None if pairs is None else len(pairs))
        self._take_gap(None if pairs is None else len(pairs))
        self._torn = False
        self._commands = Commands()
        self.guard = LaunchGuard(
            self.device, batch.states.generation, batch.filter_generation if pairs is None else None
        )
        self.broad_phase: Any = None
        self.pair_batch = asked = PairBatch()
        asked.launched = self.guard.launched
        if pairs is None:
            self._excluded_count = len(batch.excluded)
            self.broad_phase = self._make_broad_phase(room.pairs, sort_pairs)
            self.broad_phase.guard = self.guard
            self.broad_phase.wide = 0.0 if within is None else 0.5 * float(within)
            asked.pairs, asked.count = self.broad_phase.pairs, self.broad_phase.pair_count
        else:
            asked.count = wp.zeros(1, dtype=wp.int32, device=self.device)
            asked.pairs = wp.empty(room.pairs or 0, dtype=wp.vec2i, device=self.device)
        self.hits = self._make_hits(self._gap is not None)
        self.near = None if within is None else self._make_hits()
        self.work = self._make_work()
        self._no_distance = wp.empty(0, dtype=wp.float64, device=self.device)
        self._within = within
        self._resize_uncertain((room.uncertain or UNCERTAIN_ROOM) if self.uses_warps() else 0)
        self._take_pairs(self.pairs)
        if pairs is not None:
            self.set_pairs(pairs)
        self.resize((room.hits or max(1024, 16 * len(self.pairs))) if output == "faces" else 0)

    def _make_work(self):
        work, device = load_balance.Work(), self.device
        slots = load_balance.SLOT_COUNT if self.uses_warps() else 0
        # An early hit ends a pair, so that more warps ask in vain.
        work.warps_per_pair = max(1, self._regime.warps_per_pair // (2 if self.output == "any" else 1))
        work.counter = wp.zeros(load_balance.COUNTER_COUNT, dtype=wp.int32, device=device)
        work.flag = wp.zeros(slots, dtype=wp.int32, device=device)
        work.owner = wp.empty(slots, dtype=wp.vec2i, device=device)
        work.item = wp.empty(slots * load_balance.SLOT_ITEMS, dtype=wp.int64, device=device)
        work.small_faces = self._regime.small_faces
        work.record = self.guard.record()
        self.guard.write_to(work.record)
        return work

    def launch(self, between=None):
        """Run broad phase (unless pairs were given) and narrow phase. Launches only.

        Args:
            between: Called between the two, as to time them.

        Raises:
            RuntimeError: The scene's objects changed since the query was made, or its filter where the broad phase
                runs; or a change of the query's buffers was interrupted.
        """
        self._check_scene()
        with self.guard.launching(self):
            self._launch(between)
            self.finish()

    def _launch(self, between=None):
        if self.broad_phase is not None:
            self.broad_phase.launch()
            self._add_reaches()
        if between is not None:
            between()
        self.prove_apart()
        self.traverse()

    def _add_reaches(self):
        if self._reach is not None and len(self.pairs):
            inputs = [self.pair_batch, self._reach, self.hits.gap]
            self._repeat((), near_faces.add_reach_kernel, len(self.pairs), inputs)

    def finish(self, count: int | None = None):
        """Compute further outputs of the hits. Launches only.

        Args:
            count: How many hits there are; None does what there is room for, as a graph must.
        """

    def _check_scene(self):
        check_device(self.device)
        self._check_whole()
        self.batch.check("query")
        if self.broad_phase is not None and len(self.batch.excluded) > self._excluded_count:
            raise RuntimeError("pairs were filtered out of the scene since this query was made; make a new one")

    def prove_apart(self):
        """Find the pairs that are not proved farther apart than `within`, if that is asked. Launches only."""
        room = len(self.pairs)
        if self.near is None or room == 0:
            return
        inputs = self.within, self.near, int(face_pairs.WITHIN), int(face_pairs.OUTPUT_ANY)
        self._launch_search("within", partial(self._make_search, *inputs))

    def _launch_search(self, name: str, make):
        """Launch what `_make_search` makes: relative poses, the traversal, and passes over uncertain face pairs."""
        if self.device.is_capturing:
            self._launch_all(name, make)
            return
        given, cores = self.guard.given(), self._traversal_cores()
        if cores == 1 and not self.uses_warps():
            for command in self._commands.find(f"{name} alone", given, make):
                command.launch()
            return
        first, traversal, *passes = self._commands.find(name, given, make)
        first.launch()
        launch_on_cores(traversal.launch, cores)
        for command in passes:
            command.launch()

    def _traversal_cores(self) -> int:
        """Return how many cores share the traversal; a graph of the CPU has one."""
        if self.uses_warps() or self.device.is_capturing:
            return 1
        # A further core costs some 50 us: many pairs of "any"; else a pair in contact takes the root of its faces.
        least = 32 if self.output == "any" else max(1, int(50 / math.sqrt(self.batch.mean_faces)))
        # Each has memory for slabs: tests do not depend on which thread takes a pair.
        return cores_for(len(self.pairs), least, len(self.slab_memory))

    def _make_search(self, within, hits, mode, output, launch) -> list:
        """Make the launches that bring relative poses and traverse all pairs, see `Commands.find`."""
        room = len(self.pairs)
        if not self.uses_warps():
            return self._make_threads(within, hits, mode, output, launch)
        self.work.warps = self._warp_count()
        inputs = [output, self.batch.trees, within, self.pair_batch, hits, self.work]
        dim = max(room, len(self.work.flag))
        # A warp a block: few pairs lie on as many multiprocessors.
        kernel = relative_pose.relative_poses(len(within) > 0)
        first = launch(kernel, dim=dim, inputs=inputs, block_dim=WARP_SIZE, device=self.device)
        traversal = launch(
            dual_tree.warp_traversal(mode, output == int(face_pairs.OUTPUT_ANY)),
            dim=self._warp_count() * (WARP_SIZE if self.device.is_cuda else 1),
            inputs=[self._stack_length(), output, self.batch.trees, self.pair_batch, hits, self.work],
            block_dim=WARP_SIZE,
            device=self.device,
        )
        return [first, traversal]

    def _make_threads(self, within, hits, mode, output, launch) -> list:
        """Make the launch in which a thread starts all pairs and traverses them, or one for each of the two."""
        made = []
        for starts, traverses in [(True, True)] if self._traversal_cores() == 1 else [(True, False), (False, True)]:
            steps = relative_pose.ThreadSteps()
            steps.within, steps.starts, steps.traverses = within, starts, traverses
            inputs = [output, self.batch.trees, self._regime.plain_tests, steps, self.pair_batch]
            inputs += [self.slab_memory, hits, self.work]
            made.append(launch(simd.thread_traversal(mode), dim=1, inputs=inputs, device=self.device))
        return made

    def _warp_count(self) -> int:
        """Return the warps of a launch: more than units, where these are few, so that some wait for donations."""
        if not self.device.is_cuda:
            return 1
        room = len(self.pairs)
        warps = max(room, int(self.work.warps_per_pair * max(4.0, math.sqrt(room))) + 1)
        return min(warps, WARPS_MAX, WARPS_A_PROCESSOR * self.device.sm_count)

    def _stack_length(self) -> int:
        length = self._regime.stack_length
        return STACK_LENGTH if length is None else min(length, STACK_LENGTH)

    def traverse(self):
        """Run the narrow phase over the pairs in place. Launches only."""
        if not len(self.pairs):
            return
        self._launch_search("pairs", self._make_traversal)
        self._find_contained()

    def _find_contained(self):
        """Find what is inside solids, of the pairs whose surfaces do not meet. Launches only."""
        if self.batch.solids is None:
            return
        self.batch.solids.fit()
        self._launch_all("contained", self._make_contained)

    def _launch_all(self, name: str, make):
        """Launch what `make` lists, in this order, see `Commands.find`; into a graph, too."""
        # The generations are brought up to date first: kernels read the record.
        for launch in self._commands.find_callables(name, self.guard.given(), self.device, make):
            launch()

    def _make_contained(self, launch) -> list:
        solids: Any = self.batch.solids
        near = wp.empty(0, dtype=wp.int32, device=self.device) if self.near is None else self.near.any_hit
        inputs = [self.batch.trees, self.pair_batch, solids.pool, self.hits, near, self.contained]
        dim = {"dim": len(self.pairs), "block_dim": WARP_SIZE, "device": self.device}
        return [solids.prepare(launch, self.guard.launched), launch(find_contained_kernel, inputs=inputs, **dim)]

    def _make_traversal(self, launch) -> list:
        """Make the launches of the narrow phase."""
        output, within = int(OUTPUTS[self.output]), self._no_distance
        mode = _mode(self.precision, self._asked_gap is not None)
        if self._gap is not None:
            within = self.hits.gap
        made = self._make_search(within, self.hits, mode, output, launch)
        passes = _passes(self.precision, self._asked_gap is not None) if len(self.hits.uncertain) else ()
        for kernel, warps, block in passes:
            threads = warps * self.device.sm_count * WARP_SIZE if self.device.is_cuda else 1
            given = [] if kernel is near_faces.find_near_kernel else [output]
            inputs = [threads, *given, self.batch.trees, self.pair_batch, self.hits]
            made.append(launch(kernel, dim=threads, inputs=inputs, block_dim=block, device=self.device))
        return made

    @classmethod
    def kernels(cls, device, output, precision, with_gap: bool, with_distances: bool) -> list:
        """Return the kernels of the first launch, with block sizes, those first that take longest to compile."""
        within, mode, regime = int(face_pairs.WITHIN), _mode(precision, with_gap), current_regime()
        modes = [mode, *([within] if with_distances else [])]
        if regime.uses_warps(device):
            found: list = [dual_tree.warp_traversal(mode, mode == within or output == "any") for mode in modes]
            poses = [relative_pose.relative_poses(mode in (within, int(face_pairs.GAP))) for mode in modes]
            passes = [(kernel, block) for kernel, _, block in reversed(_passes(precision, with_gap))]
        else:
            found, passes, poses = [simd.thread_traversal(mode) for mode in modes], [], []
        further = [(make_slab_kernel, 256)] if regime.uses_warps(device) and regime.slabs else []
        if regime.packs(device):
            further += [(pack_pair_kernel, PACK_DIM), *(first_sort(device) if output == "faces" else [])]
        found, poses = ([(kernel, WARP_SIZE) for kernel in made] for made in (found, poses))
        return [*found, *passes, *poses, *further]

    def _kernels(self, with_distances: bool) -> list:
        return self.kernels(self.device, self.output, self.precision, self._asked_gap is not None, with_distances)

    def result(self, device: bool = False) -> Result:
        """Return the results of the last launch, sorted. Waits for the device.

        Args:
            device: Whether the arrays stay on the device, as Warp arrays that no later launch changes.

        Raises:
            RuntimeError: There are none: nothing was launched, a launch was interrupted, or it was the replay of a
                graph whose arrays were replaced.
        """
        return self._read(device)

    def run(self, device: bool = False) -> Result:
        """Launch, grow buffers that were too small, and return the whole result, as `result`. Waits for the device."""
        first = partial(self._launch_and_bring, self._launch) if self._repeats_calls(device) else None
        result = self._make_result(self._grow(partial(self._read_pairs, device), first=first), device)
        result.check()
        return result

    def grow(self, between=None):
        """Launch, and again with more room until nothing is lost. Waits for the device.

        Args:
            between: As for `launch`, which calls it once.

        Raises:
            CapacityError: More pairs or hits than there can be room for.
            RuntimeError: As `launch`; or a graph is being captured.
        """
        self._grow(lambda: Found(self._read_totals()), between)

    def _grow(self, read, between=None, first=None) -> Found:
        """Launch as `grow` and return what `read` finds of the last launch; `first` does both the first time."""
        check_device(self.device, f"{type(self).__name__}.run (launch can)")
        self._check_scene()
        with self.guard.launching(self):
            if first is None:
                self._launch(between)
            found = read() if first is None else first()
            if found.totals.pairs > len(self.pairs):
                self._take_pairs(wp.empty(self.growth * found.totals.pairs, dtype=wp.vec2i, device=self.device))
                self._launch()
                found = read()
            found = self._grow_uncertain(read, found)
            if found.totals.hits > len(self.hits.face):
                self.resize(self.growth * found.totals.hits)
                self.traverse()
                found = read()
            self.finish(found.totals.hits)
        return found

    def grow_uncertain(self):
        """Make room for the face pairs that wait, as far as there can be, and launch again until all find it."""

        def read():
            return Found(self._read_totals())

        if self._grow_uncertain(read, first := read()) is not first:
            self.finish()

    def _grow_uncertain(self, read, found: Found) -> Found:
        # How many wait varies for `any`, where the first hit of a pair ends its traversal.
        while 0 < len(self.hits.uncertain) < min(LIST_MAX, found.totals.uncertain):
            self._resize_uncertain(min(2 * found.totals.uncertain, LIST_MAX))
            self.traverse()
            found = read()
        return found
