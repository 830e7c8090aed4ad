"""Continuous collision of a step: motions cut where surfaces that are apart would meet: `CertifiedMotions`."""

import numpy as np
import warp as wp

from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.bodies import continuous as kernels
from warp_abtree.query.operator import Operator
from warp_abtree.query.request import Buffers
from warp_abtree.query.stage import Array, Rooms
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.intersect import IntersectStage
from warp_abtree.query.stages.motion import FirstContactStage
from warp_abtree.scene.scene import Scene

ROUND_MODES = kernels.CUT, kernels.MATCH, kernels.HOLD_BOTH, kernels.CERTIFY
# What each round does with the pairs that it does not prove clear.
ROUNDS = [int(mode) for mode, times in zip(ROUND_MODES, (5, 4, 3, 1)) for _ in range(times)]


class MotionRounds(FirstContactStage):
    """Cut the motions of objects in rounds, from goals on, until no pair that was apart meets."""

    def __init__(self, bodies):
        super().__init__(float(kernels.TIME_TOLERANCE))
        self._bodies, self.goals = bodies, ObjectPool()

    def attach(self, operator: Operator):
        """Take the operator."""
        super().attach(operator)
        self._pool, n = operator.batch.objects.pool, operator.batch.object_count
        self.goals.rotation, self.goals.position = wp.clone(self._pool.rotation), wp.clone(self._pool.position)
        given = {"goals": self.goals, "ends": self.ends, "counter": np.zeros(3)}
        zeros = {name: np.zeros(n) for name in ("fraction", "cut", "is_changed", "is_held")}
        self.state = struct_of(kernels.StepMotions, operator.device, **given, **zeros)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a pair or a thread."""
        own = [Array(self.state, name, wp.int32, rooms.pairs, 0) for name in ("level", "is_again")]
        return [*super().arrays(rooms), *own]

    def launch(self, kernel, dim, inputs):
        """Launch a kernel about the motions of a step."""
        wp.launch(kernel, dim, inputs, device=self.operator.device)

    def begin(self):
        """Aim all motions at their goals, whole. Launches only."""
        inputs = [self._pool, self._bodies, self.state]
        self.launch(kernels.begin_way_kernel, len(self.state.fraction), inputs)

    def search(self):
        """Cut the motions. Launches only."""
        operator, bodies, state = self.operator, self._bodies, self.state
        room, n, found, hits = len(operator.pairs), len(state.fraction), operator.pair_batch, operator.hits
        self.begin()  # again, where a search without room has cut motions
        self.launch(kernels.exempt_pair_kernel, room, [found, hits, bodies, state])
        for mode in ROUNDS:
            self.launch(kernels.choose_pair_kernel, room, [found, state, hits])
            self.begin_motions()
            if mode <= kernels.MATCH:
                inputs = [found, self.contacts, bodies, state, self.motion]
                self.launch(kernels.widen_motion_kernel, room, inputs)
            self.follow_motions()
            inputs = [mode, found, self._pool, hits, self.contacts, bodies, state]
            self.launch(kernels.cut_way_kernel, room, inputs)
            self.launch(kernels.apply_cut_kernel, n, [self._pool, bodies, state])
            if self._is_settled():
                break

    def _is_settled(self) -> bool:
        """Return whether further rounds would find nothing, where that can be told without a wait."""
        device = self.operator.device
        if not device.is_cpu or device.is_capturing:
            return False
        return not (self.state.is_changed.numpy().any() or self.state.is_again.numpy().any())


class CertifiedMotions(Operator):
    """Fractions of the objects' motions towards their goals for which no two surfaces meet that were apart.

    Motions start at the poses of the scene, where `end` puts objects, too. Pairs whose surfaces intersect at first do
    not count, nor do those without a rigid body.

    Attributes:
        goals: Poses that a step aims for, device arrays rotation and position of `kernels.base.arrays.ObjectPool`.
        fraction: How much of its motion each object made in the last step, device float64 (n,), 0 to 1.
    """

    def __init__(self, scene: Scene, bodies, capacity: Buffers):
        self._rounds, self._bodies = MotionRounds(bodies), bodies
        super().__init__(scene, [IntersectStage(), InsideStage(), self._rounds], None, capacity, sort_pairs=True)
        self._pool, self.goals = self.batch.objects.pool, self._rounds.goals
        self._state, shared = self._rounds.state, self.broad_phase.filter.shared_group
        # What moves in every world holds all of them together.
        world = self.broad_phase.filter.group
        moves = bodies.motion_type.numpy() != int(kernels.STATIC)
        self._state.world = wp.zeros_like(world) if (moves & (world.numpy() == shared)).any() else world
        self.fraction = self._state.fraction

    def launch_search(self, between=None):
        """Aim motions at their goals, and launch broad phase, exact test and rounds."""
        self._rounds.begin()
        super().launch_search(between)

    def end(self, velocity_change):
        """Pose objects where their motions end, unless there was no room for all pairs. Launches only.

        `velocity_change` is what gravity changes velocities by in a step [world units/s].
        """
        inputs = [wp.vec3d(*velocity_change), self.pair_batch, self.hits, self._state]
        self._rounds.launch(kernels.end_way_kernel, len(self.fraction), [*inputs, self._bodies, self._pool])

    def is_whole(self) -> bool:
        """Return whether there was room for all pairs. Waits for the device."""
        totals, lists = self.readout.read_totals(), len(self.hits.uncertain)
        return totals.pairs <= len(self.pairs) and (not lists or totals.uncertain <= lists)

    def pair_totals(self) -> dict:
        """Return counts of the last step's pairs, by name. Waits for the device.

        touching: pairs whose surfaces intersected at its start; undecided: pairs held because contact was neither
        proved nor excluded, once a round; held: pairs for which a whole world stood still.
        """
        touching, undecided, held = self._state.counter.numpy().tolist()
        return {"touching": touching, "undecided": undecided, "held": held}

    def check(self):
        """Raise CapacityError if there was no room for all pairs of the last step: then nothing moved. Waits.

        Pairs that are undecided are no error, since their bodies wait where they are proved apart: see `pair_totals`.
        """
        self.result().check()
