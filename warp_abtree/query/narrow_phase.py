"""ACTIVE-INTERSECT for a batch: `Query`."""

import math

import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.traversal import dual_tree, face_pairs, load_balance, relative_pose, simd, uncertain_pairs
from warp_abtree.kernels.traversal.warp_stack import STACK_LENGTH, WARP_SIZE
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.buffers import QueryBuffers
from warp_abtree.query.cpu_threads import RecordedLaunches, core_count, launch_on_cores
from warp_abtree.query.request import LIST_MAX, OUTPUTS, PRECISIONS, check_capacity, check_request, check_within
from warp_abtree.query.result import Result
from warp_abtree.state.batch import Batch
from warp_abtree.state.generation import LaunchGuard

# Face pairs that the float32 stage leaves uncertain: about one in a hundred. The list grows as needed.
UNCERTAIN_ROOM = 65536
# Warps that one multiprocessor runs at a time by their registers: of the traversal, of float64, of exact signs.
WARPS_A_PROCESSOR = 16
FILTER_WARPS_A_PROCESSOR, EXACT_WARPS_A_PROCESSOR = 20, 12
# So that each finds a slot for all that it gives away at once.
WARPS_MAX = load_balance.SLOT_COUNT // int(load_balance.DONATIONS_AT_ONCE)

EXACT = int(PRECISIONS["exact"])


def batch_of(source) -> Batch:
    """Return a `Batch`, or that of a scene."""
    return source if isinstance(source, Batch) else source.batch()


