"""Controllers of LODs: each frame they take the feedback of the last one and return the LODs of the next.

All have one method, `next_lods(feedback)`, and one attribute, `budget_ms` (None without a budget). They never read a
clock: times are part of the feedback, so that runs repeat on counted work or recorded times.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import positive
from warp_abtree.lod.selection import PaperSelection, PredictedSelection, ToleranceSelection
from warp_abtree.lod.timing import COST_STAGES
from warp_abtree.lod.view import Camera, View
from warp_abtree.query.result import Result
from warp_abtree.state.ladder import Ladder

TRIANGLE_WORK = 4.0
"""Cost of a test of two triangles in tests of two boxes, about."""


@dataclass(frozen=True)
class Feedback:
    """What a controller is told before a frame.

    Attributes:
        time: Time of the next frame [s].
        stage_ms: Stages of the last frame by name [ms]; empty before the first. The sum of `select_ms`, `refine_ms`,
            `broad_ms` and `query_ms` is T.
        nodes_refitted: Nodes that the last frame refitted.
        lods_changed: Whether it changed any LOD.
        result: Result of its query, with the tests of every pair; None before the first.
    """

    time: float
    stage_ms: dict = field(default_factory=dict)
    nodes_refitted: int = 0
    lods_changed: bool = False
    result: Result | None = None

    @property
    def cost_ms(self) -> float:
        """T', the time of interference detection in the last frame [ms]; NaN before the first."""
        return sum(self.stage_ms[name] for name in COST_STAGES) if self.stage_ms else math.nan


class Controller:
    """What all controllers share: the view of the scene.

    Args:
        scene: `Scene` with all its objects.
        camera: `Camera`, or a function from time [s] to one; None takes every object as near and still.
        window: Frames over which motion on the screen is measured.

    Attributes:
        budget_ms: T [ms], None without a budget.
        lods: LODs last given, int32 (n,) on the device.
    """

    budget_ms: float | None = None
    selection: Any  # its operator, of `warp_abtree.lod.selection`

    def __init__(self, scene, camera: Camera | Callable[[float], Camera] | None = None, window: int = 10):
        if not (camera is None or isinstance(camera, Camera) or callable(camera)):
            raise TypeError(f"camera is a {type(camera).__name__}, neither a Camera nor a function of time")
        self.scene, self.camera = scene, camera
        self.view = View(scene, window)

    def next_lods(self, feedback: Feedback) -> wp.array:
        """Return the LOD of every object for the coming frame, int32 (n,) on the device, overwritten by the next call.

        Args:
            feedback: Of the last frame; at first, a `Feedback` with a time alone.

        Raises:
            RuntimeError: The scene's objects changed since the controller was made.
        """
        self.view.check()
        if self.camera is not None:
            self.view.look(self.camera if isinstance(self.camera, Camera) else self.camera(feedback.time))
            self.view.launch()
        self._update(feedback)
        self.selection.launch()
        return self.selection.lods

    def _update(self, feedback):
        """Upload what the selection needs of the feedback."""


class PaperController(Controller):
    """The paper's selection model: LODs rise and fall by powers of two about a budget (section 4.2).

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
        self.selection = PaperSelection(self.view, budget_ms, threshold_ms, Ladder(scene.models, steps))
        self.budget_ms = budget_ms

    def _update(self, feedback):
        self.selection.cost.fill_(feedback.cost_ms)


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
        self.selection = ToleranceSelection(self.view, tolerance, loosest, Ladder(scene.models, steps, spacing))


class CostFit:
    """Least-squares fit of time against work with exponential forgetting; slope and intercept are at least 0.

    Where the work hardly varies the line goes through the origin. A time off the line by more than a factor of 2 is
    clamped to it, so that a single hitch of the machine moves the line little.

    Args:
        forget: Factor on the weight of an observation at each new one.
    """

    def __init__(self, forget: float = 0.9):
        self.forget = forget
        self.sums = np.zeros(5)

    def add(self, work: float, time: float):
        """Add an observation."""
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

    The cost is predicted from the tests of the last frame's pairs and the recent rates of this machine (see
    `warp_abtree.lod.selection.PredictedSelection`); tests grow as a power of the faces, with a fitted exponent.

    Args:
        scene, camera, window: As in `Controller`.
        budget_ms: T [ms].
        steps, spacing: As in `Ladder`.
        options: aim, low, hold_frames, loosest of `PredictedSelection`.

    Raises:
        TypeError, ValueError: As `PaperController`.
    """

    def __init__(self, scene, budget_ms, camera=None, steps=50, spacing="ratio", window=10, **options):
        self.budget_ms = positive(budget_ms, "budget_ms")
        super().__init__(scene, camera, window)
        ladder = Ladder(scene.models, steps, spacing)
        self.selection = PredictedSelection(self.view, self.budget_ms, ladder=ladder, **options)
        self._query, self._refine, self._rest = CostFit(), CostFit(), CostFit()
        self._exponent, self._drift = 1.0, 0.0

    @property
    def predicted_ms(self) -> float:
        """Predicted cost of the next frame [ms], NaN before the second. Waits for the device."""
        choice = self.selection.choice.numpy()
        return float(choice[1] + choice[2])

    def _update(self, feedback):
        if feedback.result is None:
            return
        stages, result, count = feedback.stage_ms, feedback.result, self.scene.object_count
        tests = result.node_tests + TRIANGLE_WORK * result.triangle_tests
        work = np.zeros(count)
        if len(result.pairs):
            first, second = (np.bincount(result.pairs[:, side], tests, count) for side in (0, 1))
            work = 0.5 * (first + second)
        total = float(tests.sum())
        self._fit_exponent(total)
        self._query.add(total, stages["query_ms"])
        self._rest.add(0.0, stages["select_ms"] + stages["broad_ms"])
        if feedback.lods_changed:
            self._refine.add(float(feedback.nodes_refitted), stages["refine_ms"])
        per_work, fixed = self._query.line()
        per_node, change = (0.0 if math.isnan(rate) else rate for rate in self._refine.line())
        fixed += self._rest.line()[1]
        # Conservative both ways: a climb costs more than fitted, a fall saves less.
        up, down = self._exponent + 0.2, max(self._exponent - 0.2, 0.1)
        grown = math.exp(self._drift)
        self.selection.rate.assign(np.array([fixed, per_work * grown, change, per_node, up, down]))
        self.selection.work.assign(work)

    def _fit_exponent(self, total):
        """Fit to the tests counted, against those predicted: the exponent if LODs changed, the drift if not."""
        _, _, _, predicted, before = self.selection.choice.numpy()
        if not (predicted > 0 and before > 0 and total > 0):
            self._drift *= 0.8
            return
        expected, found = math.log(predicted / before), math.log(total / before)
        if abs(expected) > 0.02:
            exponent = self._exponent + 0.2 if expected > 0 else max(self._exponent - 0.2, 0.1)
            slope = min(max(exponent * found / expected, 0.1), 1.5)
            self._exponent += min(abs(expected), 0.2) * (slope - self._exponent)
            found -= expected
        self._drift += 0.2 * (min(max(found, -0.2), 0.2) - self._drift)
        self._drift = max(self._drift, 0.0)
