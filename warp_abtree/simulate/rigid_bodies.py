"""Rigid bodies that respond to the contacts of their meshes: `Dynamics`.

One step: contacts where the bodies stand, and where they first meet as far ahead as they move; substeps of gravity,
contact impulses by projected Gauss-Seidel with warm starting and Coulomb friction, soft where points penetrate,
relaxation, and motion by semi-implicit Euler with rotations that keep energy; with `continuous`, motions cut where
surfaces would meet. docs/dynamics.md has each part, what is conserved and repeated, figures, and limits.
"""

import warnings
from contextlib import contextmanager

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import finite_array, flag, positive
from warp_abtree.checks.radix_sort import radix_sort
from warp_abtree.checks.regime import current_regime
from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.base.arrays import LAST_KEY
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.bodies import bodies as body_kernels
from warp_abtree.kernels.bodies import constraints as constraint_kernels
from warp_abtree.kernels.bodies import graph_coloring, solve
from warp_abtree.kernels.bodies.graph_coloring import COLOR_COUNT
from warp_abtree.query.request import Buffers, check_capacity
from warp_abtree.query.stages.points import POINTS_MAX, ManifoldQuery
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.body_state import SLOP, RigidBodies
from warp_abtree.simulate.contacts_ahead import AheadGapStage
from warp_abtree.simulate.continuous import CertifiedMotions

SUBSTEPS_LEAST, SUBSTEPS_MAX = 8, 32  # of a step
GIVE = 0.25  # slops that springs may give for each body borne, unless that takes more substeps
REST_DEPTH, REST_APART = 0.5, 1.0  # at which points rest, in slops: deep, or with `continuous` apart, within reach
CORRECTION = 0.2  # part of the penetration that a step corrects, however deep
FRICTION_MAX = 2.0**60  # beyond which float32 might have no product; nothing slides far below
COLOR_ROUNDS = int(COLOR_COUNT)  # of the graph coloring
RELAXING_WARPS = 12  # of a processor


