"""Distances of face pairs: against integers, random ones and those that are hard for float64, and bounds in float32.

The bounds are those of arithmetic, of coordinates, and the slack of brackets.
"""

import numpy as np
import pytest
import warp as wp
from helpers.nested import FACE_PAIRS, face_pairs, speck_cases
from helpers.questions import launch, pairs_of, scene_of
from helpers.samples import random_poses, sample
from helpers.scenes import scene_with
from oracles.triangle import triangles_intersect
from oracles.triangle_distance import triangle_distance

import warp_abtree as ab
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.distance.frame import make_scale, slack_of
from warp_abtree.kernels.triangle.distance import scale_triangles
from warp_abtree.kernels.triangle.distance_bounds import bound_faces, three_points
from warp_abtree.kernels.triangle.triangle_pair import PAIR_ROUNDING, feature_weights, nearest_features

wp.set_module_options(native.options("distance/bound_faces.cuh"))

ROUNDING = float(PAIR_ROUNDING)


@wp.kernel
def measure_pair_kernel(corners: wp.array2d[wp.vec3d], answer_out: wp.array2d[wp.float64]):
    i = wp.tid()
    t = scale_triangles(corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3], corners[i, 4], corners[i, 5])
    near = nearest_features(t)
    a, b = feature_weights(near)
    answer_out[i, 0] = wp.sqrt(near.square) * t.size
    for k in range(3):
        answer_out[i, 1 + k] = a[k]
        answer_out[i, 4 + k] = b[k]


def measure(device, pairs):
    """Return distances and weights of the nearest points, (k,) and (k, 2, 3)."""
    answers = launch(measure_pair_kernel, device, len(pairs), pairs.reshape(-1, 6, 3), columns=7)
    return answers[:, 0], answers[:, 1:].reshape(-1, 2, 3)


@pytest.mark.parametrize("kind", FACE_PAIRS)
def test_equals_integers(device, kind):
    pairs = face_pairs(kind, np.random.default_rng(1), 800)
    pairs = pairs[[not triangles_intersect(a, b) for a, b in pairs]]
    assert len(pairs) > 100
    distances, weights = measure(device, pairs)
    truth = np.array([triangle_distance(a, b) for a, b in pairs])
    size = np.abs(pairs[:, :, :, None] - pairs[:, :1, :1, None]).max((1, 2, 3, 4))
    assert (np.abs(distances - truth) / size).max() < ROUNDING
    assert ((weights >= -(2.0**-52)) & (weights <= 1)).all()
    np.testing.assert_allclose(weights.sum(2), 1, rtol=0, atol=2.0**-51)
    points = np.einsum("npk,npkx->npx", weights, pairs)
    between = np.linalg.norm(points[:, 0] - points[:, 1], axis=1)
    reach = np.abs(pairs).max((1, 2, 3))
    assert (np.abs(between - distances) <= 2.0**-49 * reach).all()
    swapped, _ = measure(device, pairs[:, ::-1])
    assert (np.abs(swapped - distances) / size).max() < ROUNDING


def test_oracle_knows_distances():
    flat = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    above = np.array([[1.0, 1, 3], [2, 2, 5], [0, 1, 6]])
    assert triangle_distance(flat, above) == 3
    assert triangle_distance(flat, flat + [7, -8, 0]) == 5
    assert triangle_distance(flat, np.array([[-1.0, 1, 1], [-1, 1, 2], [-1, 2, 1]])) == np.sqrt(2)
    crossing_lines = np.array([[3.0, -1, 2], [3, 1, 2], [9, 0, 9]])
    assert triangle_distance(np.array([[0.0, 0, 0], [4, 0, 0], [0, 0, -9]]), crossing_lines) == 2
    assert triangle_distance(np.ldexp(flat, 600), np.ldexp(above, 600)) == np.ldexp(3.0, 600)


