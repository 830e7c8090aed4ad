"""Meshes, models and poses that several tests use."""

from functools import cache

import numpy as np
import pytest
import trimesh
from conftest import real_mesh_path
from oracles.abtree import Progressive
from oracles.triangle import brute_force_faces, quaternion_matrix

import warp_abtree as ab
from warp_abtree.model.mesh import load_mesh

REAL_MESHES = ("cow", "fandisk", "fcl-env", "fcl-rob", "homer", "rocker-arm", "stanford-bunny", "woody")
WARP_MESHES = ("warp:bunny", "warp:bear", "warp:rocks")
STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def soup(faces, seed, lattice=0):
    """Random corners: nonmanifold, with faces that repeat a corner; on a small lattice with ties and duplicates too."""
    rng = np.random.default_rng(seed)
    count = faces // 2 + 3
    vertices = rng.integers(0, lattice, (count, 3)).astype(float) if lattice else rng.normal(size=(count, 3))
    corners = rng.integers(0, count, (faces, 3))
    vertices[:3] = np.eye(3)
    corners[-1] = 0, 1, 2  # so that one face has three distinct corners at least
    return vertices, corners


def crumbs(count, seed=0):
    """Many components: small tetrahedra strewn about."""
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    vertices = (0.3 * corners + np.random.default_rng(seed).uniform(-1, 1, (count, 1, 3))).reshape(-1, 3)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    return vertices, (faces + 4 * np.arange(count)[:, None, None]).reshape(-1, 3)


def grid(size):
    """A flat open sheet: every collapse and every median is a tie."""
    x, y = np.meshgrid(np.arange(size + 1.0), np.arange(size + 1.0))
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1)
    corner = (np.arange(size)[:, None] * (size + 1) + np.arange(size)).ravel()[:, None]
    near, far = corner + [0, 1, size + 2], corner + [0, size + 2, size + 1]
    return vertices, np.concatenate([near, far])


def line(direction, count=20):
    """Faces without area: every corner on one line, but for rounding."""
    i = np.arange(count - 2)
    return np.arange(count)[:, None] ** 1.5 * np.array(direction), np.stack([i, i + 1, i + 2], 1)


def repeated(vertices, faces):
    """Every face twice, the second time turned."""
    return vertices, np.concatenate([faces, np.asarray(faces)[:, [1, 2, 0]]])


def first_faces(count):
    """Tetrahedra to try the smallest trees on."""
    vertices, faces = crumbs(2, 5)
    return vertices, faces[:count]


def of_trimesh(shape):
    return np.asarray(shape.vertices), np.asarray(shape.faces)


SHAPES = {
    "one": lambda: first_faces(1),
    "two": lambda: first_faces(2),
    "three": lambda: first_faces(3),
    "five": lambda: first_faces(5),
    "ball": lambda: of_trimesh(trimesh.creation.icosphere(subdivisions=3)),
    "small ball": lambda: of_trimesh(trimesh.creation.icosphere(subdivisions=2)),
    "torus": lambda: of_trimesh(trimesh.creation.torus(1.0, 0.35, 32, 20)),
    "box": lambda: of_trimesh(trimesh.creation.box()),
    "capsule": lambda: of_trimesh(trimesh.creation.capsule(1.0, 0.4, count=(16, 16))),
    "crumbs": lambda: crumbs(60),
    "grid": lambda: grid(12),
    "soup": lambda: soup(300, 1),
    "lattice soup": lambda: soup(200, 2, lattice=5),
    "twins": lambda: repeated(*of_trimesh(trimesh.creation.icosphere(subdivisions=1))),
}


@cache
def sample(name, base_faces=4):
    """Return the model of a shape, of a mesh inside Warp, or of a real mesh; skip the test where that is not at hand.

    Loaded meshes are brought to extents of 1 to 2 by a power of two, so that any two of them can meet.
    """
    if name in SHAPES:
        return ab.Model.from_arrays(*SHAPES[name](), base_faces=base_faces, name=name)
    if name in WARP_MESHES:
        pytest.importorskip("pxr")
    mesh = load_mesh(name if name in WARP_MESHES else real_mesh_path(name))
    exponent = np.frexp(np.ptp(mesh.vertices, axis=0).max())[1] - 1
    return ab.Model.from_arrays(np.ldexp(mesh.vertices, -exponent), mesh.faces, base_faces=base_faces, name=name)


