"""LOD ladders and the common tolerance scale, as selection kernels read them."""

import math

import numpy as np

from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.lod import prediction
from warp_abtree.kernels.lod.ladder import LodPool
from warp_abtree.state.device_update import shares_levels
from warp_abtree.state.ladder import Ladder

TOLERANCES_PER_OCTAVE = int(prediction.POSITIONS_PER_OCTAVE) // int(prediction.DITHER)


def tolerance_scale(ladder: Ladder) -> np.ndarray:
    """Return tolerances that cover the errors of a ladder, falling by 2^(1/4), the last 0 [world units], float64."""
    top, known = ladder.error.max(), ladder.error[ladder.error > 0]
    count = 1 + math.ceil(TOLERANCES_PER_OCTAVE * math.log2(top / known.min())) if len(known) else 1
    return np.append(top * 2.0 ** (-np.arange(count) / TOLERANCES_PER_OCTAVE), 0.0)


def lod_pool(ladder: Ladder, scene) -> LodPool:
    """Return a ladder and the objects of a scene for kernels."""
    tolerances = tolerance_scale(ladder)
    levels = np.stack([(error > tolerances[:, None]).sum(1) for error in ladder.error])
    levels[:, 0] = 0
    shared = shares_levels(scene.object_model, ladder.levels())
    return struct_of(
        LodPool,
        scene.device,
        object_model=scene.object_model,
        importance=scene.object_importance,
        lod=ladder.lod.ravel(),
        error=ladder.error.ravel(),
        faces=ladder.faces.ravel(),
        entry=ladder.entry.ravel(),
        face_count=[model.face_count for model in ladder.models],
        refits=~shared,
        tolerance_level=levels.ravel(),
        level_count=ladder.steps + 1,
        tolerance_count=len(tolerances),
    )
