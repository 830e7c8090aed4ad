"""Random motions of samples, and their first contacts; boxes that move where numbers round much."""

import numpy as np
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from helpers.questions import pairs_of, random_lod, scene_of
from helpers.samples import random_poses, random_quaternions, sample

NAMES = ("box", "small ball", "crumbs", "soup", "torus", "three", "capsule", "one", "lattice soup", "twins")
ANSWERS = ("time", "clear", "undecided")
STILL = np.array([0, 0, 0, 0, 0, 0, 1.0])
FACES = 60


def to_bytes(result):
    return [np.asarray(getattr(result, name)).tobytes() for name in ANSWERS]


def random_motions(rng, count, names=NAMES, faces=FACES, spread=2.0):
    """Return cases at their starts, apart as a rule, and end poses (2 count, 7)."""
    cases, ends = [], []
    for _ in range(count):
        models = [sample(name) for name in rng.choice(names, 2)]
        starts, ends_now = (random_poses(rng, 2, spread) for _ in range(2))
        cases.append([x for m, pose in zip(models, starts) for x in (m, random_lod(rng, m, faces), pose)])
        ends.append(ends_now)
    return cases, np.concatenate(ends)


def find(device, cases, ends, **options):
    return scene_of(device, cases).first_contact(pairs_of(cases), ends, **options)


CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
CUBE = np.array([[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7]])
# Sizes of boxes, how far their frames' origins are, and all of them from the world's, and ways [units]; turns [rad].
FAMILIES = {
    "plain": (1.0, 0.0, 0.0, 3.0, 2.9),
    "far from the origin": (1.0, 0.0, 1e6, 3.0, 2.9),
    "far from their frames": (1e-3, 1e6, 0.0, 1e-2, 2.9),
    "tiny": (1e-6, 0.0, 0.0, 1e-6, 2.9),
    "fast": (1e-3, 0.0, 0.0, 1e6, 2.9),
    "slow turns": (1.0, 0.0, 0.0, 1.0, 1e-3),
}


def random_boxes(rng, count, name):
    """Return models of boxes of a family, and poses (2 count, 7) at both ends; a third of them do not turn."""
    (size, off, world, way, most), models, poses = FAMILIES[name], [], []
    for _ in range(2 * count):
        at = off * rng.normal(size=3)
        corners = at - 0.5 * size + CORNERS * size * rng.uniform(0.5, 1.5, 3)
        models.append(ab.Model.from_arrays(corners, CUBE, base_faces=len(CUBE)))
        first = Rotation.from_quat(random_quaternions(rng, 1)[0])
        angle = most * rng.uniform() * (rng.uniform() > 1 / 3)
        axis = rng.normal(size=3)
        last = first * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        for turn, spread in ((first, 3 * size), (last, way)):
            place = world + spread * rng.normal(size=3) - turn.apply(at)
            poses.append([*place, *turn.as_quat()])
    poses = np.array(poses)
    return models, poses[0::2], poses[1::2]


def pose_matrices(poses):
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(poses[:, 3:]).as_matrix(), poses[:, :3]
    return matrices


def skewed_boxes(rng, count, kind):
    """Return `random_boxes` posed by matrices (2 count, 4, 4) off orthonormal.

    At random; in "opposite" ways, or only the "second" of each pair.
    """
    models, *both = random_boxes(rng, count, "plain")
    matrices = [pose_matrices(poses) for poses in both]
    for k in range(2 * count):
        off = 3e-7 * rng.uniform(-1, 1, (3, 3))
        off = 4e-7 * (-1) ** k * np.eye(3) if kind == "opposite" else (off + off.T) / 2
        off = off if k % 2 or kind != "second" else 0.0
        for poses in matrices:
            poses[k, :3, :3] = poses[k, :3, :3] @ (np.eye(3) + off)
    return models, *matrices
