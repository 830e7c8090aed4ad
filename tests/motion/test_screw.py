"""Motions on screws: flat patches that pass one another closely, against dense exact tests."""

import numpy as np
import pytest
from helpers.motions import find, starts_of
from helpers.questions import pairs_of, scene_of
from helpers.samples import random_poses
from oracles.motion import pose_between
from scipy.spatial.transform import Rotation

import warp_abtree as ab

COUNT, TIMES = 80, 41


def random_patch(rng, pitch):
    """Return the model of a flat patch of 4 faces some 1 from the z axis, tilted, wide or small; some along a screw."""
    width = rng.choice([0.05, 0.35], 2) * rng.uniform(0.5, 1, 2)
    u, v = (np.stack(np.meshgrid([-1, 0, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 2) * width).T
    tilt = Rotation.from_rotvec([0, rng.uniform(-1, 1), rng.uniform(-0.3, 0.3)])
    if rng.random() < 0.5:
        tilt = Rotation.from_rotvec([np.arctan(pitch), 0, 0]) * Rotation.from_rotvec([0, rng.uniform(0.8, 1.7), 0])
    place = [rng.uniform(0.95, 1.05), 0, rng.uniform(-0.05, 0.05) * rng.choice([0.1, 1])]
    points = tilt.apply(np.stack([0 * u, u, v], 1)) + place
    return ab.Model.from_arrays(points, [[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]], base_faces=4)


def pose_on_screw(whole, turn, offset):
    """Return a pose turned about the z axis of a frame, and moved in it."""
    frame = Rotation.from_quat(whole[3:])
    return np.concatenate([frame.apply(offset) + whole[:3], (frame * Rotation.from_euler("z", turn)).as_quat()])


def sliding_motions(rng, drift):
    """Return cases of patches, one of which turns by up to 170 degrees about z and moves along it, and end poses."""
    cases, ends = [], []
    for k in range(COUNT):
        turn, rise, met = np.deg2rad(rng.uniform(5, 170)), rng.normal(), rng.uniform(-0.1, 1.1)
        models, whole = [random_patch(rng, rise / turn) for _ in range(2)], random_poses(rng, 1, 1.0)[0]
        moves = [pose_on_screw(whole, (t - met) * turn, [t * drift, 0, (t - met) * rise]) for t in (0, 1)]
        first, second = ((whole, whole), moves) if k % 2 else (moves, (whole, whole))
        cases.append([models[0], models[0].lod_max, first[0], models[1], models[1].lod_max, second[0]])
        ends += [first[1], second[1]]
    return cases, np.array(ends)


@pytest.mark.parametrize(("drift", "seed"), [(0.0, 1), (0.03, 2)])
def test_patches_on_a_screw_are_never_late(device, drift, seed):
    """Also where they drift across the axis."""
    cases, ends = sliding_motions(np.random.default_rng(seed), drift)
    result = find(device, cases, ends)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    starts = starts_of(cases)
    assert not result.undecided.any() and 10 < result.clear.sum() < COUNT - 10
    for part in np.linspace(0, 1, TIMES):
        times = np.repeat(part * result.time, 2)
        scene.set_poses(np.array([pose_between(*row) for row in zip(starts, ends, times)]))
        assert not scene.intersect(pairs).any[result.time > 0].any(), part
