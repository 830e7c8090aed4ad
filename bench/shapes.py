"""Meshes, models and poses of the benchmarks, made the same to the bit everywhere."""

from pathlib import Path

import numpy as np

import warp_abtree as ab


def knot(face_target):
    """Return a (2, 3) torus knot with a rippled tube: vertices float32 (v, 3), faces int32 (f, 3), about unit size.

    knot(5000) has 4,794 faces, knot(60000) 59,658.
    """
    nu = int(np.sqrt(face_target / 2 * 8))
    nv = max(3, face_target // 2 // nu)
    u = np.linspace(0, 2 * np.pi, nu, endpoint=False)
    w = np.linspace(0, 2 * np.pi, nv, endpoint=False)
    r = np.cos(3 * u) + 2
    centre = np.stack([r * np.cos(2 * u), r * np.sin(2 * u), -np.sin(3 * u)], 1)
    tangent = np.roll(centre, -1, 0) - np.roll(centre, 1, 0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.cross(tangent, [0, 0, 1.0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    binormal = np.cross(tangent, normal)
    radius = 0.45 * (1 + 0.1 * np.sin(9 * w)[None] * np.sin(31 * u)[:, None])
    ring = np.cos(w)[None, :, None] * normal[:, None] + np.sin(w)[None, :, None] * binormal[:, None]
    vertices = (centre[:, None] + radius[..., None] * ring).reshape(-1, 3) / 3.5
    i, j = np.meshgrid(np.arange(nu), np.arange(nv), indexing="ij")
    i2, j2 = (i + 1) % nu, (j + 1) % nv
    a, b, c, d = i * nv + j, i2 * nv + j, i2 * nv + j2, i * nv + j2
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.astype(np.float32), faces.astype(np.int32)


def pair_poses(pair_count, distance, seed=0):
    """Return float32 (2 P, 7): objects 2p and 2p+1 form pair p, both turned at random, their centres at a distance."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(2 * pair_count, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    d = rng.normal(size=(pair_count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x = np.zeros((2 * pair_count, 7), np.float32)
    x[:, 3:] = q
    x[1::2, :3] = d * distance
    return x


def centre_and_radius(model):
    """Return the middle of a model's box and the radius of the ball about it that holds the model."""
    points = model.mesh_at(model.lod_max)[0]
    centre = (points.min(0) + points.max(0)) / 2
    return centre, np.linalg.norm(points - centre, axis=1).max()


def knot_model(face_target, folder=None):
    """Return the model of `knot`, which takes minutes for a million faces; a folder keeps it between runs."""
    if folder is None:
        return ab.Model.from_arrays(*knot(face_target), name=f"knot {face_target}")
    path = Path(folder) / f"knot-{face_target}.npz"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        ab.Model.from_arrays(*knot(face_target), name=f"knot {face_target}").save(path)
    return ab.Model.open(path)
