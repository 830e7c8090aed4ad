"""Selection of LODs on the device: ladders, what the viewer sees, the paper's model, a tolerance, a predicted budget.

Operators here allocate once; `launch()` only launches, so that a graph can capture it, and leaves device arrays.
`warp_abtree.lod.controllers` feeds them frame by frame.

Source: Liu et al. 2006, section 4, and figure 4. Errata, kept here: g2 is printed with the absolute frame number and
would explode; figure 4 counts from the start of the last climb, so that a descent mirrors it. In Case 2 the change is
signed: the LOD falls. After the mirror g2 is 0 for ever and a scene over budget would stay so; here the smallest step,
one rung a frame, goes on. f is clamped to [0, 1], where an object is beyond D or its way longer than W.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy, whole_number
from warp_abtree.kernels.lod import selection as kernels
from warp_abtree.state.lod_update import full_refit_fraction

SPACINGS = ("operations", "ratio")
LEVELS_PER_OCTAVE = int(kernels.STEPS_PER_OCTAVE) // int(kernels.DITHER)

# Changes of the dial that the predicted budget weighs, finest first, in steps of 2^(1/16) of the tolerance.
CLIMBS = (8, 4, 2, 1)
FALLS = tuple(-round(2.0 ** (i / 2)) for i in range(21) if i not in (1, 3))


def _finite(values, what, shape) -> np.ndarray:
    array = to_numpy(values, what).astype(np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        wanted = "a finite number" if shape == () else f"{' by '.join(map(str, shape))} finite numbers"
        raise ValueError(f"{what}: {values!r} is not {wanted}")
    return array


def positive(value, what: str) -> float:
    """Return a finite number above 0 as float.

    Raises:
        ValueError: It is none.
    """
    number = float(_finite(value, what, ()))
    if not number > 0:
        raise ValueError(f"{what} {value!r} is not above 0")
    return number


@dataclass(frozen=True, eq=False)
class Camera:
    """Where the viewer stands, and what a pixel is.

    Attributes:
        eye: Position [world units], (3,).
        view: Rows right, up, towards the eye: the rotation of the view matrix, (3, 3).
        field_of_view: Vertical angle [rad].
        size: Width and height of the screen [pixels].
        far: D of the paper, how far one sees [world units].

    Raises:
        ValueError: A number that is not finite or not above 0, an angle of 180 degrees or more, rows that are no
            rotation within 1e-6.
    """

    eye: np.ndarray
    view: np.ndarray
    field_of_view: float = math.radians(60.0)
    size: tuple[int, int] = (1920, 1080)
    far: float = 100.0

    def __post_init__(self):
        object.__setattr__(self, "eye", _finite(self.eye, "eye", (3,)))
        view = _finite(self.view, "view", (3, 3))
        if not np.abs(view @ view.T - np.eye(3)).max() <= 1e-6 or not np.linalg.det(view) > 0:
            raise ValueError("view: the rows are no rotation")
        object.__setattr__(self, "view", view)
        if not positive(self.field_of_view, "field_of_view") < math.pi:
            raise ValueError(f"field_of_view {self.field_of_view!r} is 180 degrees or more")
        for side in _finite(self.size, "size", (2,)):
            positive(side, "size")
        positive(self.far, "far")

    @classmethod
    def look_at(cls, eye, target, up=(0.0, 1.0, 0.0), **options) -> "Camera":
        """Return a camera at `eye` that looks at `target`, both in world units, with `up` upwards on its screen.

        Raises:
            ValueError: `target` is `eye`, or `up` points along the view.
        """
        back = _finite(eye, "eye", (3,)) - _finite(target, "target", (3,))
        right = np.cross(_finite(up, "up", (3,)), back)
        length = np.linalg.norm(back), np.linalg.norm(right)
        if not length[0] > 0 or not length[1] > 1e-9 * length[0] * np.linalg.norm(up):
            raise ValueError("the camera looks at its own eye, or along up")
        back, right = back / length[0], right / length[1]
        return cls(eye, np.stack([right, np.cross(back, right), back]), **options)

    def packed(self) -> np.ndarray:
        """Return what kernels read: eye, rows, focal length and diagonal W [pixels], D; float64 (15,)."""
        width, height = self.size
        focal = 0.5 * height / math.tan(0.5 * self.field_of_view)
        return np.concatenate([self.eye, self.view.ravel(), [focal, math.hypot(width, height), self.far]])


class Ladder:
    """The LODs that objects may stand at, so that objects of one model share tree states.

    Args:
        models: `Model`s of a scene, in its order.
        steps: Rungs above the coarsest; Delta LOD of the paper is the operations of a model divided by it.
        spacing: "operations": rungs differ by equal numbers of operations, as in the paper. "ratio": by equal ratios of
            the active faces, which resolves the coarse end, where a rung of 1/50 of the operations may double the faces
            many times over.

    Attributes:
        lod: LOD of each rung, int32 (models, steps + 1).
        error: `Model.error_at` of each [model units], falling to 0, float64 (models, steps + 1).
        faces: Active faces of each, int32 (models, steps + 1).

    Raises:
        ValueError: steps is no whole number from 1, or an unknown spacing.
    """

    def __init__(self, models, steps: int = 50, spacing: str = "operations"):
        self.steps = whole_number(steps, "steps", 1, 2**20)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing {spacing!r} is none of {', '.join(map(repr, SPACINGS))}")
        self.lod = np.array([self._rungs(model, spacing) for model in models], np.int32)
        forests = [model.progressive for model in models]
        self.error = np.array([forest.lod_error[lods] for forest, lods in zip(forests, self.lod, strict=True)])
        self.faces = np.array(
            [forest.active_count(lods) for forest, lods in zip(forests, self.lod, strict=True)], np.int32
        )
        self._entry = np.array([f.split_start[lods] for f, lods in zip(forests, self.lod, strict=True)], np.int32)
        self._face_count = np.array([model.face_count for model in models], np.int32)

    def _rungs(self, model, spacing):
        share = np.arange(self.steps + 1) / self.steps
        if spacing == "operations":
            return np.floor(share * model.lod_max + 0.5).astype(np.int32)
        counts = np.maximum(model.progressive.active_count(np.arange(model.lod_max + 1)), 1)
        wanted = counts[0] * (counts[-1] / counts[0]) ** share
        lods = np.minimum(np.searchsorted(counts, wanted * (1 - 1e-12)), model.lod_max)
        lods[0], lods[-1] = 0, model.lod_max
        return lods.astype(np.int32)

    def levels(self) -> np.ndarray:
        """Return the tolerances of the dial, falling by 2^(1/4), the last 0 [world units], float64."""
        top, known = self.error.max(), self.error[self.error > 0]
        count = 1 + math.ceil(LEVELS_PER_OCTAVE * math.log2(top / known.min())) if len(known) else 1
        return np.append(top * 2.0 ** (-np.arange(count) / LEVELS_PER_OCTAVE), 0.0)

    def pool(self, scene) -> kernels.LodPool:
        """Return the ladder and the objects of a scene for kernels."""

        def upload(values, dtype=wp.int32):
            return wp.array(np.ascontiguousarray(values).ravel(), dtype=dtype, device=scene.device)

        pool = kernels.LodPool()
        pool.object_model = upload(np.array(scene.object_model, np.int32))
        pool.importance = upload(np.array(scene.object_importance, np.int32))
        pool.lod, pool.faces, pool.entry = upload(self.lod), upload(self.faces), upload(self._entry)
        pool.error = upload(self.error, wp.float64)
        pool.face_count = upload(self._face_count)
        levels = self.levels()
        rungs = np.stack([(error > levels[:, None]).sum(1) for error in self.error]).astype(np.int32)
        rungs[:, 0] = 0
        pool.level_rung = upload(rungs)
        pool.rung_count, pool.level_count = self.steps + 1, len(levels)
        return pool


class View:
    """Operator: alpha, gamma and f of every object, as the scene stands.

    Args:
        scene: `Scene` with all its objects.
        window: Frames of which gamma is the way on the screen.

    Attributes:
        distance: alpha, from the eye to the middle of the object [world units], float64 (n,) on the device.
        motion: gamma, length of its way on the screen over the last `window` launches [pixels], float64 (n,); what
            lies behind the camera adds nothing.
        focus: f = min((D - alpha) / D, (W - gamma) / W) within [0, 1], float64 (n,); 1 before any camera.
    """

    def __init__(self, scene, window: int = 10):
        self.scene = scene
        self.window = whole_number(window, "window", 1, 1000)
        self._batch = scene.batch()
        self.device, count = scene.device, scene.object_count
        self._object_model = wp.array(np.array(scene.object_model, np.int32), dtype=wp.int32, device=self.device)
        self.distance, self.motion = (wp.zeros(count, dtype=wp.float64, device=self.device) for _ in range(2))
        self.focus = wp.full(count, 1.0, dtype=wp.float64, device=self.device)
        self._screen = wp.zeros(count, dtype=wp.vec3d, device=self.device)
        self._path = wp.zeros(self.window * count, dtype=wp.float64, device=self.device)
        self._frame = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._view = wp.zeros(15, dtype=wp.float64, device=self.device)

    def look(self, camera: Camera):
        """Look through a camera from the next launch on; a launch in a captured graph reads what stands then."""
        self._view.assign(camera.packed())

    def check(self):
        """Raise RuntimeError where the scene's objects changed since the operator was made."""
        self._batch.check("selection")

    def launch(self):
        """Measure. Launches only.

        Raises:
            RuntimeError: The scene's objects changed.
        """
        self.check()
        models, objects = self._batch.models, self._batch.objects
        inputs = [self.window, models.pool.centre, self._object_model, self._view]
        inputs += [objects.pool.rotation, objects.pool.position, self._frame]
        inputs += [self._screen, self._path, self.distance, self.motion, self.focus]
        wp.launch(kernels.measure_view_kernel, dim=len(self.focus), inputs=inputs, device=self.device)
        wp.launch(kernels.advance_frame_kernel, dim=1, inputs=[self._frame], device=self.device)


