"""Solids: objects that hold what lies inside them.

A closed mesh (`warp_abtree.model.winding`) divides space into inside and outside, at every LOD and however it is wound.
An object pair with a solid intersects if the surfaces meet, or if a component of one surface lies inside the other
object, a solid. Surfaces that do not meet leave each component wholly inside or outside, so this is decided exactly, on
the numbers of `docs/exactness.md`, by the parity of the crossings of a ray (`warp_abtree.kernels.inside.parity`); at
the LODs of the objects, it says nothing of the originals. Of an object pair that intersects in this way alone

* any is True, count is 0, and it has no faces and no contacts: these are of surfaces; contact points it has, see
  `query.stages.points`;
* apart is False, whatever `within` is;
* distance and bracket are 0, both points are a corner of the component that is inside, and point_faces names its face,
  beside -1 for the solid.

A cavity is outside: what lies in it intersects nothing. So is what two overlapping parts of one mesh share, and what
faces enclose that are listed an even number of times: adding such a solid warns.
"""

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.inside.components import Solids, find_component_kernel
from warp_abtree.state.arrays import ModelArrays, StateArrays

SLOT_ARRAYS = {"shift": wp.int32, "first": wp.int32, "count": wp.int32, "made": wp.vec3i}
PLACE_ARRAYS = ("parent", "lowest", "face")


class SolidArrays:
    """Which objects of a batch are solids, and the components of its tree states.

    Attributes:
        pool: `Solids` for kernels.
        is_solid: Whether each object is a solid, (n,).
    """

    def __init__(self, models: ModelArrays, states: StateArrays, is_solid):
        self.models, self.states = models, states
        self.device = states.device
        self.is_solid = np.asarray(is_solid, bool)
        self.pool = Solids()
        self.pool.is_solid = wp.array(self.is_solid.astype(np.int32), dtype=wp.int32, device=self.device)
        self._slot_models: list[int] = []
        self._allocate(0, 0)
        self.fit()

    def _allocate(self, slots: int, places: int):
        made = {name: wp.zeros(slots, dtype=dtype, device=self.device) for name, dtype in SLOT_ARRAYS.items()}
        made |= {name: wp.empty(places, dtype=wp.int32, device=self.device) for name in PLACE_ARRAYS}
        self.states.generation.advance()
        for name, array in made.items():
            setattr(self.pool, name, array)

    def fit(self):
        """Make room for the components of all tree states that there are now.

        Raises RuntimeError where that takes room and a graph is being captured, or the device is out of memory.
        """
        slots = [slot.model for slot in self.states.slots]
        if slots == self._slot_models:
            return
        check_device(self.device, "making room for the components of solids")
        lengths = np.diff(self.models.vertex_start)[slots]
        first = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
        total = int(first[-1])
        if total >= 2**31:
            raise ValueError(f"the tree states of solids would hold {total} vertices, more than 2^31; use fewer LODs")
        room, places = len(self.pool.first), len(self.pool.parent)
        if len(self.states.pool.lod) > room or total > places:
            grown = max(total, min(2 * places, 2**31 - 1))
            self._allocate(len(self.states.pool.lod), grown if total > places else places)
        starts = np.full((2, len(self.pool.first)), -1, np.int32)
        starts[:, : len(slots)] = first[:-1], first[:-1] - self.models.vertex_start[slots]
        self.pool.made.fill_(wp.vec3i(-1))
        self.pool.first.assign(starts[0])
        self.pool.shift.assign(starts[1])
        self._slot_models = slots

    def forget(self):
        """Make room anew: tree states are others than they were."""
        self._slot_models = [-1]

    def prepare(self, launch, launched):
        """Make the launch that finds the components of states which have changed; `launched` as of `LaunchRecord`."""
        lanes = WARP_SIZE if self.device.is_cuda else 1
        inputs = [self.models.pool, self.states.pool, launched, self.pool]
        # With room for states to come, which a captured graph finds too.
        dim = len(self.pool.first) * lanes
        return launch(find_component_kernel, dim=dim, inputs=inputs, block_dim=WARP_SIZE, device=self.device)
