"""LODs as people ask for them: `resolve_lod` of a word or number, `LodSweep` over time."""

from dataclasses import dataclass

import numpy as np

from warp_abtree.model.model import Model
from warp_abtree.simulate.motion import triangle_wave


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