class PaperSelection:
    """Operator: the selection model of section 4.2. Every object starts at its coarsest LOD.

    Args:
        view: `View` of the scene; launched by whoever owns it.
        budget: T [ms].
        threshold: t [ms]; None is 10 % of T.
        ladder: `Ladder` of the scene's models; None is the paper's, 50 steps of equal operations.

    Attributes:
        cost: T', the time of the last frame [ms], float64 (1,) on the device, written by the caller; NaN at first.
        case: Case of the last launch, frames it has lasted, frames of the last climb, int32 (3,) on the device.
        level: Where each object stands [rungs], parts of a rung kept, float64 (n,) on the device.
        lods: LOD of each object, int32 (n,) on the device.
    """

    def __init__(self, view: View, budget: float, threshold: float | None = None, ladder: Ladder | None = None):
        self.view, scene = view, view.scene
        self.budget = positive(budget, "budget")
        self.threshold = 0.1 * self.budget if threshold is None else positive(threshold, "threshold")
        self.ladder = Ladder(scene.models) if ladder is None else ladder
        self.pool = self.ladder.pool(scene)
        self.cost = wp.full(1, math.nan, dtype=wp.float64, device=scene.device)
        self.case = wp.zeros(3, dtype=wp.int32, device=scene.device)
        self.level = wp.zeros(scene.object_count, dtype=wp.float64, device=scene.device)
        self.lods = wp.zeros(scene.object_count, dtype=wp.int32, device=scene.device)

    def launch(self):
        """Select the LODs of a frame. Launches only."""
        device = self.view.device
        inputs = [self.budget, self.threshold, self.cost, self.case]
        wp.launch(kernels.advance_case_kernel, dim=1, inputs=inputs, device=device)
        inputs = [self.pool, self.view.focus, self.case, self.level, self.lods]
        wp.launch(kernels.step_level_kernel, dim=len(self.lods), inputs=inputs, device=device)


