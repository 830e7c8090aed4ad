"""The door to the inside for tests and benchmarks: regimes are switched here, stages of the exact test are named.

Regimes change no answer.
"""

from contextlib import contextmanager

import numpy as np
import warp as wp

from warp_abtree.checks.regime import Regime, change_regime, current_regime
from warp_abtree.kernels.exact.predicates import EXACT, FILTER, FLOAT32, UNCERTAIN
from warp_abtree.kernels.motion.face_pair import CLEAR, UNDECIDED, FirstContact
from warp_abtree.kernels.motion.linear import advance_corners_kernel
from warp_abtree.kernels.native import options as kernel_options
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, float32_filter_triangles
from warp_abtree.kernels.triangle.float64_filter import decide_triangles
from warp_abtree.state.lod_update import LodUpdate
from warp_abtree.state.work_lists import full_refit_fraction

__all__ = [
    "EXACT",
    "FILTER",
    "FLOAT32",
    "FLOAT32_UNIT",
    "UNCERTAIN",
    "Regime",
    "advance_corners",
    "current_regime",
    "decide_triangles",
    "float32_filter_triangles",
    "force_refits",
    "full_refit_fraction",
    "kernel_options",
    "read_bits",
    "regime",
    "repeat_update",
    "state_lods",
    "upload_lods",
]


@contextmanager
def regime(**changes):
    """Let operators made inside take other paths; see `Regime` for the choices.

    Raises:
        TypeError: No such choice.
    """
    before = change_regime(**changes)
    try:
        yield
    finally:
        change_regime(**vars(before))


def force_refits(full: bool | None):
    """Return a context in which LOD changes refit every state whole (True), never (False), or as measured (None)."""
    fraction = current_regime().full_refit if full is None else dict.fromkeys(("cpu", "cuda"), -1.0 if full else 1e6)
    return regime(full_refit=fraction)


def repeat_update(update: LodUpdate):
    """Return a launch that does an update of `Scene.set_lods` again, from whatever LODs stand there."""
    states = update.states
    targets = wp.clone(states.pool.lod)  # the next update writes in place

    def launch():
        if update.entry_room or update.face_room:
            for name in ("changed_count", "marked_count", "level_count"):
                getattr(update.plan, name).zero_()
        wp.copy(states.pool.lod, targets)
        update.relaunch()

    return launch


def read_bits(scene) -> list:
    """Return boxes, skip links and corners bit by bit, one row a state, in the order of model and LOD. Waits."""
    states = scene.batch().states
    order = np.lexsort(([slot.lod for slot in states.slots], [slot.model for slot in states.slots]))
    pool, node_end = states.pool, states.node_total
    arrays = [pool.node_box[: 2 * node_end], pool.face_corner[: states.face_total]]
    return [array.numpy().view(np.int32).reshape(len(states.slots), -1)[order] for array in arrays]


def state_lods(scene) -> list:
    """Return the LOD of every state."""
    return [slot.lod for slot in scene.batch().states.slots]


def upload_lods(scene):
    """Write the host's LODs of the states to the device, after repeated launches."""
    scene.batch().states.upload_slots()


def advance_corners(starts, ends, tolerance=1e-6, device="cpu"):
    """Return when pairs of faces first touch whose corners move straight: times, clear and undecided, each (p,).

    Args:
        starts, ends: Corners of A's face and of B's at first and at last, float64 (p, 6, 3).
    """
    contacts = wp.empty(len(starts), dtype=FirstContact, device=device)
    given = [wp.array(corners, dtype=wp.vec3d, device=device) for corners in (starts, ends)]
    # Each coordinate on the way errs by 4 u, so do dot products: 28 u of the largest in all.
    inputs = [wp.float64(tolerance), wp.float64(2.0**-48), *given, contacts]
    wp.launch(advance_corners_kernel, len(starts), inputs, device=device)
    found = contacts.numpy()
    return found["time"], found["end"] == int(CLEAR), found["end"] == int(UNDECIDED)
