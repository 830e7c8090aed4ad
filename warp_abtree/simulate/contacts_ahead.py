"""Contact points of rigid bodies, those included that they come to within a step: `AheadQuery`."""

import numpy as np
import warp as wp

from warp_abtree.kernels.bodies import ahead
from warp_abtree.query.distance import DistanceQuery
from warp_abtree.query.manifold import ManifoldQuery


class NearestQuery(DistanceQuery):
    """Distances, of surfaces alone, of those pairs of another query whose gap is wide."""

    def __init__(self, scene):
        self._chosen = ahead.Chosen()
        super().__init__(scene, np.zeros((0, 2), np.int32))

    def _pair_arrays(self, room: int) -> list:
        place = wp.empty(room, dtype=wp.int32, device=self.device)
        return [*super()._pair_arrays(room), (self._chosen, "place", place)]

    def make_room(self, room: int):
        """Make room for so many pairs."""
        if len(self.pairs) < room:
            self._take_pairs(wp.empty(room, dtype=wp.vec2i, device=self.device))
            chosen = self._chosen
            chosen.count, chosen.pairs, chosen.beyond = self.pair_count, self.pairs, self._found.beyond

    def cut(self, query, gap, bodies):
        """Cut the gaps of a query's pairs, which there is room for; see `kernels.bodies.ahead`. Launches only."""
        room, trees, chosen = len(query.pairs), self.batch.trees, self._chosen
        given = query.guard.given()
        with self.guard.launching(self):
            self.pair_count.zero_()
            inputs = [trees, query.pair_batch, gap, bodies, chosen]
            self._repeat(given, ahead.choose_fast_kernel, room, inputs)
            self.traverse()
            self._repeat(given, ahead.cut_gap_kernel, room, [trees, chosen, self.distances, bodies, gap])

    def _find_contained(self):
        pass

    def _make_crossings(self, launch) -> list:
        return []

    def _make_inside(self, launch) -> list:
        return []


class AheadQuery(ManifoldQuery):
    """Contact points of bodies where they stand, and where they first meet as far ahead as they move in a step.

    As `ManifoldQuery` with a gap otherwise.

    Args:
        scene, capacity: As for `ManifoldQuery`.
        bodies: `kernels.bodies.bodies.Bodies` of all objects; its `reach` is the widest gap.
    """

    def __init__(self, scene, bodies, capacity=None):
        self._bodies, self._nearest = bodies, NearestQuery(scene)
        super().__init__(scene, None, capacity, gap=bodies.reach)

    def _take_pairs(self, pairs):
        self._nearest.make_room(len(pairs))
        super()._take_pairs(pairs)

    def prove_apart(self):
        """Cut gaps to a little over the distances of the pairs. Launches only."""
        super().prove_apart()
        if len(self.pairs):
            self._nearest.cut(self, self.hits.gap, self._bodies)