class ToleranceSelection:
    """Operator: the coarsest LOD whose certified error is within each object's own tolerance.

    That is the tolerance times beta / f: twice it at half of D, or where an object crosses half the screen in `window`
    frames, for far and fast objects matter less (section 4.1); three times it for objects that are not important.

    Args:
        view: `View` of the scene; launched by whoever owns it.
        tolerance: Error of an important, still object at the eye [world units], at least 0.
        loosest: Most that a tolerance is loosened.
        ladder: `Ladder`; None has 50 steps of equal ratios.

    Attributes:
        tolerance: float64 (1,) on the device; may be written between launches.
        lods: LOD of each object, int32 (n,) on the device.
    """

    def __init__(self, view: View, tolerance: float, loosest: float = 64.0, ladder: Ladder | None = None):
        self.view, scene = view, view.scene
        value = float(_finite(tolerance, "tolerance", ()))
        if not value >= 0:
            raise ValueError(f"tolerance {tolerance!r} is below 0")
        self.loosest = check_loosest(loosest)
        self.ladder = Ladder(scene.models, spacing="ratio") if ladder is None else ladder
        self.pool = self.ladder.pool(scene)
        self.tolerance = wp.full(1, value, dtype=wp.float64, device=scene.device)
        self.lods = wp.zeros(scene.object_count, dtype=wp.int32, device=scene.device)

    def launch(self):
        """Select the LODs of a frame. Launches only."""
        inputs = [self.loosest, self.pool, self.view.focus, self.tolerance, self.lods]
        device = self.view.device
        wp.launch(kernels.select_tolerance_kernel, dim=len(self.lods), inputs=inputs, device=device)


def check_loosest(loosest) -> float:
    """Return the most that a tolerance is loosened, at least 1.

    Raises:
        ValueError: It is below 1 or not finite.
    """
    if not positive(loosest, "loosest") >= 1:
        raise ValueError(f"loosest {loosest!r} is below 1")
    return float(loosest)


