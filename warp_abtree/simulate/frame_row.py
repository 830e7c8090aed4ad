"""The row of one frame, `FrameRow`: counts, times, and statistics of its LODs."""

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from warp_abtree.lod.timing import STAGES


@dataclass(frozen=True)
class FrameRow:
    """Record of one frame.

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
        nodes_refitted: Nodes of all updated trees; none where a controller finds a tree state for each level.
        node_tests, triangle_tests: Pairs of boxes and of faces tested.
        budget_ms: T that a controller held [ms]; None without a budget.
        select_ms, refine_ms, move_ms: Selection of LODs; LOD change and refit; poses [ms].
        broad_ms, query_ms: Broad phase; narrow phase, and all of it where the motion finds contacts [ms].
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
        """All stages together, which a budget is for [ms]."""
        return sum(getattr(self, stage) for stage in STAGES)

    def as_dict(self) -> dict:
        """Return the row as plain values, total_ms among them."""
        return {**asdict(self), "total_ms": self.total_ms}

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of `as_dict` in their order."""
        return [*ROW_FIELDS, "total_ms"]


ROW_FIELDS = tuple(field.name for field in fields(FrameRow))


class LodColumns:
    """Columns of a `FrameRow` about LODs: of levels at which objects may stand, a model and an LOD each, int arrays."""

    def __init__(self, scene, level_model, level_lod):
        self.lod, level_model = np.asarray(level_lod), np.asarray(level_model)
        levels = [(scene.models[model], lod) for model, lod in zip(level_model.tolist(), self.lod.tolist())]
        # Levels of the model that places without an object have count for nothing, but where there is no object.
        present, self.counts = scene.present, np.ones(len(levels), bool)
        if present.any() and not present.all():
            self.counts = np.isin(level_model, np.array(scene.object_model)[present])
        self.error = np.array([model.error_at(lod) for model, lod in levels])
        self.faces = np.array([model.progressive.active_count(lod) for model, lod in levels])

    def columns(self, count) -> dict[str, Any]:
        """Return the columns for a number of objects at each level, int array."""
        used = np.flatnonzero(count * self.counts)
        repeats, error = count[used], self.error[used]
        return {
            "states": len(used),
            "lod_min": int(self.lod[used].min()),
            "lod_max": int(self.lod[used].max()),
            "faces": int(self.faces[used] @ repeats),
            "error_mean": float(sum((error * repeats).tolist()) / int(repeats.sum())),
            "error_max": float(error.max()),
        }


class LodTracker:
    """LODs of the objects of a scene from frame to frame, as the host knows them."""

    columns: dict[str, Any]  # of a `FrameRow`, about the LODs last measured

    def __init__(self, scene):
        self._direction = np.zeros(0, np.int8)
        self.restart(scene)

    def restart(self, scene):
        """Take the LODs as they stand for those of the last frame."""
        self._lods = scene.batch().lods
        if len(self._direction) != len(self._lods):
            self._direction = np.zeros(len(self._lods), np.int8)
        self.measure(scene)

    def measure(self, scene) -> dict:
        """Measure the LODs as they stand; return columns: how many changed, and how many of these turned back."""
        lods = scene.lods.astype(np.int64)
        direction = np.sign(lods - self._lods).astype(np.int8)
        turned = np.count_nonzero(direction * self._direction < 0)
        self._direction = np.where(direction == 0, self._direction, direction)
        self._lods = lods
        keys, repeats = np.unique((np.array(scene.object_model, np.int64) << 32) + lods, return_counts=True)
        self.columns = LodColumns(scene, keys >> 32, keys & (2**32 - 1)).columns(repeats)
        return {"lods_changed": int(np.count_nonzero(direction)), "oscillations": int(turned)}
