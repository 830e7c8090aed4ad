"""One frame after another: set LODs, move, find candidate pairs, intersect them; each stage timed on its own.

LODs come from a function of time; their selection under a time budget (section 4.2 of the paper) comes later, and so
does the movement that answers contacts.

Source: Liu et al. 2006, Algorithm 4.
"""

import csv
import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import perf_counter

import numpy as np
import warp as wp

from warp_abtree.dynamics import Kinematic, triangle_wave
from warp_abtree.intersect import Result
from warp_abtree.model import Model
from warp_abtree.scene import Scene

STAGES = ("refine_ms", "move_ms", "broad_ms", "query_ms")


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
        nodes_refitted: Nodes of all updated trees.
        refine_ms: LOD change and refit [ms].
        move_ms: Poses [ms].
        broad_ms: Broad phase [ms].
        query_ms: Narrow phase and results [ms].
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
    nodes_refitted: int
    refine_ms: float
    move_ms: float
    broad_ms: float
    query_ms: float

    @property
    def total_ms(self) -> float:
        """All stages together [ms]."""
        return sum(getattr(self, stage) for stage in STAGES)

    def as_dict(self) -> dict:
        """Return the row as plain values, total_ms among them."""
        return {**asdict(self), "total_ms": self.total_ms}

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of `as_dict` in their order."""
        return [*(field.name for field in fields(cls)), "total_ms"]


class Frame:
    """Runs a scene frame by frame and keeps a row on each.

    Args:
        scene: `Scene` with all its objects.
        motion: `Kinematic` of as many objects; None leaves them where they are.
        lods: Called with the time [s], returns the LOD of every object, int (n,); None leaves them.
        output: What is asked of each candidate pair: "any", "count" or "faces".
        time_step: Time between frames [s].
        clock: Seconds of the host, read around stages that wait for the device.

    Attributes:
        history: One `FrameRow` a frame run.

    Raises:
        ValueError: A motion of another number of objects, or a time step that is not finite.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Kinematic | None = None,
        lods: Callable[[float], np.ndarray] | None = None,
        output: str = "count",
        time_step: float = 1 / 60,
        clock: Callable[[], float] = perf_counter,
    ):
        if motion is not None and len(motion) != scene.object_count:
            raise ValueError(f"the motion is of {len(motion)} objects, the scene has {scene.object_count}")
        if not np.isfinite(time_step):
            raise ValueError(f"time_step {time_step!r} is not finite")
        self.scene = scene
        self.motion = motion
        self.lods = lods
        self.output = output
        self.time_step = float(time_step)
        self.clock = clock
        self.history: list[FrameRow] = []
        self._poses = np.empty((scene.object_count, 7))
        self._model = np.array(scene.object_model)
        scene.arrays()
        self._measure_lods()

    def warm_up(self):
        """Run every stage once and keep no row, so that no row times the loading of kernels; LODs stay as they are."""
        if self.lods is not None:
            before = self.scene.lods
            self.scene.set_lods(np.asarray(self.lods(self.time_step)))
            self.scene.set_lods(before)
        self.scene.intersect(self.scene.broad_phase(), output=self.output)

    def poses_at(self, time: float) -> np.ndarray:
        """Return the poses of a time [s], (n, 7), in a buffer that the next call overwrites.

        Raises:
            ValueError: The scene has no motion.
        """
        if self.motion is None:
            raise ValueError("the scene has no motion")
        return self.motion.poses(time, out=self._poses)

    def step(self) -> Result:
        """Run the next frame, append its row, and return what the query found."""
        number = len(self.history)
        time = number * self.time_step
        marks = [self._mark()]
        stats = self._set_lods(time)
        marks.append(self._mark())
        if self.motion is not None:
            self.scene.set_poses(self.poses_at(time))
        marks.append(self._mark())
        pairs = self.scene.broad_phase()
        marks.append(self._mark())
        result = self.scene.intersect(pairs, output=self.output)
        marks.append(self._mark())
        stage_ms = {stage: 1e3 * (end - begin) for stage, begin, end in zip(STAGES, marks, marks[1:])}
        if stats is not None:
            self._measure_lods()
        self.history.append(
            FrameRow(
                frame=number,
                time=time,
                objects=self.scene.object_count,
                states=self._states,
                pairs=len(pairs),
                touching=int(np.count_nonzero(result.any)),
                hits=None if result.count is None else int(np.sum(result.count, dtype=np.int64)),
                lod_min=int(self._lods.min()),
                lod_max=int(self._lods.max()),
                faces=self._faces,
                nodes_refitted=0 if stats is None else int(np.sum(stats.nodes_refitted, dtype=np.int64)),
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

    def summary(self) -> dict:
        """Return mean, min and max of the counts, the range of LODs, and mean, p95 and total of stages [ms]."""
        columns = {name: [row.as_dict()[name] for row in self.history] for name in FrameRow.names()}
        found = {"frames": len(self.history), "objects": self.scene.object_count}
        for name in ("states", "pairs", "touching", "hits", "faces", "nodes_refitted"):
            values = np.array([math.nan if value is None else value for value in columns[name]], np.float64)
            found[name] = {"mean": float(values.mean()), "min": float(values.min()), "max": float(values.max())}
        found["lod_min"], found["lod_max"] = min(columns["lod_min"]), max(columns["lod_max"])
        found["stages"] = {}
        for name in (*STAGES, "total_ms"):
            values = np.array(columns[name])
            found["stages"][name] = {
                "mean": float(values.mean()),
                "p95": float(np.percentile(values, 95)),
                "total": float(values.sum()),
            }
        return found

    def record(self, path):
        """Write the history to a .json file, or as CSV to any other; the file appears whole or not at all."""
        path = Path(path)
        partial = path.with_name(path.name + ".partial")
        rows = [row.as_dict() for row in self.history]
        try:
            with open(partial, "w", newline="", encoding="utf-8") as file:
                if path.suffix.lower() == ".json":
                    json.dump(rows, file, indent=1)
                else:
                    writer = csv.DictWriter(file, FrameRow.names())
                    writer.writeheader()
                    writer.writerows(rows)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)

    def _mark(self) -> float:
        """Read the clock when the device has finished. (synchronization point)"""
        wp.synchronize_device(self.scene.device)
        return self.clock()

    def _set_lods(self, time):
        wanted = None if self.lods is None else np.asarray(self.lods(time))
        if wanted is None or np.array_equal(wanted, self.scene.lods):
            return None
        return self.scene.set_lods(wanted)

    def _measure_lods(self):
        self._lods = self.scene.lods.astype(np.int64)
        keys, repeats = np.unique(np.stack([self._model, self._lods], axis=1), axis=0, return_counts=True)
        models = self.scene.models
        self._states = len(keys)
        self._faces = sum(
            models[model].progressive.active_count(int(lod)) * int(times) for (model, lod), times in zip(keys, repeats)
        )
