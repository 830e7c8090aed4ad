"""Containment in solids, of object pairs whose surfaces do not meet."""

from typing import Any

import warp as wp

from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.inside.containment import find_contained_kernel
from warp_abtree.query.stage import Array, Rooms, Stage


class InsideStage(Stage):
    """Find what is inside solids, of the pairs whose surfaces do not meet; nothing where there are no solids."""

    contained: wp.array  # face of what is inside, device int32 (pair,)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the faces."""
        solids = self.operator.batch.solids
        return [] if solids is None else [Array(self, "contained", wp.int32, rooms.pairs)]

    def search(self):
        """Find it. Launches only."""
        solids = self.operator.batch.solids
        if solids is not None:
            solids.fit()
            self.operator.launch_all("contained", self._make)

    def _make(self, launch) -> list:
        operator, near = self.operator, self.operator.near
        solids: Any = operator.batch.solids
        near_hit = wp.empty(0, dtype=wp.int32, device=operator.device) if near is None else near.any_hit
        inputs = [operator.batch.trees, operator.pair_batch, solids.pool, operator.hits, near_hit, self.contained]
        dim = {"dim": operator.rooms.pairs, "block_dim": WARP_SIZE, "device": operator.device}
        prepared = solids.prepare(launch, operator.guard.launched)
        return [prepared, launch(find_contained_kernel, inputs=inputs, **dim)]
