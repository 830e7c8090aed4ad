"""Selection of LODs on the device: the paper's model, a tolerance, and a predicted budget.

Operators here allocate once; `launch()` only launches, so that a graph can capture it, and leaves device arrays.
`warp_abtree.lod.controllers` feeds them frame by frame.

Source: Liu et al. 2006, section 4, and figure 4. Errata, kept here: g2 is printed with the absolute frame number and
would explode; figure 4 counts from the start of the last climb, so that a descent mirrors it. In Case 2 the change is
signed: the LOD falls. After the mirror g2 is 0 for ever and a scene over budget would stay so; here the smallest step,
one level a frame, goes on. f is clamped to [0, 1], where an object is beyond D or its path longer than W.
"""

import math

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import finite_array, positive, whole_number
from warp_abtree.kernels.lod import paper, prediction, tolerance
from warp_abtree.kernels.lod.ladder import LodPool
from warp_abtree.lod.view import View
from warp_abtree.state.ladder import Ladder
from warp_abtree.state.lod_update import full_refit_fraction

TOLERANCES_PER_OCTAVE = int(prediction.POSITIONS_PER_OCTAVE) // int(prediction.DITHER)

# Changes of the position on the tolerance scale that are candidates, finest first, in steps of 2^(1/16).
CLIMBS = (8, 4, 2, 1)
FALLS = tuple(-round(2.0 ** (i / 2)) for i in range(21) if i not in (1, 3))


def tolerance_scale(ladder: Ladder) -> np.ndarray:
    """Return tolerances that cover the errors of a ladder, falling by 2^(1/4), the last 0 [world units], float64."""
    top, known = ladder.error.max(), ladder.error[ladder.error > 0]
    count = 1 + math.ceil(TOLERANCES_PER_OCTAVE * math.log2(top / known.min())) if len(known) else 1
    return np.append(top * 2.0 ** (-np.arange(count) / TOLERANCES_PER_OCTAVE), 0.0)


def lod_pool(ladder: Ladder, scene) -> LodPool:
    """Return a ladder and the objects of a scene for kernels."""
    tolerances = tolerance_scale(ladder)
    levels = np.stack([(error > tolerances[:, None]).sum(1) for error in ladder.error])
    levels[:, 0] = 0
    pool = LodPool()
    for name, values in (
        ("object_model", scene.object_model),
        ("importance", scene.object_importance),
        ("lod", ladder.lod),
        ("error", ladder.error),
        ("faces", ladder.faces),
        ("entry", ladder.entry),
        ("face_count", [model.face_count for model in ladder.models]),
        ("tolerance_level", levels),
    ):
        dtype, real = (wp.float64, np.float64) if name == "error" else (wp.int32, np.int32)
        array = np.ascontiguousarray(values, real).ravel()
        setattr(pool, name, wp.array(array, dtype=dtype, device=scene.device))
    pool.level_count, pool.tolerance_count = ladder.steps + 1, len(tolerances)
    return pool


def check_loosest(loosest) -> float:
    """Return the most that a tolerance is loosened, at least 1.

    Raises:
        ValueError: It is below 1 or not finite.
    """
    if not positive(loosest, "loosest") >= 1:
        raise ValueError(f"loosest {loosest!r} is below 1")
    return float(loosest)


class Selection:
    """What all selections share.

    Args:
        view: `View` of the scene, launched by its owner.
        ladder: `Ladder` of the scene's models.

    Attributes:
        lods: LOD of each object, int32 (n,) on the device.
    """

    def __init__(self, view: View, ladder: Ladder):
        self.view, self.ladder, self.device = view, ladder, view.device
        self.pool = lod_pool(ladder, view.scene)
        self.lods = self._zeros(view.scene.object_count, wp.int32)

    def _zeros(self, length, dtype=wp.float64):
        return wp.zeros(length, dtype=dtype, device=self.device)

    def _launch(self, kernel, dim, *inputs):
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.device)


