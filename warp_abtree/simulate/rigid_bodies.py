"""Motion of objects over time: prescribed in closed form (`Kinematic`), or that of rigid bodies (`Dynamics`).

`Dynamics` is the smallest honest stepper on the meshes as they are at their LODs, not on boxes or hulls. One step:

1. Contacts where the bodies stand, each touching pair reduced to at most 8 points (`warp_abtree.query.manifold`).
2. Bounces: pairs with a point that comes in faster than 2 |gravity| dt are reflected, `restitution` times as fast,
   pair after pair, as often as `iterations` allows; friction acts against what slides.
3. Gravity; then impulses at all points by relaxation, one point after another, to and fro (projected Gauss-Seidel, the
   sequential impulses of games), until nothing sinks, started from those of the step before where points rest. Friction
   is Coulomb's, in a disc.
4. Corrections of place, one fifth of the way to a depth of `slop` a step, that leave no velocity behind (split
   impulses). A resting contact keeps that depth, or it would be none.
5. Semi-implicit Euler: places move with the new velocities. Rotations keep the angular momentum, not the spin, by a
   symplectic splitting, so that a free tumble neither gains nor loses energy for good.
6. Islands of bodies that touch each other and have all been slow for `sleep_time` sleep: they cost nothing until
   something awake, or driven, touches them.

Everything is float64 on the device and the same, bit for bit, when repeated on one device, and for a world alone or
among others: pairs are sorted, and those relaxed at once share no body that moves.

What is kept, to rounding: momentum and angular momentum of bodies that only meet each other, without gravity. Under
gravity corrections of place move angular momentum. A bounce adds no energy, converged or not: it keeps it at
restitution 1 and without friction. Nor do the impulses of rest, but for recalled ones that relaxation has not undone.
Energy swings: of a free tumble by the part (spin dt)^2, under gravity by m g v dt / 2, as semi-implicit Euler does.
Elastic bodies under gravity lose some where points come in slower than 2 |gravity| dt.

What it is not: no continuous detection (what passes through another within a step, or lies whole inside another, since
only surfaces that cross have contacts, is not stopped; keep steps so short that nothing sinks deeper than it is wide);
no joints, motors, soft bodies or rolling friction. Without gravity two bodies that overlap are not pushed apart. What
is taken away under a sleeping body does not wake it, nor does a change of LODs: call `wake`. A step is accurate to
first order.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import whole_number
from warp_abtree.kernels.dynamics import bodies as body_kernels
from warp_abtree.kernels.dynamics import graph_coloring as colouring
from warp_abtree.kernels.dynamics import solve
from warp_abtree.model.mesh import mesh_from_arrays
from warp_abtree.model.model import Model
from warp_abtree.query.manifold import POINTS_MAX, ManifoldQuery
from warp_abtree.query.request import CapacityError
from warp_abtree.scene.poses import check_poses
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.body_state import RigidBodies, matrices_of, positive, stretch

AXIS_TOLERANCE = 1e-3
COLOURS, NO_COLOUR = int(colouring.COLOURS), int(colouring.NO_COLOUR)


def triangle_wave(phase) -> np.ndarray:
    """Return 0 at whole numbers, 1 halfway between them, linear in between; any shape, float64."""
    phase = np.asarray(phase, np.float64)
    fraction = phase - np.floor(phase)
    return 1.0 - np.abs(2.0 * fraction - 1.0)


def multiply_quaternions(p, q) -> np.ndarray:
    """Return p q, the rotation q followed by p; quaternions x y z w, shape (..., 4), float64."""
    px, py, pz, pw = np.moveaxis(np.asarray(p, np.float64), -1, 0)
    qx, qy, qz, qw = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    return np.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


def quaternions_about(axis, angle) -> np.ndarray:
    """Return quaternions x y z w of rotations by an angle [rad] about unit axes, (..., 3) and (...,) to (..., 4)."""
    half = 0.5 * np.asarray(angle, np.float64)[..., None]
    return np.concatenate([np.asarray(axis, np.float64) * np.sin(half), np.cos(half)], axis=-1)


# Defaults of `Kinematic`, a row or a number for all objects; it makes arrays of them.
_NO_TURN: Any = (0.0, 0.0, 0.0, 1.0)
_NO_WAY: Any = (0.0, 0.0, 0.0)
_UPWARDS: Any = (0.0, 0.0, 1.0)
_ZERO: Any = 0.0
_FOR_EVER: Any = np.inf


@dataclass(eq=False)
class Kinematic:
    """Prescribed motion of n objects.

    At time t an object stands at position + velocity t + wave(t / period + phase) shuttle, where the wave runs from 0
    to 1 and back in straight lines, and is turned by rate t about its axis through its own origin, after its start
    rotation. A single row, or number, serves all objects.

    Attributes:
        position: Start [units], float64 (n, 3).
        rotation: Start quaternions x y z w, normalised, (n, 4).
        velocity: Linear velocity [units/s], (n, 3).
        axis: Turning axis in the world, normalised, (n, 3).
        rate: Turning rate [rad/s], (n,).
        shuttle: Way from one end of the shuttle to the other [units], (n, 3).
        period: Time there and back [s], above 0, (n,); inf stands still.
        phase: Part of a period by which the shuttle is ahead, (n,).

    Raises:
        ValueError: Shapes that do not fit, numbers that are not finite, a quaternion whose norm is off 1 by more than
            1e-3, an axis of no length that turns, a period not above 0.
    """

    position: np.ndarray
    rotation: np.ndarray = _NO_TURN
    velocity: np.ndarray = _NO_WAY
    axis: np.ndarray = _UPWARDS
    rate: np.ndarray = _ZERO
    shuttle: np.ndarray = _NO_WAY
    period: np.ndarray = _FOR_EVER
    phase: np.ndarray = _ZERO

    def __post_init__(self):
        self.position = np.array(self.position, np.float64)
        if self.position.ndim != 2 or self.position.shape[1] != 3:
            raise ValueError(f"position: shape {self.position.shape}, not (n, 3)")
        n = len(self.position)
        for name, width in (("rotation", 4), ("velocity", 3), ("axis", 3), ("shuttle", 3)):
            setattr(self, name, stretch(getattr(self, name), n, width, name))
        for name in ("rate", "period", "phase"):
            setattr(self, name, stretch(getattr(self, name), n, None, name))
        for name in ("position", "rotation", "velocity", "axis", "rate", "shuttle", "phase"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name}: a number is not finite")
        if not (self.period > 0).all():
            raise ValueError("period: not above 0")
        norm = np.linalg.norm(self.rotation, axis=1, keepdims=True)
        if (np.abs(norm - 1) > AXIS_TOLERANCE).any():
            raise ValueError("rotation: the norm of a quaternion is off 1 by more than 1e-3")
        self.rotation /= norm
        length = np.linalg.norm(self.axis, axis=1, keepdims=True)
        if ((length[:, 0] == 0) & (self.rate != 0)).any():
            raise ValueError("axis: an object turns about an axis of no length")
        self.axis /= np.where(length > 0, length, 1.0)

    def __len__(self) -> int:
        return len(self.position)

    def poses(self, time: float, out=None) -> np.ndarray:
        """Return the pose of every object at a time [s]: x y z qx qy qz qw, unit quaternions, float64 (n, 7).

        Args:
            time: Seconds since the start; may be negative.
            out: Array to write into, float64 (n, 7).
        """
        if out is None:
            out = np.empty((len(self), 7))
        wave = triangle_wave(time / self.period + self.phase)
        out[:, :3] = self.position + self.velocity * time + self.shuttle * wave[:, None]
        turned = multiply_quaternions(quaternions_about(self.axis, self.rate * time), self.rotation)
        out[:, 3:] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        return out


class Dynamics(RigidBodies):
    """Rigid bodies of a scene, moved step by step; what it is and is not stands in this module's docstring.

    Static objects of the scene stay where they are. Kinematic ones move as `step` is told, and push bodies. All others
    are rigid bodies of uniform density, with the mass of their original meshes at every LOD (`mass_properties`).

    Args:
        scene: `Scene` with all its objects; its poses are where the bodies start, and where `step` puts them.
        density: Mass per volume, above 0, one for all or (n,).
        restitution: From 0, no bounce, to 1, all of it; one for all or (n,). A pair has the larger of two.
        friction: Coulomb's coefficient, 0 or more; one for all or (n,). A pair has the geometric mean of two.
        gravity: Acceleration [world units/s^2], (3,).
        kinematic: Objects whose motion is prescribed: indices, or bool (n,).
        velocity: Start velocity of the centres of mass [world units/s], (3,) or (n, 3).
        spin: Start angular velocity in the world [rad/s], (3,) or (n, 3).
        iterations: Times that all contacts are relaxed in a step.
        slop: Depth that contacts may keep [world units], one for all or (n,), a pair the smaller of two; None is
            1/512 of each body's reach.
        sleep_speed: Speed below which a body counts as at rest [world units/s], one for all or (n,); None is
            0.01 sqrt(gravity reach), 0 without gravity, so that nothing sleeps.
        sleep_time: How long all bodies that touch each other must be at rest before they sleep [s].
        capacity: `Buffers`, or the contacts that there is room for; `step` makes more, `launch` does not.

    Attributes:
        bodies, properties, mass, rigid, driven: As `RigidBodies`.
        query: The `ManifoldQuery` of the last step: its pairs, contacts and contact points.
        time: Seconds since the start.

    Raises:
        ValueError: A number out of range or of the wrong shape, or a body without a volume.
    """

    _colour: wp.array
    _colour_key: wp.array
    _colour_order: wp.array

    def __init__(
        self,
        scene: Scene,
        density=1.0,
        restitution=0.0,
        friction=0.5,
        gravity=(0.0, 0.0, -9.81),
        kinematic=(),
        velocity=(0.0, 0.0, 0.0),
        spin=(0.0, 0.0, 0.0),
        iterations: int = 16,
        slop=None,
        sleep_speed=None,
        sleep_time: float = 0.5,
        capacity=None,
    ):
        super().__init__(scene, density, restitution, friction, gravity, kinematic, slop, sleep_speed)
        self.iterations = whole_number(iterations, "iterations", 1, 10_000)
        self.sleep_time = positive(sleep_time, "sleep_time")
        self.time = 0.0
        self.set_velocities(velocity, spin)
        self._targets = (
            wp.empty(0, dtype=wp.mat33d, device=self.device),
            wp.empty(0, dtype=wp.vec3d, device=self.device),
        )
        self.query = ManifoldQuery(scene, None, capacity, roles=self.bodies.role)
        self._rows, self._memory = solve.Rows(), solve.Memory()
        self._room, self._torn = -1, False
        self._grow()

    def _grow(self):
        """Make the arrays that have an entry a pair as long as the query's; impulses in memory are kept."""
        room = len(self.query.pairs)
        if room == self._room:
            return
        kept = max(self._room, 0)
        points = (room, POINTS_MAX)

        def empty(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        made: list = []
        for kind, struct, single in (
            (solve.Rows, self._rows, ("restitution", "friction", "threshold", "free")),
            (solve.Memory, self._memory, ("key", "count")),
        ):
            for name, variable in kind.vars.items():
                array = empty(room if name in single else points, variable.type.dtype)
                if struct is self._memory:
                    if name == "key":
                        array.fill_(int(body_kernels.LAST_KEY))
                    if kept:
                        old = getattr(struct, name)
                        wp.copy(array.flatten(), old.flatten(), count=old.size)
                made.append((struct, name, array))
        made += [(self, name, empty(2 * room, wp.int32)) for name in ("_colour_key", "_colour_order")]
        made.append((self, "_colour", empty(room, wp.int32)))
        with self._between():
            for owner, name, array in made:
                setattr(owner, name, array)
            self._room = room

    @contextmanager
    def _between(self):
        """Refuse the bodies for good where what changes them is interrupted; a capture changes nothing."""
        self._torn = self._torn or not self.device.is_capturing
        yield
        self._torn = False

    def _check_whole(self):
        if self._torn:
            raise RuntimeError("a step of the bodies was interrupted; make a new Dynamics of the scene")

    def step(self, dt: float, targets=None):
        """Move all bodies by one step. Waits for the device, to grow what is too small.

        Args:
            dt: Length of the step [s].
            targets: Poses of all objects at the end of the step, as for `Scene.set_poses`; only those of kinematic
                objects count, which turn by less than half a turn. None leaves these where they are.

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
        self._settle(dt, whole=False)

    def set_targets(self, targets):
        """Set where kinematic objects are to stand at the end of the next `launch`; see `step`."""
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

        Bodies are lost to each other where contacts or pairs do not fit; `check` tells.
        """
        self._check_whole()
        with self.query.guard.launching(self):
            self._begin(dt)
            self.query.launch()
            self._settle(dt, whole=True)

    def check(self):
        """Raise where the last step had no room for its contacts. Waits for the device.

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

    def _settle(self, dt, whole):
        """Take contacts to the poses at the end of the step; unless whole, launch no more colours than there are."""
        with self._between():
            self._answer_contacts(dt, whole)

    def _answer_contacts(self, dt, whole):
        n, room, query, bodies = len(self.mass), self._room, self.query, self.bodies
        pairs = query.pairs
        touching = [query.pair_count, pairs, query.manifolds]
        self._launch(body_kernels.unite_island_kernel, room, [*touching, bodies])
        self._launch(body_kernels.rest_island_kernel, n, [bodies])
        self._launch(body_kernels.wake_body_kernel, n, [self.sleep_time, bodies])
        colours = self._find_colours(touching, whole)
        posed = [pairs, self._colour, self._objects.pool, query.manifolds]
        threshold = 2.0 * float(np.linalg.norm(self.gravity)) * dt
        inputs = [dt, threshold, query.pair_key, *posed, self._memory, bodies, self._rows]
        self._launch(solve.prepare_row_kernel, room, inputs)
        self._relax(int(solve.BOUNCE), self.iterations, colours)
        self._launch(body_kernels.accelerate_body_kernel, n, [wp.vec3d(*(dt * self.gravity)), bodies])
        self._relax(int(solve.START), 1, colours)
        self._relax(int(solve.VELOCITY), self.iterations, colours)
        self._relax(int(solve.PLACE), self.iterations, colours)
        inputs = [query.pair_count, query.pair_key, *posed, self._rows, self._memory]
        self._launch(solve.keep_impulse_kernel, room, inputs)
        self._launch(body_kernels.move_body_kernel, n, [dt, *self._targets, bodies, self._objects.pool])
        self.time += dt

    def _find_colours(self, touching, whole):
        """Colour the pairs, sort them by colour, and return the colours to be relaxed."""
        room, pairs, bodies = self._room, self.query.pairs, self.bodies
        self._launch(colouring.begin_colour_kernel, room, [*touching, bodies, self._colour_order, self._colour])
        for colour in range(COLOURS):
            if not whole and self.device.is_cpu and not (self._colour.numpy() == COLOURS).any():
                break
            self._launch(colouring.bid_colour_kernel, room, [colour, pairs, self._colour, bodies])
            self._launch(colouring.take_colour_kernel, room, [colour, pairs, bodies, self._colour])
        wp.copy(self._colour_key, self._colour, count=room)
        with wp.ScopedDevice(self.device):
            wp.utils.radix_sort_pairs(self._colour_key, self._colour_order, room, end_bit=7)
        if whole or self.in_turn:
            return range(COLOURS + 1)
        return [c for c in np.unique(self._colour.numpy()).tolist() if c < NO_COLOUR]

    @property
    def in_turn(self) -> bool:
        """Whether one thread relaxes all pairs, as the CPU's only one does best."""
        return self.device.is_cpu

    def _relax(self, stage, rounds, colours):
        touching = [self.query.pairs, self.query.manifolds]
        inputs = [self._colour_order, self._colour_key, *touching, self._memory, self._rows, self.bodies]
        if self.in_turn:
            self._launch(solve.relax_in_turn_kernel, 1, [stage, 0, 0, rounds, *inputs])
            return
        for turn in range(rounds):
            backward = turn % 2 if stage == int(solve.VELOCITY) else 0
            for colour in reversed(colours) if backward else colours:
                if colour < COLOURS:
                    self._launch(solve.relax_colour_kernel, self._room, [stage, backward, colour, *inputs])
                else:
                    self._launch(solve.relax_in_turn_kernel, 1, [stage, backward, COLOURS, 1, *inputs])


def load_kernels(device):
    """Let two tetrahedra collide, in all the ways in which steps launch."""
    corners, faces = np.concatenate([np.zeros((1, 3)), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    model, scene = Model.load(mesh_from_arrays(corners, faces)), Scene(device=device)
    scene.add(model)
    scene.add(model, pose=(0.1, 0.1, 0.1, 0, 0, 0, 1))
    bodies = Dynamics(scene)
    bodies.step(1e-3)
    bodies.launch(1e-3)


class SteppedMotion:
    """Steps of `Dynamics` as the motion of a `Frame`: each frame asks for contacts once, and answers them.

    Args:
        dynamics: `Dynamics`.
        prescribed: `Kinematic`, or what has its `poses`, for all objects: kinematic ones follow it. None leaves these
            where they are.
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
        """Load all kernels of a step, and make the room that contacts take where the bodies stand; nothing moves."""
        load_kernels(self.dynamics.device)
        self.find(time_step)

    def find(self, time_step: float):
        """Find the contacts of the step from here; return a `ManifoldResult` without points. Waits for the device."""
        targets = None if self.prescribed is None else self.prescribed.poses(self._time + time_step)
        self.dynamics.find(time_step, targets)
        return self.dynamics.query.result(with_points=False)

    def answer(self, result, time_step: float):
        """Move on by a step."""
        self.dynamics.answer(time_step)
