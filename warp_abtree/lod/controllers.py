"""Controllers of LODs: each frame they hear what the last one did and give the LODs of the next.

All have one method, `next_lods(feedback)`, and one attribute, `budget_ms` (None where they hold no budget). They never
read a clock: time reaches them in the feedback, so they repeat themselves on counted work or recorded times.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.lod.selection import (
    Camera,
    Ladder,
    PaperSelection,
    PredictedSelection,
    ToleranceSelection,
    View,
    positive,
)
from warp_abtree.lod.timing import COST_STAGES
from warp_abtree.query.result import Result

# A test of two triangles costs about as much as so many tests of two boxes.
TRIANGLE_WORK = 4.0


@dataclass(frozen=True)
class Feedback:
    """What a controller hears before a frame.

    Attributes:
        time: Of the frame to come [s].
        stage_ms: Stages of the frame before by name [ms]; empty before the first. `select_ms`, `refine_ms`, `broad_ms`
            and `query_ms` make T.
        nodes_refitted: Nodes that it refitted.
        lods_changed: Whether it changed any LOD.
        result: What its query found, with the tests of every pair; None before the first.
    """

    time: float
    stage_ms: dict = field(default_factory=dict)
    nodes_refitted: int = 0
    lods_changed: bool = False
    result: Result | None = None

    @property
    def cost_ms(self) -> float:
        """T', the time of interference detection in the frame before [ms]; NaN before the first."""
        return sum(self.stage_ms[name] for name in COST_STAGES) if self.stage_ms else math.nan


class Controller:
    """What all controllers share: the view of the scene.

    Args:
        scene: `Scene` with all its objects.
        camera: `Camera`, or a function from time [s] to one; None, and every object is near and still.
        window: Frames over which motion on the screen is measured.

    Attributes:
        budget_ms: T [ms], None without a budget.
        lods: LODs last given, int32 (n,) on the device.
    """

    budget_ms: float | None = None
    _selection: Any  # of warp_abtree.lod

    def __init__(self, scene, camera: Camera | Callable[[float], Camera] | None = None, window: int = 10):
        if not (camera is None or isinstance(camera, Camera) or callable(camera)):
            raise TypeError(f"camera is a {type(camera).__name__}, neither a Camera nor a function of time")
        self.scene, self.camera = scene, camera
        self.view = View(scene, window)

    def next_lods(self, feedback: Feedback) -> wp.array:
        """Return the LOD of every object for the coming frame, int32 (n,) on the device, overwritten by the next call.

        Args:
            feedback: The frame before, or a first `Feedback` of a time alone.

        Raises:
            RuntimeError: The scene's objects changed since the controller was made.
        """
        self.view.check()
        if self.camera is not None:
            self.view.look(self.camera if isinstance(self.camera, Camera) else self.camera(feedback.time))
            self.view.launch()
        self._hear(feedback)
        self._selection.launch()
        return self._selection.lods

    def _hear(self, feedback):
        """Bring what the selection needs of the feedback to the device."""


class PaperController(Controller):
    """The paper's selection model: LODs climb and fall by powers of two about a budget (section 4.2).

    Args:
        scene, camera, window: As in `Controller`.
        budget_ms: T [ms].
        threshold_ms: t [ms]; None is 10 % of T.
        steps: Delta LOD is the operations of a model divided by this.

    Raises:
        TypeError: camera is neither a `Camera` nor a function.
        ValueError: Anything else is out of range.
    """

    def __init__(self, scene, budget_ms, camera=None, threshold_ms=None, steps: int = 50, window: int = 10):
        budget_ms = positive(budget_ms, "budget_ms")
        if threshold_ms is not None:
            threshold_ms = positive(threshold_ms, "threshold_ms")
        super().__init__(scene, camera, window)
        self._selection = PaperSelection(self.view, budget_ms, threshold_ms, Ladder(scene.models, steps))
        self.budget_ms = budget_ms

    def _hear(self, feedback):
        self._selection.cost.fill_(feedback.cost_ms)


class ToleranceController(Controller):
    """A tolerance in the world for every object, looser where it is far, fast or unimportant (section 4.1).

    Args:
        scene, camera, window: As in `Controller`.
        tolerance: Error of an important, still object at the eye [world units], at least 0.
        loosest: Most that a tolerance is loosened.
        steps, spacing: As in `Ladder`.

    Raises:
        TypeError, ValueError: As `PaperController`.
    """

    def __init__(self, scene, tolerance, camera=None, loosest=64.0, steps=50, spacing="ratio", window=10):
        super().__init__(scene, camera, window)
        self._selection = ToleranceSelection(self.view, tolerance, loosest, Ladder(scene.models, steps, spacing))


