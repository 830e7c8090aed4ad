"""Margins of the float32 stages: at random, where one part of them alone finds a pair; and where roundings add up.

At random, a speck some units in the last place long starts at a corner of the other face and of its box and leads away
from it, so whatever the boxes err by, and no margin covers, prunes the pair. Where they add up, a search found the
cases, close to the proven bounds; at random a bound of a fraction of the right size passes too.
"""

import numpy as np
import pytest
import warp as wp
from conftest import slow
from helpers.questions import GpuQuery, launch, pairs_of, scene_of, to_matrix
from helpers.samples import mirrored, model_of_faces, random_quaternions, true_faces
from oracles.signs import true_signs
from oracles.triangle import into_frame_of_a, quaternion_matrix, triangles_intersect

import warp_abtree as ab
from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import pair_pose
from warp_abtree.kernels.distance.frame import make_scale
from warp_abtree.kernels.exact.predicates import UNCERTAIN
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, side_of_plane

wp.set_module_options(native.options("triangle/float32_filter.cuh"))

U = 2.0**-24
STILL = np.eye(4)


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
    turns = [quaternion_matrix(q) for q in random_quaternions(rng, 2)]
    skewed = turns[0] @ (np.eye(3) + skew * rng.uniform(-0.2, 0.2, (3, 3)))
    pose_a = to_matrix(skewed, rng.normal(size=3) * size)
    pose_b = to_matrix(turns[1] @ (np.eye(3) + lean), np.zeros(3))
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


@pytest.mark.parametrize("speck_first", [True, False], ids=["speck first", "speck second"])
@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.slow
def test_faces_that_touch_are_never_missed(device, regime, speck_first):
    rng = np.random.default_rng([11, list(REGIMES).index(regime)])
    cases = [touching_pair(rng, *REGIMES[regime], speck_first) for _ in range(80)]
    for a, pose_a, b, pose_b in cases:
        assert triangles_intersect(a, into_frame_of_a(b, pose_a, pose_b))
    models = [(model_of_faces(a), model_of_faces(b)) for a, _, b, _ in cases]
    scene = scene_of(device, [(a, None, STILL, b, None, STILL) for a, b in models])
    poses = np.array([pose for case in cases for pose in case[1::2]])
    objects = scene.batch().objects.pool  # past the scene's check, as they may be skewed
    objects.rotation.assign(np.ascontiguousarray(poses[:, :3, :3]))
    objects.position.assign(np.ascontiguousarray(poses[:, :3, 3]))
    for make_query in (ab.Query, GpuQuery):
        assert make_query(scene, "any", pairs=pairs_of(cases)).run().any.all()


# Quaternion of B; lower and upper ends of the boxes of A's and B's face, float32; which end is that of the corner in
# which both meet. Roundings come to 6.7 times u (r_a + r_b + s) along an axis of B in the first case, to 5.2 times that
# along one of A in the second, of 9 that the margin has. As sums of float32 go in steps, margins of 5 and 3.5 show it.
BOXES = [
    (
        (-0.26090298953917723, 0.4137406052698503, 0.1340690716194268, 0.861843272083482),
        (-1.1599217653274536, -1.159389853477478, -1.156362771987915),
        (1.1601052284240723, 1.1591155529022217, 1.1599173545837402),
        (-1.058033244349943e-10, -1.2454214015633625e-07, -1.2427281603777374e-07),
        (5.646884915222472e-08, 7.928227518938513e-12, 5.089442945586457e-20),
        (1, 1, 1),
        (1, 0, 0),
    ),
    (
        (-0.2761283992516813, 0.40640969186259124, -0.8232389535439696, 0.2843622598986859),
        (-4.572072620437492e-16, -6.299571975176832e-09, -9.719712387105516e-15),
        (-5.170177713524492e-28, -7.1068089451289e-25, 5.994618389824335e-22),
        (3.83704957584996e-07, -1.2721312714347732e-07, 7.860363098188827e-07),
        (0.07367590814828873, 0.0734814926981926, 0.07280632853507996),
        (1, 0, 1),
        (0, 0, 0),
    ),
]


def span_box(lower, upper, first_high):
    """Return a face that fills a float32 box, a little inside, its first two corners at opposite ends."""
    lower, upper, first_high = np.array(lower), np.array(upper), np.array(first_high, bool)
    inside = 2.0**-48 * np.abs([lower, upper]).max()
    lower, upper = lower + inside, upper - inside
    first, last = np.where(first_high, upper, lower), np.where(first_high, lower, upper)
    return np.array([first, last, (first[0], last[1], last[2])])


def touching_boxes(quaternion, lower_a, upper_a, lower_b, upper_b, high_a, high_b):
    """Return A, B and the pose of B: faces that meet in their first corners, ends of their boxes."""
    a, b = span_box(lower_a, upper_a, high_a), span_box(lower_b, upper_b, high_b)
    pose = to_matrix(quaternion_matrix(quaternion), a[0] - quaternion_matrix(quaternion) @ b[0])
    a[0] = into_frame_of_a(b[:1], STILL, pose)[0]
    return mirrored(a), mirrored(b), pose


def rounded_apart():
    """Return A, B and the pose of B: a speck whose first corner lies on A's large face, in float32 4 u above it.

    A's height rounds down by 0.99 u, the height of B's centre up by as much. The rows of B's corner take 2.02 u from it
    in three parts, each under half a unit in the last place, and no part changes the rounded sum. The bound is 10 u.
    """
    third, across = np.ones(3) / np.sqrt(3.0), np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    pose = to_matrix((across, np.cross(third, across), third), (2.0**-10, 2.0**-10, 1 + 3.01 * U))
    b = U * np.array([[0.0, 0.0, -2.02], [20.0, 0.0, 9.0], [0.0, 20.0, 9.0]]) @ pose[:3, :3]
    height = into_frame_of_a(b, STILL, pose)[0, 2]
    assert 0.98 * U < height - 1 < U
    a = np.array([[0.0, 0.0, height], [0.5, 0.0, height], [0.0, 0.5, height]])
    return mirrored(a), mirrored(b), pose


