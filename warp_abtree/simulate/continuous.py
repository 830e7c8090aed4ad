"""Continuous collision of a step: motions cut where surfaces that are apart would meet: `CertifiedMotions`."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.bodies import continuous as kernels
from warp_abtree.query.request import Buffers
from warp_abtree.scene.first_contact import FirstContactQuery
from warp_abtree.scene.scene import Scene

TIME_TOLERANCE = 2.0**-24  # of times, as a fraction of a step's motion
INTEGERS = [(name, wp.int32) for name in ("is_changed", "is_held", "stuck")]
ROUND_MODES = kernels.CUT, kernels.MATCH, kernels.HOLD_BOTH, kernels.CERTIFY
# What each round does with the pairs that it does not prove clear.
ROUNDS = [int(mode) for mode, times in zip(ROUND_MODES, (5, 4, 3, 1)) for _ in range(times)]


class CertifiedMotions(FirstContactQuery):
    """Fractions of the objects' motions towards their goals for which no two surfaces meet that were apart.

    Motions start at the poses of the scene, where `end` puts objects, too. Pairs whose surfaces intersect at first do
    not count, nor do those without a rigid body.

    Attributes:
        goals: Poses that a step aims for, device arrays rotation and position of `kernels.base.arrays.ObjectPool`.
        fraction: How much of its motion each object made in the last step, device float64 (n,), 0 to 1.
    """

    def __init__(self, scene: Scene, bodies, capacity: Buffers):
        self._pool, n = scene.batch().objects.pool, scene.object_count
        self._bodies, self.goals = bodies, ObjectPool()
        self.goals.rotation, self.goals.position = wp.clone(self._pool.rotation), wp.clone(self._pool.position)
        self._state, self._is_begun = kernels.StepMotions(), False
        super().__init__(scene, None, None, capacity, TIME_TOLERANCE)
        state, shared = self._state, self.broad_phase.shared_group
        state.goals, state.ends = self.goals, self.ends
        for name, dtype in (("fraction", wp.float64), ("cut", wp.float64), *INTEGERS):
            setattr(state, name, wp.zeros(n, dtype=dtype, device=self.device))
        state.counter = wp.zeros(3, dtype=wp.int32, device=self.device)
        # What moves in every world holds all of them together.
        world = self.broad_phase.group
        moves = bodies.motion_type.numpy() != int(kernels.STATIC)
        state.world = wp.zeros_like(world) if (moves & (world.numpy() == shared)).any() else world
        self.fraction = state.fraction

    def _pair_arrays(self, room: int) -> list:
        made = super()._pair_arrays(room)
        names = "level", "is_again"
        return [*made, *((self._state, name, wp.zeros(room, dtype=wp.int32, device=self.device)) for name in names)]

    def _launch(self, between=None):
        self._begin()
        self._is_begun = True
        super()._launch(between)

    def _run(self, kernel, dim, inputs):
        wp.launch(kernel, dim, inputs, device=self.device)

    def _begin(self):
        self._run(kernels.begin_way_kernel, len(self.fraction), [self._pool, self._bodies, self._state])

    def traverse(self):
        """Cut the motions of objects in rounds, from goals on. Launches only."""
        room, n, state = len(self.pairs), len(self.fraction), self._state
        if not self._is_begun:  # a traversal again, with more room
            self._begin()
        self._is_begun = False
        super(FirstContactQuery, self).traverse()
        found = [self.pair_count, self.pairs]
        self._run(kernels.exempt_pair_kernel, room, [*found, self.hits, self._bodies, state])
        for mode in ROUNDS:
            self._run(kernels.choose_pair_kernel, room, [*found, state, self.hits])
            self.begin_motions()
            if mode <= kernels.MATCH:
                inputs = [*found, self.contacts, self._bodies, state, self._motion]
                self._run(kernels.widen_motion_kernel, room, inputs)
            self.follow_motions()
            inputs = [mode, *found, self._pool, self.hits, self.contacts, self._bodies, state]
            self._run(kernels.cut_way_kernel, room, inputs)
            self._run(kernels.apply_cut_kernel, n, [self._pool, self._bodies, state])
            if self._is_settled():
                break

    def _is_settled(self) -> bool:
        """Return whether further rounds would find nothing, where that can be told without a wait."""
        if not self.device.is_cpu or self.device.is_capturing:
            return False
        return not (self._state.is_changed.numpy().any() or self._state.is_again.numpy().any())

    def free_stuck(self, dt: float):
        """Set other goals for bodies that were stuck in the last step. Launches only."""
        self._run(kernels.free_stuck_kernel, len(self.fraction), [dt, self._pool, self._bodies, self._state])

    def end(self, velocity_change):
        """Pose objects where their motions end, unless there was no room for all pairs. Launches only.

        `velocity_change` is what gravity changes velocities by in a step [world units/s].
        """
        inputs = [wp.vec3d(*velocity_change), self.guard.launched, self.pair_count, self.hits, self._state]
        self._run(kernels.end_way_kernel, len(self.fraction), [*inputs, self._bodies, self._pool])

    def is_whole(self) -> bool:
        """Return whether there was room for all pairs. Waits for the device."""
        totals, lists = self._read_totals(), len(self.hits.uncertain)
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