class Dynamics(RigidBodies):
    """Rigid bodies of a scene, moved step by step; docs/dynamics.md says what it is and what it is not.

    Static objects of the scene do not move. Kinematic ones move as `step` is told, and push bodies. All others are
    rigid bodies of density 1, with the mass of their original meshes at every LOD (`mass_properties`).

    Args:
        scene: `Scene` with all its objects; its poses are where the bodies start, and where `step` puts them.
        friction: Coulomb's coefficient, 0 or more.
        gravity: Acceleration [world units/s^2], (3,).
        kinematic: Objects whose motion is prescribed: indices, or bool (n,).
        velocity: Initial velocity of the centres of mass [world units/s], (3,) or (n, 3).
        angular_velocity: Initial angular velocity in the world frame [rad/s], (3,) or (n, 3).
        capacity: `Buffers`, or the initial capacity for contacts; `step` grows it, `launch` does not.
        continuous: Whether surfaces that are apart are proved to stay apart: bodies stop, for the rest of a step, short
            of where they would meet, and rest a little apart. Kinematic objects stop too.
        remember: As for `ManifoldQuery`: pairs that hardly move are not searched again. Off, since a controller of LODs
            that sees none of their cost makes them too fine, and pays once it changes them.

    Attributes:
        bodies, mass, rigid, kinematic: As `RigidBodies`.
        certified: With `continuous`, `CertifiedMotions`, what the last step made of each motion; else None.
        query: The `ManifoldQuery` of the last step: its pairs, contacts and contact points.
        constraints: Their impulses and colors, `kernels.bodies.constraints.Constraints`.

    Raises:
        ValueError: A number out of range or of the wrong shape, or a body without a volume.
    """

    def __init__(
        self,
        scene: Scene,
        friction: float = 0.5,
        gravity=(0.0, 0.0, -9.81),
        kinematic=(),
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
        capacity: Buffers | int | None = None,
        continuous: bool = False,
        remember: bool | float = False,
    ):
        super().__init__(scene, gravity, kinematic, velocity, angular_velocity, flag(continuous, "continuous"))
        self.friction = float(finite_array(friction, "friction", ()))
        if self.friction < 0:
            raise ValueError(f"friction {friction!r} is below 0")
        self.query = ManifoldQuery(scene, None, capacity, gap=AheadGapStage(scene, self.bodies), remember=remember)
        self.certified = None
        if continuous:
            self.certified = CertifiedMotions(scene, self.bodies, Buffers(pairs=check_capacity(capacity).pairs))
        slop, radius = self.bodies.slop.numpy(), self.bodies.bounding_radius.numpy()
        thin = np.where(slop < SLOP * radius, slop, np.inf)
        self._thinnest, self._thin_slop = int(thin.argmin()) if len(thin) else 0, thin.min(initial=np.inf)
        self._least_slop = slop.min(initial=np.inf)
        most = RELAXING_WARPS * self.device.sm_count if self.device.is_cuda else 1
        self._warps = current_regime().relaxing_warps or most
        self._warm_start = constraint_kernels.WarmStart()
        self._turns = wp.zeros(2 + 2 * SUBSTEPS_MAX, dtype=wp.int32, device=self.device)
        self._room, self._interrupted = -1, False
        self._grow()

    def _grow(self):
        """Give the arrays over pairs the capacity of the query; impulses of the step before are kept."""
        room = len(self.query.pairs)
        if room == self._room:
            return
        constraints = zeros_of(constraint_kernels.Constraints, room, POINTS_MAX, self.device)
        warm_start = zeros_of(constraint_kernels.WarmStart, room, POINTS_MAX, self.device)
        warm_start.key.fill_(int(LAST_KEY))
        if self._room > 0:
            for name in constraint_kernels.WarmStart.vars:
                old = getattr(self._warm_start, name)
                wp.copy(getattr(warm_start, name).flatten(), old.flatten(), count=old.size)
        color, pair = (wp.zeros(2 * room, dtype=wp.int32, device=self.device) for _ in range(2))
        shape = room if self.device.is_cpu else 0, POINTS_MAX  # where each lane does not hold a point
        relaxed = wp.empty(shape, dtype=solve.RelaxedPoint, device=self.device)
        with self._changing():
            self.constraints, self._warm_start, self._room = constraints, warm_start, room
            self._sorted_color, self._sorted_pair, self._relaxed = color, pair, relaxed

    @contextmanager
    def _changing(self):
        """Refuse the bodies for good if a change of them is interrupted; a capture changes nothing."""
        self._interrupted = self._interrupted or not self.device.is_capturing
        yield
        self._interrupted = False

    def _check_whole(self):
        if self._interrupted:
            raise RuntimeError("a step of the bodies was interrupted; make a new Dynamics of the scene")

    def step(self, dt: float, targets=None):
        """Move all bodies by one step. Waits for the device, to grow what is too small.

        Args:
            dt: Length of the step [s].
            targets: Poses of all objects at the end of the step, as for `Scene.set_poses`; only those of kinematic
                objects count, which rotate by less than half a turn. None leaves them where they are.

        Raises:
            ValueError: A step that is not above 0 or too long for a thin body, or bad poses; nothing is changed.
            RuntimeError: Objects were added to the scene, or a step was interrupted.
            CapacityError: More contacts than can be numbered.
        """
        dt = self._check_step(dt)
        self.find(targets)
        self.answer(dt)
        self.finish(dt)

    def substeps(self, dt: float) -> int:
        """Return how many substeps a step has: more the longer it is, and the smaller its smallest body.

        A contact gives by about twice the square of a substep times gravity for each body borne.

        Raises:
            ValueError: That is much of the thickness of a thin body, which would pass through what it rests on.
        """
        pull = dt * np.sqrt(2.0 * np.linalg.norm(self.gravity) / GIVE)
        wanted, thin = (pull / np.sqrt(slop) for slop in (self._least_slop, self._thin_slop))
        if thin > SUBSTEPS_MAX:
            what = f"dt {dt:.3g} is too long for body {self.scene.name(self._thinnest)!r}, which is thin: it would fall"
            longest = dt * SUBSTEPS_MAX / thin
            raise ValueError(f"{what} through others; use steps of {longest:.2g} at most, or continuous=True")
        return int(np.clip(np.ceil(wanted), SUBSTEPS_LEAST, SUBSTEPS_MAX))

    def _check_step(self, dt) -> float:
        """Return the length of a step, or raise before anything is changed."""
        dt = positive(dt, "dt")
        self.substeps(dt)
        return dt

    def find(self, targets=None):
        """Do the first half of `step`: find the contacts where the bodies stand, without moving them."""
        self._check_whole()
        self.aim(targets)
        self.find_contacts()

    def aim(self, targets=None):
        """Set where kinematic objects are at the end of the coming step; None leaves them where they are."""
        if targets is not None:
            self.set_targets(targets)
        elif self.kinematic.any():
            self.clear_targets()

    def find_contacts(self, between=None):
        """Find the contacts, with room for all of them; see `Query.grow`. Waits for the device."""
        self.query.grow(between)
        self._grow()

    def answer(self, dt: float):
        """Do the second half of `step`: impulses, and motion. Launches only.

        Where contacts or pairs outran the capacity nothing moves.
        """
        self._check_whole()
        n, room, query, bodies = len(self.mass), self._room, self.query, self.bodies
        substeps = self.substeps(dt)
        h = dt / substeps
        posed = [query.pair_batch, self._pool, query.manifolds]
        each = solve.Relaxation()
        each.friction, each.fast = min(self.friction, FRICTION_MAX), 2.0 * float(np.linalg.norm(self.gravity)) * dt
        each.rest = REST_DEPTH if self.certified is None else -REST_APART
        each.per_substep, each.correction = 1.0 / h, CORRECTION / dt
        with self._changing():
            self._launch(body_kernels.judge_contacts_kernel, 1, [query.pair_batch, query.hits, bodies])
            self._launch(body_kernels.begin_step_kernel, n, [dt, self.targets, self._pool, bodies])
            inputs = [each.fast, *posed, self._warm_start, bodies, self._sorted_pair, self.constraints]
            self._launch(constraint_kernels.prepare_constraints_kernel, room, inputs)
            self._color_pairs()
            self._relax(each, solve.WARM_START)
            for turn in range(substeps + 1):
                inputs = [h if turn else 0.0, int(turn < substeps), wp.vec3d(*(h * self.gravity)), bodies]
                self._launch(body_kernels.move_bodies_kernel, n, inputs)
                if turn < substeps:
                    self._relax(each, solve.SOLVE)
                    self._launch(body_kernels.keep_solved_kernel, n, [bodies])
                    self._relax(each, solve.RELAX)
            inputs = [query.broad_phase.key, *posed, self.constraints, bodies, self._warm_start]
            self._launch(constraint_kernels.save_impulses_kernel, room, inputs)
            posed = self._pool if self.certified is None else self.certified.goals
            self._launch(body_kernels.pose_objects_kernel, n, [dt, self.targets, bodies, posed])
            if self.certified is not None:
                self.certified.launch()
                self.certified.end(dt * self.gravity)

    def finish(self, dt: float):
        """Finish an `answer` whose motions had more pairs than room for them. Waits for the device if `continuous`."""
        if self.certified is not None and not self.certified.is_whole():
            with self._changing():
                self.certified.grow()
                self.certified.end(dt * self.gravity)

    def launch(self, dt: float):
        """Move all bodies by one step. Launches only: after a `step`, a CUDA graph can capture it, with this dt.

        Where contacts or pairs outrun the capacity nothing moves; `check` raises then.

        Raises:
            ValueError: A step that is not above 0, or too long for a thin body.
            RuntimeError: As `step`.
        """
        dt = self._check_step(dt)
        self._check_whole()
        with self.query.guard.launching(self):
            self.query.launch()
            self.answer(dt)

    def check(self):
        """Raise if the last step exceeded the capacity. Waits for the device.

        Raises:
            CapacityError: Names the demand.
        """
        self.query.result(with_points=False).check()
        if self.certified is not None:
            self.certified.check()

    def motion(self, prescribed=None) -> "SteppedMotion":
        """Return what a `Frame` takes as motion: steps of this, with kinematic objects on a prescribed path."""
        return SteppedMotion(self, prescribed)

    def _launch(self, kernel, dim, inputs, block_dim=256):
        wp.launch(kernel, dim=dim, inputs=inputs, block_dim=block_dim, device=self.device)

    def _color_pairs(self):
        """Color the pairs in contact, and sort all pairs by color."""
        room, color = self._room, self.constraints.color
        for turn in range(COLOR_ROUNDS):
            for kernel in (graph_coloring.bid_kernel, graph_coloring.assign_color_kernel):
                self._launch(kernel, room, [turn, self.query.pair_batch, color, self.bodies])
        wp.copy(self._sorted_color, color, count=room)
        radix_sort(self._sorted_color, self._sorted_pair, room, 7)
        self._turns.zero_()
        inputs = [self._sorted_color, self._sorted_pair, self.query.pair_batch, self.bodies, self.constraints.rank]
        self._launch(graph_coloring.rank_pairs_kernel, room, [*inputs, self._turns])

    def _relax(self, each, stage):
        """Relax all pairs once."""
        each.stage, each.backward = int(stage), int(stage == solve.RELAX)
        threads = min(self._warps, self._room) * (WARP_SIZE if self.device.is_cuda else 1)
        inputs = [each, self._sorted_pair, self.query.pair_batch, self.query.manifolds, self._relaxed, self._turns]
        self._launch(solve.relax_kernel, threads, [*inputs, self.constraints, self.bodies], WARP_SIZE)
        each.passes += 1