@pytest.mark.parametrize("make_query", [ab.Query, *slow(GpuQuery)], ids=["threads", "as on CUDA"])
def test_margins_and_errors_cover_roundings_that_add_up(device, make_query):
    """Compare the faces that meet with exact brute force; the first faces of each pair do."""
    cases = [rounded_apart(), *[touching_boxes(*case) for case in BOXES]]
    scene = scene_of(device, [(a, None, STILL, b, None, pose) for a, b, pose in cases])
    found = make_query(scene, "faces", pairs=pairs_of(cases)).run().faces
    for k, (a, b, pose) in enumerate(cases):
        truth = true_faces(a, a.lod_max, STILL, b, b.lod_max, pose)
        assert [0, 0] in truth.tolist()
        np.testing.assert_array_equal(found[found[:, 0] == k][:, 1:], truth)


# Float32 determinants of the wrong sign, 1.40 and 1.44 times u |u||v||w| beyond 0, of 9 that the bound has.
SIDES = """
1.6862074136734009 0.8520998358726501 -0.00023535435320809484
0.6243591904640198 -0.2703389823436737 1.0831425189971924
1.639235019683838 0.8024471402168274 -0.00023535435320809484
0.6243591904640198 -0.2703390121459961 -0.00023535435320809484
1.2515507936477661 1.121414065361023 0.0383477583527565
0.048140592873096466 -0.11057006567716599 1.8105762004852295
2.3238625526428223 2.2183172702789307 0.03832273930311203
0.04814060032367706 -0.10959417372941971 0.03856706991791725
"""


@wp.kernel
def side_kernel(points: wp.array2d[wp.vec3], side_out: wp.array[int]):
    i = wp.tid()
    plane = wp.matrix_from_rows(points[i, 0], points[i, 1], points[i, 2])
    side_out[i] = side_of_plane(0.0, FLOAT32_UNIT, plane, points[i, 3])


def test_the_bound_of_determinants_covers_roundings_that_add_up(device):
    points = np.array(SIDES.split(), float).reshape(-1, 4, 3)
    assert (points == points.astype(np.float32)).all()
    # Rows that change places change the sign, and the order of roundings with it.
    points = np.concatenate([points[:, order] for order in ([0, 1, 2, 3], [1, 2, 0, 3], [2, 0, 1, 3], [1, 0, 2, 3])])
    sides, truth = launch(side_kernel, device, len(points), points), true_signs(points)
    sure = sides != int(UNCERTAIN)
    np.testing.assert_array_equal(sides[sure], truth[sure])


@wp.kernel
def margin_kernel(trees: Trees, margins_out: wp.array2d[wp.float64]):
    """Write the margin of an object pair's boxes, its float32 coordinates' error, and the margin of their distance."""
    i = wp.tid()
    pose = pair_pose(False, trees, 2 * i, 2 * i + 1, wp.float64(0.0))
    scaling = make_scale(trees, pose, 2 * i, 2 * i + 1)
    margins_out[i, 0] = wp.float64(pose.margin)
    margins_out[i, 1] = wp.float64(pose.error) / pose.scale
    margins_out[i, 2] = wp.float64(scaling.margin) / wp.float64(scaling.scale)


def test_margins_have_what_roundings_add_up_to(device):
    """Those of docs/exactness.md, of objects far from their own origins, from one another, or neither, and large."""
    rng, cases, most = np.random.default_rng(8), [], []
    for k in range(64):
        far, size = 2.0 ** rng.choice([-4, 0, 24, 32], 2), 2.0 ** rng.choice([-20, 0], 2)
        centre_a, centre_b = (rng.normal(size=3) * f for f in far)
        turn = quaternion_matrix(random_quaternions(rng, 1)[0])
        apart = size.max() * rng.normal(size=3) * (k % 3)
        shift = centre_a - turn @ centre_b + apart
        a, b = (model_of_faces(c + s * rng.uniform(-1, 1, (3, 3))) for c, s in zip((centre_a, centre_b), size))
        cases.append((a, None, STILL, b, None, to_matrix(turn, shift)))
        reach_a, reach_b = (np.abs(m.mesh_at(m.lod_max)[0] - m.centre).max() for m in (a, b))
        at_b, whole = np.abs(b.centre).max(), (np.abs(shift) + np.abs(a.centre)).max()
        s = np.abs(turn @ b.centre + shift - a.centre).max()
        exact = 2.0**-53 * (44 * at_b + 22 * reach_b + 15 * whole)  # bound 9 leaves no more of a unit quaternion
        boxes = U * max(8.94 * reach_b + 5 * s + 2 * reach_a, 8.94 * reach_a + 8.66 * s + 2 * reach_b)
        corners = U * (3.9 * reach_a + 22.2 * reach_b + 6.1 * s)
        most.append((boxes + exact, corners + 2 * exact, boxes + exact))
    trees = scene_of(device, cases).batch().trees
    margins = launch(margin_kernel, device, len(cases), trees, columns=3)
    near = np.isfinite(margins[:, 0])  # others are apart for certain
    margins, most = margins[near], np.array(most)[near]
    assert near.sum() > 40 and (margins >= most).all() and (margins < 8 * most).all()
