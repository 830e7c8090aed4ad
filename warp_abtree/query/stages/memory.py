"""Contact points kept between launches: which object pairs rest, and what they keep (`kernels.contacts.memory`)."""

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import positive
from warp_abtree.kernels.contacts import memory
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Rooms, Stage, fields

PAIR_TYPES = {"pairs": wp.vec2i, "searched": memory.SearchedPair}
POINT_TYPES = {"points": memory.KeptPoint, "shown": wp.int32}


def check_remember(remember, gap) -> float | None:
    """Return how far points of a pair that rests may have moved, -1 for a part of its gap and size, None without.

    Raises ValueError for neither a bool nor a distance above 0, and without a gap.
    """
    on = isinstance(remember, bool | np.bool_)
    if remember is None or (on and not remember):
        return None
    if gap is None:
        raise ValueError("remember: needs a gap, of which it is a part")
    return -1.0 if on else positive(remember, "remember")


def _copy_table(old, new):
    """Copy both tables of an array to one that may have other room."""
    for k in range(2 if old is not None and old.size and new.size else 0):
        entries = min(old[k].size, new[k].size)
        wp.copy(new[k].flatten(), old[k].flatten(), count=entries)


class MemoryStage(Stage):
    """Find the pairs that rest, which are not traversed, and give them the points that they had.

    Args:
        distance: As `check_remember` returns it.
        points: Most points of a pair.

    Attributes:
        memory: Device arrays, `kernels.contacts.memory.PointMemory`.
        row, place, asked: Of each pair, its row in the memory, the same if it rests, and the gap to traverse it with,
            see `find_resting_kernel`.
    """

    row: wp.array
    place: wp.array
    asked: wp.array

    def __init__(self, distance: float, points: int):
        self._distance, self._points, self.memory = distance, points, memory.PointMemory()

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        for name in ("turn", "known", "launches"):
            setattr(self.memory, name, wp.zeros(1, dtype=wp.int32, device=operator.device))
        self._rest = memory.Rest()
        self._rest.distance, self._rest.sorted = self._distance, operator.given is None

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return both tables, which keep what they hold where there is more room, and what has an entry a pair."""
        made = fields(self, rooms.pairs, row=wp.int32, place=wp.int32, asked=wp.float64)
        for names, shape in ((PAIR_TYPES, ()), (POINT_TYPES, (self._points,))):
            for name, dtype in names.items():
                copy = partial(_copy_table, getattr(self.memory, name))
                made.append(Array(self.memory, name, dtype, (2, rooms.pairs, *shape), copy))
        return made

    def search(self):
        """Find the pairs that rest. Launches only."""
        operator = self.operator
        inputs = [self._rest, operator.batch.trees, operator.pair_batch, operator.hits.gap, self.memory]
        inputs += [self.row, self.place, self.asked]
        operator.launch_kernel(memory.find_resting_kernel, operator.rooms.pairs, inputs)

    def resume(self):
        """Say which of the pairs that rest intersect. Launches only, after what decides that of the others."""
        inputs = [self.operator.pair_batch, self.place, self.memory, self.operator.hits]
        self.operator.launch_kernel(memory.resume_resting_kernel, self.operator.rooms.pairs, inputs)

    def keep(self, manifolds: Any):
        """Give the pairs that rest their points, and keep those of the others. Launches only."""
        operator, hits = self.operator, self.operator.hits
        inputs = [operator.batch.trees, operator.pair_batch, hits.gap, self.row, self.place, hits]
        operator.launch_warps(memory.keep_points_kernel, operator.rooms.pairs, [*inputs, manifolds, self.memory])
        operator.launch_kernel(memory.turn_memory_kernel, 1, [operator.pair_batch, hits, self.memory])

    def forget(self):
        """Let no pair rest in the next launch. Launches only."""
        self.memory.known.zero_()
