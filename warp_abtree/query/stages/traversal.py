"""Traversal of object pairs, by warps or by threads of the CPU: launches, and the work that warps share."""

import math
from functools import partial
from typing import Any, NamedTuple

import warp as wp

from warp_abtree.checks.cpu_threads import launch_on_cores
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.contacts import near_search
from warp_abtree.kernels.distance import within
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect import (
    dual_tree,
    face_pairs,
    near_faces,
    relative_pose,
    simd,
    uncertain_pairs,
)
from warp_abtree.kernels.search import descent, item, load_balance, thread_search
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Rooms

# Warps that one multiprocessor runs at a time by their registers: of the traversal, of float64, of exact signs.
WARPS_A_PROCESSOR = 16
FILTER_WARPS_A_PROCESSOR, EXACT_WARPS_A_PROCESSOR = 20, 12
# So that each finds a slot for all that it gives away at once.
WARPS_MAX = load_balance.SLOT_COUNT // int(load_balance.DONATIONS_AT_ONCE)


class AskedHits(NamedTuple):
    """Traversal for face pairs that intersect, or are nearer than a gap.

    Attributes:
        mode, output: As for the kernels, `face_pairs` and `item` have them.
        reduced: Whether what is apart is reduced to slots: threads offer it to them, warps list it.
    """

    mode: int
    output: int
    reduced: bool = False

    def kernel(self, warps: bool):
        """Return the kernel that traverses."""
        if warps:
            return dual_tree.warp_traversal(self.mode, self.output == int(item.OUTPUT_ANY))
        return near_search.thread_near_search() if self.reduced else simd.thread_traversal(self.mode)

    def found(self, warps: bool, hits, slots):
        """Return what it writes."""
        if warps or not self.reduced:
            found = face_pairs.FoundHits()
        else:
            found = near_search.NearFound()
            found.slots = slots
        found.hits = hits
        return found

    def has_distances(self) -> bool:
        """Return whether boxes are widened."""
        return self.mode == int(face_pairs.GAP)

    def passes(self) -> list:
        """Return the passes over its lists: kernels, their warps a multiprocessor, threads of a block."""
        if self.mode not in (int(EXACT), int(face_pairs.GAP)):
            return [(uncertain_pairs.resolve_rounded_kernel, FILTER_WARPS_A_PROCESSOR, uncertain_pairs.RESOLVE_THREADS)]
        lists_near = self.mode == int(face_pairs.GAP) and not self.reduced
        return [
            (uncertain_pairs.float64_filter_kernel, FILTER_WARPS_A_PROCESSOR, uncertain_pairs.RESOLVE_THREADS),
            (uncertain_pairs.resolve_inexact_kernel, EXACT_WARPS_A_PROCESSOR, uncertain_pairs.RESOLVE_THREADS),
            *([(near_faces.find_near_kernel, EXACT_WARPS_A_PROCESSOR, WARP_SIZE)] if lists_near else []),
        ]


class AskedVisits(NamedTuple):
    """Traversal that visits face pairs not proved farther apart than a distance."""

    question: within.Question

    @property
    def output(self) -> int:
        """What it is called by the kernels."""
        return self.question.output

    def kernel(self, warps: bool):
        """Return the kernel that traverses."""
        return within.warp_within(self.question) if warps else within.thread_within(self.question)

    def found(self, warps: bool, hits, own):
        """Return what it writes."""
        found = within.found_struct(self.question.own)()
        found.hits, found.own = hits, own
        return found

    def has_distances(self) -> bool:
        """Return whether boxes are widened."""
        return True

    def passes(self) -> list:
        """Return none: each face pair is decided where it is visited."""
        return []


def traversal_kernels(device, regime, asked: AskedHits | AskedVisits) -> list:
    """Return the kernels of a traversal with block sizes, those first that take longest to compile."""
    warps = regime.uses_warps(device)
    searching = asked.kernel(warps), WARP_SIZE
    if not warps:
        return [searching]
    return [
        searching,
        *[(kernel, block) for kernel, _, block in reversed(asked.passes())],
        (relative_pose.relative_poses(asked.has_distances()), WARP_SIZE),
    ]


def _clear_slabs(memory: wp.array):
    memory.numpy()[:, : descent.SLAB_ZEROS] = 0.0


