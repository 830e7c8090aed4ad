"""Rigid bodies: mass, centre of mass and inertia of models by trimesh, and the state of a scene's bodies."""

from dataclasses import dataclass

import numpy as np
import trimesh
import warp as wp

from warp_abtree.checks.arguments import first_line, to_numpy
from warp_abtree.kernels.dynamics import bodies as kernels
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene

SLOP = 1 / 512  # of a body's reach
SLEEP_SPEED = 0.01  # of the speed that a body gains by falling as far as half its reach


def stretch(values, count, width, what):
    values = np.asarray(values, np.float64)
    shape = (count,) if width is None else (count, width)
    try:
        values = np.broadcast_to(values, shape).copy()
    except ValueError:
        raise ValueError(f"{what}: shape {values.shape} does not stretch to {shape}") from None
    return values


def positive(value, what):
    value = float(to_numpy(value, what).reshape(()))
    if not 0 < value < np.inf:
        raise ValueError(f"{what} {value} is not above 0 and finite")
    return value


def vector(values, what):
    values = to_numpy(values, what).astype(np.float64)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"{what} {values} is not three finite numbers")
    return values


def column(values, count, what, low, high=np.inf, open_below=False):
    """Return (count,) numbers between two, the lower one excluded if it is open."""
    values = stretch(to_numpy(values, what), count, None, what)
    fits = np.isfinite(values) & (values > low if open_below else values >= low) & (values <= high)
    if not fits.all():
        i = int(np.argmin(fits))
        raise ValueError(
            f"{what}: {values[i]} of object {i} is not {'above' if open_below else 'at least'} {low}"
            + (f" and at most {high}" if high < np.inf else " and finite")
        )
    return values


def mask_of(chosen, count):
    """Return bool (count,) from indices or a mask."""
    chosen = np.asarray(chosen)
    mask = np.zeros(count, bool)
    if chosen.dtype == bool and chosen.shape == (count,):
        return chosen.copy()
    if chosen.size == 0:
        return mask
    if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or chosen.min() < 0 or chosen.max() >= count:
        raise ValueError(f"kinematic: no indices of {count} objects, and no mask of them")
    mask[chosen] = True
    return mask


def quaternions_of(matrices) -> np.ndarray:
    """Return unit quaternions x y z w, w >= 0, of rotation matrices (n, 3, 3), float64 (n, 4)."""
    m = np.asarray(matrices, np.float64)
    x, y, z = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # 4 q q^T, of which the row of the largest component has the most digits.
    square = np.empty((len(m), 4, 4))
    for i, d in enumerate((x - y - z, y - x - z, z - x - y, x + y + z)):
        square[:, i, i] = 1 + d
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        square[:, i, j] = square[:, j, i] = m[:, i, j] + m[:, j, i]
        square[:, 3, k] = square[:, k, 3] = m[:, j, i] - m[:, i, j]
    best = np.argmax(np.einsum("nii->ni", square), axis=1)
    q = square[np.arange(len(m)), best]
    return q / np.linalg.norm(q, axis=1, keepdims=True) * np.where(q[:, 3:] < 0, -1.0, 1.0)