class Query(QueryBuffers):
    """Intersection of many object pairs as an operator: allocates once, launches many times.

    `launch()` only launches, so that a CUDA graph can capture it, the first launch too. Objects added to the scene ask
    for a new query; so do pairs filtered out of it, where the query runs the broad phase. A captured graph holds until
    arrays that it uses are replaced: by these, by a change of LODs that takes more tree states than the scene had room
    for, and by a buffer that grows. `result()` refuses what a stale graph has left. Keep the query as long as its
    graphs.

    Args:
        scene: `Scene` or `Batch` whose poses and LODs hold at the time of each launch.
        output: "any", "count" or "faces".
        pairs: Object pairs to query, (p, 2); None runs the broad phase in every launch.
        capacity: `Buffers`, or the face pairs that `faces` has room for.
        precision: "exact": the sign of every determinant is right. "float32": the sign of the rounded one.
        within: Distances [world units], one for all pairs or (p,) beside given pairs: tell also which pairs are farther
            apart. The proof covers all rounding: pairs beyond by less than about 1e-13 of their size stay unproved, by
            less than 6 s where a rotation is off orthonormal by s, and all for distances from 2^1000 on.

    Attributes:
        batch: `Batch` that is queried.
        hits: Device arrays of the last launch (`kernels.traversal.face_pairs.Hits`), faces in no order.
        pairs, pair_count: The pairs queried, device vec2i and int32 (1,).
        near: As `hits` for `within`: any_hit is 0 where a pair is proved apart; None without within.

    Raises:
        ValueError: An unknown output or precision, bad pairs or distances, a capacity out of range, an empty scene.
        RuntimeError: A graph is being captured.
    """

    result_type: type[Result] = Result
    growth = 1  # room that `run` makes, over the demand

    def __init__(self, scene, output="faces", pairs=None, capacity=None, precision="exact", within=None):
        check_request(output, precision)
        check_device(scene.device, f"making a {type(self).__name__}")
        room = check_capacity(capacity)
        self.batch = batch = batch_of(scene)
        if pairs is not None:
            pairs = batch.check_pairs(pairs)
        if within is not None:
            within = check_within(within, None if pairs is None else len(pairs))
        self._regime = current_regime()
        self.output, self.precision = output, precision
        self.device = batch.device
        self._torn = False
        self.guard = LaunchGuard(
            self.device, batch.states.generation, batch.filter_generation if pairs is None else None
        )
        self.broad_phase = None
        if pairs is None:
            self._excluded_count = len(batch.excluded)
            self.broad_phase = BroadPhase(batch, room.pairs)
            self.broad_phase.guard = self.guard
            self.pairs, self.pair_count = self.broad_phase.pairs, self.broad_phase.pair_count
        else:
            self.pair_count = wp.zeros(1, dtype=wp.int32, device=self.device)
            self.pairs = wp.empty(room.pairs or 0, dtype=wp.vec2i, device=self.device)
        self.hits = self._make_hits()
        self.near = None if within is None else self._make_hits()
        self.work = self._make_work()
        self._recorded = RecordedLaunches()
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
        work.record = self.guard.record()
        self.guard.write_to(work.record)
        return work

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
        self.batch.check("query")
        if self.broad_phase is not None and len(self.batch.excluded) > self._excluded_count:
            raise RuntimeError("pairs were filtered out of the scene since this query was made; make a new one")

    def prove_apart(self):
        """Find the pairs that are not proved farther apart than `within`, if that is asked. Launches only."""
        room = len(self.pairs)
        if self.near is None or room == 0:
            return
        self._launch_traversal(self.within, self.near, int(face_pairs.WITHIN), int(face_pairs.OUTPUT_ANY))

    def _launch_traversal(self, within, hits, mode, output):
        pools = self.batch.pools
        room = len(self.pairs)
        inputs = [output, *pools, self.pair_count, self.pairs, within]
        self.guard.record()
        inputs += [self.pair_poses, hits, self.work]
        dim = max(room, len(self.work.flag))
        # A warp a block: few pairs lie on as many multiprocessors.
        kernel = relative_pose.relative_pose_kernel
        if self.device.is_cuda:
            wp.launch(kernel, dim=dim, inputs=inputs, block_dim=WARP_SIZE, device=self.device)
        else:
            self._recorded.launch(kernel, dim, inputs, self.device)
        inputs = [output, *pools[:2], self.pair_count, self.pair_poses]
        if not self.uses_warps():
            cores = current_regime().cpu_threads or core_count()
            # A launch on a further core costs some 50 us: the work of many pairs apart, of less than one in contact.
            least = 32 if output == int(face_pairs.OUTPUT_ANY) else 1
            inputs += [self._regime.plain_tests, self.slab_memory, hits, self.work]
            kernel = simd.thread_traversal(mode)
            if min(cores, room // least) > 1:
                launch_on_cores(kernel, room, inputs, self.device, cores, least)
            else:
                self._recorded.launch(kernel, 1, inputs, self.device)
            return
        # More than there are units, where these are few: idle warps wait for donations.
        units = int(self.work.warps_per_pair * max(4.0, math.sqrt(room))) + 1
        warps = max(room, units)
        warps = min(warps, WARPS_MAX, WARPS_A_PROCESSOR * self.device.sm_count) if self.device.is_cuda else 1
        wp.launch(
            dual_tree.warp_traversal(mode, output == int(face_pairs.OUTPUT_ANY)),
            dim=warps * (WARP_SIZE if self.device.is_cuda else 1),
            inputs=[self._stack_length(), *inputs, hits, self.work],
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
        if len(self.hits.uncertain):
            first = uncertain_pairs.float64_filter_kernel if mode == EXACT else uncertain_pairs.resolve_rounded_kernel
            passes = [(first, FILTER_WARPS_A_PROCESSOR)]
            if mode == EXACT:
                passes.append((uncertain_pairs.resolve_inexact_kernel, EXACT_WARPS_A_PROCESSOR))
            models, states, _ = self.batch.pools
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
        return self.result_type(self, *self._queried())

    def _queried(self):
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
        self.grow()
        result = self.result()
        result.check()
        return result

    def grow(self):
        """Launch, and again with more room until nothing is lost. Waits for the device.

        Raises:
            CapacityError: More pairs or hits than there can be room for.
            RuntimeError: As `launch`; or a graph is being captured.
        """
        check_device(self.device, f"{type(self).__name__}.run (launch can)")
        self._check_scene()
        with self.guard.launching(self):
            self._launch()
            if self.broad_phase is not None and self.broad_phase.count_found() > len(self.pairs):
                room = self.growth * self.broad_phase.count_found()
                self._take_pairs(wp.empty(room, dtype=wp.vec2i, device=self.device))
                self._launch()
            self.grow_uncertain()
            if self.output == "faces" and self._sum(self.hits.count) > len(self.hits.face):
                self.resize(self.growth * self._sum(self.hits.count))
                self.traverse()

    def grow_uncertain(self):
        """Make room for the face pairs that wait, as far as there can be, and traverse again until all find it."""
        # How many wait varies for `any`, where the first hit of a pair ends its traversal.
        while 0 < len(self.hits.uncertain) < min(LIST_MAX, demand := self._sum(self.hits.float64_tests)):
            self._resize_uncertain(min(2 * demand, LIST_MAX))
            self.traverse()

    @staticmethod
    def _sum(counts) -> int:
        return int(counts.numpy().sum())