class Traversal:
    """Launches of a dual-tree traversal of an operator's pairs.

    Args:
        operator: `Operator`.
        is_any: Whether one hit a pair is enough.

    Attributes:
        work: `load_balance.Work`, the queue that warps share.
        slab_memory: Slabs of each thread of the CPU.
    """

    slab_memory: wp.array

    def __init__(self, operator: Operator, is_any: bool):
        self.operator, device, regime = operator, operator.device, operator.regime
        self._is_any = is_any
        self.work = work = load_balance.Work()
        slots = load_balance.SLOT_COUNT if operator.uses_warps() else 0
        # An early hit ends a pair, so that more warps ask in vain.
        work.warps_per_pair = max(1, regime.warps_per_pair // (2 if is_any else 1))
        work.counter = wp.zeros(load_balance.COUNTER_COUNT, dtype=wp.int32, device=device)
        work.flag = wp.zeros(slots, dtype=wp.int32, device=device)
        work.owner = wp.empty(slots, dtype=wp.vec2i, device=device)
        work.item = wp.empty(slots * load_balance.SLOT_ITEMS, dtype=wp.int64, device=device)
        work.small_faces = regime.small_faces
        work.record = operator.guard.record()
        operator.guard.write_to(work.record)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what each thread of the CPU keeps slabs in; the system gives it only what it touches."""
        threads = self.operator.threads(rooms.pairs)
        words = descent.slab_memory_words(int(self.operator.batch.models.depth.max())) if threads else 0
        clear = _clear_slabs if threads else None
        return [Array(self, "slab_memory", wp.float32, (threads, words), clear)]

    def warp_count(self) -> int:
        """Return the warps of a launch: more than units, where these are few, so that some wait for donations."""
        device, room = self.operator.device, self.operator.rooms.pairs
        if not device.is_cuda:
            return 1
        warps = max(room, int(self.work.warps_per_pair * max(4.0, math.sqrt(room))) + 1)
        return min(warps, WARPS_MAX, WARPS_A_PROCESSOR * device.sm_count)

    def stack_length(self) -> int:
        """Return how many items the stack of a warp holds."""
        length = self.operator.regime.stack_length
        return STACK_LENGTH if length is None else min(length, STACK_LENGTH)

    def _cores(self) -> int:
        # A further core costs some 50 us: many pairs of "any"; else a pair in contact takes the root of its faces.
        least = 32 if self._is_any else max(1, int(50 / math.sqrt(self.operator.batch.mean_faces)))
        # Each has memory for slabs: tests do not depend on which thread takes a pair.
        return self.operator.cores(least, len(self.slab_memory))

    def launch(self, name: str, asked: AskedHits | AskedVisits, within: wp.array, hits, beside: Any = None):
        """Launch relative poses, the traversal, and passes over uncertain face pairs.

        Args:
            name: Of the recorded launches.
            within: Distances by which boxes are wider [world units], device float64 (pair,); (0,) for none.
            hits: `Hits` to write.
            beside: What it writes beside them: `kernels.contacts.slots.Slots`, started, or what visits are given.
        """
        operator = self.operator
        make = partial(self._make, asked, within, hits, beside)
        if operator.device.is_capturing:
            operator.launch_all(name, make)
            return
        given, cores = operator.guard.given(), self._cores()
        if cores == 1 and not operator.uses_warps():
            for command in operator.commands.find(f"{name} alone", given, make):
                command.launch()
            return
        first, traversal, *passes = operator.commands.find(name, given, make)
        first.launch()
        launch_on_cores(traversal.launch, cores)
        for command in passes:
            command.launch()

    def _make(self, asked, within: wp.array, hits, beside, launch) -> list:
        """Make the launches of `launch`, see `Commands.find`."""
        warps = self.operator.uses_warps()
        made = self._make_warps if warps else self._make_threads
        found = asked.found(warps, hits, beside)
        return made(asked, within, hits, found, launch) + self._make_passes(asked, hits, launch)

    def _make_warps(self, asked, within: wp.array, hits, found, launch) -> list:
        operator, device = self.operator, self.operator.device
        posed = operator.batch.trees, operator.pair_batch
        self.work.warps = self.warp_count()
        # A warp a block: few pairs lie on as many multiprocessors.
        first = launch(
            relative_pose.relative_poses(len(within) > 0),
            dim=max(operator.rooms.pairs, len(self.work.flag)),
            inputs=[asked.output, posed[0], within, posed[1], hits, self.work],
            block_dim=WARP_SIZE,
            device=device,
        )
        traversal = launch(
            asked.kernel(True),
            dim=self.warp_count() * operator.lanes,
            inputs=[self.stack_length(), asked.output, *posed, found, self.work],
            block_dim=WARP_SIZE,
            device=device,
        )
        return [first, traversal]

    def _make_threads(self, asked, within: wp.array, hits, found, launch) -> list:
        """Make the launch in which a thread starts all pairs and traverses them, or one for each of the two."""
        operator, made = self.operator, []
        for starts, traverses in [(True, True)] if self._cores() == 1 else [(True, False), (False, True)]:
            steps = thread_search.ThreadSteps()
            steps.within, steps.starts, steps.traverses = within, starts, traverses
            inputs = [asked.output, operator.batch.trees, operator.regime.plain_tests, steps, operator.pair_batch]
            inputs += [self.slab_memory, found, self.work]
            made.append(launch(asked.kernel(False), dim=1, inputs=inputs, device=operator.device))
        return made

    def _make_passes(self, asked, hits, launch) -> list:
        operator, device, made = self.operator, self.operator.device, []
        if hits.uncertain is None or not len(hits.uncertain):
            return []
        for kernel, warps, block in asked.passes():
            threads = warps * device.sm_count * WARP_SIZE if device.is_cuda else 1
            output = [] if kernel is near_faces.find_near_kernel else [asked.output]
            inputs = [threads, *output, operator.batch.trees, operator.pair_batch, hits]
            made.append(launch(kernel, dim=threads, inputs=inputs, block_dim=block, device=device))
        return made