def matrices_of(quaternions) -> np.ndarray:
    """Return rotation matrices of quaternions x y z w, normalised, (n, 4) to float64 (n, 3, 3)."""
    q = np.asarray(quaternions, np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of a model at density 1, in the model's frame.

    Attributes:
        volume: Volume [units^3].
        centre: Centre of mass [units], float64 (3,).
        moments: Principal moments of inertia about the centre, ascending, float64 (3,).
        axes: Their axes, a rotation matrix with unit columns, float64 (3, 3).
        reach: Largest distance of a vertex from the centre [units].
        convex_hull: Whether they are those of the convex hull, for want of a closed mesh.
    """

    volume: float
    centre: np.ndarray
    moments: np.ndarray
    axes: np.ndarray
    reach: float
    convex_hull: bool


def mass_properties(model: Model) -> MassProperties:
    """Return the mass properties of a model's original mesh, the same whatever its LOD.

    A mesh that is not closed, of one winding, and of positive volume has those of its convex hull. A hull without a
    volume worth the name, as of a flat sheet, has none.

    Raises:
        ValueError: The convex hull has no volume, or is needed where scipy or networkx is missing.
    """
    vertices, faces, _ = model.mesh_at(model.lod_max)
    middle = 0.5 * (vertices.min(0) + vertices.max(0))
    size = np.ptp(vertices, axis=0).max()
    mesh = trimesh.Trimesh((vertices - middle) / size, faces, process=False, validate=False)
    with np.errstate(all="ignore"):
        convex_hull = not mesh.is_volume
        if convex_hull:
            try:
                mesh = mesh.convex_hull
            except ImportError as error:
                what = f"model {model.name!r} is not closed: its convex hull needs scipy and networkx, extra `dynamics`"
                raise ValueError(f"{what} ({error})") from None
            except Exception as error:  # Qhull's own, for points in a plane
                what = f"model {model.name!r} is flat: it has no mass, so it must be static"
                raise ValueError(f"{what} ({first_line(error)})") from None
        found = mesh.mass_properties
    inertia = np.asarray(found.inertia, np.float64)
    if not (found.mass > 1e-12 and np.isfinite(inertia).all()):
        raise ValueError(f"model {model.name!r} is flat: it has no mass, so it must be static")
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    centre = np.asarray(found.center_mass, np.float64)
    reach = np.linalg.norm(mesh.vertices - centre, axis=1).max()
    return MassProperties(
        volume=float(found.mass * size**3),
        centre=centre * size + middle,
        moments=moments * size**5,
        axes=axes,
        reach=float(reach * size),
        convex_hull=convex_hull,
    )


class RigidBodies:
    """State of a scene's bodies, and what can be asked of it; see `Dynamics` for what stands in for arguments.

    Attributes:
        bodies: Device arrays of all objects, `kernels.bodies.Bodies`.
        properties: `MassProperties` of each object's model, None unless rigid.
        mass: (n,), inf unless rigid.
        rigid, driven: Which objects are rigid bodies, and which move as they are told, bool (n,).
    """

    def __init__(self, scene: Scene, density, restitution, friction, gravity, kinematic, slop, sleep_speed):
        self.scene, self.device = scene, scene.device
        n = scene.object_count
        self._objects = scene.batch().objects
        self.gravity = vector(gravity, "gravity")
        self.driven = mask_of(kinematic, n)
        self.rigid = ~self.driven & (self._objects.pool.is_static.numpy() == 0)
        restitution = column(restitution, n, "restitution", 0.0, 1.0)
        friction = column(friction, n, "friction", 0.0)
        self._fill_bodies(column(density, n, "density", 0.0, open_below=True), slop, sleep_speed)
        self._send("restitution", restitution)
        self._send("friction", friction)
        self.read_poses()

    def _fill_bodies(self, density, slop, sleep_speed):
        """Make the arrays of all bodies, with masses and sizes."""
        scene, rigid, n = self.scene, self.rigid, self.scene.object_count
        self.bodies = bodies = kernels.Bodies()
        for name, variable in kernels.Bodies.vars.items():
            setattr(bodies, name, wp.zeros(n, dtype=variable.type.dtype, device=self.device))
        found = {
            m: mass_properties(scene.models[m]) for m in sorted({scene.object_model[i] for i in np.flatnonzero(rigid)})
        }
        self.properties = [found[m] if r else None for m, r in zip(scene.object_model, rigid)]
        self.mass, self._moments = np.full(n, np.inf), np.full((n, 3), np.inf)
        centre, axes, reach = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.full(n, np.inf)
        for i in np.flatnonzero(rigid):
            own = found[scene.object_model[i]]
            self.mass[i], self._moments[i] = density[i] * own.volume, density[i] * own.moments
            centre[i], axes[i], reach[i] = own.centre, own.axes, own.reach
        self._centre, self._axes = centre, axes
        if sleep_speed is None:
            fall = np.linalg.norm(self.gravity) * np.where(rigid, reach, 0.0)
            sleep_speed = SLEEP_SPEED * np.sqrt(fall)
        slop = np.where(rigid, SLOP * reach, np.inf) if slop is None else column(slop, n, "slop", 0.0)
        world = self._objects.pool.world.numpy()[rigid]
        order = np.argsort(world, kind="stable")
        rank, ranks = np.zeros(n, np.int64), np.empty(len(world), np.int64)
        ranks[order] = np.arange(len(world)) - np.searchsorted(world[order], world[order])
        rank[rigid] = ranks
        for name, values in (
            ("rank", rank),
            ("driven", self.driven),
            ("inverse_mass", 1 / self.mass),
            ("inverse_moment", 1 / self._moments),
            ("centre", centre),
            ("axes", axes),
            ("reach", reach),
            ("slop", slop),
            ("sleep_speed", column(sleep_speed, n, "sleep_speed", 0.0)),
            ("role", np.where(rigid, int(kernels.AWAKE), int(kernels.FIXED))),
        ):
            self._send(name, values)

    def _send(self, name, values):
        getattr(self.bodies, name).assign(values)

    def read_poses(self):
        """Take all poses from the scene, as after `Scene.set_poses`, and wake all bodies. Waits for the device."""
        pool = self._objects.pool
        rotation = pool.rotation.numpy()
        self._send("position", pool.position.numpy() + np.einsum("nij,nj->ni", rotation, self._centre))
        self._send("rotation", quaternions_of(rotation @ self._axes))
        self.wake()

    def wake(self):
        """Wake all bodies."""
        self._send("role", np.where(self.rigid, int(kernels.AWAKE), int(kernels.FIXED)))
        self.bodies.rest.zero_()

    def set_velocities(self, velocity, spin):
        """Set velocities of the centres of mass [world units/s] and spins [rad/s, world], (3,) or (n, 3); wake all.

        Only rigid bodies have them. Waits for the device.

        Raises:
            ValueError: Wrong shape, or a number that is not finite; nothing is changed.
        """
        n = len(self.mass)
        velocity, spin = stretch(velocity, n, 3, "velocity"), stretch(spin, n, 3, "spin")
        for name, values in (("velocity", velocity), ("spin", spin)):
            if not np.isfinite(values).all():
                raise ValueError(f"{name}: a number is not finite")
        rigid = self.rigid[:, None]
        own = np.einsum("nji,nj->ni", self._frames(), spin) * np.where(rigid, self._moments, 0.0)
        self._send("velocity", np.where(rigid, velocity, 0.0))
        self._send("momentum", np.einsum("nij,nj->ni", self._frames(), own))
        self.wake()

    def _frames(self):
        """Return the rotation matrices of the bodies' own frames, (n, 3, 3). Waits for the device."""
        return self._objects.pool.rotation.numpy() @ self._axes

    def poses(self) -> np.ndarray:
        """Return the pose of every object: x y z qx qy qz qw, float64 (n, 7). Waits for the device."""
        pool = self._objects.pool
        return np.concatenate([pool.position.numpy(), quaternions_of(pool.rotation.numpy())], axis=1)

    def velocities(self):
        """Return velocities of the centres of mass [world units/s] and spins [rad/s], float64 (n, 3) each.

        0 for static objects, the last step's for kinematic ones. Waits for the device.
        """
        frames = self._frames()
        own = np.einsum("nji,nj->ni", frames, self.bodies.momentum.numpy()) / self._moments
        return self.bodies.velocity.numpy().copy(), self.bodies.spin.numpy() + np.einsum("nij,nj->ni", frames, own)

    @property
    def asleep(self) -> np.ndarray:
        """Which bodies sleep, bool (n,). Waits for the device."""
        return self.bodies.role.numpy() == int(kernels.ASLEEP)

    def energy(self) -> float:
        """Return the energy of all rigid bodies, kinetic and in the field of gravity. Waits for the device."""
        rigid, own = self.rigid, np.einsum("nji,nj->ni", self._frames(), self.bodies.momentum.numpy())
        mass, velocity = self.mass[rigid], self.bodies.velocity.numpy()[rigid]
        kinetic = 0.5 * (mass @ (velocity**2).sum(1) + (own[rigid] ** 2 / self._moments[rigid]).sum())
        return float(kinetic - mass @ (self.bodies.position.numpy()[rigid] @ self.gravity))

    def momentum(self):
        """Return momentum and angular momentum about the origin of all bodies, (3,) each. Waits for the device."""
        rigid = self.rigid
        linear = self.mass[rigid, None] * self.bodies.velocity.numpy()[rigid]
        angular = np.cross(self.bodies.position.numpy()[rigid], linear) + self.bodies.momentum.numpy()[rigid]
        return linear.sum(0), angular.sum(0)