class PaperSelection(Selection):
    """Operator: the selection model of section 4.2. Every object starts at its coarsest LOD.

    Args:
        view: As in `Selection`.
        budget: T [ms].
        threshold: t [ms]; None is 10 % of T.
        ladder: As in `Selection`; None is the paper's, 50 steps of equal operations.

    Attributes:
        cost: T', the time of the last frame [ms], float64 (1,) on the device, written by the caller; NaN at first.
        case: Case of the last launch, frames it has lasted, frames of the last climb, int32 (3,) on the device.
        level: Level of each object on the LOD ladder, with its fraction, float64 (n,) on the device.
        lods: As in `Selection`.
    """

    def __init__(self, view: View, budget: float, threshold: float | None = None, ladder: Ladder | None = None):
        self.budget = positive(budget, "budget")
        self.threshold = 0.1 * self.budget if threshold is None else positive(threshold, "threshold")
        super().__init__(view, ladder or Ladder(view.scene.models))
        self.cost = wp.full(1, math.nan, dtype=wp.float64, device=self.device)
        self.case, self.level = self._zeros(3, wp.int32), self._zeros(len(self.lods))

    def launch(self):
        """Select the LODs of a frame. Launches only."""
        self._launch(paper.advance_case_kernel, 1, self.budget, self.threshold, self.cost, self.case)
        inputs = self.pool, self.view.focus, self.case, self.level, self.lods
        self._launch(paper.advance_level_kernel, len(self.lods), *inputs)


class ToleranceSelection(Selection):
    """Operator: the coarsest LOD whose certified error is within each object's own tolerance.

    That is the tolerance times beta / f: twice it at half of D, or where an object crosses half the screen in `window`
    frames, since far and fast objects matter less (section 4.1); three times it for objects that are not important.

    Args:
        view: As in `Selection`.
        tolerance: Error of an important, still object at the eye [world units], at least 0.
        loosest: Most that a tolerance is loosened.
        ladder: As in `Selection`; None has 50 steps of equal ratios.

    Attributes:
        tolerance: float64 (1,) on the device; may be written between launches.
        lods: As in `Selection`.
    """

    def __init__(self, view: View, tolerance: float, loosest: float = 64.0, ladder: Ladder | None = None):
        value = float(finite_array(tolerance, "tolerance", ()))
        if not value >= 0:
            raise ValueError(f"tolerance {tolerance!r} is below 0")
        self.loosest = check_loosest(loosest)
        super().__init__(view, ladder or Ladder(view.scene.models, spacing="ratio"))
        self.tolerance = wp.full(1, value, dtype=wp.float64, device=self.device)

    def launch(self):
        """Select the LODs of a frame. Launches only."""
        inputs = self.loosest, self.pool, self.view.focus, self.tolerance, self.lods
        self._launch(tolerance.select_tolerance_kernel, len(self.lods), *inputs)


