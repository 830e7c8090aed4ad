"""Rigid bodies that respond to the contacts of their meshes: `Dynamics`.

One step: contacts where the bodies stand (`ManifoldQuery`, at most 8 points a pair); restitution; gravity; contact
impulses by projected Gauss-Seidel with warm starting and Coulomb friction; position correction by split impulses;
semi-implicit Euler with a symplectic rotation; islands at rest fall asleep. All in float64, with the same bits when
repeated on one device, and for a world alone or among others. docs/dynamics.md has each part, figures, and limits.

Momentum and angular momentum of bodies that only meet each other are conserved to rounding without gravity; under
gravity position corrections change angular momentum. Restitution adds no energy, converged or not, and conserves it for
1 and no friction; resting impulses add none but what a warm start leaves. Energy oscillates: of a free tumble by the
fraction (angular velocity dt)^2, under gravity by m g v dt / 2, as in semi-implicit Euler.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import positive, whole_number
from warp_abtree.checks.quaternions import matrices_of
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.dynamics import bodies as body_kernels
from warp_abtree.kernels.dynamics import constraints as constraint_kernels
from warp_abtree.kernels.dynamics import graph_coloring, solve
from warp_abtree.model.mesh import mesh_from_arrays
from warp_abtree.model.model import Model
from warp_abtree.query.manifold import POINTS_MAX, ManifoldQuery
from warp_abtree.query.request import Buffers, CapacityError
from warp_abtree.scene.poses import check_poses
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.body_state import RigidBodies, zeros_of

COLOR_COUNT, INACTIVE = int(graph_coloring.COLOR_COUNT), int(graph_coloring.INACTIVE)


@dataclass(frozen=True)
class SolverOptions:
    """Options of `Dynamics` that are rarely changed, given to it by name.

    Attributes:
        iterations: Rounds of relaxation over all contacts in a step.
        slop: Penetration that is not corrected [world units], one for all or (n,), a pair the smaller of two; None is
            1/512 of each bounding radius.
        sleep_speed: Speed below which a body counts as at rest [world units/s], one for all or (n,); None is
            0.01 sqrt(gravity * bounding radius), which is 0 without gravity: nothing sleeps.
        sleep_time: How long all bodies of an island must be at rest before they sleep [s].
        capacity: `Buffers`, or the initial capacity for contacts; `step` grows it, `launch` does not.
    """

    iterations: int = 16
    slop: Any = None
    sleep_speed: Any = None
    sleep_time: float = 0.5
    capacity: Buffers | int | None = None


class BodyContacts(ManifoldQuery):
    """Contact points of the pairs in which a body can move."""

    def __init__(self, scene, bodies, capacity):
        self._motion_type = bodies.motion_type
        super().__init__(scene, None, capacity)

    def make_pair_keys(self, order, keys):
        inputs = [self.pair_count, self.pairs, self._motion_type, order, keys]
        wp.launch(body_kernels.make_body_pair_key_kernel, len(self.pairs), inputs, device=self.device)


class Dynamics(RigidBodies):
    """Rigid bodies of a scene, moved step by step; docs/dynamics.md says what it is and what it is not.

    Static objects of the scene do not move. Kinematic ones move as `step` is told, and push bodies. All others are
    rigid bodies of uniform density, with the mass of their original meshes at every LOD (`mass_properties`).

    Args:
        scene: `Scene` with all its objects; its poses are where the bodies start, and where `step` puts them.
        density: Mass per volume, above 0, one for all or (n,).
        restitution: Coefficient from 0, no bounce, to 1, elastic; one for all or (n,). A pair has the larger of two.
        friction: Coulomb's coefficient, 0 or more; one for all or (n,). A pair has the geometric mean of two.
        gravity: Acceleration [world units/s^2], (3,).
        kinematic: Objects whose motion is prescribed: indices, or bool (n,).
        velocity: Initial velocity of the centres of mass [world units/s], (3,) or (n, 3).
        angular_velocity: Initial angular velocity in the world frame [rad/s], (3,) or (n, 3).
        options: Attributes of `SolverOptions`.

    Attributes:
        bodies, properties, mass, rigid, kinematic: As `RigidBodies`.
        query: The `ManifoldQuery` of the last step: its pairs, contacts and contact points.
        time: Seconds since the start.

    Raises:
        ValueError: A number out of range or of the wrong shape, or a body without a volume.
    """

    def __init__(
        self,
        scene: Scene,
        density=1.0,
        restitution=0.0,
        friction=0.5,
        gravity=(0.0, 0.0, -9.81),
        kinematic=(),
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
        **options,
    ):
        solver = SolverOptions(**options)
        super().__init__(scene, density, restitution, friction, gravity, kinematic, solver.slop, solver.sleep_speed)
        self.iterations = whole_number(solver.iterations, "iterations", 1, 10_000)
        self.sleep_time = positive(solver.sleep_time, "sleep_time")
        by_color = current_regime().relax_by_color
        self._by_color = not self.device.is_cpu if by_color is None else by_color
        self.time = 0.0
        self.set_velocities(velocity, angular_velocity)
        self._targets = tuple(wp.empty(0, dtype=kind, device=self.device) for kind in (wp.mat33d, wp.vec3d))
        self.query = BodyContacts(scene, self.bodies, solver.capacity)
        self._warm_start = constraint_kernels.WarmStart()
        self._room, self._interrupted = -1, False
        self._grow()

    def _grow(self):
        """Give the arrays over pairs the capacity of the query; impulses of the step before are kept."""
        room = len(self.query.pairs)
        if room == self._room:
            return
        constraints = zeros_of(constraint_kernels.Constraints, room, POINTS_MAX, self.device)
        warm_start = zeros_of(constraint_kernels.WarmStart, room, POINTS_MAX, self.device)
        warm_start.key.fill_(int(body_kernels.LAST_KEY))
        if self._room > 0:
            for name in constraint_kernels.WarmStart.vars:
                old = getattr(self._warm_start, name)
                wp.copy(getattr(warm_start, name).flatten(), old.flatten(), count=old.size)
        color, sorted_color, sorted_pair = (
            wp.zeros(size, dtype=wp.int32, device=self.device) for size in (room, 2 * room, 2 * room)
        )
        with self._changing():
            self._constraints, self._warm_start = constraints, warm_start
            self._pair_color, self._sorted_color, self._sorted_pair = color, sorted_color, sorted_pair
            self._room = room

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
            ValueError: A step that is not above 0, or bad poses; nothing is changed.
            RuntimeError: Objects were added to the scene, or a step was interrupted.
            CapacityError: More contacts than can be numbered.
        """
        self.find(dt, targets)
        self.answer(dt)

    def find(self, dt: float, targets=None):
        """Do the first half of `step`: find the contacts where the bodies stand, without moving them."""
        dt = positive(dt, "dt")
        self._check_whole()
        if targets is not None:
            self.set_targets(targets)
        elif len(self._targets[0]):
            self.clear_targets()
        self._begin(dt)
        self.query.grow()
        self._grow()

    def answer(self, dt: float):
        """Do the second half of `step`, with the same dt: impulses, and motion."""
        self._check_whole()
        self._respond(dt, launch_only=False)

    def set_targets(self, targets):
        """Set the poses of kinematic objects at the end of the next `launch`; see `step`."""
        targets = check_poses(targets, "targets")
        if len(targets) != len(self.mass):
            raise ValueError(f"targets: {len(targets)} given for {len(self.mass)} objects")
        if targets.ndim == 2:
            rotation, position = matrices_of(targets[:, 3:]), targets[:, :3]
        else:
            rotation, position = targets[:, :3, :3], targets[:, :3, 3]
        if not len(self._targets[0]):
            n, device = len(targets), self.device
            self._targets = wp.zeros(n, dtype=wp.mat33d, device=device), wp.zeros(n, dtype=wp.vec3d, device=device)
        self._targets[0].assign(np.ascontiguousarray(rotation))
        self._targets[1].assign(np.ascontiguousarray(position))

    def clear_targets(self):
        """Let kinematic objects stand where they are."""
        wp.copy(self._targets[0], self._objects.pool.rotation)
        wp.copy(self._targets[1], self._objects.pool.position)

    def launch(self, dt: float):
        """Move all bodies by one step. Launches only: after a `step`, a CUDA graph can capture it, with this dt.

        Contacts and pairs beyond the capacity are lost; `check` raises then.
        """
        self._check_whole()
        with self.query.guard.launching(self):
            self._begin(dt)
            self.query.launch()
            self._respond(dt, launch_only=True)

    def check(self):
        """Raise if the last step exceeded the capacity. Waits for the device.

        Raises:
            CapacityError: Names the demand.
        """
        assert self.query.broad_phase is not None  # the query was made without pairs
        pairs = self.query.broad_phase.count_found()
        if pairs > self._room:
            raise CapacityError(
                f"{pairs} object pairs, there is room for {self._room}: make it with capacity=Buffers(pairs={pairs})"
            )
        self.query.result().check()

    def motion(self, prescribed=None) -> "SteppedMotion":
        """Return what a `Frame` takes as motion: steps of this, with kinematic objects on a prescribed path."""
        return SteppedMotion(self, prescribed)

    def _launch(self, kernel, dim, inputs):
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def _begin(self, dt):
        inputs = [dt, *self._targets, self._objects.pool, self.bodies]
        self._launch(body_kernels.begin_step_kernel, len(self.mass), inputs)

    def _respond(self, dt, launch_only):
        """Apply the contacts found, and move all bodies to the end of the step."""
        n, room, query, bodies = len(self.mass), self._room, self.query, self.bodies
        contacts = [query.pair_count, query.pairs, query.manifolds]
        with self._changing():
            self._launch(body_kernels.unite_islands_kernel, room, [*contacts, bodies])
            self._launch(body_kernels.measure_island_rest_kernel, n, [bodies])
            self._launch(body_kernels.update_sleep_kernel, n, [self.sleep_time, bodies])
            colors = self._color_pairs(contacts, launch_only)
            posed = [query.pair_key, query.pairs, self._pair_color, self._objects.pool, query.manifolds]
            threshold = 2.0 * float(np.linalg.norm(self.gravity)) * dt
            inputs = [dt, threshold, *posed, self._warm_start, bodies, self._constraints]
            self._launch(constraint_kernels.prepare_constraints_kernel, room, inputs)
            self._relax(solve.RESTITUTION, self.iterations, colors)
            self._launch(body_kernels.apply_gravity_kernel, n, [wp.vec3d(*(dt * self.gravity)), bodies])
            self._relax(solve.WARM_START, 1, colors)
            self._relax(solve.VELOCITY, self.iterations, colors)
            self._relax(solve.POSITION, self.iterations, colors)
            inputs = [query.pair_count, *posed, self._constraints, self._warm_start]
            self._launch(constraint_kernels.save_impulses_kernel, room, inputs)
            self._launch(body_kernels.integrate_kernel, n, [dt, *self._targets, bodies, self._objects.pool])
            self.time += dt

    def _color_pairs(self, contacts, launch_only):
        """Color the pairs, sort them by color, and return the colors to relax: the used ones, or all to launch only."""
        room, pairs, bodies, color = self._room, self.query.pairs, self.bodies, self._pair_color
        inputs = [*contacts, bodies, self._sorted_pair, color]
        self._launch(graph_coloring.begin_coloring_kernel, room, inputs)
        for c in range(COLOR_COUNT):
            if not launch_only and self.device.is_cpu and not (color.numpy() == COLOR_COUNT).any():
                break
            self._launch(graph_coloring.bid_kernel, room, [c, pairs, color, bodies])
            self._launch(graph_coloring.assign_color_kernel, room, [c, pairs, bodies, color])
        wp.copy(self._sorted_color, color, count=room)
        with wp.ScopedDevice(self.device):
            wp.utils.radix_sort_pairs(self._sorted_color, self._sorted_pair, room, end_bit=7)
        if launch_only or not self._by_color:
            return range(COLOR_COUNT + 1)
        return [c for c in np.unique(color.numpy()).tolist() if c < INACTIVE]

    def _relax(self, stage, rounds, colors):
        """Relax all pairs: by one thread in one launch, or a launch for each color of each round."""
        if not self._by_color:
            self._launch_relaxation(1, stage, 0, 0, COLOR_COUNT, rounds)
            return
        for turn in range(rounds):
            backward = turn % 2 if stage == solve.VELOCITY else 0
            for color in reversed(colors) if backward else colors:
                # The pairs without a color of their own are relaxed one after another.
                threads = self._room if color < COLOR_COUNT else 1
                self._launch_relaxation(threads, stage, backward, color, color, 1)

    def _launch_relaxation(self, threads, stage, backward, first_color, last_color, rounds):
        relaxation = solve.Relaxation()
        relaxation.stage, relaxation.backward, relaxation.threads = int(stage), backward, threads
        relaxation.first_color, relaxation.last_color, relaxation.rounds = first_color, last_color, rounds
        inputs = [relaxation, self._sorted_pair, self._sorted_color, self.query.pairs, self.query.manifolds]
        inputs += [self._warm_start, self._constraints, self.bodies]
        self._launch(solve.relax_kernel, threads, inputs)