class PredictedSelection:
    """Operator: the finest common tolerance whose predicted cost keeps a budget; objects loosen it as in
    `ToleranceSelection`.

    A dial holds the tolerance in steps of 2^(1/16). Each launch predicts, for some steps up and down, the tests
    from the last frame's tests of every object and the faces it would have, and the nodes refitted from the rungs that
    nobody stands at yet, and takes the finest step that keeps the budget (`choose_dial_kernel`).

    Args:
        view: `View` of the scene; launched by whoever owns it.
        budget: T [ms].
        aim: Part of the budget that a change goes for.
        low: Part of the budget under which it climbs. Between `low` and 1 the dial stays: hysteresis.
        patience: Frames that a move waits, because its own refit does not fit into the budget, before it is made.
        loosest: Most that a tolerance is loosened.
        ladder: `Ladder`; None has 50 steps of equal ratios.

    Attributes:
        rate: Prices, float64 (6,) on the device, written by the caller: ms of a frame, of a unit of work, of any change
            of LODs, of a node refitted; exponents of the faces with which tests grow and fall. NaN at first: no change.
        work: Work of each object in the last frame, float64 (n,) on the device, written by the caller.
        dial: Step (0 is the coarsest), and frames that a climb has waited, int32 (2,) on the device.
        choice: Candidate, its lasting and moving cost [ms], its work, the work in place, float64 (5,) on the device.
        rung, lods: Rung and LOD of each object, int32 (n,) on the device.

    Raises:
        ValueError: A number out of range; low and aim must rise: 0 < low <= aim <= 1.
    """

    def __init__(self, view, budget, aim=0.9, low=0.75, patience=30, loosest=64.0, ladder: Ladder | None = None):
        self.view, scene = view, view.scene
        self.budget, self.aim, self.low = positive(budget, "budget"), positive(aim, "aim"), positive(low, "low")
        if not self.low <= self.aim <= 1:
            raise ValueError(f"low {low!r} and aim {aim!r} do not rise to at most 1")
        self.patience = whole_number(patience, "patience", 0, 2**30)
        self.loosest = check_loosest(loosest)
        self.ladder = Ladder(scene.models, spacing="ratio") if ladder is None else ladder
        self.pool = self.ladder.pool(scene)
        most = int(math.log2(self.loosest) * int(kernels.STEPS_PER_OCTAVE))
        self.dial_max = int(kernels.DITHER) * (self.pool.level_count - 1) + most
        self.stay = len(CLIMBS)
        device, count = scene.device, scene.object_count

        def zeros(length, dtype=wp.float64):
            return wp.zeros(length, dtype=dtype, device=device)

        # The last candidate is the rungs in place.
        steps = [*CLIMBS, 0, *(step for step in FALLS if step > -self.dial_max), -self.dial_max, 0]
        candidates, models, rungs = len(steps), len(scene.models), len(scene.models) * (self.ladder.steps + 1)
        self._shape = candidates, models
        prediction = kernels.Prediction()
        prediction.step = wp.array(np.array(steps, np.int32), dtype=wp.int32, device=device)
        chunks = candidates * int(kernels.CHUNKS)
        prediction.chunk_work, prediction.chunk_change = zeros(chunks), zeros(chunks, wp.int32)
        prediction.work, prediction.change = zeros(candidates), zeros(candidates, wp.int32)
        prediction.nodes, prediction.held = zeros(candidates), zeros(candidates * rungs, wp.int32)
        prediction.power_up, prediction.power_down = zeros(rungs), zeros(rungs)
        prediction.rate = self.rate = wp.full(6, math.nan, dtype=wp.float64, device=device)
        self._prediction = prediction
        self.work, self.choice = zeros(count), zeros(5)
        self.dial, self._offset = zeros(2, wp.int32), zeros(count, wp.int32)
        self.rung, self.lods = zeros(count, wp.int32), zeros(count, wp.int32)

    def launch(self):
        """Predict, choose and select the LODs of a frame. Launches only."""
        prediction, pool, count = self._prediction, self.pool, len(self.lods)
        candidates, models = self._shape

        def launch(kernel, dim, *inputs):
            wp.launch(kernel, dim=dim, inputs=list(inputs), device=self.view.device)

        prediction.held.zero_()
        prediction.nodes.zero_()
        launch(kernels.loosen_object_kernel, count, self.loosest, pool, self.view.focus, self._offset)
        launch(kernels.raise_faces_kernel, len(prediction.power_up), pool, prediction)
        inputs = models, pool, self.dial, self._offset, self.rung, self.work, prediction
        launch(kernels.predict_work_kernel, (candidates, int(kernels.CHUNKS)), *inputs)
        share = full_refit_fraction(self.view.device)
        launch(kernels.predict_refit_kernel, (candidates, models), models, share, pool, prediction)
        launch(kernels.sum_chunk_kernel, candidates, prediction)
        limits = self.budget, self.aim, self.low, self.patience, self.dial_max, self.stay
        launch(kernels.choose_dial_kernel, 1, *limits, prediction, self.dial, self.choice)
        launch(
            kernels.set_rung_kernel,
            count,
            candidates - 1,
            pool,
            self.dial,
            self._offset,
            self.choice,
            self.rung,
            self.lods,
        )
