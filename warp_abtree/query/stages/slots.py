"""Contact witnesses: what is near, reduced to the slots of each object pair (`kernels.contacts.slots`)."""

import numpy as np
import warp as wp

from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.contacts import slots
from warp_abtree.query.operator import Operator
from warp_abtree.query.stage import Array, Rooms, Stage, fields

# Threads of a multiprocessor that offer face pairs, by their registers.
OFFERING_THREADS = 1024
TURN = 0.4  # of the bins, about a generic axis [rad], so that no axis of a frame lies between two


def bin_directions() -> np.ndarray:
    """Return the normal of each bin and two vectors across it, float32 (9 NORMAL_BINS,): corners of a dodecahedron."""
    golden = (1 + 5**0.5) / 2
    cube = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    rest = [np.roll((0, x / golden, y * golden), k) for k in range(3) for x in (-1, 1) for y in (-1, 1)]
    axis = np.array([0.6134, 0.5327, 0.5831])
    turn = np.array(wp.quat_to_matrix(wp.quat_from_axis_angle(wp.normalize(wp.vec3(*axis)), TURN))).reshape(3, 3)
    rows = []
    for normal in np.array([*cube, *rest]) / 3**0.5 @ turn.T:
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first /= np.linalg.norm(first)
        rows.append([*normal, *first, *np.cross(normal, first)])
    return np.array(rows, np.float32).ravel()


class SlotStage(Stage):
    """Reduce the face pairs that are nearer than a gap to witnesses, with places for what crosses.

    Args:
        with_gap: Whether there is a gap; else only what crosses is reduced.

    Attributes:
        slots: Device arrays, `kernels.contacts.slots.Slots`.
        rows: What they keep, `kernels.contacts.slots.WitnessRows`.
    """

    def __init__(self, with_gap: bool):
        self._with_gap, self.slots, self.rows = with_gap, slots.Slots(), slots.WitnessRows()

    def attach(self, operator: Operator):
        """Take the operator, whose hits then count witnesses."""
        super().attach(operator)
        operator.hits.witness_total = wp.zeros(1, dtype=wp.int32, device=operator.device)
        self.slots.directions = wp.array(bin_directions(), dtype=wp.float32, device=operator.device)

    def kernels(self, device) -> list:
        """Return what offers face pairs."""
        listed = self._with_gap and current_regime().uses_warps(device)
        return [(slots.offer_near_kernel, 256)] if listed else []

    @staticmethod
    def room(rooms: Rooms) -> int:
        """Return how many witnesses there is room for, of as many hits."""
        return min(rooms.hits, slots.SLOT_ROOM * rooms.pairs)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return the slots, and what they keep."""
        return [
            Array(self.slots, "key", wp.int64, slots.SLOT_ROOM * rooms.pairs, 0),
            Array(self.slots, "used", wp.int32, rooms.pairs, 0),
            *fields(self.slots, rooms.pairs, weight=wp.float32, widths=wp.vec2i),
            *fields(self.rows, rooms.pairs, start=wp.int32, count=wp.int32),
            Array(self.rows, "item", wp.vec3i, self.room(rooms)),
        ]

    def start(self):
        """Empty the slots, before the traversal offers to them. Launches only."""
        operator = self.operator
        inputs = [operator.batch.trees, operator.pair_batch, operator.hits.gap, operator.hits, self.slots]
        operator.launch_warps(slots.start_slots_kernel, operator.rooms.pairs, inputs)

    def search(self):
        """Offer what is listed as apart, and reserve places for witnesses. Launches only."""
        operator, device, found = self.operator, self.operator.device, [self.operator.pair_batch, self.slots]
        if not self._with_gap:
            self.start()
        elif operator.uses_warps():
            step = OFFERING_THREADS * device.sm_count if device.is_cuda else 1
            inputs = [step, operator.batch.trees, operator.pair_batch, operator.hits, self.slots]
            operator.launch_kernel(slots.offer_near_kernel, step, inputs)
        operator.launch_warps(slots.reserve_witness_kernel, operator.rooms.pairs, [*found, operator.hits, self.rows])

    def list_witnesses(self):
        """List the witnesses, after what crosses was offered. Launches only."""
        operator = self.operator
        inputs = [operator.pair_batch, self.slots, self.rows]
        operator.launch_warps(slots.list_witness_kernel, operator.rooms.pairs, inputs)