class PredictedSelection(Selection):
    """Operator: the finest common tolerance whose predicted cost keeps a budget, loosened as in `ToleranceSelection`.

    The common tolerance is a position on a scale in steps of 2^(1/16). Each launch takes some finer and coarser
    positions as candidates. It predicts their tests from the last frame's tests of every object and the faces it would
    have, and the nodes refitted from the levels without a tree state yet, and takes the finest position that keeps the
    budget (`choose_position_kernel`).

    Args:
        view: As in `Selection`.
        budget: T [ms].
        aim: Fraction of the budget that a change goes for.
        low: Fraction of the budget under which it climbs. Between `low` and 1 the position stays: hysteresis.
        hold_frames: Frames for which a change is held if its refit does not fit into the budget, before it is made.
        loosest: Most that a tolerance is loosened.
        ladder: As in `Selection`; None has 50 steps of equal ratios.

    Attributes:
        rate: float64 (6,) on the device, written by the caller: ms of a frame, of a unit of work, of any change of
            LODs, of a node refitted; exponents of the faces with which tests grow and fall. NaN at first: no change.
        work: Work of each object in the last frame, float64 (n,) on the device, written by the caller.
        scale: Position (0 is the coarsest), and frames that a change has been held, int32 (2,) on the device.
        choice: Candidate, its steady and transition cost [ms], its work, the work in place, float64 (5,) on the device.
        level, lods: Level and LOD of each object, int32 (n,) on the device.
        offset: Positions by which each object is loosened, int32 (n,) on the device.
        changes: Change of the position of each candidate; the last leaves every object at its level.
        prediction: What each candidate would cost, `kernels.lod.prediction.Prediction`.

    Raises:
        ValueError: A number out of range; low and aim must rise: 0 < low <= aim <= 1.
    """

    def __init__(self, view, budget, aim=0.9, low=0.75, hold_frames=30, loosest=64.0, ladder: Ladder | None = None):
        self.budget, self.aim, self.low = positive(budget, "budget"), positive(aim, "aim"), positive(low, "low")
        if not self.low <= self.aim <= 1:
            raise ValueError(f"low {low!r} and aim {aim!r} do not rise to at most 1")
        self.hold_frames = whole_number(hold_frames, "hold_frames", 0, 2**30)
        self.loosest = check_loosest(loosest)
        super().__init__(view, ladder or Ladder(view.scene.models, spacing="ratio"))
        loosened = int(math.log2(self.loosest) * int(prediction.POSITIONS_PER_OCTAVE))
        self.position_max = int(prediction.DITHER) * (self.pool.tolerance_count - 1) + loosened
        self.stay = len(CLIMBS)
        falls = [step for step in FALLS if step > -self.position_max]
        self.changes = [*CLIMBS, 0, *falls, -self.position_max, 0]
        self.prediction = self._make_prediction()
        self.rate, count = self.prediction.rate, len(self.lods)
        self.work, self.choice = self._zeros(count), self._zeros(5)
        self.scale, self.offset = self._zeros(2, wp.int32), self._zeros(count, wp.int32)
        self.level = self._zeros(count, wp.int32)

    def _make_prediction(self):
        candidates, levels = len(self.changes), self.ladder.lod.size
        made = prediction.Prediction()
        made.change = wp.array(np.array(self.changes, np.int32), dtype=wp.int32, device=self.device)
        made.rate = wp.full(6, math.nan, dtype=wp.float64, device=self.device)
        made.power_up, made.power_down = self._zeros(levels), self._zeros(levels)
        chunks = candidates * int(prediction.CHUNKS)
        made.chunk_work, made.chunk_moved = self._zeros(chunks), self._zeros(chunks, wp.int32)
        made.used = self._zeros(candidates * levels, wp.int32)
        made.work, made.moved = self._zeros(candidates), self._zeros(candidates, wp.int32)
        made.nodes = self._zeros(candidates)
        return made

    def launch(self):
        """Predict, choose and select the LODs of a frame. Launches only."""
        predicted, pool, count = self.prediction, self.pool, len(self.lods)
        candidates, models = len(self.changes), len(self.ladder.models)
        predicted.used.zero_()
        predicted.nodes.zero_()
        self._launch(prediction.update_offset_kernel, count, self.loosest, pool, self.view.focus, self.offset)
        self._launch(prediction.raise_faces_kernel, len(predicted.power_up), pool, predicted)
        inputs = models, pool, self.scale, self.offset, self.level, self.work, predicted
        self._launch(prediction.predict_work_kernel, (candidates, int(prediction.CHUNKS)), *inputs)
        share = full_refit_fraction(self.device)
        self._launch(prediction.predict_refit_kernel, (candidates, models), models, share, pool, predicted)
        self._launch(prediction.sum_chunk_kernel, candidates, predicted)
        limits = self.budget, self.aim, self.low, self.hold_frames, self.position_max, self.stay
        self._launch(prediction.choose_position_kernel, 1, *limits, predicted, self.scale, self.choice)
        place = self.scale, self.offset, self.choice, self.level, self.lods
        self._launch(prediction.set_level_kernel, count, candidates - 1, pool, *place)
