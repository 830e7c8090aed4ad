"""The margins of the box test: each part on pairs of faces that meet in one point, where that part alone finds it.

One face is a speck some units in the last place long, which starts at a corner of the other face and of its box and
leads away from it, so whatever the boxes err by, and no margin covers, prunes the pair.
"""

import numpy as np
import pytest
from helpers.questions import GpuQuery, pairs_of, scene_of, to_matrix
from helpers.samples import random_quaternions
from oracles.triangle import into_frame_of_a, quaternion_matrix, triangles_intersect

import warp_abtree as ab

FACE = [[0, 1, 2]]


def random_turn(rng):
    return quaternion_matrix(random_quaternions(rng, 1)[0])


def step_ulps(point, axis, sign, steps):
    """Return points that lie some units in the last place from a point along one axis, (len(steps), 3)."""
    points = np.tile(point, (len(steps), 1))
    points[:, axis] += sign * np.array(steps) * np.spacing(np.abs(point).max())
    return points


def corner_face(rng, corner, signs, size):
    """Return a face whose first corner is the corner of its box on the side of some signs."""
    return corner - size * np.concatenate([np.zeros((1, 3)), rng.uniform(0.2, 2.0, (2, 3))]) * signs


def touching_pair(rng, far_a, far_b, skew, speck_first):
    """Return corners of A, pose of A, corners of B, pose of B: faces that meet in the first corner of both."""
    size = 2.0 ** rng.choice([-40, 0, 60])
    signs = rng.choice([-1.0, 1.0], 3)
    axis = rng.integers(3)
    place = rng.normal(size=3) * size * max(far_b, 1.0)
    # Columns lean towards the corner, where they make the most of B's extent along each other.
    lean = skew * rng.uniform(0.5, 1.0, (3, 3)) * np.outer(signs, signs)
    pose_a = to_matrix(
        random_turn(rng) @ (np.eye(3) + skew * rng.uniform(-0.2, 0.2, (3, 3))), rng.normal(size=3) * size
    )
    pose_b = to_matrix(random_turn(rng) @ (np.eye(3) + lean), np.zeros(3))
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


# Far from their own origin, x' and the shift between the models' centres round by far more than float32 margins of the
# sizes. Skewed matrices tilt B's axes against its box. How far A and B lie off, in sizes, and matrices off orthonormal:
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
    cases = [touching_pair(rng, *REGIMES[regime], speck_first) for _ in range(150)]
    for a, pose_a, b, pose_b in cases:
        assert triangles_intersect(a, into_frame_of_a(b, pose_a, pose_b))
    models = [[ab.Model.from_arrays(corners, FACE) for corners in (a, b)] for a, _, b, _ in cases]
    scene = scene_of(device, [(a, None, np.eye(4), b, None, np.eye(4)) for a, b in models])
    poses = np.array([pose for case in cases for pose in case[1::2]])
    objects = scene.batch().objects.pool  # past the scene's check, as they may be skewed
    objects.rotation.assign(np.ascontiguousarray(poses[:, :3, :3]))
    objects.position.assign(np.ascontiguousarray(poses[:, :3, 3]))
    assert make_query(scene, "any", pairs=pairs_of(cases)).run().any.all()
