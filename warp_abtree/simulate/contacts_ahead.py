"""Gaps of rigid bodies, within which their contacts are looked for: as far as they move in a step."""

import numpy as np
import warp as wp

from warp_abtree.kernels.bodies import ahead
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Rooms, fields
from warp_abtree.query.stages.distance import NOT_BEYOND, DistanceStage
from warp_abtree.query.stages.intersect import GapStage, IntersectStage


class AheadGapStage(GapStage):
    """Gaps as wide as bodies move in a step, their `reach`, cut to a little over the distance of nearer pairs."""

    def __init__(self, scene, bodies):
        super().__init__(bodies.reach)
        self._bodies, self._chosen = bodies, ahead.Chosen()
        # Of surfaces alone, of those pairs whose gap is wide.
        self._distance = DistanceStage(NOT_BEYOND, with_points=False)
        self._nearest = Operator(scene, [IntersectStage(), self._distance], np.zeros((0, 2), np.int32))

    def prepare(self, rooms: Rooms):
        """Make room for the distances of as many pairs."""
        nearest, chosen = self._nearest, self._chosen
        if rooms.pairs > nearest.rooms.pairs:
            nearest.make_room(pairs=rooms.pairs)
        chosen.count, chosen.pairs = nearest.pair_count, nearest.pairs
        chosen.beyond = self._distance.found.beyond

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the gaps, and the places of chosen pairs."""
        return [*super().arrays(rooms), *fields(self._chosen, rooms.pairs, place=wp.int32)]

    def search(self):
        """Find gaps, and cut those that are wide; see `kernels.bodies.ahead`. Launches only."""
        super().search()
        nearest, chosen, bodies, operator = self._nearest, self._chosen, self._bodies, self.operator
        trees, gap, room, given = operator.batch.trees, operator.hits.gap, len(operator.pairs), operator.guard.given()
        nearest.check_whole()
        with nearest.guard.launching(self):
            nearest.pair_count.zero_()
            inputs = [trees, operator.pair_batch, gap, bodies, chosen]
            nearest.launch_kernel(ahead.choose_fast_kernel, room, inputs, given=given)
            nearest.search()
            inputs = [trees, chosen, self._distance.distances, bodies, gap]
            nearest.launch_kernel(ahead.cut_gap_kernel, room, inputs, given=given)