def model_of_faces(corners, **options):
    """Return the model of faces (f, 3, 3), or of one (3, 3), each with corners of its own."""
    points = np.reshape(corners, (-1, 3))
    return ab.Model.from_arrays(points, np.arange(len(points)).reshape(-1, 3), **options)


def mirrored(face):
    """Return the model of a face (3, 3) and its mirror image in the origin, which is the model's centre to the bit."""
    model = model_of_faces([face, -face])
    assert not model.centre.any()
    return model


def corners_of(model, lod=None):
    """Return the corners (f, 3, 3) of a model's faces at a LOD, the finest unless told."""
    vertices, faces, _ = model.mesh_at(model.lod_max if lod is None else lod)
    return vertices[faces]


@cache
def plain(model):
    """Return a model's progressive mesh as the lists that the oracle reads."""
    return Progressive.of(model.progressive)


def random_quaternions(rng, count):
    q = rng.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def random_poses(rng, count, spread):
    return np.concatenate([rng.uniform(-spread, spread, (count, 3)), random_quaternions(rng, count)], 1)


def contact_poses(rng, model_a, lod_a, model_b, lod_b, spread=1.0):
    """Two random poses that bring a vertex of B's mesh near a vertex of A's, a little inside."""
    pose_a, pose_b = random_poses(rng, 2, spread)
    mesh_a, mesh_b = model_a.mesh_at(lod_a)[0], model_b.mesh_at(lod_b)[0]
    a, b = mesh_a[rng.integers(len(mesh_a))], mesh_b[rng.integers(len(mesh_b))]
    goal = quaternion_matrix(pose_a[3:]) @ (0.9 * a + 0.1 * model_a.centre) + pose_a[:3]
    pose_b[:3] = goal - quaternion_matrix(pose_b[3:]) @ (0.9 * b + 0.1 * model_b.centre)
    return pose_a, pose_b


def true_faces(model_a, lod_a, pose_a, model_b, lod_b, pose_b):
    """All intersecting (face of A, face of B) by exact brute force, as original face indices, sorted; A comes first."""
    (*mesh_a, ids_a), (*mesh_b, ids_b) = model_a.mesh_at(lod_a), model_b.mesh_at(lod_b)
    hits = brute_force_faces(*mesh_a, *mesh_b, pose_a, pose_b)
    return np.stack([ids_a[hits[:, 0]], ids_b[hits[:, 1]]], 1)


def stored_state(scene_models, batch, state):
    """Return a tree state as it is stored, not with boxes as `tree_state` widens them."""
    states = batch.states
    slot = states.slots[state]
    model = scene_models[slot.model]
    nodes = slice(slot.node_start, slot.node_start + model.tree.node_count)
    marked = np.unpackbits(states.pool.node_mark.numpy().view(np.uint8), bitorder="little")[nodes]
    lower, upper, skip = states.read_nodes(slot, model.tree.node_count)
    corners = states.pool.face_corner.numpy()[slot.face_start : slot.face_start + model.face_count, :3]
    return {
        "lod": int(states.pool.lod.numpy()[state]),
        "status": np.where(marked, 2, skip >= 0).astype(np.int32),
        "lower": lower,
        "upper": upper,
        "skip": skip,
        "corner": np.where(corners < 0, -1, corners - batch.models.vertex_start[slot.model]),
    }


def raw_state(scene, i):
    batch = scene.batch()
    return stored_state(scene.models, batch, batch.objects.state[i])


# A ball, and a ring that moves through it to and fro; tests add what they ask about.
SHUTTLE_SCENE = """
scene = { frames = 4, time_step = 0.25 }
models.ball = { shape = "icosphere", subdivisions = 2 }
models.ring = { shape = "torus", major_radius = 1.0, minor_radius = 0.3 }
[[objects]]
model = "ball"
name = "ball"
[[objects]]
model = "ring"
position = [0.6, 0, 0]
shuttle = { by = [0.4, 0, 0], period = 2 }
"""
