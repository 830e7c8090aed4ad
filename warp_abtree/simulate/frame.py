"""The frame loop: select LODs, refine, move, find candidate pairs, intersect them, respond; each stage timed.

LODs come from a function of time, or from a controller (`warp_abtree.lod.controllers`) that holds a budget.

Source: Liu et al. 2006, Algorithm 4.
"""

import csv
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import positive
from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.lod.controllers import Feedback
from warp_abtree.lod.timing import COST_STAGES, STAGES, Timer
from warp_abtree.model.model import Model
from warp_abtree.query.request import check_request
from warp_abtree.query.result import Result
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.budget_report import budget_report
from warp_abtree.simulate.motion import triangle_wave
from warp_abtree.state.work_lists import full_refit_fraction


def resolve_lod(model: Model, request) -> int:
    """Return the LOD that a request means for a model.

    Args:
        request: A float is a fraction of the faces in (0, 1], an int a LOD; "finest", "coarsest", or "tol:X", the
            coarsest LOD whose certified error is within X [model units]. A number as text with a dot is a float.

    Raises:
        ValueError: None of these, or out of range.
    """
    if request in ("finest", "coarsest"):
        return model.lod_max if request == "finest" else 0
    if isinstance(request, str):
        number = request.removeprefix("tol:")
        for kind in (float,) if number != request else (int, float):
            try:
                value = kind(number)
            except ValueError:
                continue
            return model.lod_for(tolerance=value) if number != request else resolve_lod(model, value)
        raise ValueError(f"LOD {request!r} is none of a fraction of the faces, a whole number, finest, coarsest, tol:X")
    return model.lod_for(fraction=request) if isinstance(request, float) else model.check_lod(request)


@dataclass(frozen=True)
class LodSweep:
    """LODs of some objects that go from one fraction of the faces to another and back, in equal ratios.

    Attributes:
        objects: Object indices by model, a list of (`Model`, int array).
        start, turn: Fractions of the faces at the start, and half a period later.
        period: Time there and back [s].
    """

    objects: list
    start: float
    turn: float
    period: float

    def fraction(self, time: float) -> float:
        """Return the fraction of the faces at a time [s]."""
        return self.start * (self.turn / self.start) ** float(triangle_wave(time / self.period))

    def apply(self, fraction: float, lods: np.ndarray):
        """Write the LODs of a fraction of the faces into the LODs of all objects, int (n,)."""
        for model, indices in self.objects:
            lods[indices] = model.lod_for(fraction=fraction)


