"""Rigid bodies of a scene: mass properties of models by trimesh, and the state of the bodies on the device."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import broadcast_rows, finite_array, first_line
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.quaternions import quaternions_of
from warp_abtree.checks.upload import zeros_of
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.bodies import bodies as kernels
from warp_abtree.model.model import Model
from warp_abtree.scene.posed_objects import expect_scene
from warp_abtree.scene.scene import Scene
from warp_abtree.state.poses import PoseSetter

# Penetration that matters little, as a fraction of the bounding radius, and of the thickness at most.
SLOP, SLOP_OF_THICKNESS = 2.0**-9, 0.25
FIRST_STEP = 1 / 60  # length of a step [s] before the first one is known


def object_mask(chosen, count):
    """Return which objects are chosen by indices or by a mask, bool (count,)."""
    try:
        chosen = np.asarray(chosen)
    except ValueError as error:  # lists of several lengths
        raise ValueError(f"kinematic: {first_line(error)}") from None
    if chosen.dtype == bool and chosen.shape == (count,):
        return chosen.copy()
    mask = np.zeros(count, bool)
    if chosen.size:
        if chosen.ndim != 1 or chosen.dtype.kind not in "iu" or chosen.min() < 0 or chosen.max() >= count:
            raise ValueError(f"kinematic: no indices of {count} objects, and no mask of them")
        mask[chosen] = True
    return mask


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of a model at density 1, in the model's frame."""

    volume: float  # [units^3]
    centre: np.ndarray  # of mass [units], float64 (3,)
    moments: np.ndarray  # principal moments of inertia about the centre, ascending, float64 (3,)
    axes: np.ndarray  # principal axes, a rotation matrix with unit columns, float64 (3, 3)
    bounding_radius: float  # largest distance of a vertex from the centre [units]
    thickness: float  # least extent along a principal axis [units]


# What stands for the mass properties of an object that is no rigid body.
IMMOVABLE = MassProperties(np.inf, np.zeros(3), np.full(3, np.inf), np.eye(3), np.inf, np.inf)


def mass_properties(model: Model) -> MassProperties:
    """Return the mass properties of a model's original mesh, the same at every LOD.

    A mesh that is not closed, not consistently wound, or without positive volume has those of its convex hull. Raises
    ValueError for a flat one, or where the hull is needed and scipy or networkx is missing.
    """
    import trimesh

    model.warn_of_winding("the mass of its bodies and the normals of their contacts depend on the winding")
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
        thickness=float(np.ptp(mesh.vertices @ axes, axis=0).min() * size),
    )


def _ranks(worlds):
    """Return the rank of each entry among those of the same world."""
    order = np.argsort(worlds, kind="stable")
    ranks = np.empty(len(worlds), np.int64)
    ranks[order] = np.arange(len(worlds)) - np.searchsorted(worlds[order], worlds[order])
    return ranks


