"""Rigid bodies of a scene: mass properties of models by trimesh, and the state of the bodies on the device."""

from dataclasses import dataclass

import numpy as np
import trimesh
import warp as wp

from warp_abtree.checks.arguments import broadcast_rows, finite_array, first_line, to_numpy
from warp_abtree.checks.quaternions import quaternions_of
from warp_abtree.kernels.dynamics import bodies as kernels
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene

SLOP = 1 / 512  # of the bounding radius
SLEEP_SPEED = 0.01  # of the speed after a fall by half the bounding radius


def object_values(values, count, what, low, high=np.inf, open_below=False):
    """Return a number for each object, float64 (count,), from `low` (excluded if `open_below`) to `high`."""
    values = broadcast_rows(to_numpy(values, what), what, (count,))
    fits = np.isfinite(values) & (values > low if open_below else values >= low) & (values <= high)
    if not fits.all():
        i = int(np.argmin(fits))
        raise ValueError(
            f"{what}: {values[i]} of object {i} is not {'above' if open_below else 'at least'} {low}"
            + (f" and at most {high}" if high < np.inf else " and finite")
        )
    return values


def object_mask(chosen, count):
    """Return which objects are chosen by indices or by a mask, bool (count,)."""
    chosen = np.asarray(chosen)
    if chosen.dtype == bool and chosen.shape == (count,):
        return chosen.copy()
    mask = np.zeros(count, bool)
    if chosen.size:
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or chosen.min() < 0 or chosen.max() >= count:
            raise ValueError(f"kinematic: no indices of {count} objects, and no mask of them")
        mask[chosen] = True
    return mask


