"""Stage of an operator: what it allocates, loads, launches and reads; and the distances of pairs that it is given."""

from __future__ import annotations

from typing import Any, NamedTuple
from weakref import proxy

import numpy as np
import warp as wp

from warp_abtree.query.request import check_within


class Rooms(NamedTuple):
    """Entries that the arrays of an operator have room for."""

    pairs: int = 0
    hits: int = 0  # face pairs that are listed
    uncertain: int = 0  # face pairs between float32 and the later passes


class Array(NamedTuple):
    """Device array that a stage asks for: the attribute that holds it, type and shape, and what is in it at first."""

    owner: Any  # a stage, or a Warp struct of its own
    name: str
    dtype: Any
    shape: Any
    fill: Any = None  # a value, or what is called with the new array; None: whatever was there
    is_stale: bool = False  # what stands there is of no more use, whatever its shape

    def is_in_place(self) -> bool:
        """Return whether the attribute holds an array of this shape that is of use."""
        if self.is_stale or (array := getattr(self.owner, self.name, None)) is None:
            return False
        return array.shape == (self.shape if isinstance(self.shape, tuple) else (self.shape,))

    def make(self, device) -> wp.array:
        """Return a new array."""
        array = wp.empty(self.shape, dtype=self.dtype, device=device)
        if callable(self.fill):
            self.fill(array)
        elif self.fill is not None:
            array.fill_(self.fill)
        return array


def fields(owner, shape, **types) -> list[Array]:
    """Return arrays of one shape for fields of a struct, by their types."""
    return [Array(owner, name, dtype, shape) for name, dtype in types.items()]


class Stage:
    """One step of an operator. Whatever it does not override it does not have.

    Attributes:
        operator: The operator that it belongs to, from `attach` on.
        distance: `PairDistance` that it is given, or None.
    """

    operator: Any
    distance: Any = None

    def attach(self, operator: Any):
        """Take the operator, whose batch and guard are in place, and make what has no room of its own."""
        self.operator = proxy(operator)  # which would wait for the garbage collector in a cycle

    def kernels(self, device) -> list:
        """Return the kernels of its first launch with their block sizes, those first that take longest to compile."""
        return []

    def boxes(self, boxes):
        """Return what boxes objects for the broad phase: these, perhaps wider, or others in their place."""
        return boxes

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return its arrays where there are so many entries."""
        return []

    def fits_states(self) -> bool:
        """Return whether its arrays have room for the tree states that there are; a graph goes on with what it had."""
        return True

    def prepare(self, rooms: Rooms):
        """Make what does not belong to the operator fit for so many entries; before its arrays are made."""

    def link(self):
        """Take note of arrays that are new. Must not fail."""

    def search(self):
        """Find what it finds of the pairs in place, of which there are some. Launches only."""

    def report(self, count: int | None):
        """Compute further outputs of so many hits; None: of as many as have room. Launches only."""

    def read(self, found: Any, device: bool, with_rows: bool):
        """Add its part to what was found, on the host or in arrays of the device, perhaps without rows of hits."""


class PairDistance:
    """Distances of pairs [world units] that a stage reads: one for all, or one a pair beside given pairs.

    Args:
        name: What errors call it, and the owner's attribute that holds the device array of distances, float64 (pair,).
        value: The distances, as asked, from `check` on NumPy () or (p,); None where kernels write them.
        check: Returns a value, checked, for a number of pairs, None for those of the broad phase.
    """

    def __init__(self, name: str, value, owner, check=check_within):
        self.name, self.value, self._owner, self._check = name, value, owner, check

    @property
    def rows(self) -> wp.array:
        """The device array of distances."""
        return getattr(self._owner, self.name)

    def check(self, value, pair_count: int | None) -> np.ndarray:
        """Return other distances, checked; None stands for those in place."""
        return self._check(self.value if value is None else value, pair_count)

    def fill(self):
        """Write the distances to the device."""
        if self.value is not None and self.value.ndim == 0:
            self.rows.fill_(float(self.value))
        elif self.value is not None and len(self.value):
            source = wp.array(self.value, dtype=wp.float64, device="cpu", copy=False)
            wp.copy(self.rows, source, count=len(source))