def load_kernels(device):
    """Load all kernels of a step: let two tetrahedra collide."""
    corners, faces = np.concatenate([np.zeros((1, 3)), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    model, scene = Model.load(mesh_from_arrays(corners, faces)), Scene(device=device)
    scene.add(model)
    scene.add(model, pose=(0.1, 0.1, 0.1, 0, 0, 0, 1))
    bodies = Dynamics(scene)
    bodies.step(1e-3)
    bodies.launch(1e-3)


class SteppedMotion:
    """Steps of `Dynamics` as the motion of a `Frame`: each frame finds the contacts once, and responds to them.

    Args:
        dynamics: `Dynamics`.
        prescribed: `Kinematic`, or anything with its `poses`, for all objects: kinematic ones follow it. None leaves
            them where they are.
    """

    def __init__(self, dynamics: Dynamics, prescribed=None):
        self.dynamics, self.prescribed = dynamics, prescribed
        self._time = 0.0

    def __len__(self) -> int:
        return len(self.dynamics.mass)

    def poses(self, time: float, out=None) -> None:
        """Take the time [s]; the poses are in the scene already."""
        self._time = time

    def warm_up(self, time_step: float):
        """Load all kernels of a step, and grow to the contacts where the bodies stand; nothing moves."""
        load_kernels(self.dynamics.device)
        self.find(time_step)

    def find(self, time_step: float):
        """Find the contacts of the step from here; return a `Result` without points. Waits for the device."""
        targets = None if self.prescribed is None else self.prescribed.poses(self._time + time_step)
        self.dynamics.find(time_step, targets)
        return self.dynamics.query.result(with_points=False)

    def answer(self, result, time_step: float):
        """Move on by a step."""
        self.dynamics.answer(time_step)
