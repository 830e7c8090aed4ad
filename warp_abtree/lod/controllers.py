"""Controllers of LODs: each frame they take the feedback of the last one and select the LODs of the next.

Before a frame `prepare(feedback)` writes a few numbers to the device; `launch()`, which only launches, so that a graph
can capture it, selects the LODs of all objects there. `budget_ms` is T, None without a budget. Controllers never read a
clock: times are part of the feedback, so that runs repeat on counted work. They allocate once.

Source: Liu et al. 2006, section 4, and figure 4. Errata, kept here: g2 is printed with the absolute frame number and
would explode; figure 4 counts from the start of the last climb, so that a descent mirrors it. In Case 2 the change is
signed: the LOD falls. After the mirror g2 is 0 for ever and a scene over budget would stay so; here the smallest step,
one level a frame, goes on. f is clamped to [0, 1], where an object is beyond D or its path longer than W.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import finite_array, positive, whole_number
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.upload import Download, Upload, struct_of
from warp_abtree.kernels.lod import paper, prediction, tolerance
from warp_abtree.kernels.lod.ladder import WARP
from warp_abtree.lod.selection import lod_pool
from warp_abtree.lod.timing import CostFit
from warp_abtree.lod.view import Camera, View
from warp_abtree.scene.posed_objects import expect_scene
from warp_abtree.state.ladder import Ladder
from warp_abtree.state.work_lists import full_refit_fraction

# Threads that share the objects of a candidate, at most.
CHUNKS_MOST = 8192

# Changes of the position on the tolerance scale that are candidates, finest first, in steps of 2^(1/16).
CLIMBS = (8, 4, 2, 1)
FALLS = tuple(-round(2.0 ** (i / 2)) for i in range(21) if i not in (1, 3))


@dataclass(frozen=True)
class Feedback:
    """Feedback to a controller before a frame.

    Attributes:
        time: Time of the next frame [s].
        stage_ms: Stages of the last frame by name [ms], whose sum is T'; empty before the first.
        nodes_refitted: Nodes that the last frame refitted.
        tests: Tests of its query, in tests of two boxes; None before the first. Those of each object a frame brings to
            `PredictiveController.tests` itself.
    """

    time: float
    stage_ms: dict = field(default_factory=dict)
    nodes_refitted: int = 0
    tests: float | None = None

    @property
    def cost_ms(self) -> float:
        """T', the time of the last frame [ms]; NaN before the first."""
        return sum(self.stage_ms.values()) if self.stage_ms else math.nan


