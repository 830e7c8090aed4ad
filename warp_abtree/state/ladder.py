"""LOD ladders: the LODs that objects may stand at."""

from functools import cached_property

import numpy as np

from warp_abtree.checks.arguments import whole_number

SPACINGS = ("operations", "ratio")


class Ladder:
    """The LODs that objects may stand at, so that objects of one model share tree states.

    Args:
        models: `Model`s of a scene, in its order.
        steps: Levels above the coarsest; Delta LOD of the paper is the operations of a model divided by it.
        spacing: "operations": levels differ by equal numbers of operations, as in the paper. "ratio": by equal ratios
            of the active faces, which resolves the coarse end, where 1/50 of the operations may double the faces many
            times over.

    Attributes:
        lod: LOD of each level, int32 (models, steps + 1).
        faces: Active faces of each, int32 (models, steps + 1).
        entry: Where each starts in the split faces of its model, int32 (models, steps + 1).

    Raises:
        ValueError: steps is no whole number from 1, or an unknown spacing.
    """

    def __init__(self, models, steps: int = 50, spacing: str = "operations"):
        self.steps = whole_number(steps, "steps", 1, 2**20)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing {spacing!r} is none of {', '.join(map(repr, SPACINGS))}")
        self.models = list(models)
        self.lod = np.array([self._levels(model, spacing) for model in models], np.int32)
        rows = [(model.progressive, lods) for model, lods in zip(models, self.lod, strict=True)]
        self.faces = np.array([progressive.active_count(lods) for progressive, lods in rows], np.int32)
        self.entry = np.array([progressive.split_start[lods] for progressive, lods in rows], np.int32)

    @cached_property
    def error(self) -> np.ndarray:
        """`Model.error_at` of each level [model units], falling to 0, float64 (models, steps + 1)."""
        rows = zip(self.models, self.lod, strict=True)
        return np.array([model.progressive.lod_error[lods] for model, lods in rows])

    def levels(self) -> list:
        """Return the distinct LODs of each model, rising int arrays."""
        return [np.unique(lods) for lods in self.lod]

    def _levels(self, model, spacing):
        fraction = np.arange(self.steps + 1) / self.steps
        if spacing == "operations":
            return np.floor(fraction * model.lod_max + 0.5).astype(np.int32)
        counts = np.maximum(model.progressive.active_count(np.arange(model.lod_max + 1)), 1)
        wanted = counts[0] * (counts[-1] / counts[0]) ** fraction
        lods = np.minimum(np.searchsorted(counts, wanted * (1 - 1e-12)), model.lod_max)
        lods[0], lods[-1] = 0, model.lod_max
        return lods.astype(np.int32)
