"""Candidate object pairs from posed root boxes.

Worlds never mix, static objects never pair with static ones, and collision groups and masks must allow a pair.
"""

from weakref import proxy

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.radix_sort import radix_sort
from warp_abtree.checks.regime import current_regime
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.intersect import box_sweep, box_tiles
from warp_abtree.kernels.intersect import broad_phase as kernels
from warp_abtree.query.commands import Commands
from warp_abtree.query.request import CapacityError
from warp_abtree.query.sorting import sort_rows
from warp_abtree.state.batch import Batch
from warp_abtree.state.generation import LaunchGuard

EVERY_WORLD = -1
# Tasks of warps at most, of sorted objects, but for what their number needs.
SORTED_TASKS = 2**20
# Warps that share the objects of a tile at most, and all warps then; of sorted objects, of which most find nothing.
# Each waits for one object after the other. Of one task they would find pairs in an order that changes.
SHARING_WARPS, WARPS_AT_ONCE, SORTED_WARPS = 8, 2**13, 2**15
# Launches before a sort of objects: boxes, their bounds, and keys.
SORT_AFTER = 3


def broad_phase_kernels(device) -> list:
    """Return the kernels of a broad phase, as `loading` takes them."""
    by_warps = current_regime().uses_warps(device)
    finding = (box_tiles.find_tile_pair_kernel, WARP_SIZE) if by_warps else (box_sweep.sweep_pair_kernel, 256)
    return [finding, (kernels.pose_box_kernel, 256)]


class PosedBoxes:
    """Boxes of objects where they stand, for a `BroadPhase`.

    Args:
        batch: `Batch` of the objects.

    Attributes:
        reach: By how much each object's box is wider on all sides [world units]: the length of x, y, z and w, device
            vec4d (n,), read by each launch; (0,) for not at all.
        wide: By how much all boxes are wider at least [world units].
    """

    def __init__(self, batch: Batch):
        self._batch, self.wide = batch, 0.0
        self.reach = wp.empty(0, dtype=wp.vec4d, device=batch.device)

    def given(self) -> tuple:
        """Return the numbers that they depend on, by which launches are recorded anew."""
        return (self.wide,)

    def make(self, launch, guard: LaunchGuard, boxes: kernels.PosedBounds):
        """Make the launch that writes the boxes."""
        inputs = [self._batch.trees, guard.record(), self.wide, self.reach, boxes]
        return launch(kernels.pose_box_kernel, dim=len(boxes.lower), inputs=inputs, device=self._batch.device)


