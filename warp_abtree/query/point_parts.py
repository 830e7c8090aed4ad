"""Parts of a query's object pairs that take turns in the lists of an operator of its own, so that memory is bounded.

Pairs do not depend on one another: whatever the parts, each has the same contact points, to the bit.
"""

from typing import Any

import numpy as np
import warp as wp

from warp_abtree.kernels.io import point_parts as kernels
from warp_abtree.query.operator import Operator
from warp_abtree.query.request import Buffers
from warp_abtree.query.stage import Array, Rooms, Stage
from warp_abtree.query.stages.intersect import GapStage

# Entries of the lists of hits, and of face pairs that may be near, beyond which parts of the pairs take turns: some 600
# and 500 MB.
HITS_AT_ONCE, UNCERTAIN_AT_ONCE = 2**21, 7 * 2**22


class PartGaps(GapStage):
    """Gaps of a part's pairs, which the query gives it.

    Attributes:
        asked: What the traversal takes for them, device float64 (pair,).
    """

    asked: wp.array

    def __init__(self):
        super().__init__(None)

    def attach(self, operator: Any):
        """Take the operator."""
        Stage.attach(self, operator)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the gaps, twice."""
        return [*super().arrays(rooms), Array(self, "asked", wp.float64, max(1, rooms.pairs))]


def needs_parts(pairs: int, hits: int, uncertain: int) -> bool:
    """Return whether lists of so many entries are for parts of the pairs."""
    return pairs > 1 and (hits > HITS_AT_ONCE or uncertain > UNCERTAIN_AT_ONCE)


class PointParts:
    """An operator that finds contact points of one part of a query's pairs after the other.

    Args:
        query: `ManifoldQuery` whose lists are too short.
        stages: Of the operator, those of a query with gaps of its own.
        pairs: That there are.
        hits, uncertain: Entries that the query's lists would need.

    Attributes:
        operator: The operator, whose lists hold those of the last part.
        count: How many parts the pairs are divided into, as many as there are in a launch, evenly.
    """

    def __init__(self, query: Any, stages: list[Any], pairs: int, hits: int, uncertain: int):
        self.count = min(pairs, max(-(-hits // HITS_AT_ONCE), -(-uncertain // UNCERTAIN_AT_ONCE)))
        # Half as many again as an even share: contacts are sorted, and looked at, as many as there is room for.
        hits = min(hits, HITS_AT_ONCE, -(-3 * hits // (2 * self.count)))
        uncertain = min(UNCERTAIN_AT_ONCE, -(-uncertain // self.count))  # what was asked has room to spare
        rooms = Buffers(hits, -(-query.rooms.pairs // self.count), uncertain or None)
        self._gaps = next((stage for stage in stages if isinstance(stage, PartGaps)), None)
        self._points, self._lent = stages[-1], -1  # generation of the lists that the query has
        self._none = wp.empty(0, dtype=wp.float64, device=query.device)  # gaps where there are none
        # Its pairs are written on the device.
        self.operator = Operator(query.batch, stages, np.empty((0, 2), np.int32), rooms, "faces")

    def fit_states(self) -> bool:
        """Make room for tree states that are new; return whether the lists are others than were lent last."""
        self.operator.fit_states()
        return self.operator.guard.buffers.number != self._lent

    def lend_lists(self, hits: Any):
        """Let hits of the query have the lists of the parts, whose totals it then has."""
        for name in ("face", "uncertain", "inexact", "apart"):
            setattr(hits, name, getattr(self.operator.hits, name))
        self._lent = self.operator.guard.buffers.number

    def fit_pairs(self, pairs: int):
        """Make room for parts of so many pairs that a query has room for."""
        if -(-pairs // self.count) > self.operator.rooms.pairs:
            self.operator.make_room(pairs=-(-pairs // self.count))

    def make_room(self, pairs: int, hits: int | None, uncertain: int | None):
        """Make room for longer lists of a part, or where these are long enough, make twice as many parts.

        Args:
            pairs: That there are; a part of one has lists as long as it takes.
        """
        rooms, most = self.operator.rooms, {"hits": HITS_AT_ONCE, "uncertain": UNCERTAIN_AT_ONCE}
        wanted = {name: room for name, room in (("hits", hits), ("uncertain", uncertain)) if room is not None}
        within = {name: max(getattr(rooms, name), min(room, most[name])) for name, room in wanted.items()}
        if self.count >= pairs:
            self.operator.make_room(**wanted)
        elif any(within[name] > getattr(rooms, name) for name in wanted):
            self.operator.make_room(**within)
        else:
            self.count = min(2 * self.count, pairs)

    def launch(self, query: Any, asked: Any):
        """Find the contact points of all pairs of a query. Launches only.

        Args:
            query: The query.
            asked: What the traversal takes for gaps, device float64 (pair,); None for the gaps.
        """
        operator, size, gaps = self.operator, self.operator.rooms.pairs, self._gaps
        none, record = self._none, query.guard.record()
        gap, own = (none, (none, none)) if gaps is None else (query.hits.gap, (operator.hits.gap, gaps.asked))
        whole = query.hits, query.manifolds
        taken = query.pair_batch, gap, none if asked is None else asked, *whole, operator.pair_batch, *own
        put = query.pair_batch, operator.hits, self._points.manifolds, *whole

        def launch(kernel, k, dim, inputs):
            def make(launch):
                inputs_of_part = [wp.vec2i(k, self.count), *inputs]
                return [launch(kernel, dim=dim, inputs=inputs_of_part, device=operator.device)]

            for command in operator.find_launches(f"{kernel.key} {k}", make, query.guard.given(), self.count):
                command()

        for k in range(self.count):
            launch(kernels.take_part_kernel, k, size if k else query.rooms.pairs, [record, *taken])
            operator.search()
            operator.report()
            launch(kernels.put_part_kernel, k, (size, query.point_max), put)