class Controller(DeviceMemory):
    """Base of all controllers.

    Args:
        scene: `Scene` with all its objects.
        camera: `Camera`, or a function from time [s] to one; None takes every object as near and still.
        window: Frames over which motion on the screen is measured.
        ladder: `Ladder` of the scene's models.

    Attributes:
        budget_ms: T [ms], None without a budget.
        view: `View` of the scene.
        lods: LODs last selected, int32 (n,) on the device.
        tests: Tests of the last frame that each object took part in, written by what runs frames; None where the
            controller reads none.
        chosen: `kernels.lod.prediction.LevelChoice`, what LODs follow from after `choose`; empty where that sets them.
    """

    budget_ms: float | None = None
    tests: wp.array | None = None

    def __init__(self, scene, camera: Camera | Callable[[float], Camera] | None, window: int, ladder: Ladder):
        if not (camera is None or isinstance(camera, Camera) or callable(camera)):
            raise TypeError(f"camera is a {type(camera).__name__}, neither a Camera nor a function of time")
        self.scene, self.camera, self.ladder, self.device = scene, camera, ladder, scene.device
        self.view, self.pool = View(scene, window), lod_pool(ladder, scene)
        self._ahead = math.nan  # time of a camera that was brought for the next `prepare`
        self.lods, self.chosen = self._zeros(scene.object_count, wp.int32), prediction.LevelChoice()

    def next_lods(self, feedback: Feedback) -> wp.array:
        """Return the LOD of every object for the coming frame, int32 (n,) on the device, overwritten by the next call.

        `feedback` is of the last frame; at first, a `Feedback` with a time alone. Raises RuntimeError where the scene's
        objects changed since the controller was made.
        """
        self.prepare(feedback)
        self.launch()
        return self.lods

    def rests(self, feedback: Feedback) -> bool:
        """Return whether a selection would leave all LODs as they are, and may be left out. Waits for the device."""
        return False

    def prepare(self, feedback: Feedback, rests: bool = False):
        """Bring to the device what `launch` reads of the feedback and the camera; a captured graph reads it too.

        `rests` tells whether the selection is left out. Raises RuntimeError as `next_lods`.
        """
        self.view.check()
        if self._ahead != feedback.time:
            self.look_ahead(feedback.time)
        self._ahead = math.nan
        if not rests:
            self._update(feedback)

    def look_ahead(self, time: float):
        """Bring the camera of the next `prepare` to the device, behind what was launched."""
        if self.camera is not None:
            self.view.look(self.camera(time) if callable(self.camera) else self.camera)
        self._ahead = time

    def launch(self, rests: bool = False):
        """Measure the view as the camera and the objects stand, and select LODs unless it rests. Launches only."""
        if self.camera is not None:
            self.view.launch()
        if not rests:
            self._select()

    def choose(self, rests: bool = False):
        """Do what `launch` does, but leave it to the frame's own kernel to set what follows from `chosen`."""
        self.launch(rests)

    def _select(self):
        raise NotImplementedError

    def _update(self, feedback):
        """Upload what the selection needs of the feedback."""

    def _zeros(self, length, dtype=wp.float64):
        return wp.zeros(length, dtype=dtype, device=self.device)

    def _launch(self, kernel, dim, *inputs):
        wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.device)


class PaperController(Controller):
    """The paper's selection model: LODs rise and fall by powers of two about a budget (section 4.2).

    Every object starts at its coarsest LOD.

    Args:
        scene, camera, window: As in `Controller`.
        budget_ms: T [ms].
        threshold_ms: t [ms]; None is 10 % of T.
        steps: Delta LOD is the operations of a model divided by this.

    Attributes:
        cost: T', the time of the last frame [ms], float64 (1,) on the device; NaN at first.
        level: Level of each object on the LOD ladder, with its fraction, float64 (n,) on the device.

    Raises:
        TypeError: camera is neither a `Camera` nor a function.
        ValueError: Anything else is out of range.
    """

    def __init__(self, scene, budget_ms, camera=None, threshold_ms=None, steps: int = 50, window: int = 10):
        self.budget_ms = positive(budget_ms, "budget_ms")
        self.threshold = 0.1 * self.budget_ms if threshold_ms is None else positive(threshold_ms, "threshold_ms")
        super().__init__(scene, camera, window, Ladder(expect_scene(scene).models, steps))
        self.cost = wp.full(1, math.nan, dtype=wp.float64, device=self.device)
        # Case of the last launch, frames it has lasted, frames of the last climb.
        self._case, self.level = self._zeros(3, wp.int32), self._zeros(len(self.lods))

    def _update(self, feedback):
        self.cost.fill_(feedback.cost_ms)

    def _select(self):
        self._launch(paper.advance_case_kernel, 1, self.budget_ms, self.threshold, self.cost, self._case)
        inputs = self.pool, self.view.focus, self._case, self.level, self.lods
        self._launch(paper.advance_level_kernel, len(self.lods), *inputs)


