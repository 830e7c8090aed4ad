"""The door to the inside for tests and benchmarks: equivalent paths are switched here, and answers stay the same."""

from contextlib import contextmanager

import warp as wp

from warp_abtree.checks.regime import Regime, change_regime, current_regime, restore_regime
from warp_abtree.state.lod_update import LodUpdate

__all__ = ["Regime", "current_regime", "force_refits", "regime", "repeat_update"]


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
        restore_regime(before)


def force_refits(full: bool | None):
    """Return a context in which LOD changes refit every state whole (True), never (False), or as measured (None)."""
    fraction = current_regime().full_refit if full is None else dict.fromkeys(("cpu", "cuda"), -1.0 if full else 1e6)
    return regime(full_refit=fraction)


def repeat_update(update: LodUpdate, refine: bool = True):
    """Return a launch that does an update of `Scene.set_lods` again, from whatever LODs stand there.

    Args:
        refine: Whether meshes are refined too, or trees refitted alone.
    """
    states = update.states
    targets = wp.clone(states.pool.lod)  # the next update writes in place

    def launch():
        for name in ("changed_count", "marked_count", "level_count"):
            getattr(update.plan, name).zero_()
        states.pool.lod = targets
        update.relaunch() if refine else update.refit()

    return launch