def count_others(group: np.ndarray, tile: int, shared_group: int) -> np.ndarray:
    """Return how many tiles each tile is compared with: those from itself to the end of its last group.

    Args:
        group: Group of each object in the order of tiles, rising.
        tile: Objects of a tile.
        shared_group: The group that pairs with all, -1 or the first.
    """
    first = np.arange(0, len(group), tile)
    last = np.minimum(first + tile, len(group)) - 1
    end = np.searchsorted(group, group[last], side="right")
    end = np.where(group[first] == shared_group, len(group), end)
    return -(-end // tile) - np.arange(len(first))


def count_possible(group: np.ndarray, shared_group: int) -> int:
    """Return how many pairs there are at most of objects of one group, or of which one is of the shared group, -1 for
    none."""
    sizes = np.bincount(group)
    shared = int(sizes[shared_group]) if shared_group >= 0 else 0
    return int((sizes * (sizes - 1)).sum()) // 2 + shared * (len(group) - shared)


def list_tasks(others: np.ndarray, most: int) -> np.ndarray:
    """Return what warps compare, int32 (t, 3): a tile, the first of the others, and how many, so many at most."""
    tasks = -(-others // most)
    row = np.repeat(np.arange(len(others)), tasks)
    skipped = most * (np.arange(tasks.sum()) - np.repeat(np.cumsum(tasks) - tasks, tasks))
    return np.stack([row, row + skipped, np.minimum(most, others[row] - skipped)], 1).astype(np.int32)


class TileSearch:
    """Search for pairs by warps, in tiles of objects; of large groups along a curve.

    Args:
        broad_phase: `BroadPhase`.
        group: Group of each object, NumPy int32 (n,).

    Attributes:
        in_order: Whether it lists pairs in their order, where that is asked.
    """

    def __init__(self, broad_phase: "BroadPhase", group: np.ndarray):
        self._broad_phase, self.device, count = proxy(broad_phase), broad_phase.device, len(group)
        self.tiles, self._lanes = box_tiles.Tiles(), WARP_SIZE if broad_phase.device.is_cuda else 1
        order, most = np.argsort(group, kind="stable").astype(np.int32), 1
        others = count_others(group[order], self._lanes, broad_phase.filter.shared_group)
        self.sorts, shared = others.sum() > current_regime().tile_tasks, broad_phase.filter.shared_group >= 0
        # Objects of every world meet those of others in no order.
        self.in_order = broad_phase.sorts and not self.sorts and not (shared and (np.diff(order) < 0).any())
        if not self.sorts:
            self.tiles.order = wp.array(order, dtype=wp.int32, device=self.device)
        else:
            # Few enough to be launched, many enough to share the work.
            most = self._lanes * max(1, -(-int(others.sum()) // (self._lanes * SORTED_TASKS)))
            self._key = wp.empty(2 * count, dtype=wp.int64, device=self.device)
            broad_phase.bounds.ends = wp.empty(6, dtype=wp.float32, device=self.device)
            self.tiles.order = wp.empty(2 * count, dtype=wp.int32, device=self.device)
        self._tasks = wp.array(list_tasks(others, most), dtype=wp.vec3i, device=self.device)
        self._key_bits = box_tiles.CURVE_BITS + int(group.max(initial=0)).bit_length()
        self._tile_count = len(others)
        boxed = self._tile_count if self.sorts else 0
        self.tiles.lower, self.tiles.upper = (wp.empty(boxed, dtype=wp.vec3, device=self.device) for _ in range(2))
        if self.in_order:
            starts = np.concatenate([[0], np.cumsum(others)])
            self.tiles.place = wp.array(np.argsort(order), dtype=wp.int32, device=self.device)
            self.tiles.task = wp.array(starts, dtype=wp.int32, device=self.device)
            self.tiles.meets = wp.zeros(len(self._tasks) * self._lanes, dtype=wp.int32, device=self.device)
            counts = count + -(-count // int(box_tiles.COUNT_CHUNK))
            broad_phase.bounds.first_count = wp.zeros(counts, dtype=wp.int32, device=self.device)

    def make(self, launch) -> list:
        """Make the launches that find pairs of boxes."""
        found, count, made = self._broad_phase, len(self._broad_phase.lower), []
        warps = {"device": self.device, "block_dim": WARP_SIZE}
        if self.sorts:
            step = self._lanes * max(1, min(self._tile_count, 4 * self.device.sm_count if self.device.is_cuda else 1))
            inputs = [found.filter, found.bounds, self.tiles.order, self._key]
            made.append(launch(box_tiles.bound_middle_kernel, dim=step, inputs=[step, found.bounds], **warps))
            made.append(launch(box_tiles.make_curve_key_kernel, dim=count, inputs=inputs, **warps))
            dim = self._lanes * self._tile_count
            made.append(launch(box_tiles.bound_tile_kernel, dim=dim, inputs=[found.bounds, self.tiles], **warps))
        pool = found.batch.objects.pool
        at_once, parts = SORTED_WARPS if self.sorts else WARPS_AT_ONCE, 1
        if self._lanes > 1 and len(self._tasks) > 1:
            parts = max(1, min(SHARING_WARPS, at_once // len(self._tasks)))
        inputs = [parts, self._tasks, found.filter, self.tiles, pool, found.bounds, found.pairs]
        dim = self._lanes * parts * len(self._tasks)
        made.append(launch(box_tiles.find_tile_pair_kernel, dim=dim, inputs=inputs, **warps))
        if self.in_order:
            inputs = [self._tasks, self.tiles, found.bounds, found.pairs, found.key]
            made.append(launch(box_tiles.list_tile_pair_kernel, dim=self._lanes * count, inputs=inputs, **warps))
        return made

    def sort(self):
        """Sort the objects along the curve. Launches only."""
        radix_sort(self._key, self.tiles.order, len(self._key) // 2, self._key_bits)


class SweepSearch:
    """Search for pairs by one thread of the CPU: sweep and prune in each group.

    Args:
        broad_phase, group: As for `TileSearch`.
    """

    in_order = False

    def __init__(self, broad_phase: "BroadPhase", group: np.ndarray):
        self._broad_phase, count = proxy(broad_phase), len(group)
        self.sweep = struct_of(
            box_sweep.Sweep,
            "cpu",
            start=np.concatenate([[0], np.cumsum(np.bincount(group))]),
            order=np.argsort(group, kind="stable"),
            place=np.zeros(count),
            rows=np.zeros(6 * (count + 16)),
            words=np.zeros(2 * count),
        )

    def make(self, launch) -> list:
        """Make the launch that finds pairs of boxes."""
        found = self._broad_phase
        inputs = [found.filter, self.sweep, found.batch.objects.pool, found.bounds, found.pairs]
        return [launch(box_sweep.sweep_pair_kernel, dim=1, inputs=inputs, device=found.device)]


class BroadPhase(DeviceMemory):
    """Broad phase of a batch: allocates once, launches many times.

    Args:
        capacity: Pairs that there is room for at first.
        sorts: Whether a launch sorts the pairs by their objects, so that nothing depends on the order in which it
            found them.
        boxes: What boxes the objects, by default `PosedBoxes`.
        guard: `LaunchGuard` of what launches it; None makes one.

    Attributes:
        pairs: (i, j), i < j, device vec2i (capacity,).
        key: i * 2^32 + j of each pair where they are sorted, device int64 (capacity,) or more; behind the last pair the
            greatest int64.
        boxes: As given.
        bounds: Boxes of the last launch, `kernels.intersect.broad_phase.PosedBounds`.
        lower, upper: Ends of these boxes, device vec3 (n,).
        pair_count: How many pairs were found, device int32 (1,); it keeps counting past the capacity.
        usual_room: Pairs that so many objects mostly have room for, whether there may be as many or not.
        filter: Which objects may be a pair, `kernels.intersect.broad_phase.PairFilter`.
    """

    pairs: wp.array
    key: wp.array
    order: wp.array

    def __init__(self, batch: Batch, capacity=None, sorts=False, boxes=None, guard: LaunchGuard | None = None):
        self.batch, self.sorts, self.boxes = batch, sorts, boxes or PosedBoxes(batch)
        self.device = device = batch.device
        check_device(device, "making a broad phase")
        count = batch.object_count
        worlds = batch.objects.pool.world.numpy()
        # What is in every world comes first.
        names, inverse = np.unique(worlds, return_inverse=True)
        group: np.ndarray = inverse.astype(np.int32).reshape(-1)
        shared, bits = 0 if len(names) and names[0] == EVERY_WORLD else -1, batch.objects.collision_bits
        given = {"shared_group": shared, "group": group, "excluded": batch.excluded, "collision_bits": bits}
        self.filter = struct_of(kernels.PairFilter, device, **given)
        corners = np.zeros((count, 3))
        self.bounds = struct_of(kernels.PosedBounds, device, lower=corners, upper=corners, pair_count=[0])
        self.lower, self.upper, self.pair_count = self.bounds.lower, self.bounds.upper, self.bounds.pair_count
        self.guard = guard or LaunchGuard(device, batch.states.generation, batch.filter_generation)
        self._commands = Commands()
        self.search: TileSearch | SweepSearch
        self.search = (TileSearch if current_regime().uses_warps(device) else SweepSearch)(self, group)
        self.usual_room = max(64, 4 * count)
        self.resize(capacity or max(1, min(self.usual_room, count_possible(group, self.filter.shared_group))))

    def resize(self, capacity: int):
        """Make room for a number of pairs."""
        for owner, name, array in self.make_arrays(capacity):
            setattr(owner, name, array)

    def make_arrays(self, capacity: int) -> list:
        """Return (owner, attribute, new array) of a list of pairs and of what sorts them."""
        made = [(self, "pairs", wp.empty(capacity, dtype=wp.vec2i, device=self.device))]
        if self.sorts and self.search.in_order:
            made.append((self, "key", wp.empty(capacity, dtype=wp.int64, device=self.device)))
        elif self.sorts:
            # The sort takes as much again as scratch.
            for name, dtype in {"key": wp.int64, "order": wp.int32}.items():
                made.append((self, name, wp.empty(2 * capacity, dtype=dtype, device=self.device)))
        return made

    def launch(self):
        """Box, search, and sort if asked. Launches only, so that a graph can capture it."""
        given = *self.guard.given(), self.pairs.ptr, self.boxes.given()
        launches = self._commands.find_callables("pairs", given, self.device, self._make_launches)
        for launch in launches[:SORT_AFTER]:
            launch()
        if isinstance(self.search, TileSearch) and self.search.sorts:
            self.search.sort()
        for launch in launches[SORT_AFTER:]:
            launch()
        if self.sorts and not self.search.in_order:
            self._sort()

    def _sort(self):
        room = len(self.pairs)
        inputs = [self.pair_count, self.pairs, self.order, self.key]
        wp.launch(kernels.make_pair_key_kernel, room, inputs, device=self.device)
        # The key behind all others has only ones among these bits.
        radix_sort(self.key, self.order, room, 32 + len(self.lower).bit_length())
        inputs = [self.key, self.pair_count, self.pairs]
        wp.launch(kernels.place_pair_kernel, room + 1, inputs, device=self.device)

    def _make_launches(self, launch) -> list:
        """Return what boxes the objects, and what finds pairs."""
        return [self.boxes.make(launch, self.guard, self.bounds), *self.search.make(launch)]

    def count_found(self) -> int:
        """Return how many pairs the last launch found; raise CapacityError for 2^31 or more. Waits for the device."""
        return self.check_found(int(self.pair_count.numpy()[0]))

    @staticmethod
    def check_found(found: int) -> int:
        """Return a number of pairs found; raise CapacityError for 2^31 or more."""
        if found < 0:
            raise CapacityError("the broad phase found 2^31 object pairs or more; use more worlds or fewer objects")
        return found

    def find(self, within=0.0) -> np.ndarray:
        """Return all pairs, int32 (p, 2), sorted, i < j. Waits for the device; buffers grow as needed.

        Args:
            within: Distance [world units] up to which objects count as a pair.
        """
        self.boxes.wide = 0.5 * within
        self.launch()
        found = self.count_found()
        if found > len(self.pairs):
            self.resize(found)
            self.launch()
        return sort_rows(self.pairs.numpy()[:found].reshape(-1, 2))
