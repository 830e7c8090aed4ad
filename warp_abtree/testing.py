"""The door to the inside for tests and benchmarks: equivalent paths are switched here, and answers stay the same."""

from contextlib import contextmanager

from warp_abtree.checks.regime import Regime, change_regime, current_regime, restore_regime

__all__ = ["Regime", "current_regime", "force_refits", "regime"]


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
    fraction = current_regime().full_refit if full is None else dict.fromkeys(("cpu", "cuda"), -1.0 if full else 1e300)
    return regime(full_refit=fraction)
