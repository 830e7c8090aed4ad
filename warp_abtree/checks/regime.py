"""Regimes, choices among equivalent code paths; `warp_abtree.testing` switches them, nothing else does."""

from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class Regime:
    """Choices that change no answer; of those that are None, the device decides."""

    warps: bool | None = None  # whether warps traverse object pairs: on CUDA they do, on the CPU threads
    warps_per_pair: int = 128  # that share a single object pair; c pairs have 1 / sqrt(c) of that each, half for "any"
    stack_length: int | None = None  # items on a warp's stack before the rest goes depth-first; None is all the room
    small_faces: int = 96  # faces up to which warps compare two trees at once, not level by level
    key_bits: int = 63  # of a sort key; an object pair and two faces that take more are sorted in two passes
    segments: bool | None = None  # whether hits are sorted by a segment a pair: on CUDA where pairs have few
    cpu_threads: int | None = None  # of a launch on the CPU; None is all that the process may use
    # Pairs of nodes that a thread of the CPU compares by boxes alone before it looks whether few of them hit, and makes
    # slabs of subtrees where they do, which as many more tests have to pay for.
    plain_tests: int = 6144
    # Pairs of tiles of objects from which on the broad phase of warps sorts these along a curve in each launch.
    tile_tasks: int = 65536
    slabs: bool = True  # whether warps compare slabs of nodes of few faces, too, and distances slabs of all nodes
    # Fraction of its faces past which a state is refitted whole, as measured; slices repeat faces, k is smaller still.
    full_refit: dict = field(default_factory=lambda: {"cpu": 0.5, "cuda": 0.2})
    block_updates: bool = True  # whether a block updates a tree state by itself where it can, not all by level lists
    packs_results: bool | None = None  # whether results are packed and sorted on the device first: on CUDA
    relaxing_warps: int | None = None  # that relax contacts of rigid bodies; on the CPU it is one thread
    captures_frames: bool | None = None  # whether frames without a clock of their own replay a graph: on CUDA they do

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