class ToleranceController(Controller):
    """The coarsest LOD whose certified error is within each object's own tolerance.

    That is the tolerance times beta / f: twice it at half of D, or where an object crosses half the screen in `window`
    frames, since far and fast objects matter less (section 4.1); three times it for objects that are not important.

    Args:
        scene, camera, window: As in `Controller`.
        tolerance: Error of an important, still object at the eye [world units], at least 0.
        loosest: Most that a tolerance is loosened.
        steps, spacing: As in `Ladder`.

    Attributes:
        tolerance: float64 (1,) on the device; may be written between frames.

    Raises:
        TypeError, ValueError: As `PaperController`.
    """

    def __init__(self, scene, tolerance, camera=None, loosest=64.0, steps=50, spacing="ratio", window=10):
        value = float(finite_array(tolerance, "tolerance", ()))
        if not value >= 0:
            raise ValueError(f"tolerance {tolerance!r} is below 0")
        self.loosest = check_loosest(loosest)
        super().__init__(scene, camera, window, Ladder(expect_scene(scene).models, steps, spacing))
        self.tolerance = wp.full(1, value, dtype=wp.float64, device=self.device)

    def _select(self):
        inputs = self.loosest, self.pool, self.view.focus, self.tolerance, self.lods
        self._launch(tolerance.select_tolerance_kernel, len(self.lods), *inputs)


def check_loosest(loosest) -> float:
    """Return the most that a tolerance is loosened; raise ValueError unless it is finite and at least 1."""
    if not positive(loosest, "loosest") >= 1:
        raise ValueError(f"loosest {loosest!r} is below 1")
    return float(loosest)


