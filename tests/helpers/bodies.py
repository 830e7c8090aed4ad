"""Bodies, models and scenes that tests of motion and of LOD selection start from."""

from functools import cache

import numpy as np
import trimesh

import warp_abtree as ab

FLOOR = (0, 0, -0.5, 0, 0, 0, 1)


def model_of(mesh):
    return ab.Model.from_arrays(np.asarray(mesh.vertices), np.asarray(mesh.faces), base_faces=4)


def box(*extents, splits=0):
    mesh = trimesh.creation.box(extents)
    for _ in range(splits):
        mesh = mesh.subdivide()
    return model_of(mesh)


CUBE, BRICK, GROUND = box(1, 1, 1), box(1, 0.7, 0.5), box(8, 8, 1)
BALL = model_of(trimesh.creation.icosphere(1, 0.5))
TORUS = model_of(trimesh.creation.torus(0.5, 0.2, 8, 6))


def about(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return (*(np.sin(angle / 2) * axis), np.cos(angle / 2))


def make(device, *placed, world=0, **options):
    """Return the dynamics of (model, pose) or (model, pose, static)."""
    scene = ab.Scene(device)
    for model, pose, *static in placed:
        scene.add(model, pose=pose, static=bool(static and static[0]), world=world)
    return ab.Dynamics(scene, **options)


def on_ground(device, *placed, **options):
    return make(device, (GROUND, FLOOR, True), *placed, **options)


def bits(dynamics):
    """Return poses, velocities and angular velocities, (n, 13)."""
    return np.concatenate([dynamics.poses(), *dynamics.velocities()], axis=1)


def run(dynamics, steps, dt=1 / 120):
    """Step, and return `bits`."""
    for _ in range(steps):
        dynamics.step(dt)
    return bits(dynamics)


@cache
def ring_and_ball():
    """Return two models that frames move."""
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.15, major_sections=24, minor_sections=12)
    return ab.Model.load(ring), ab.Model.load(trimesh.creation.icosphere(subdivisions=2, radius=0.4))


@cache
def selection_models():
    """Return a ring, a ball off its origin, and a box."""
    ring = trimesh.creation.torus(major_radius=0.5, minor_radius=0.2, major_sections=24, minor_sections=12)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    ball.apply_translation([0.3, -0.2, 0.1])
    return ab.Model.load(ring), ab.Model.load(ball), ab.Model.load(trimesh.creation.box(), base_faces=6)


def strewn(count, device):
    """Return a scene with objects of all `selection_models` and importances at random places."""
    rng, models = np.random.default_rng(0), selection_models()
    scene = ab.Scene(device=device)
    for i in range(count):
        turn = rng.normal(size=4)
        pose = np.concatenate([rng.uniform(-4, 4, 3), turn / np.linalg.norm(turn)])
        scene.add(models[i % len(models)], pose, importance=1 + i // len(models) % 3)
    return scene
