"""Meshes and poses of the benchmarks, reproducible to the bit."""

import gc

import numpy as np

import warp_abtree as ab
from warp_abtree.checks.quaternions import matrices_of

# Batches of pairs of a knot with itself, their centres at distances.
KNOT_PAIRS = {"faces": 5000, "pairs": (1, 64, 1024, 8192), "distances": (0.9, 0.2), "repeats": 15}
FAR, PAIRS_MAX_CLOSE, PAIRS_MAX_CPU = 0.9, 1024, 64  # more pairs take minutes on a CPU, or where they are nearer


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


def random_directions(rng, *shape):
    """Return unit vectors of the last dimension of a shape: with four, rotations as quaternions."""
    vectors = rng.normal(size=shape)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def pair_poses(pair_count, distance):
    """Return float32 (2 P, 7): objects 2p and 2p+1 form pair p, any rotations, their centres at a distance."""
    rng = np.random.default_rng(0)
    poses = np.zeros((2 * pair_count, 7), np.float32)
    poses[:, 3:] = random_directions(rng, 2 * pair_count, 4)
    poses[1::2, :3] = random_directions(rng, pair_count, 3) * distance
    return poses


def knot_batches(device, sizes):
    """Yield batches of pairs of a knot that do not take long on a device: columns, the model, and poses (2 P, 7)."""
    model = ab.Model.from_arrays(*knot(sizes["faces"]), name="knot")
    for count in sizes["pairs"]:
        for distance in sizes["distances"]:
            if count <= (PAIRS_MAX_CPU if device.is_cpu else PAIRS_MAX_CLOSE if distance < FAR else count):
                yield {"pairs": count, "distance": distance}, model, pair_poses(count, distance)


def random_poses(reach, *shape, seed=0):
    """Return float64 (*shape, 7): any rotation, positions in a cube that reaches so far from the origin."""
    rng = np.random.default_rng(seed)
    rotations = random_directions(rng, *shape, 4)
    return np.concatenate([reach * rng.uniform(-1, 1, (*shape, 3)), rotations], -1)


def pose_matrices(poses):
    """Return matrices float64 (n, 4, 4) of poses (n, 7)."""
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = matrices_of(poses[:, 3:]), poses[:, :3]
    return matrices


def longest_side(model) -> float:
    """Return the longest side of a model's box [model units]."""
    return float(np.ptp(model.mesh_at(model.lod_max)[0], axis=0).max())


def centre_and_radius(model):
    """Return the middle of a model's box and the radius of the ball about it that holds the model."""
    points = model.mesh_at(model.lod_max)[0]
    centre = (points.min(0) + points.max(0)) / 2
    return centre, np.linalg.norm(points - centre, axis=1).max()


def scene_of_objects(device, model, poses, world_size=None):
    """Return a scene of a model at poses (n, 7), all in one world or so many in each."""
    scene = ab.Scene(device=device)
    scene.add_many(model, poses, worlds=np.arange(len(poses)) // world_size if world_size else 0)
    return scene


def scene_of_pairs(device, model, poses):
    """Return a scene of objects at poses (2 P, 7), and its pairs (P, 2): 2p with 2p + 1."""
    gc.collect()  # scenes and their queries hold each other
    return scene_of_objects(device, model, poses), np.arange(len(poses)).reshape(-1, 2)


def scene_of_poses(device, model_a, model_b, poses):
    """Return a scene of A at the origin and B at each pose or matrix, and its pairs (0, 1), (0, 2), ..."""
    gc.collect()
    scene = ab.Scene(device=device)
    scene.add(model_a)
    scene.add_many(model_b, poses)
    return scene, np.stack([np.zeros(len(poses), np.int32), np.arange(1, len(poses) + 1, dtype=np.int32)], 1)


def place_at_gaps(model, count):
    """Return matrices of B, rotations random, 0.3 to 0.01 of the size away from A, evenly in the logarithm."""
    size, rng = longest_side(model), np.random.default_rng(0)
    matrices = pose_matrices(random_poses(0.0, count))
    away, (middle, _) = random_directions(rng, count, 3), centre_and_radius(model)
    start = middle - np.einsum("nij,j->ni", matrices[:, :3, :3], middle)
    low, high, gaps = np.zeros(count), np.full(count, 3 * size), size * np.geomspace(0.3, 0.01, count)
    for _ in range(25):
        far = (low + high) / 2
        matrices[:, :3, 3] = start + far[:, None] * away
        wide = ab.sweep(model, model, matrices, output="distance", device="cpu")["distance"] > gaps
        low, high = np.where(wide, low, far), np.where(wide, far, high)
    matrices[:, :3, 3] = start + high[:, None] * away
    return matrices