class PredictiveController(Controller):
    """Hold a budget with the finest common tolerance whose predicted cost fits, loosened as in `ToleranceController`.

    The common tolerance is a position on a scale in steps of 2^(1/16). Each frame takes some finer and coarser
    positions as candidates. It predicts their tests from the last frame's tests of every object and the faces it would
    have (tests grow as a power of the faces, with a fitted exponent), and the nodes refitted, of models whose levels do
    not all have tree states; with the recent rates of this machine it takes the finest position that keeps the budget
    (`choose_position`).

    Args:
        scene, camera, window: As in `Controller`.
        budget_ms: T [ms].
        steps, spacing: As in `Ladder`.
        aim: Fraction of the budget that a change goes for.
        low: Fraction of the budget under which it climbs. Between `low` and 1 the position stays: hysteresis.
        hold_frames: Frames for which a change is held if its refit does not fit into the budget, before it is made.
        loosest: Most that a tolerance is loosened.

    Attributes:
        rate: See the RATE constants of `kernels.lod.prediction`, float64 (5,) on the device; NaN at first: no change.
        tests: int64 (n,) on the device.
        choice: See `choose_position`, float64 (6,) on the device.
        scale: Position, and frames that a change has been held, int32 (2,) on the device.
        offset: Positions by which each object is loosened, int32 (n,) on the device.
        changes: Change of the position of each candidate; the last leaves every object at its level.
        prediction: What each candidate would cost, `kernels.lod.prediction.Prediction`.

    Raises:
        TypeError, ValueError: As `PaperController`; low and aim must rise: 0 < low <= aim <= 1.
    """

    def __init__(
        self,
        scene,
        budget_ms,
        camera=None,
        steps=50,
        spacing="ratio",
        window=10,
        aim=0.9,
        low=0.75,
        hold_frames=30,
        loosest=64.0,
    ):
        self.budget_ms: float = positive(budget_ms, "budget_ms")
        self.aim, self.low = positive(aim, "aim"), positive(low, "low")
        if not self.low <= self.aim <= 1:
            raise ValueError(f"low {low!r} and aim {aim!r} do not rise to at most 1")
        self.hold_frames = whole_number(hold_frames, "hold_frames", 0, 2**30)
        self.loosest = check_loosest(loosest)
        super().__init__(scene, camera, window, Ladder(expect_scene(scene).models, steps, spacing))
        loosened = int(math.log2(self.loosest) * int(prediction.POSITIONS_PER_OCTAVE))
        self.position_max = int(prediction.DITHER) * (self.pool.tolerance_count - 1) + loosened
        falls = [step for step in FALLS if step > -self.position_max]
        self.changes = [*CLIMBS, 0, *falls, -self.position_max, 0]
        self._rates = Upload(5, self.device)
        self._rates.send([math.nan] * 5)
        powers = dict.fromkeys(("power_up", "power_down"), np.zeros(self.ladder.lod.size))
        sums = dict.fromkeys(("work", "nodes"), np.zeros(len(self.changes)))
        given = {"change": self.changes, "rate": self._rates.array, "ended": [0]}
        self.prediction = struct_of(prediction.Prediction, self.device, **given, **powers, **sums)
        self.rate, count = self.prediction.rate, len(self.lods)
        self.tests, self.choice = self._zeros(count, wp.int64), self._zeros(6)
        self._told = Download(6, wp.float64, self.device)  # the choice, for the host
        self.scale, self.offset = self._zeros(2, wp.int32), self._zeros(count, wp.int32)
        self.level = self._zeros(count, wp.int32)
        of_objects = {"scale": self.scale, "choice": self.choice, "offset": self.offset, "level": self.level}
        held = len(self.changes) - 1
        self.chosen = struct_of(prediction.LevelChoice, self.device, held=held, lods=self.pool, **of_objects)
        self._query, self._refine, self._rest = CostFit(), CostFit(), CostFit()
        self._exponent, self._drift = 1.0, 0.0

    def _limits(self):
        made = prediction.Limits()
        made.budget, made.aim, made.low = self.budget_ms, self.aim, self.low
        made.hold_frames, made.position_max, made.stay = self.hold_frames, self.position_max, len(CLIMBS)
        return made

    @property
    def predicted_ms(self) -> float:
        """Predicted cost of the next frame [ms], NaN before the second. Waits for the device."""
        choice = self._read_choice()
        return float(choice[1] + choice[2])

    def rests(self, feedback: Feedback) -> bool:
        """Return whether every object is at the finest LOD for good: the last frame was within `aim` of the budget."""
        return bool(self._read_choice()[5] == self.position_max and feedback.cost_ms <= self.aim * self.budget_ms)

    def _read_choice(self) -> np.ndarray:
        """Return what the last launch chose. Waits for the device."""
        if self.device.is_cuda:
            wp.synchronize_stream(wp.get_stream(self.device))
        return self._told.view

    def _update(self, feedback):
        if feedback.tests is None:
            return
        stages = feedback.stage_ms
        self._fit_exponent(feedback.tests)
        self._query.add(feedback.tests, stages["query_ms"])
        self._refine.add(float(feedback.nodes_refitted), stages["refine_ms"])
        self._rest.add(0.0, feedback.cost_ms - stages["query_ms"] - stages["refine_ms"])
        (per_work, fixed), (per_node, change) = self._query.line(), self._refine.line()
        fixed += change + self._rest.line()[1]
        # Conservative both ways: a climb costs more than fitted, a fall saves less.
        up, down = self._exponent + 0.2, max(self._exponent - 0.2, 0.1)
        grown = math.exp(self._drift)
        self._rates.send((fixed, per_work * grown, per_node, up, down))

    def _fit_exponent(self, total):
        """Fit to the tests counted, against those predicted: the exponent if LODs changed, the drift if not."""
        predicted, before = self._read_choice()[3:5].tolist()
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

    def launch(self, rests: bool = False):
        """Do what `Controller.launch` does."""
        self.choose(rests)
        if not rests:
            self._launch(prediction.set_level_kernel, len(self.lods), self.chosen, self.lods)

    def choose(self, rests: bool = False):
        """Measure the view, and choose a position on the tolerance scale. Launches only: two, or one that measures."""
        if rests:
            super().launch(rests)
            return
        self.view.check()
        predicted, poses = self.prediction, self.view.batch.objects.pool
        candidates, dim = len(self.changes), max(len(self.lods), len(self.changes), len(predicted.power_up))
        seen = self.camera is not None, poses.rotation, poses.position, self.view.arrays
        inputs = self.loosest, self.pool, *seen, predicted, self.offset
        self._launch(prediction.begin_prediction_kernel, dim, *inputs)
        # On the CPU one thread works anyway.
        chunks = min(CHUNKS_MOST, -(-len(self.lods) // WARP) * WARP) if self.device.is_cuda else WARP
        share, told = full_refit_fraction(self.device), self._told.array
        costs = chunks, share, self.tests, self._limits(), predicted, self.chosen, told
        self._launch(prediction.predict_kernel, (candidates, chunks), *costs)
