"""One frame after another: select LODs, refine, move, find candidate pairs, intersect them, answer; each stage timed.

LODs come from a function of time, or from a controller (`warp_abtree.lod.controllers`) that holds a budget.

Source: Liu et al. 2006, Algorithm 4.
"""

import csv
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.atomic_write import atomic_write
from warp_abtree.lod.controllers import Feedback
from warp_abtree.lod.selection import positive
from warp_abtree.lod.timing import COST_STAGES, STAGES, Timer
from warp_abtree.model.model import Model
from warp_abtree.query.request import check_request
from warp_abtree.query.result import Result
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.rigid_bodies import triangle_wave
from warp_abtree.state.lod_update import full_refit_fraction


def resolve_lod(model: Model, wish) -> int:
    """Return the LOD that a wish means for a model.

    Args:
        wish: A float is a part of the faces in (0, 1], an int a LOD; "finest", "coarsest", or "tol:X", the coarsest
            LOD whose certified error is within X [model units]. A number as text with a dot is a float.

    Raises:
        ValueError: None of these, or out of range.
    """
    if wish in ("finest", "coarsest"):
        return model.lod_max if wish == "finest" else 0
    if isinstance(wish, str):
        number, kinds = wish.removeprefix("tol:"), (float,) if wish.startswith("tol:") else (int, float)
        for kind in kinds:
            try:
                value = kind(number)
            except ValueError:
                continue
            return model.lod_for(tolerance=value) if number != wish else resolve_lod(model, value)
        raise ValueError(f"LOD {wish!r} is none of a part of the faces, a whole number, finest, coarsest, tol:X")
    return model.lod_for(fraction=wish) if isinstance(wish, float) else model.check_lod(wish)


@dataclass(frozen=True)
class LodSweep:
    """LODs of some objects that go from one part of the faces to another and back, in equal ratios.

    Attributes:
        objects: Object indices by model, a list of (`Model`, int array).
        start, turn: Parts of the faces at the start, and half a period later.
        period: Time there and back [s].
    """

    objects: list
    start: float
    turn: float
    period: float

    def fraction(self, time: float) -> float:
        """Return the part of the faces at a time [s]."""
        return self.start * (self.turn / self.start) ** float(triangle_wave(time / self.period))

    def apply(self, fraction: float, lods: np.ndarray):
        """Write the LODs of a part of the faces into the LODs of all objects, int (n,)."""
        for model, indices in self.objects:
            lods[indices] = model.lod_for(fraction=fraction)


@dataclass(frozen=True)
class FrameRow:
    """What one frame did.

    Attributes:
        frame, time: Number from 0, and time in the scene [s].
        objects, states: Objects, and the distinct (model, LOD) among them, which share a tree state.
        pairs: Candidate pairs of the broad phase.
        touching: Pairs that intersect.
        hits: Intersecting face pairs; None where only "any" was asked.
        lod_min, lod_max: Least and greatest LOD of any object.
        faces: Active faces of all objects together.
        error_mean, error_max: Mean and greatest `Model.error_at` of the objects at their LODs, one-sided [world units].
        lods_changed: Objects whose LOD this frame changed.
        lods_turned: Those of them whose change before it went the other way: oscillation.
        nodes_refitted: Nodes of all updated trees.
        node_tests, triangle_tests: Pairs of boxes and of faces tested.
        budget_ms: T that a controller held [ms]; None without a budget.
        select_ms: Selection of LODs [ms].
        refine_ms: LOD change and refit [ms].
        move_ms: Poses [ms].
        broad_ms: Broad phase [ms].
        query_ms: Narrow phase and results [ms]; the broad phase too where the motion finds contacts itself.
        answer_ms: What the motion does about it [ms].
    """

    frame: int
    time: float
    objects: int
    states: int
    pairs: int
    touching: int
    hits: int | None
    lod_min: int
    lod_max: int
    faces: int
    error_mean: float
    error_max: float
    lods_changed: int
    lods_turned: int
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