class CostFit:
    """A line through work and time, least squares with forgetting; slope and intercept are at least 0.

    Where the work hardly varies the line goes through the origin. A time more than twice off the line counts as twice,
    so that a single hitch of the machine moves it little.

    Args:
        forget: Weight that an observation keeps at each next one.
    """

    def __init__(self, forget: float = 0.9):
        self.forget = forget
        self.sums = np.zeros(5)

    def add(self, work: float, time: float):
        """Take one observation."""
        slope, intercept = self.line()
        expected = slope * work + intercept
        if self.sums[0] > 2 and expected > 0:
            time = min(max(time, 0.5 * expected), 2.0 * expected)
        self.sums = self.forget * self.sums + [1.0, work, time, work * work, work * time]

    def line(self) -> tuple[float, float]:
        """Return slope and intercept, NaN before the first observation."""
        weight, x, y, xx, xy = self.sums.tolist()
        if weight == 0:
            return math.nan, math.nan
        x, y, xx, xy = x / weight, y / weight, xx / weight, xy / weight
        if x <= 0:
            return 0.0, y
        slope, spread = y / x, xx - x * x
        if spread > 1e-4 * x * x:
            slope = min(max((xy - x * y) / spread, 0.0), slope)
        return slope, y - slope * x


class PredictiveController(Controller):
    """Hold a budget with the finest common tolerance whose cost is predicted to fit, loosened object by object.

    The cost is predicted from the tests of the last frame's pairs and the rates at which this machine has lately worked
    (see `warp_abtree.lod.PredictedSelection`); tests are taken to grow as a power of the faces, fitted as it goes.

    Args:
        scene, camera, window: As in `Controller`.
        budget_ms: T [ms].
        steps, spacing: As in `Ladder`.
        options: aim, low, patience, loosest of `PredictedSelection`.

    Attributes:
        predicted_ms: What the frame to come is predicted to cost [ms]; NaN before the second. Waits for the device.

    Raises:
        TypeError, ValueError: As `PaperController`.
    """

    def __init__(self, scene, budget_ms, camera=None, steps=50, spacing="ratio", window=10, **options):
        self.budget_ms = positive(budget_ms, "budget_ms")
        super().__init__(scene, camera, window)
        ladder = Ladder(scene.models, steps, spacing)
        self._selection = PredictedSelection(self.view, self.budget_ms, ladder=ladder, **options)
        self._query, self._refine, self._rest = CostFit(), CostFit(), CostFit()
        self._exponent, self._drift = 1.0, 0.0

    @property
    def predicted_ms(self) -> float:
        """Return what the frame to come is predicted to cost [ms], NaN before the second. Waits for the device."""
        choice = self._selection.choice.numpy()
        return float(choice[1] + choice[2])

    def _hear(self, feedback):
        if feedback.result is None:
            return
        stages, result, count = feedback.stage_ms, feedback.result, self.scene.object_count
        tests = result.node_tests + TRIANGLE_WORK * result.triangle_tests
        work = np.zeros(count)
        if len(result.pairs):
            first, second = (np.bincount(result.pairs[:, side], tests, count) for side in (0, 1))
            work = 0.5 * (first + second)
        total = float(tests.sum())
        self._learn_growth(total)
        self._query.add(total, stages["query_ms"])
        self._rest.add(0.0, stages["select_ms"] + stages["broad_ms"])
        if feedback.lods_changed:
            self._refine.add(float(feedback.nodes_refitted), stages["refine_ms"])
        per_work, fixed = self._query.line()
        per_node, change = (0.0 if math.isnan(rate) else rate for rate in self._refine.line())
        fixed += self._rest.line()[1]
        # Both ways on the safe side: a climb costs more than fitted, a fall spares less.
        up, down = self._exponent + 0.2, max(self._exponent - 0.2, 0.1)
        grown = math.exp(self._drift)
        self._selection.rate.assign(np.array([fixed, per_work * grown, change, per_node, up, down]))
        self._selection.work.assign(work)

    def _learn_growth(self, total):
        """Compare the tests counted with those predicted: the exponent where LODs moved, the drift where they stood."""
        _, _, _, predicted, before = self._selection.choice.numpy()
        if not (predicted > 0 and before > 0 and total > 0):
            self._drift *= 0.8
            return
        moved, found = math.log(predicted / before), math.log(total / before)
        if abs(moved) > 0.02:
            exponent = self._exponent + 0.2 if moved > 0 else max(self._exponent - 0.2, 0.1)
            slope = min(max(exponent * found / moved, 0.1), 1.5)
            self._exponent += min(abs(moved), 0.2) * (slope - self._exponent)
            found -= moved
        self._drift += 0.2 * (min(max(found, -0.2), 0.2) - self._drift)
        self._drift = max(self._drift, 0.0)
