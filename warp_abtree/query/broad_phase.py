"""Candidate object pairs from posed root boxes.

Worlds never mix, static objects never pair with static ones, and collision groups and masks must allow a pair.
"""

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.kernels.intersect.broad_phase import (
    find_pair_kernel,
    make_pair_key_kernel,
    place_pair_kernel,
    pose_box_kernel,
)
from warp_abtree.query.commands import Commands
from warp_abtree.query.request import CapacityError
from warp_abtree.state.batch import Batch
from warp_abtree.state.generation import LaunchGuard

EVERY_WORLD = -1


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

    def make(self, launch, guard: LaunchGuard, lower, upper):
        """Make the launch that writes lower and upper bounds of the boxes."""
        inputs = [self._batch.trees, guard.record(), self.wide, self.reach, lower, upper]
        return launch(pose_box_kernel, dim=len(lower), inputs=inputs, device=self._batch.device)


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
        key: i * 2^32 + j of each pair where they are sorted, device int64 (2 capacity,); the greatest int64 behind the
            last pair.
        pair_count: Pairs found, device int32 (1,); keeps counting past the capacity.
        boxes: As given.
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
        names, group = np.unique(worlds, return_inverse=True)
        everywhere = np.flatnonzero(names == EVERY_WORLD)
        self.shared_group = int(everywhere[0]) if len(everywhere) else -1
        self.lower = wp.zeros(count, dtype=wp.vec3, device=device)
        self.upper = wp.zeros(count, dtype=wp.vec3, device=device)
        self.group = wp.array(group.astype(np.int32), dtype=wp.int32, device=device)
        self.excluded = wp.array(batch.excluded, dtype=wp.int64, device=device)
        self.collision_bits = batch.objects.collision_bits
        self.pair_count = wp.zeros(1, dtype=wp.int32, device=device)
        self.guard = guard or LaunchGuard(device, batch.states.generation, batch.filter_generation)
        self.resize(capacity or max(64, 4 * count))
        self._commands = Commands()
        self.boxes.make(wp.launch, self.guard, self.lower, self.upper)
        # Made here, since no graph can capture it.
        self.bvh = wp.Bvh(self.lower, self.upper, groups=self.group)

    def resize(self, capacity: int):
        """Make room for a number of pairs."""
        for owner, name, array in self.make_arrays(capacity):
            setattr(owner, name, array)

    def make_arrays(self, capacity: int) -> list:
        """Return (owner, attribute, new array) of a list of pairs and of what sorts them."""
        made = [(self, "pairs", wp.empty(capacity, dtype=wp.vec2i, device=self.device))]
        # The sort takes as much again as scratch.
        for name, dtype in {"key": wp.int64, "order": wp.int32}.items() if self.sorts else ():
            made.append((self, name, wp.empty(2 * capacity, dtype=dtype, device=self.device)))
        return made

    def launch(self):
        """Box, rebuild, query, and sort if asked. Launches only, so that a graph can capture it."""
        given = *self.guard.given(), self.pairs.ptr, self.boxes.given()
        launch_boxes, launch_find = self._commands.find_callables("pairs", given, self.device, self._make_launches)
        launch_boxes()
        self.bvh.rebuild()
        self.pair_count.zero_()
        launch_find()
        if self.sorts:
            self._sort()

    def _sort(self):
        room = len(self.pairs)
        inputs = [self.pair_count, self.pairs, self.order, self.key]
        wp.launch(make_pair_key_kernel, room, inputs, device=self.device)
        with wp.ScopedDevice(self.device):
            # The key behind all others has only ones among these bits.
            wp.utils.radix_sort_pairs(self.key, self.order, room, end_bit=32 + len(self.lower).bit_length())
        inputs = [self.key, self.pair_count, self.pairs]
        wp.launch(place_pair_kernel, room + 1, inputs, device=self.device)

    def _make_launches(self, launch) -> list:
        """Return what boxes the objects, and what finds pairs."""
        inputs = [
            *(self.shared_group, self.bvh.id, self.lower, self.upper, self.group, self.excluded),
            *(self.collision_bits, self.batch.objects.pool, self.pair_count, self.pairs),
        ]
        find = launch(find_pair_kernel, dim=len(self.lower), inputs=inputs, device=self.device)
        return [self.boxes.make(launch, self.guard, self.lower, self.upper), find]

    def count_found(self) -> int:
        """Return how many pairs the last launch found. Waits for the device.

        Raises:
            CapacityError: 2^31 pairs or more.
        """
        return self.check_found(int(self.pair_count.numpy()[0]))

    @staticmethod
    def check_found(found: int) -> int:
        """Return a number of pairs found.

        Raises:
            CapacityError: 2^31 pairs or more.
        """
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
        # As numbers i * 2^32 + j they sort ten times as fast as by two keys.
        first, second = self.pairs.numpy()[:found].reshape(-1, 2).astype(np.int64).T
        keys = np.sort((first << 32) + second)
        return np.stack([keys >> 32, keys & (2**32 - 1)], 1).astype(np.int32)