def judge_budget(rows, budget_ms: float | None = None, after: float = 1.0) -> dict | None:
    """Judge how frames held a budget.

    Args:
        rows: `FrameRow`s in their order.
        budget_ms: T [ms]; None takes what each row names, and rows without one are left out.
        after: Frames before this time in the scene [s] are left out.

    Returns:
        None where no row is left, else a dict: frames; within and within_tenth, shares of them within T and T + 10 %;
        worst, the greatest cost over T; longest_over, most frames in a row over T + 10 %; turns, how often the LOD of
        an object turned back, a second; error_mean, the mean `Model.error_at` [world units].
    """
    rows = [row for row in rows if row.time >= after and (budget_ms or row.budget_ms) is not None]
    if not rows:
        return None
    ratio = np.array([row.cost_ms / (budget_ms or row.budget_ms) for row in rows])
    # Where the runs of frames over the limit begin and end.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ratio > 1.1, [0]]).astype(int)))
    span = (rows[-1].time - rows[0].time) * len(rows) / max(len(rows) - 1, 1)
    turned = sum(row.lods_turned / row.objects for row in rows)
    return {
        "frames": len(rows),
        "within": float(np.mean(ratio <= 1.0)),
        "within_tenth": float(np.mean(ratio <= 1.1)),
        "worst": float(ratio.max()),
        "longest_over": int((edges[1::2] - edges[::2]).max(initial=0)),
        "turns": float(turned / span) if span > 0 else 0.0,
        "error_mean": float(np.mean([row.error_mean for row in rows])),
    }


def judge_step(rows, frame: int, budget_ms: float | None = None) -> dict:
    """Judge how a budget was regained after the load rose at a frame.

    Args:
        rows: `FrameRow`s in their order. budget_ms: T [ms]; None takes what the row at `frame` names.

    Returns:
        peak, the greatest cost over T from that frame on; frames, how many from it on passed before the first within
        T + 10 %, None where none was.
    """
    rows = [row for row in rows if row.frame >= frame]
    if not rows or (budget_ms or rows[0].budget_ms) is None:
        raise ValueError(f"there is no frame {frame}, or no budget to judge it by")
    ratio = np.array([row.cost_ms for row in rows]) / (budget_ms or rows[0].budget_ms)
    back = np.flatnonzero(ratio <= 1.1)
    return {"peak": float(ratio.max()), "frames": int(back[0]) if len(back) else None}


def rehearse_updates(scene: Scene):
    """Launch whatever a change of LODs may launch, on a copy of the smallest model that has it all.

    In part, from a copied state; from another, in place; and whole. Models so small that they are always refitted
    whole never are in part.
    """
    share = full_refit_fraction(scene.device)
    chosen, step = None, 0
    for model in sorted(scene.models, key=lambda model: model.face_count):
        if not model.lod_max:
            continue
        spans = np.diff(model.progressive.split_start)
        if chosen is None:
            chosen = model
        if spans.min() <= share * model.face_count:
            chosen, step = model, int(spans.argmin())
            break
    if chosen is None:
        return
    copy = Scene(device=scene.device)
    for _ in range(2):
        copy.add(chosen, lod=step)
    for lods in ((step, step + 1), (step + 1, step), (0, chosen.lod_max), (chosen.lod_max, chosen.lod_max)):
        copy.set_lods(lods)