class SteppedMotion:
    """Steps of `Dynamics` as the motion of a `Frame`: each frame finds the contacts once, and responds to them.

    Kinematic objects follow what is prescribed, `Kinematic` or anything with its `poses`, or stay where they are.
    """

    def __init__(self, dynamics: Dynamics, prescribed=None):
        self.dynamics, self.prescribed = dynamics, prescribed

    def __len__(self) -> int:
        return len(self.dynamics.mass)

    def warn_of_coarse_lods(self):
        """Warn of objects that are no bodies and that may let one through at their coarsest LOD."""
        dynamics, scene = self.dynamics, self.dynamics.scene
        least = dynamics.bodies.bounding_radius.numpy()[dynamics.rigid].min(initial=np.inf)
        fixed = np.setdiff1d(np.flatnonzero(~dynamics.rigid), scene.batch().removed).tolist()
        for model, i in {scene.object_model[i]: i for i in reversed(fixed)}.items():
            error = scene.models[model].error_at(0)
            if error > least:
                warnings.warn(
                    f"object {i} {scene.name(i)!r}: at its model's coarsest LOD the surface is off by up to "
                    f"{error:.3g}, more than the smallest body's radius {least:.3g}: bodies may fall through; make the "
                    "model with base_faces=",
                    RuntimeWarning,
                    stacklevel=3,
                )

    def warm_up(self, time: float):
        """Load all kernels of a step, and grow to the contacts where the bodies stand; nothing moves."""
        device = self.dynamics.device
        for module in (body_kernels, constraint_kernels, graph_coloring, solve):
            wp.load_module(module, device)
        self.aim(time)
        self.dynamics.find_contacts()
        if self.dynamics.certified is not None:
            self.dynamics.certified.grow()

    def aim(self, time: float):
        """Set where kinematic objects are at a time [s], the end of the coming step."""
        if self.dynamics.kinematic.any():
            self.dynamics.aim(None if self.prescribed is None else self.prescribed.poses(time))
