"""The margins of the box test: each part on pairs of faces that meet in one point, where that part alone finds it.

The error of the float32 stage that comes first is made of the same parts, so they answer too.

One face is a speck some units in the last place long, which starts at a corner of the other face and leads away from
it. That corner is a corner of the other's box too, so whatever the boxes err by, and no margin covers, prunes the pair.
The reference is exact and knows no boxes.
"""

import numpy as np
import pytest
from helpers.orient import orient2d_kernel
from helpers.questions import GpuQuery
from helpers.samples import random_quaternions
from oracles.signs import find_signs, rounded_signs, true_signs
from oracles.triangle import into_frame_of_a, quaternion_matrix, triangles_intersect

import warp_abtree as ab
from warp_abtree.kernels.arithmetic.predicates import EXACT, FILTER, UNCERTAIN

COUNT = 150
FACE = [[0, 1, 2]]


def random_turn(rng):
    return quaternion_matrix(random_quaternions(rng, 1)[0])


def to_pose(rotation, translation):
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def step_ulps(point, axis, sign, steps):
    """Return points that lie some units in the last place from a point along one axis, (len(steps), 3)."""
    points = np.tile(point, (len(steps), 1))
    points[:, axis] += sign * np.array(steps) * np.spacing(np.abs(point).max())
    return points


def corner_face(rng, corner, signs, size):
    """Return a face whose first corner is the corner of its box on the side of some signs."""
    return corner - size * np.concatenate([np.zeros((1, 3)), rng.uniform(0.2, 2.0, (2, 3))]) * signs


def touching_pair(rng, far_a, far_b, skew, speck_first):
    """Return corners of A, pose of A, corners of B, pose of B: faces that meet in the first corner of both.

    Args:
        far_a, far_b: How far each lies from the origin of its own coordinates, in sizes.
        skew: How far the rotation matrices are off orthonormal.
        speck_first: Whether A is the speck.
    """
    size = 2.0 ** rng.choice([-40, 0, 60])
    signs = rng.choice([-1.0, 1.0], 3)
    axis = rng.integers(3)
    place = rng.normal(size=3) * size * max(far_b, 1.0)
    # Columns lean towards the corner, where they make the most of B's extent along each other.
    lean = skew * rng.uniform(0.5, 1.0, (3, 3)) * np.outer(signs, signs)
    pose_a = to_pose(random_turn(rng) @ (np.eye(3) + skew * rng.uniform(-0.2, 0.2, (3, 3))), rng.normal(size=3) * size)
    pose_b = to_pose(random_turn(rng) @ (np.eye(3) + lean), np.zeros(3))
    goal = rng.normal(size=3) * size * max(far_a, 1.0)
    pose_b[:3, 3] = pose_a[:3, :3] @ goal + pose_a[:3, 3] - pose_b[:3, :3] @ place
    if speck_first:
        b = corner_face(rng, place, signs, size)
        # The speck leads along an axis of A, to the side of that axis of B which it follows most.
        along = (pose_a[:3, :3].T @ pose_b[:3, :3])[axis]
        j = np.argmax(np.abs(along))
        a = step_ulps(into_frame_of_a(b, pose_a, pose_b)[0], axis, signs[j] * np.sign(along[j]), (0, 1, 2))
    else:
        b = step_ulps(place, axis, signs[axis], (0, 1, 2))
        a = corner_face(rng, into_frame_of_a(b, pose_a, pose_b)[0], signs, size)
    return a, pose_a, b, pose_b


def ask_touching(device, cases, make_query):
    """Return which cases are found to meet; poses go past the scene's check, as they may be skewed."""
    scene = ab.Scene(device)
    for a, _, b, _ in cases:
        scene.add(ab.Model.from_arrays(a, FACE))
        scene.add(ab.Model.from_arrays(b, FACE))
    poses = np.array([pose for case in cases for pose in (case[1], case[3])])
    objects = scene.batch().objects.pool
    objects.rotation.assign(np.ascontiguousarray(poses[:, :3, :3]))
    objects.position.assign(np.ascontiguousarray(poses[:, :3, 3]))
    return make_query(scene, "any", pairs=np.arange(2 * len(cases)).reshape(-1, 2)).run().any


# Far from their own origin, x' and the shift between the models' centres round by far more than float32 margins of the
# sizes. Skewed matrices tilt B's axes against its box.
REGIMES = {
    "near": (0.0, 0.0, 0.0),
    "B far from its origin": (0.0, 2.0**40, 0.0),
    "A far from its origin": (2.0**40, 0.0, 0.0),
    "both far": (2.0**40, 2.0**40, 0.0),
    "as skewed as poses may be": (0.0, 0.0, 2.4e-7),
    "skewed": (0.0, 0.0, 2.0**-12),
    "skewed and far": (2.0**40, 2.0**40, 2.0**-12),
}


@pytest.mark.parametrize("make_query", [ab.Query, GpuQuery], ids=["threads", "as on CUDA"])
@pytest.mark.parametrize("speck_first", [True, False], ids=["speck first", "speck second"])
@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.slow
def test_faces_that_touch_are_never_missed(device, regime, speck_first, make_query):
    rng = np.random.default_rng([11, list(REGIMES).index(regime)])
    cases = [touching_pair(rng, *REGIMES[regime], speck_first) for _ in range(COUNT)]
    for a, pose_a, b, pose_b in cases:
        assert triangles_intersect(a, into_frame_of_a(b, pose_a, pose_b))
    missed = np.flatnonzero(~ask_touching(device, cases, make_query))
    assert missed.tolist() == []


def test_the_filter_in_two_dimensions_is_never_sure_and_wrong(device):
    """Points nearly on a line; every difference, product and sum of the determinant rounds."""
    rng = np.random.default_rng(12)
    points = np.empty((20_000, 3, 2))
    a, b, c = points[:, 0], points[:, 1], points[:, 2]
    c[:] = rng.uniform(1, 2, c.shape)
    a[:] = rng.uniform(-0.1, 0.1, a.shape)
    b[:] = c + rng.uniform(0.5, 2.0, (len(b), 1)) * (a - c) + 2.0**-52 * rng.integers(-4, 5, b.shape)
    truth = true_signs(points)
    filtered = find_signs(orient2d_kernel, FILTER, points, device)
    sure = filtered != int(UNCERTAIN)
    np.testing.assert_array_equal(filtered[sure], truth[sure])
    wrong = rounded_signs(points) != truth
    assert wrong.mean() > 0.1 and sure.any(), "the points are too easy or too hard"
    np.testing.assert_array_equal(find_signs(orient2d_kernel, EXACT, points, device), truth)