class Frame:
    """Runs a scene frame by frame and keeps a row on each.

    Args:
        scene: `Scene` with all its objects.
        motion: What moves the objects; None leaves them where they are. `Kinematic`, or anything with these, called in
            this order in every frame:
            `len(motion)`, as many as objects (asked once);
            `poses(time, out)`, times [s] rising from 0: returns poses, float64 (n, 7), in `out` or an array of its own,
            or None where it has set those of the scene itself;
            `find(time_step)`, optional: returns a `Result` in the place of the frame's own broad phase and query, for
            what finds its contacts itself;
            `warm_up(time_step)`, optional: loads what these launch, and moves nothing (asked by `Frame.warm_up`);
            `answer(result, time_step)`, optional: hears what was found, and moves on by the time to the next frame [s].
        lods: A controller of `warp_abtree.lod.controllers`, or anything with its `next_lods` and `budget_ms`; or called
            with the time [s], returns the LOD of every object, int (n,); None leaves them.
        output: What is asked of each candidate pair: "any", "count", "faces" or "contacts".
        time_step: Time between frames [s], above 0.
        clock: Seconds, read around stages when the device has finished. A clock with a method `charge` is told the
            counted work of a stage first (`WorkClock`). None is the host's clock, on CUDA events.

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
        self._heard: dict = {}
        self._poses = np.empty((scene.object_count, 7))
        self._model = np.array(scene.object_model)
        self._way = np.zeros(scene.object_count, np.int8)
        scene.batch()
        self._measure_lods()

    def warm_up(self):
        """Run every stage once and keep no row, so that no row times the loading of kernels.

        Nothing moves, and LODs stay as they are: changes of them are rehearsed on copies. A motion that finds contacts
        itself is asked to load its own, where it has `warm_up(time_step)`. Waits for the device.
        """
        if self.lods is not None:
            # A controller hears of no frame yet: it looks at the scene as it stands.
            self._select(0.0)
            rehearse_updates(self.scene)
        if hasattr(self.motion, "warm_up"):
            self.motion.warm_up(self.time_step)
        if not hasattr(self.motion, "find"):
            self.scene.intersect(self.scene.broad_phase(), output=self.output)
        wp.synchronize_device(self.scene.device)

    def poses_at(self, time: float) -> np.ndarray:
        """Return the poses of a time [s], (n, 7), in a buffer that the next call overwrites.

        Raises:
            ValueError: The scene has no motion.
        """
        if self.motion is None:
            raise ValueError("the scene has no motion")
        return self.motion.poses(time, out=self._poses)

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
            poses = self.poses_at(time)
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
        changed, turned = (0, 0) if stats is None else self._measure_lods()
        self._heard = {
            "stage_ms": stage_ms,
            "nodes_refitted": refitted,
            "lods_changed": stats is not None,
            "result": result,
        }
        self.history.append(
            FrameRow(
                frame=number,
                time=time,
                objects=scene.object_count,
                states=self._states,
                pairs=len(result.pairs),
                touching=int(np.count_nonzero(result.any)),
                hits=None if result.count is None else _sum(result.count),
                lod_min=int(self._lods.min()),
                lod_max=int(self._lods.max()),
                faces=self._faces,
                error_mean=self._error_mean,
                error_max=self._error_max,
                lods_changed=changed,
                lods_turned=turned,
                nodes_refitted=refitted,
                node_tests=node_tests,
                triangle_tests=triangle_tests,
                budget_ms=getattr(self.lods, "budget_ms", None),
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
            after: `budget`, the verdict of `judge_budget`, leaves out frames before this time [s].

        Raises:
            ValueError: No frame has run.
        """
        if not self.history:
            raise ValueError("a summary is of frames, and none has run")
        columns = {name: [row.as_dict()[name] for row in self.history] for name in FrameRow.names()}
        found: dict[str, Any] = {"frames": len(self.history), "objects": self.scene.object_count}
        counts = "states", "pairs", "touching", "hits", "faces", "nodes_refitted", "node_tests", "triangle_tests"
        for name in (*counts, "error_mean", "error_max"):
            values = np.array([math.nan if value is None else value for value in columns[name]], np.float64)
            found[name] = {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}
        found["lod_min"], found["lod_max"] = min(columns["lod_min"]), max(columns["lod_max"])
        found["stages"] = {}
        for name in (*STAGES, "total_ms", "cost_ms"):
            values = np.array(columns[name])
            found["stages"][name] = {
                "mean": float(values.mean()),
                "p95": float(np.percentile(values, 95)),
                "total": float(values.sum()),
            }
        found["budget_ms"] = columns["budget_ms"][-1]
        found["budget"] = judge_budget(self.history, after=after)
        return found

    def record(self, path):
        """Write the history to a .json file, or as CSV to any other; the file appears whole or not at all.

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
            return self.lods.next_lods(Feedback(time, **self._heard)).numpy()
        return np.asarray(self.lods(time))

    def _measure_lods(self):
        """Take stock of the LODs as they stand; return how many changed, and how many of them turned back."""
        lods = self.scene.lods.astype(np.int64)
        way = np.sign(lods - getattr(self, "_lods", lods)).astype(np.int8)
        changed, turned = int(np.count_nonzero(way)), int(np.count_nonzero(way * self._way < 0))
        self._way = np.where(way == 0, self._way, way)
        self._lods = lods
        keys, repeats = np.unique((self._model.astype(np.int64) << 32) + lods, return_counts=True)
        models = self.scene.models
        stand = [(models[key >> 32], key & (2**32 - 1), times) for key, times in zip(keys.tolist(), repeats.tolist())]
        errors = [model.error_at(lod) for model, lod, _ in stand]
        self._states = len(keys)
        self._faces = sum(model.progressive.active_count(lod) * times for model, lod, times in stand)
        self._error_mean = sum(error * times for error, (_, _, times) in zip(errors, stand)) / len(lods)
        self._error_max = max(errors)
        return changed, turned


def _sum(counts) -> int:
    return int(np.sum(counts, dtype=np.int64))