class RigidBodies(DeviceMemory):
    """State of the bodies of a scene; `Dynamics` documents the arguments.

    Attributes:
        bodies: Device arrays of all objects, `kernels.bodies.bodies.Bodies`.
        mass: Mass at density 1, (n,), inf unless rigid.
        rigid, kinematic: Which objects are rigid bodies, and which have prescribed motion, bool (n,).
        targets: `ObjectPool` of the poses that kinematic objects have at the end of the next step.
    """

    def __init__(self, scene: Scene, gravity, kinematic, velocity, angular_velocity, rests_apart):
        self.scene, self.device, n = expect_scene(scene), scene.device, scene.object_count
        self._pool = pool = scene.batch().objects.pool
        self.gravity = finite_array(gravity, "gravity", (3,))
        self.kinematic = object_mask(kinematic, n)
        self.rigid = ~self.kinematic & (pool.is_static.numpy() == 0)
        velocity, angular_velocity = (
            broadcast_rows(values, name, (n, 3), unread=scene.batch().removed)
            for name, values in (("velocity", velocity), ("angular_velocity", angular_velocity))
        )
        models = sorted({scene.object_model[i] for i in np.flatnonzero(self.rigid)})
        found = {m: mass_properties(scene.models[m]) for m in models}
        own = [found[m] if r else IMMOVABLE for m, r in zip(scene.object_model, self.rigid)]
        self.mass, self._moments = np.array([one.volume for one in own]), np.array([one.moments for one in own])
        self._axes, centre = np.array([one.axes for one in own]), np.array([one.centre for one in own])
        radius, thickness = (np.array([getattr(one, name) for one in own]) for name in ("bounding_radius", "thickness"))
        rank = np.zeros(n, np.int64)
        rank[self.rigid] = _ranks(pool.world.numpy()[self.rigid])
        rotation, rigid, frames = pool.rotation.numpy(), self.rigid[:, None], self._frames()
        local = np.einsum("nji,nj->ni", frames, angular_velocity) * np.where(rigid, self._moments, 0.0)
        self.bodies = zeros_of(kernels.Bodies, n, 0, self.device)
        for name, values in {
            "motion_type": np.select([self.rigid, self.kinematic], [int(kernels.DYNAMIC), int(kernels.KINEMATIC)], 0),
            "rank": rank,
            "inverse_mass": 1 / self.mass,
            "inverse_moment": 1 / self._moments,
            "centre": centre,
            "axes": self._axes,
            "bounding_radius": radius,
            "slop": SLOP * radius if rests_apart else np.minimum(SLOP * radius, SLOP_OF_THICKNESS * thickness),
            "position": pool.position.numpy() + np.einsum("nij,nj->ni", rotation, centre),
            "rotation": quaternions_of(frames),
            "velocity": np.where(rigid, velocity, 0.0),
            "momentum": np.einsum("nij,nj->ni", frames, local),
            "reach": self._first_reach(velocity, angular_velocity, radius),
        }.items():
            getattr(self.bodies, name).assign(values)
        self.targets = ObjectPool()
        self.targets.rotation, self.targets.position = wp.clone(pool.rotation), wp.clone(pool.position)
        self._target_setter = PoseSetter(self.targets, self.device, scene.batch().removed, "targets")

    def _first_reach(self, velocity, angular_velocity, radii):
        """Return how far ahead contacts of the first step are looked for, as if it took FIRST_STEP, (n, 4)."""
        radius = np.where(self.rigid, radii, 0.0)
        turn = FIRST_STEP * np.linalg.norm(angular_velocity, axis=1) * radius
        most = float(kernels.LOOKAHEAD_MAX) * radius
        motion = FIRST_STEP * np.where(self.rigid[:, None], velocity, 0.0)
        length = np.linalg.norm(motion, axis=1)
        part = np.minimum(most, length) / np.maximum(length, 1e-300)
        reach = np.minimum(turn, most) + float(kernels.LOOKAHEAD_LEAST) * radius
        return np.column_stack([motion * part[:, None], reach])

    def clear_targets(self):
        """Let kinematic objects stand where they are."""
        wp.copy(self.targets.rotation, self._pool.rotation)
        wp.copy(self.targets.position, self._pool.position)

    def set_targets(self, targets):
        """Set the poses of kinematic objects at the end of the next step; see `Dynamics.step`."""
        self._target_setter.set(targets)

    def _frames(self):
        """Return the rotation matrices of the body frames, (n, 3, 3). Waits for the device."""
        return self._pool.rotation.numpy() @ self._axes

    def poses(self) -> np.ndarray:
        """Return the pose of every object: x y z qx qy qz qw, float64 (n, 7). Waits for the device."""
        return np.concatenate([self._pool.position.numpy(), quaternions_of(self._pool.rotation.numpy())], axis=1)

    def velocities(self):
        """Return the velocities of the centres of mass [world units/s] and angular velocities [rad/s], float64 (n, 3).

        0 for static objects, those of the last step for kinematic ones. Waits for the device.
        """
        frames, momentum = self._frames(), self.bodies.momentum.numpy()
        local = np.einsum("nji,nj->ni", frames, momentum) / self._moments
        angular_velocity = np.where(self.kinematic[:, None], momentum, np.einsum("nij,nj->ni", frames, local))
        return self.bodies.velocity.numpy().copy(), angular_velocity