# Distances of these, corners of A and of B, are too short in float32 by 7.0 u of what joins corners, too long by 5.1 u
# and, where they are small, by 8.9 u: a search found them. Bounds have 48 u and, where it is small, 256 u.
ROUNDED = """
10.054244041442871 -1.1639070510864258 0.29015541076660156 -0.5406184792518616 -1.1792354583740234 0.3008108139038086
0.2553110122680664 -1.1632226705551147 0.3018760681152344 -1.178404450416565 14.842141151428223 -16.01190948486328
1.0482897758483887 14.940482139587402 -16.01624298095703 -6.037839889526367 14.933395385742188 -15.996874809265137

-0.23862013220787048 -1.3956738710403442 0.3948177695274353 -0.24370604753494263 2.067084550857544 0.647355318069458
-0.4515213072299957 0.6433582305908203 0.8404097557067871 0.28087499737739563 -6.6145172119140625 8.488607406616211
-1.4049440622329712 -1.4131320714950562 9.076437950134277 1.9498586654663086 -2.4364302158355713 8.991321563720703

-0.3461741507053375 0.8877944350242615 -0.1948689967393875 -0.4623752236366272 -0.31842660903930664 0.6536509990692139
1.199400782585144 -0.8921202421188354 1.1106220483779907 1.1147310733795166 -0.8415639400482178 1.0722731351852417
0.2736254632472992 0.06651438772678375 1.3164710998535156 0.5043172240257263 -0.0875043123960495 0.9839113354682922
"""


@wp.kernel
def bound_faces_kernel(corners: wp.array2d[wp.vec3], bounds_out: wp.array2d[wp.float32]):
    i = wp.tid()
    a, b = three_points(), three_points()
    for k in range(3):
        a[k] = corners[i, k]
        b[k] = corners[i, 3 + k]
    bound_faces(0.0, a, b, bounds_out[i, 0], bounds_out[i, 1])


def test_bounds_of_faces_cover_roundings_that_add_up(device):
    points = np.array(ROUNDED.split(), float).reshape(3, 6, 3)
    assert (points == points.astype(np.float32)).all()
    lower, upper = launch(bound_faces_kernel, device, len(points), points, columns=2).astype(float).T
    truth = np.array([triangle_distance(corners[:3], corners[3:]) for corners in points])
    assert (lower < truth).all() and (truth < upper).all()
    size = np.abs(points[:, :3, None] - points[:, None, 3:]).max((1, 2, 3))
    np.testing.assert_allclose((upper - lower) / (2.0**-23 * size), [48, 48, 256], rtol=0.03)


def test_faces_far_from_the_middle_are_not_lost(device, regime):
    """Of a large object: coordinates round by more than a quarter of what is allowed, and by far more than the gap."""
    cases, distances = speck_cases(np.random.default_rng(1), 60, gap=1e-3)
    query = ab.DistanceQuery(scene_of(device, cases), pairs_of(cases), beyond=distances * (1 + 1e-9))
    np.testing.assert_allclose(query.run().distance, distances, rtol=1e-10)


@wp.kernel
def slack_kernel(
    trees: Trees, batch: PairBatch, distances: wp.array2d(dtype=wp.float64), slack_out: wp.array2d(dtype=wp.float64)
):
    i = wp.tid()
    frame = make_scale(trees, batch.poses[i], batch.pairs[i][0], batch.pairs[i][1])
    for k in range(distances.shape[1]):
        slack_out[i, k] = slack_of(frame, distances[i, k])


def test_slack_is_what_the_proof_adds_up(device):
    """Steps 2 and 3 of `kernels.distance.frame`: 90 u and 96 u of the sizes, 256 u where distances are small."""
    rng, count = np.random.default_rng(2), 12
    model = sample("box")
    poses = random_poses(rng, 2 * count, 1.0)
    poses[:, :3] *= 10.0 ** rng.integers(-2, 4, (2 * count, 1))
    scene = scene_with(device, *[(model, pose) for pose in poses])
    query = ab.DistanceQuery(scene, np.arange(2 * count).reshape(-1, 2))
    query.run()
    reach = np.abs(model.mesh_at(model.lod_max)[0]).max()
    size = 2 * reach + np.abs(poses[1::2, :3] - poses[0::2, :3]).max(1)
    parts = 2.0 ** np.array([-60, -30, -19, -17.0])
    slack = launch(slack_kernel, device, count, query.batch.trees, query.pair_batch, parts * size[:, None], columns=4)
    unit = 2.0**-53 * size[:, None]
    assert (slack[:, :3] >= (90 + 256) * unit).all() and (slack[:, 3:] >= (90 + 96) * unit).all()
    # Rotations of quaternions are off orthonormal by some u; the rest is no more than twice what it need be.
    assert (slack[:, 3:] <= 2 * (90 + 96) * unit + 24 * unit).all()
