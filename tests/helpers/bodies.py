"""Bodies, models and scenes that tests of motion and of LOD selection start from; contacts in Newton."""

from functools import cache

import numpy as np
import trimesh
import warp as wp

import warp_abtree as ab
from helpers.samples import random_poses
from helpers.scenes import scene_with

FLOOR = (0, 0, -0.5, 0, 0, 0, 1)


def model_of(mesh):
    return ab.Model.from_arrays(np.asarray(mesh.vertices), np.asarray(mesh.faces), base_faces=4)


def box(*extents, splits=0):
    mesh = trimesh.creation.box(extents)
    for _ in range(splits):
        mesh = mesh.subdivide()
    return model_of(mesh)


def plain_model(vertices, faces):
    return ab.Model.from_arrays(np.asarray(vertices, float), np.asarray(faces), base_faces=len(faces))


def open_floor(cells, low, high):
    """Return a floor in the plane z = 0 of two faces a cell, between two corners."""
    x, y = (np.linspace(a, b, n + 1) for a, b, n in zip(low, high, cells))
    vertices = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], -1).reshape(-1, 3)
    index = np.arange(len(vertices)).reshape(len(x), len(y))
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(part, -1).reshape(-1, 3) for part in ((a, b, c), (a, c, d))])
    return plain_model(vertices, faces)


CUBE, BRICK, GROUND = box(1, 1, 1), box(1, 0.7, 0.5), box(8, 8, 1)
BALL = model_of(trimesh.creation.icosphere(1, 0.5))
TORUS = model_of(trimesh.creation.torus(0.5, 0.2, 8, 6))


def about(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return (*(np.sin(angle / 2) * axis), np.cos(angle / 2))


def make(device, *placed, world=0, **options):
    """Return the dynamics of (model, pose) or (model, pose, static)."""
    objects = [(model, pose, {"static": bool(static and static[0])}) for model, pose, *static in placed]
    return ab.Dynamics(scene_with(device, *objects, world=world), **options)


def on_ground(device, *placed, **options):
    return make(device, (GROUND, FLOOR, True), *placed, **options)


def heap(device, **options):
    """Return seven rigid bodies that fall onto each other."""
    poses = [(0.1 * i, 0.05 * i, 0.6 + 0.55 * i, 0, 0, 0, 1) for i in range(7)]
    return on_ground(device, *(((BRICK, TORUS, BALL)[i % 3], pose) for i, pose in enumerate(poses)), **options)


def bits(dynamics):
    """Return poses, velocities and angular velocities, (n, 13)."""
    return np.concatenate([dynamics.poses(), *dynamics.velocities()], axis=1)


def run(dynamics, steps, dt=1 / 120):
    for _ in range(steps):
        dynamics.step(dt)
    return bits(dynamics)


@cache
def ring_and_ball():
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.15, major_sections=24, minor_sections=12)
    return ab.Model.load(ring), ab.Model.load(trimesh.creation.icosphere(subdivisions=2, radius=0.4))


@cache
def selection_models():
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.2, major_sections=24, minor_sections=12)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    ball.apply_translation([0.3, -0.2, 0.1])
    return ab.Model.load(ring), ab.Model.load(ball), ab.Model.load(trimesh.creation.box(), base_faces=6)


def strewn(count, device):
    """Return a scene with objects of all `selection_models` and importances at random places."""
    rng, models, scene = np.random.default_rng(0), selection_models(), ab.Scene(device)
    for i, pose in enumerate(random_poses(rng, count, 4.0)):
        scene.add(models[i % len(models)], pose, importance=1 + i // len(models) % 3)
    return scene


def newton_mesh(shape):
    import newton

    return newton.Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int32).ravel())


def at(x=0.0, y=0.0, z=0.0, angle=0.0):
    return wp.transform((x, y, z), about((0, 0, 1), angle))


def collided(model, **options):
    """Return the state of a model of Newton, what finds its contacts, and those at its poses."""
    state, found = model.state(), ab.NewtonContacts(model, **options)
    contacts = found.contacts()
    found.collide(state, contacts)
    return state, found, contacts


def contact_rows(contacts, *names):
    """Return columns of the rigid contacts that Newton has."""
    count = int(contacts.rigid_contact_count.numpy()[0])
    return [getattr(contacts, f"rigid_contact_{name}").numpy()[:count].copy() for name in names]


def touching_shapes(contacts):
    return {tuple(sorted(pair)) for pair in np.stack(contact_rows(contacts, "shape0", "shape1"), 1).tolist()}


class PairContacts:
    """Stands for a `newton.CollisionPipeline` of given pairs: a contact each, wherever the shapes are."""

    def __init__(self, model, *, broad_phase, shape_pairs_filtered, rigid_contact_max, deterministic):
        self.device, self.shape_pairs_filtered = model.device, shape_pairs_filtered
        self.rigid_contact_max = rigid_contact_max
        self.shapes = [wp.array(column, device=self.device) for column in shape_pairs_filtered.numpy().T.copy()]

    def contacts(self):
        import newton

        return newton.Contacts(self.rigid_contact_max, 0, device=self.device)

    def collide(self, state, contacts):
        contacts.clear()
        contacts.rigid_contact_count.fill_(len(self.shapes[0]))
        for side, shapes in enumerate(self.shapes):
            wp.copy(getattr(contacts, f"rigid_contact_shape{side}"), shapes)


def settle(model, found, steps):
    """Step bodies by a solver of Newton's; return their poses and the last contacts."""
    import newton

    state, after, control, contacts = model.state(), model.state(), model.control(), found.contacts()
    solver = newton.solvers.SolverXPBD(model, iterations=2)
    for _ in range(steps):
        state.clear_forces()
        found.collide(state, contacts)
        solver.step(state, after, control, contacts, 1 / 240)
        state, after = after, state
    return state.body_q.numpy(), contacts
