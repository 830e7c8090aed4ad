"""Requests of a query, checked: outputs, precisions, distances, and the capacity of its buffers."""

from dataclasses import dataclass

import numpy as np

from warp_abtree.checks.arguments import flag, to_numpy, whole_number
from warp_abtree.kernels.exact import predicates
from warp_abtree.kernels.search import item

OUTPUTS = {"any": item.OUTPUT_ANY, "count": item.OUTPUT_COUNT, "faces": item.OUTPUT_FACES}
PRECISIONS = {"exact": predicates.EXACT, "float32": predicates.FLOAT32}

_PRECISION_NAMES = tuple(PRECISIONS)  # found without a hash

# Options that each output takes beside precision: in a scene, and in a sweep.
_HITS, _DISTANCE = ("within",), ("tolerance", "relative", "beyond", "signed", "originals")
SCENE_OPTIONS = {"any": _HITS, "count": _HITS, "faces": _HITS, "contacts": ("within", "gap"), "distance": _DISTANCE}
_SWEPT = {"any": _HITS, "count": _HITS, "faces": (), "distance": _DISTANCE}
SWEEP_OPTIONS = {**_SWEPT, "first_contact": ("end_poses", "tolerance", "screw", "linear")}

SWITCHES = ("signed", "originals", "screw", "linear")

# A launch of 32 threads a pair stays within 2^31.
PAIRS_MAX = 2**26
# Entries that an int32 numbers.
LIST_MAX = 2**31 - 1


class CapacityError(RuntimeError):
    """A buffer was too small and work was lost; the message names the demand."""


# Lists of face pairs grow to twice the demand, by so many, or by a quarter.
ROOM_MORE = 2**24

# Where all face pairs that may be near are listed, those that are uncertain have this part of the room.
APART_FOR_UNCERTAIN = 4


def more_room(demand: int) -> int:
    """Return the room that a list is given whose demand has outgrown it."""
    return min(demand + max(min(demand, ROOM_MORE), demand // 4), LIST_MAX)


@dataclass(frozen=True)
class Buffers:
    """Room of a query's lists; None is a guess. `run()` makes more room, `launch()` cannot.

    Attributes:
        hits: Intersecting face pairs, where they are listed; of a `ManifoldQuery` also witnesses, at most 380 an object
            pair.
        pairs: Object pairs; by default those given, or a guess for the broad phase.
        uncertain: Face pairs between float32 and the later stages, and with a gap as many that are apart. Of a
            `ManifoldQuery` with a gap, face pairs that may be near; those between stages have a quarter of it. Not
            needed on the CPU.

    Raises:
        ValueError: A number that is out of range.
    """

    hits: int | None = None
    pairs: int | None = None
    uncertain: int | None = None

    def __post_init__(self):
        for name, most in (("hits", LIST_MAX), ("pairs", PAIRS_MAX), ("uncertain", LIST_MAX)):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, whole_number(value, f"buffers: {name}", 1, most))


def check_capacity(capacity) -> Buffers:
    """Return `Buffers` as they are, or of the hits that there is room for; raise ValueError for no number in range."""
    if isinstance(capacity, Buffers):
        return capacity
    return Buffers(None if capacity is None else whole_number(capacity, "capacity", 1, LIST_MAX))


def check_request(output: str, precision: str):
    """Raise ValueError for an unknown output or precision, or an output that another operator finds."""
    if not isinstance(output, str) or output not in (*OUTPUTS, "contacts", "distance"):
        raise ValueError(f"output {output!r} is none of 'any', 'count', 'faces', 'contacts', 'distance'")
    if not isinstance(precision, str) or precision not in _PRECISION_NAMES:
        raise ValueError(f"precision {precision!r} is neither 'exact' nor 'float32'")
    others = {"contacts": "ContactQuery", "distance": "DistanceQuery"}
    if output in others:
        raise ValueError(f"output {output!r} is found by ab.{others[output]}, or Scene.intersect")


def check_options(taken: dict, output: str, precision: str, options: dict) -> dict:
    """Return the options of an output that are not None, nor switches that are off; `taken` is one of the tables above.

    Raises ValueError for an unknown output or precision, or an option that means nothing for this output.
    """
    given = {name: value for name, value in options.items() if value is not None}
    given = {name: value for name, value in given.items() if name not in SWITCHES or flag(value, name)}
    if not isinstance(output, str) or output not in taken:
        check_request(output, precision)
    if not isinstance(precision, str):
        check_request("faces", precision)
    if output in ("distance", "first_contact") and precision != "exact":
        raise ValueError(f"precision means nothing for output {output!r}")
    for name in given:
        if name not in taken[output]:
            raise ValueError(f"{name} means nothing for output {output!r}")
    if precision not in _PRECISION_NAMES:
        check_request("faces", precision)
    return given


def check_gap(gap, pair_count, object_count: int, removed=()) -> np.ndarray:
    """Return gaps [world units] as `check_within`: () or (p,) beside given pairs, () or (n,) for the broad phase.

    Of objects that were removed nothing is read.
    """
    if pair_count is not None:
        return check_within(gap, pair_count, "gap")
    known = f"pairs of the broad phase: one for all, or one for each of {object_count} objects"
    gap = to_numpy(gap, "gap")
    if len(removed) and gap.shape == (object_count,):
        gap = gap.copy()
        gap[removed] = 0
    return check_within(gap, object_count, "gap", known)


def check_within(within, pair_count=None, name="within", known=None) -> np.ndarray:
    """Return distances [world units] as float64, () or (p,), for the broad phase one for all; errors have their name.

    Raises ValueError for another shape, and for a distance that is negative, infinite or no number.
    """
    within = to_numpy(within, name).astype(np.float64)
    if within.shape != () and within.shape != (pair_count,):
        if known is None:
            known = "pairs of the broad phase: one distance for all" if pair_count is None else f"{pair_count} pairs"
        raise ValueError(f"{name}: shape {within.shape} given for {known}")
    bad = np.flatnonzero(~(np.isfinite(within) & (within >= 0)))
    if len(bad):
        whose = "" if within.shape == () else f" of {'pair' if known is None else 'object'} {bad[0]}"
        raise ValueError(f"{name}: {within.flat[bad[0]]}{whose} is no finite distance of 0 or more")
    return within


def check_pair_room(count: int):
    """Raise CapacityError for more object pairs than a launch holds."""
    if count > PAIRS_MAX:
        raise CapacityError(f"{count} object pairs at a time, more than 2^26; ask them in parts")


def refuse_signed(signed: bool, has_solid: bool):
    """Raise ValueError where depths are asked of surfaces alone: all would be 0."""
    if signed and not has_solid:
        raise ValueError("signed: no object of the pairs is a solid (solid=True), so that nothing has a depth")
