"""Regimes, choices among equivalent code paths; `warp_abtree.testing` switches them, nothing else does."""

from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Regime:
    """Choices that change no answer.

    Attributes:
        warps: Whether warps traverse object pairs; None: on CUDA they do, on the CPU threads.
        warps_per_pair: Warps that share a single object pair; c pairs have 1 / sqrt(c) of that each, half for "any".
        stack_length: Items on a warp's stack before the rest goes depth-first; None is all there is room for.
        small_faces: Faces up to which warps compare two trees at once, not level by level.
        key_bits: Bits of a sort key; an object pair and two faces that take more are sorted in two passes.
        segments: Whether hits are sorted by a segment a pair; None: on CUDA where pairs have few.
        cpu_threads: Threads of a launch on the CPU; None is all that the process may use.
        plain_tests: Pairs of nodes that a thread of the CPU compares by boxes alone before it looks whether few of them
            hit, and makes slabs of subtrees where they do, which as many more tests have to pay for.
        slabs: Whether warps compare slabs of nodes of few faces, too, and distances slabs of all nodes.
        full_refit: Fraction of its faces past which a state is refitted whole, by kind of device, as measured. A slice
            repeats faces, so k is smaller still.
        block_updates: Whether a block updates a tree state by itself where it can; False: all by level lists.
        packs_results: Whether results are packed and sorted on the device before they are brought over; None: on CUDA.
        relax_by_color: Whether contacts of rigid bodies are relaxed by color, a thread a pair; None: on CUDA they are,
            on the CPU one thread relaxes them all.
        captures_frames: Whether frames without a clock of their own are replays of a graph; None: on CUDA they are.
    """

    warps: bool | None = None
    warps_per_pair: int = 128
    stack_length: int | None = None
    small_faces: int = 96
    key_bits: int = 63
    segments: bool | None = None
    cpu_threads: int | None = None
    plain_tests: int = 6144
    slabs: bool = True
    full_refit: dict = field(default_factory=lambda: {"cpu": 0.5, "cuda": 0.2})
    block_updates: bool = True
    packs_results: bool | None = None
    relax_by_color: bool | None = None
    captures_frames: bool | None = None

    def uses_warps(self, device) -> bool:
        """Return whether warps work on object pairs; on the CPU each thread takes one pair after the other."""
        return device.is_cuda if self.warps is None else self.warps

    def packs(self, device) -> bool:
        """Return whether kernels pack results on the device."""
        return device.is_cuda if self.packs_results is None else self.packs_results


_current = Regime()


def current_regime() -> Regime:
    """Return the regime that operators made now take."""
    return _current


def change_regime(**changes) -> Regime:
    """Change choices from now on and return the regime before; raise TypeError for a name that is none."""
    global _current
    before, _current = _current, replace(_current, **changes)
    return before


def restore_regime(regime: Regime):
    """Put a regime back."""
    global _current
    _current = regime
