"""How far apart the original meshes are, at whatever LODs their objects stand: `OriginalDistances`."""

import numpy as np
import warp as wp

from warp_abtree.kernels.distance.originals import bound_originals_kernel
from warp_abtree.kernels.distance.report import two_points
from warp_abtree.query.distance import DistanceQuery, prepare_query
from warp_abtree.query.result import COUNTERS, Found, Result, Totals
from warp_abtree.state.batch import Batch

# Of what is asked: what certified errors may be, together, for a pair to be asked at its LODs, and what goes to the
# search there; the rest goes to the faces of the originals that stand near the witnesses.
HOPE, SEARCHED = 0.5, 0.5
# Distance, in sizes, at which a fraction of it is such a length: how far a pair is apart is not known yet.
FAR = 0.1
# Ends a search at LODs, relative, where only distances beyond which nothing matters can decide.
ROUGH = 0.5
# Over what rotations that scenes take may lengthen an error by.
STRETCH = 1.0 + 2e-5
# Rows of a result, and their types on a device.
ROWS = {"any": wp.bool, "distance": wp.float64, "bracket": wp.vec2d, "points": two_points, "point_faces": wp.vec2i}


class OriginalDistances:
    """Distances of the original meshes of a batch's object pairs.

    A pair is asked at its objects' LODs where that may decide it, and its originals only if it does not: then tree
    states at the finest LODs are made of its models, and stay. Where they are there already, or both objects stand at
    their finest LODs, the originals are asked at once, which takes no longer than LODs that decide as much.

    Args:
        batch: `Batch` whose objects are asked about, as posed.
        at_lods: `DistanceQuery` of that batch, to be used from now on; None makes one when needed.

    Attributes:
        finest: Batch of the objects at their finest LODs, with tree states of those models that needed them; None
            before any did.
    """

    def __init__(self, batch: Batch, at_lods: DistanceQuery | None = None):
        self.batch, self._at_lods = batch, at_lods
        self._at_finest: DistanceQuery | None = None
        self.finest: Batch | None = None
        self._made = np.zeros(len(batch.models.lod_max), bool)

    def run(self, pairs: np.ndarray, beyond: np.ndarray, tolerance=0.0, relative=0.0, device=False) -> Result:
        """Return distances, brackets and nearest points of originals. Waits for the device.

        Args:
            pairs, beyond, tolerance, relative, device: As for `DistanceQuery` and its `run`; pairs and distances
                checked.
        """
        tolerances = {"tolerance": tolerance, "relative": relative}
        errors, whole = self._measure(pairs)
        if whole.all():
            return self._ask_lods(pairs, beyond, tolerances).run(device)
        tried = whole | self._may_decide(pairs, errors, beyond, tolerances)
        if not tried.any():
            return self._ask_originals(pairs, beyond, tolerances).run(device)
        asked, left = np.flatnonzero(tried), ~tried
        bounded, decided = self._bound(pairs[asked], errors[asked], whole[asked], _some(beyond, asked), tolerances)
        rows = {name: np.zeros((len(pairs), *values.shape[1:]), values.dtype) for name, values in bounded.items()}
        for name, values in bounded.items():
            rows[name][asked] = values
        left[asked] = ~decided
        rest = np.flatnonzero(left)
        if len(rest):
            query = self._ask_originals(pairs[rest], _some(beyond, rest), tolerances)
            query.start_from(np.where(tried[rest, None], rows["point_faces"][rest], -1))
            result = query.run()
            for name in ROWS:
                rows[name][rest] = getattr(result, name)
            for name in COUNTERS:
                rows[name][rest] += getattr(result, name)
        return self._make_result(pairs, rows, device)

    def reach(self) -> float:
        """Return how much nearer than their LODs two originals may be at most [world units]."""
        return 2 * STRETCH * float(self._errors()[0].max())

    def _measure(self, pairs) -> tuple[np.ndarray, np.ndarray]:
        """Return the certified errors of pairs, added up [model units], and which stand at their finest LODs."""
        errors, whole = self._errors()
        return errors[pairs].sum(1), whole[pairs].all(1)

    def _errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the certified error of each object at its LOD [model units], and which stand at their finest LODs."""
        self.batch.catch_up()
        states, model = self.batch.states, self.batch.object_model
        lods = np.array([slot.lod for slot in states.slots])[self.batch.objects.state]
        errors = np.zeros(len(model))
        for k, error in enumerate(self.batch.models.lod_error):
            errors[model == k] = error[lods[model == k]]
        return errors, lods == self.batch.models.lod_max[model]

    def _may_decide(self, pairs, errors, beyond, tolerances) -> np.ndarray:
        """Return which pairs are asked at their LODs: errors are within what is asked, originals not at hand."""
        model = self.batch.object_model[pairs]
        size = self.batch.models.size[model].sum(1)
        asked = np.maximum(tolerances["tolerance"], tolerances["relative"] * FAR * size)
        asked = np.maximum(asked, np.where(np.isfinite(beyond), beyond, 0.0))
        # Errors of surfaces say nothing of what lies inside a solid.
        solids = self.batch.solids
        hopeless = self._made[model].all(1) | (False if solids is None else solids.is_solid[pairs].any(1))
        return ~hopeless & (errors <= HOPE * asked)

    def _ask_lods(self, pairs, beyond, tolerances) -> DistanceQuery:
        """Return a query of pairs at their LODs."""
        query, self._at_lods = self._at_lods, None  # one that fails, for lack of memory, gives its own back
        self._at_lods = query = prepare_query(query, self.batch, pairs, beyond, tolerances)
        return query

    def _ask_originals(self, pairs, beyond, tolerances) -> DistanceQuery:
        """Return a query of pairs at their finest LODs, after making the tree states that it lacks."""
        query, finest, made = self._at_finest, self.finest, self._made
        self._at_finest, self.finest, self._made = None, None, np.zeros_like(made)
        finest = finest or self.batch.with_own_states(follows_poses=True)
        missing = np.setdiff1d(self.batch.object_model[pairs], np.flatnonzero(made))
        if len(missing):
            finest.add_finest(missing.tolist())
            made[missing] = True
        query = prepare_query(query, finest, pairs, beyond, tolerances)
        self._at_finest, self.finest, self._made = query, finest, made
        return query

    def _bound(self, pairs, errors, whole, beyond, tolerances) -> tuple[dict, np.ndarray]:
        """Query pairs at their LODs; return rows that hold for their originals, and which of them are decided."""
        asked = tolerances
        if not whole.all():
            # Much over the errors it would leave open whether surfaces intersect at all.
            tolerance = min(SEARCHED * tolerances["tolerance"], float(errors.max()))
            asked = {"tolerance": tolerance, "relative": SEARCHED * tolerances["relative"]}
            if not any(asked.values()) and not whole.any():
                asked["relative"] = ROUGH
        padded = beyond + STRETCH * errors if np.isfinite(beyond).all() else beyond
        query, n = self._ask_lods(pairs, padded, asked), len(pairs)
        found = query.run()
        rows = {name: getattr(found, name) for name in (*ROWS, *COUNTERS)}
        inputs = [*self.batch.pools, query.pair_count, query.pairs, query.pair_poses]
        inputs += [wp.array(errors, dtype=wp.float64, device=self.batch.device), query.distances]
        wp.launch(bound_originals_kernel, n, inputs, device=self.batch.device)
        proved = query.distances
        bounded = {"distance": proved.distance, "bracket": proved.bracket, "points": proved.points}
        bounded = {name: array.numpy()[:n].copy() for name, array in (bounded | {"point_faces": proved.faces}).items()}
        distance, (lower, upper) = bounded["distance"], bounded["bracket"].T
        far, some = np.isinf(distance) & (lower >= beyond), np.where(np.isinf(distance), 0.0, distance)
        width = np.maximum(tolerances["tolerance"], tolerances["relative"] * some)
        near = np.isfinite(distance) & (lower > 0) & (upper <= beyond) & (upper - lower <= width)
        bounded["bracket"][far, 0] = np.broadcast_to(beyond, n)[far]
        for name, values in bounded.items():
            values[whole] = rows[name][whole]
        return rows | bounded, whole | far | near

    def _make_result(self, pairs, rows, device) -> Result:
        """Return a result of rows, on the host or the device."""
        if device:
            kinds = ROWS | dict.fromkeys(COUNTERS, wp.int64)
            rows = {name: wp.array(rows[name], dtype=kinds[name], device=self.batch.device) for name in rows}
            pairs = wp.array(pairs, dtype=wp.vec2i, device=self.batch.device)
        found = Found(Totals(0, len(pairs), 0, 0), pairs.copy() if not device else pairs)
        found.tests = {name: rows.pop(name) for name in COUNTERS}
        for name, values in rows.items():
            setattr(found, name, values)
        return Result(found, (len(pairs), 0, 0), "any")


def _some(beyond: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Return the distances of some pairs, of one for all or one each."""
    return beyond if beyond.ndim == 0 else beyond[which]