@dataclass(frozen=True)
class FrameRow:
    """What one frame did.

    Attributes:
        frame, time: Number from 0, and time in the scene [s].
        objects, states: Objects, and the distinct (model, LOD) among them, which share a tree state.
        pairs: Candidate pairs of the broad phase.
        intersecting: Pairs that intersect.
        hits: Intersecting face pairs; None where only "any" was asked.
        lod_min, lod_max: Least and greatest LOD of any object.
        faces: Active faces of all objects together.
        error_mean, error_max: Mean and greatest `Model.error_at` of the objects at their LODs, one-sided [world units].
        lods_changed: Objects whose LOD this frame changed.
        oscillations: Those of them whose previous change had the opposite direction.
        nodes_refitted: Nodes of all updated trees.
        node_tests, triangle_tests: Pairs of boxes and of faces tested.
        budget_ms: T that a controller held [ms]; None without a budget.
        select_ms, refine_ms, move_ms: Selection of LODs; LOD change and refit; poses [ms].
        broad_ms, query_ms: Broad phase; narrow phase and results, and all of it where the motion finds contacts [ms].
        answer_ms: Response of the motion [ms].
    """

    frame: int
    time: float
    objects: int
    states: int
    pairs: int
    intersecting: int
    hits: int | None
    lod_min: int
    lod_max: int
    faces: int
    error_mean: float
    error_max: float
    lods_changed: int
    oscillations: int
    nodes_refitted: int
    node_tests: int
    triangle_tests: int
    budget_ms: float | None
    select_ms: float
    refine_ms: float
    move_ms: float
    broad_ms: float
    query_ms: float
    answer_ms: float

    @property
    def total_ms(self) -> float:
        """All stages together [ms]."""
        return sum(getattr(self, stage) for stage in STAGES)

    @property
    def cost_ms(self) -> float:
        """The stages that a budget is for, T = TR + TB + TQ + TLOD of the paper: all but movement [ms]."""
        return sum(getattr(self, stage) for stage in COST_STAGES)

    def as_dict(self) -> dict:
        """Return the row as plain values, total_ms and cost_ms among them."""
        return {**asdict(self), "total_ms": self.total_ms, "cost_ms": self.cost_ms}

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of `as_dict` in their order."""
        return [*(field.name for field in fields(cls)), "total_ms", "cost_ms"]


def load_update_kernels(scene: Scene):
    """Launch all kernels of LOD changes on a copy of the smallest model that uses them all.

    These are a partial refit from a copied state, one in place, and a full refit. Very small models always have full
    refits.
    """
    share, copy = full_refit_fraction(scene.device), Scene(device=scene.device)
    models = sorted((model for model in scene.models if model.lod_max), key=lambda model: model.face_count)
    if not models:
        return
    spans = [np.diff(model.progressive.split_start) for model in models]
    used = (i for i, model in enumerate(models) if spans[i].min() <= share * model.face_count)
    place = next(used, 0)
    chosen, step = models[place], int(spans[place].argmin())
    for _ in range(2):
        copy.add(chosen, lod=step)
    for lods in ((step, step + 1), (step + 1, step), (0, chosen.lod_max), (chosen.lod_max, chosen.lod_max)):
        copy.set_lods(lods)


class Frame:
    """Runs a scene frame by frame and keeps a `FrameRow` on each.

    A motion has a length, the number of objects, and these methods, called in this order in every frame:

    - `poses(time, out)` returns the poses at a time [s], float64 (n, 7), in `out` or an array of its own, or None if
      it has set the poses of the scene itself
    - `find(time_step)`, optional, returns a `Result` in place of the frame's own broad phase and query
    - `answer(result, time_step)`, optional, takes the result, and moves on by the time to the next frame [s]

    and optionally `warm_up(time_step)`, which loads the kernels of these and moves nothing.

    Args:
        scene: `Scene` with all its objects.
        motion: `Kinematic`, or anything with the methods above; None leaves the objects where they are.
        lods: A controller of `warp_abtree.lod.controllers`, or anything with its `next_lods` and `budget_ms`; or a
            function from time [s] to the LOD of every object, int (n,); None leaves them.
        output: Output of the query: "any", "count", "faces" or "contacts".
        time_step: Time between frames [s], above 0.
        clock: Returns seconds; read between stages when the device has finished. A clock with a method `charge` is
            first told the counted work of the stage (`WorkClock`). None is the host's clock, on a GPU CUDA events.

    Attributes:
        history: One `FrameRow` a frame run.

    Raises:
        ValueError: A motion of another number of objects, a time step that is not above 0 and finite, an unknown
            output, LODs that are neither a controller nor a function, or a clock that cannot be called.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Any = None,
        lods: Any = None,
        output: str = "count",
        time_step: float = 1 / 60,
        clock: Callable[[], float] | None = None,
    ):
        if motion is not None and len(motion) != scene.object_count:
            raise ValueError(f"the motion is of {len(motion)} objects, the scene has {scene.object_count}")
        if not (lods is None or callable(lods) or hasattr(lods, "next_lods")):
            raise ValueError(f"lods: a {type(lods).__name__} is neither a controller nor a function of time")
        if not (clock is None or callable(clock)):
            raise ValueError(f"clock: a {type(clock).__name__} cannot be called")
        check_request("faces" if output == "contacts" else output, "exact")
        self.scene = scene
        self.motion = motion
        self.lods = lods
        self.output = output
        self.time_step = positive(time_step, "time_step")
        self.history: list[FrameRow] = []
        self._timer = Timer(scene.device, clock)
        self._feedback = Feedback(0.0)
        self._poses = np.empty((scene.object_count, 7))
        self._model = np.array(scene.object_model)
        self._direction = np.zeros(scene.object_count, np.int8)
        scene.batch()
        self._measure_lods()

    def warm_up(self):
        """Run every stage once and keep no row, so that no row times the loading of kernels.

        Nothing moves, and LODs stay as they are: changes of them are launched on copies. Waits for the device.
        """
        if self.lods is not None:
            self._select(0.0)
            load_update_kernels(self.scene)
        if hasattr(self.motion, "warm_up"):
            self.motion.warm_up(self.time_step)
        if not hasattr(self.motion, "find"):
            self.scene.intersect(self.scene.broad_phase(), output=self.output)
        wp.synchronize_device(self.scene.device)

    def step(self) -> Result:
        """Run the next frame, append its row, and return what the query found. Waits for the device."""
        number, scene, timer = len(self.history), self.scene, self._timer
        time = number * self.time_step
        timer.begin()
        wanted = None if self.lods is None else self._select(time)
        timer.mark(selected=0 if wanted is None else scene.object_count)
        stats = None if wanted is None or np.array_equal(wanted, scene.lods) else scene.set_lods(wanted)
        refitted = _sum(stats.nodes_refitted) if stats is not None and timer.counts_work else 0
        timer.mark(lod_change=int(stats is not None), node_refitted=refitted)
        if self.motion is not None:
            poses = self.motion.poses(time, out=self._poses)
            if poses is not None:
                scene.set_poses(poses)
        timer.mark(posed=0 if self.motion is None else scene.object_count)
        finds = hasattr(self.motion, "find")
        pairs = None if finds else scene.broad_phase()
        timer.mark(candidate=0 if pairs is None else len(pairs))
        result = self.motion.find(self.time_step) if finds else scene.intersect(pairs, output=self.output)
        node_tests, triangle_tests = _sum(result.node_tests), _sum(result.triangle_tests)
        timer.mark(query=1, node_test=node_tests, triangle_test=triangle_tests)
        if hasattr(self.motion, "answer"):
            self.motion.answer(result, self.time_step)
        timer.mark()
        stage_ms = timer.stage_ms()
        refitted = 0 if stats is None else _sum(stats.nodes_refitted)
        changed, oscillations = (0, 0) if stats is None else self._measure_lods()
        self._feedback = Feedback(time, stage_ms, refitted, stats is not None, result)
        self.history.append(
            FrameRow(
                frame=number,
                time=time,
                objects=scene.object_count,
                pairs=len(result.pairs),
                intersecting=int(np.count_nonzero(result.any)),
                hits=None if result.count is None else _sum(result.count),
                lods_changed=changed,
                oscillations=oscillations,
                nodes_refitted=refitted,
                node_tests=node_tests,
                triangle_tests=triangle_tests,
                budget_ms=getattr(self.lods, "budget_ms", None),
                **self._lod_columns,
                **stage_ms,
            )
        )
        return result

    def run(self, frames: int, progress=None) -> list[FrameRow]:
        """Run a number of frames and return the whole history; progress(done, total) is called after each."""
        for done in range(1, frames + 1):
            self.step()
            if progress is not None:
                progress(done, frames)
        return self.history

    def summary(self, after: float = 1.0) -> dict:
        """Return mean, min and max of the counts, the range of LODs, and mean, p95 and total of stages [ms].

        Args:
            after: `budget`, the result of `budget_report`, leaves out frames before this time [s].

        Raises:
            ValueError: No frame has run.
        """
        if not self.history:
            raise ValueError("a summary is of frames, and none has run")
        rows = [row.as_dict() for row in self.history]
        found: dict[str, Any] = {"frames": len(rows), "objects": self.scene.object_count, "stages": {}}
        counts = "states", "pairs", "intersecting", "hits", "faces", "nodes_refitted", "node_tests", "triangle_tests"
        for name in (*counts, "error_mean", "error_max"):
            values = np.array([math.nan if row[name] is None else row[name] for row in rows], np.float64)
            found[name] = {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}
        for name in (*STAGES, "total_ms", "cost_ms"):
            values = np.array([row[name] for row in rows])
            p95 = float(np.percentile(values, 95))
            found["stages"][name] = {"mean": float(values.mean()), "p95": p95, "total": float(values.sum())}
        found["lod_min"] = min(row["lod_min"] for row in rows)
        found["lod_max"] = max(row["lod_max"] for row in rows)
        found["budget_ms"] = rows[-1]["budget_ms"]
        found["budget"] = budget_report(self.history, after=after)
        return found

    def record(self, path):
        """Write the history to a .json file, or as CSV to any other, atomically.

        Raises:
            OSError: The file cannot be written.
        """
        rows = [row.as_dict() for row in self.history]
        with atomic_write(path, "w", newline="", encoding="utf-8") as file:
            if Path(path).suffix.lower() == ".json":
                json.dump(rows, file, indent=1)
            else:
                writer = csv.DictWriter(file, FrameRow.names())
                writer.writeheader()
                writer.writerows(rows)

    def _select(self, time):
        """Return the LODs that are wanted at a time, on the host. (synchronization point)"""
        if hasattr(self.lods, "next_lods"):
            return self.lods.next_lods(replace(self._feedback, time=time)).numpy()
        return np.asarray(self.lods(time))

    def _measure_lods(self):
        """Measure the LODs as they stand; return how many changed, and how many of these reversed their direction."""
        scene, lods = self.scene, self.scene.lods.astype(np.int64)
        direction = np.sign(lods - getattr(self, "_lods", lods)).astype(np.int8)
        changed = int(np.count_nonzero(direction))
        oscillations = int(np.count_nonzero(direction * self._direction < 0))
        self._direction = np.where(direction == 0, self._direction, direction)
        self._lods = lods
        keys, repeats = np.unique((self._model.astype(np.int64) << 32) + lods, return_counts=True)
        states = [(scene.models[key >> 32], key & (2**32 - 1)) for key in keys.tolist()]
        errors = np.array([model.error_at(lod) for model, lod in states])
        faces = np.array([model.progressive.active_count(lod) for model, lod in states])
        self._lod_columns: dict[str, Any] = {
            "states": len(keys),
            "lod_min": int(lods.min()),
            "lod_max": int(lods.max()),
            "faces": int(faces @ repeats),
            "error_mean": float(sum((errors * repeats).tolist()) / len(lods)),
            "error_max": float(errors.max()),
        }
        return changed, oscillations


def _sum(counts) -> int:
    return int(np.sum(counts, dtype=np.int64))