def zeros_of(struct, rows, columns, device):
    """Return a struct of device arrays that are 0: `rows` entries each, or rows and columns."""
    made = struct()
    for name, variable in struct.vars.items():
        shape = rows if variable.type.ndim == 1 else (rows, columns)
        setattr(made, name, wp.zeros(shape, dtype=variable.type.dtype, device=device))
    return made


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of a model at density 1, in the model's frame.

    Attributes:
        volume: Volume [units^3].
        centre: Centre of mass [units], float64 (3,).
        moments: Principal moments of inertia about the centre, ascending, float64 (3,).
        axes: Principal axes, a rotation matrix with unit columns, float64 (3, 3).
        bounding_radius: Largest distance of a vertex from the centre [units].
    """

    volume: float
    centre: np.ndarray
    moments: np.ndarray
    axes: np.ndarray
    bounding_radius: float


IMMOVABLE = MassProperties(np.inf, np.zeros(3), np.full(3, np.inf), np.eye(3), np.inf)
"""What stands for the mass properties of an object that is no rigid body."""


def mass_properties(model: Model) -> MassProperties:
    """Return the mass properties of a model's original mesh, the same at every LOD.

    A mesh that is not closed, not consistently wound, or without positive volume has those of its convex hull.

    Raises:
        ValueError: The mesh is flat, or its convex hull is needed and scipy or networkx is missing.
    """
    vertices, faces, _ = model.mesh_at(model.lod_max)
    middle = 0.5 * (vertices.min(0) + vertices.max(0))
    size = np.ptp(vertices, axis=0).max()
    mesh = trimesh.Trimesh((vertices - middle) / size, faces, process=False, validate=False)
    flat = f"model {model.name!r} is flat: it has no mass, so it must be static"
    with np.errstate(all="ignore"):
        if not mesh.is_volume:
            try:
                mesh = mesh.convex_hull
            except ImportError as error:
                what = f"model {model.name!r} is not closed: its convex hull needs scipy and networkx, extra `dynamics`"
                raise ValueError(f"{what} ({error})") from None
            except Exception as error:  # Qhull's own, for points in a plane
                raise ValueError(f"{flat} ({first_line(error)})") from None
        found = mesh.mass_properties
    inertia = np.asarray(found.inertia, np.float64)
    if not (found.mass > 1e-12 and np.isfinite(inertia).all()):
        raise ValueError(flat)
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    centre = np.asarray(found.center_mass, np.float64)
    radius = np.linalg.norm(mesh.vertices - centre, axis=1).max()
    return MassProperties(
        volume=float(found.mass * size**3),
        centre=centre * size + middle,
        moments=moments * size**5,
        axes=axes,
        bounding_radius=float(radius * size),
    )


def _ranks(worlds):
    """Return the rank of each entry among those of the same world."""
    order = np.argsort(worlds, kind="stable")
    ranks = np.empty(len(worlds), np.int64)
    ranks[order] = np.arange(len(worlds)) - np.searchsorted(worlds[order], worlds[order])
    return ranks


class RigidBodies:
    """State of the bodies of a scene; `Dynamics` documents the arguments.

    Attributes:
        bodies: Device arrays of all objects, `kernels.dynamics.bodies.Bodies`.
        properties: `MassProperties` of each object's model, None unless rigid.
        mass: (n,), inf unless rigid.
        rigid, kinematic: Which objects are rigid bodies, and which have prescribed motion, bool (n,).
    """

    def __init__(self, scene: Scene, density, restitution, friction, gravity, kinematic, slop, sleep_speed):
        self.scene, self.device = scene, scene.device
        n = scene.object_count
        self._objects = scene.batch().objects
        self.gravity = finite_array(gravity, "gravity", (3,))
        self.kinematic = object_mask(kinematic, n)
        self.rigid = ~self.kinematic & (self._objects.pool.is_static.numpy() == 0)
        restitution = object_values(restitution, n, "restitution", 0.0, 1.0)
        friction = object_values(friction, n, "friction", 0.0)
        self._fill_bodies(object_values(density, n, "density", 0.0, open_below=True), slop, sleep_speed)
        self._upload(restitution=restitution, friction=friction)
        self.read_poses()

    def _fill_bodies(self, density, slop, sleep_speed):
        """Allocate the arrays of all bodies, and write what stays for good."""
        scene, rigid, n = self.scene, self.rigid, self.scene.object_count
        self.bodies = zeros_of(kernels.Bodies, n, 0, self.device)
        models = sorted({scene.object_model[i] for i in np.flatnonzero(rigid)})
        found = {m: mass_properties(scene.models[m]) for m in models}
        self.properties = [found[m] if r else None for m, r in zip(scene.object_model, rigid)]
        own = [IMMOVABLE if found is None else found for found in self.properties]
        self.mass = density * [found.volume for found in own]
        self._moments = density[:, None] * [found.moments for found in own]
        self._centre, self._axes = np.array([found.centre for found in own]), np.array([found.axes for found in own])
        radius, rank = np.array([found.bounding_radius for found in own]), np.zeros(n, np.int64)
        rank[rigid] = _ranks(self._objects.pool.world.numpy()[rigid])
        if sleep_speed is None:
            sleep_speed = SLEEP_SPEED * np.sqrt(np.linalg.norm(self.gravity) * np.where(rigid, radius, 0.0))
        slop = np.where(rigid, SLOP * radius, np.inf) if slop is None else object_values(slop, n, "slop", 0.0)
        self._upload(
            rank=rank,
            prescribed=self.kinematic,
            inverse_mass=1 / self.mass,
            inverse_moment=1 / self._moments,
            centre=self._centre,
            axes=self._axes,
            bounding_radius=radius,
            slop=slop,
            sleep_speed=object_values(sleep_speed, n, "sleep_speed", 0.0),
        )

    def _upload(self, **values):
        for name, array in values.items():
            getattr(self.bodies, name).assign(array)

    def read_poses(self):
        """Take all poses from the scene, as after `Scene.set_poses`, and wake all bodies. Waits for the device."""
        pool = self._objects.pool
        rotation = pool.rotation.numpy()
        self._upload(
            position=pool.position.numpy() + np.einsum("nij,nj->ni", rotation, self._centre),
            rotation=quaternions_of(rotation @ self._axes),
        )
        self.wake()

    def wake(self):
        """Wake all bodies."""
        self._upload(motion_type=np.where(self.rigid, int(kernels.DYNAMIC), int(kernels.STATIC)))
        self.bodies.rest_time.zero_()

    def set_velocities(self, velocity, angular_velocity):
        """Set the velocities of rigid bodies, and wake all bodies. Waits for the device.

        Args:
            velocity: Of the centres of mass [world units/s], (3,) or (n, 3).
            angular_velocity: In the world frame [rad/s], (3,) or (n, 3).

        Raises:
            ValueError: Wrong shape, or a number that is not finite; nothing is changed.
        """
        shape = (len(self.mass), 3)
        velocity = broadcast_rows(velocity, "velocity", shape)
        angular_velocity = broadcast_rows(angular_velocity, "angular_velocity", shape)
        for name, values in (("velocity", velocity), ("angular_velocity", angular_velocity)):
            if not np.isfinite(values).all():
                raise ValueError(f"{name}: a number is not finite")
        rigid, frames = self.rigid[:, None], self._frames()
        local = np.einsum("nji,nj->ni", frames, angular_velocity) * np.where(rigid, self._moments, 0.0)
        self._upload(velocity=np.where(rigid, velocity, 0.0), momentum=np.einsum("nij,nj->ni", frames, local))
        self.wake()

    def _frames(self):
        """Return the rotation matrices of the body frames, (n, 3, 3). Waits for the device."""
        return self._objects.pool.rotation.numpy() @ self._axes

    def poses(self) -> np.ndarray:
        """Return the pose of every object: x y z qx qy qz qw, float64 (n, 7). Waits for the device."""
        pool = self._objects.pool
        return np.concatenate([pool.position.numpy(), quaternions_of(pool.rotation.numpy())], axis=1)

    def velocities(self):
        """Return the velocities of the centres of mass [world units/s] and angular velocities [rad/s], float64 (n, 3).

        0 for static objects, those of the last step for kinematic ones. Waits for the device.
        """
        frames = self._frames()
        local = np.einsum("nji,nj->ni", frames, self.bodies.momentum.numpy()) / self._moments
        angular_velocity = self.bodies.angular_velocity.numpy() + np.einsum("nij,nj->ni", frames, local)
        return self.bodies.velocity.numpy().copy(), angular_velocity

    @property
    def asleep(self) -> np.ndarray:
        """Which bodies sleep, bool (n,). Waits for the device."""
        return self.bodies.motion_type.numpy() == int(kernels.ASLEEP)

    def energy(self) -> float:
        """Return the kinetic and potential energy of all rigid bodies. Waits for the device."""
        rigid, local = self.rigid, np.einsum("nji,nj->ni", self._frames(), self.bodies.momentum.numpy())
        mass, velocity = self.mass[rigid], self.bodies.velocity.numpy()[rigid]
        kinetic = 0.5 * (mass @ (velocity**2).sum(1) + (local[rigid] ** 2 / self._moments[rigid]).sum())
        return float(kinetic - mass @ (self.bodies.position.numpy()[rigid] @ self.gravity))

    def momentum(self):
        """Return momentum and angular momentum about the origin of all bodies, (3,) each. Waits for the device."""
        rigid = self.rigid
        linear = self.mass[rigid, None] * self.bodies.velocity.numpy()[rigid]
        angular = np.cross(self.bodies.position.numpy()[rigid], linear) + self.bodies.momentum.numpy()[rigid]
        return linear.sum(0), angular.sum(0)
