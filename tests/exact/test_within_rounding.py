"""Margins of a proof of distance: its own rounding, poses that round, and frames that are not orthonormal.

Each case names two points, one of either surface: no pair is farther apart than the least float64 over their distance.
"""

import math
from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from helpers.questions import ask, launch
from helpers.samples import model_of_faces, random_quaternions
from helpers.scenes import scene_with
from oracles.triangle import fractions

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import boxes_overlap, pose_box
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import pair_pose
from warp_abtree.kernels.triangle.distance import triangles_near

wp.set_module_options(native.options())

SKEW = 2.0**-22  # scenes refuse a frame that is off by 10^-6


def distance_over(p, q):
    """Return the least float64 that is no less than the distance of points in fractions."""
    square = sum((q - p) ** 2)
    d = math.sqrt(float(square)) * (1 - 2.0**-50)
    while Fraction(d) ** 2 < square:
        d = math.nextafter(d, math.inf)
    return d


@wp.kernel
def near_kernel(distance: wp.array[wp.float64], corners: wp.array2d[wp.vec3d], near_out: wp.array[int]):
    i = wp.tid()
    a, b, c, d, e, f = corners[i, 0], corners[i, 1], corners[i, 2], corners[i, 3], corners[i, 4], corners[i, 5]
    near_out[i] = triangles_near(distance[i], a, b, c, d, e, f)


def over_a_face(rng, height):
    """Return two triangles, the second with a corner over the inside of the first, and the distance of that corner."""
    a = rng.normal(size=(3, 3))
    weight = np.array([0.25, 0.5, 0.25]) if rng.random() < 0.5 else np.array([0.375, 0.25, 0.375])
    foot = (fractions(a) * fractions(weight)[:, None]).sum(0)
    normal = np.cross(a[1] - a[0], a[2] - a[0])
    normal /= np.linalg.norm(normal)
    corner = foot.astype(float) + height * normal
    aside = 0.3 * rng.normal(size=(2, 3))
    aside -= (aside @ normal)[:, None] * normal
    b = corner + np.array([np.zeros(3), *(aside + 0.5 * normal)])
    return np.concatenate([a, b]), distance_over(foot, fractions(corner))


@pytest.mark.parametrize("height", [1.0, 2.0**-20, 2.0**-40])
def test_gaps_allow_for_their_own_rounding(device, height):
    rng = np.random.default_rng(1)
    corners, distances = zip(*[over_a_face(rng, height) for _ in range(60)])
    corners, distances = np.array(corners), np.array(distances)
    assert launch(near_kernel, device, 60, distances, corners).all()
    # And for no more than that: a little less than the distance is proved.
    assert not launch(near_kernel, device, 60, distances * (1 - 1e-4) - 2.0**-44, corners).any()


def turn_of(quaternion):
    """Return the rotation of a quaternion, normalised, in fractions."""
    x, y, z, w = fractions(quaternion)
    s = 2 / (x * x + y * y + z * z + w * w)
    first = 1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    second = s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)
    return np.array([first, second, (s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y))])


def is_apart(device, faces, poses, distances):
    """Return which pairs of single faces, of A and of B, are proved farther apart than their distances."""
    models = [list(map(model_of_faces, of_one)) for of_one in faces]
    nones = [None] * len(distances)
    cases = list(zip(models[0], nones, poses[0], models[1], nones, poses[1], strict=True))
    return ask(device, cases, output="any", within=distances).apart


@pytest.mark.parametrize(("far_a", "far_b"), [(0.0, 2.0**30), (2.0**30, 0.0), (2.0**30, 2.0**30)])
def test_distances_allow_for_poses_that_round(device, far_a, far_b):
    """Faces some 2^-23 apart at quaternions, their coordinates far from their own origins."""
    rng = np.random.default_rng(2)
    faces, poses, distances = ([], []), ([], []), []
    for _ in range(30):
        q = random_quaternions(rng, 2)
        turns = [turn_of(x) for x in q]
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        place = rng.normal(size=(2, 3)) * [[1 + far_a], [1 + far_b]]
        shift = rng.normal(size=(2, 3))
        world = fractions(place[0]) @ turns[0].T + fractions(shift[0])
        shift[1] = (world - fractions(place[1]) @ turns[1].T).astype(float) + 2.0**-23 * way
        point = fractions(place[1]) @ turns[1].T + fractions(shift[1])
        for k, side in enumerate((-1, 1)):
            aside = rng.normal(size=(2, 3))
            aside -= (aside @ way)[:, None] * way
            away = np.concatenate([np.zeros((1, 3)), aside + side * way])  # from the other face
            away = away @ turns[k].astype(float)
            faces[k].append(place[k] + away)
            poses[k].append(np.concatenate([shift[k], q[k]]))
        distances.append(distance_over(world, point))
    assert not is_apart(device, faces, poses, distances).any()


def stretched(x, stretch):
    """Return a pose at x along the first axis."""
    pose = np.diag([1 + stretch] * 3 + [1.0])
    pose[0, 3] = x
    return pose


# Stretch of A's and B's frame, place of A's face in its frame, where B's face begins in the world, distance. In the
# last case a displacement of B by 1 in its own frame moves it by 1 + SKEW.
SKEWED = {
    "A's frame measures more": (SKEW, 0.0, 0.0, 1.0, 1.0),
    "A's face is moved": (SKEW, 0.0, 1024.0, 1024 * (1 + SKEW) + 2.0**-10, 2.0**-10),
    "B's errors are longer": (0.0, SKEW, 0.0, 1 + 0.75 * SKEW, 1.0),
}


@pytest.mark.parametrize("case", SKEWED)
def test_distances_allow_for_frames_off_orthonormal(device, case):
    stretch_a, stretch_b, place, start, distance = SKEWED[case]
    spread = 2.0**-12 * np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    a, b = np.array([place, 0.0, 0.0]) - spread, spread
    poses = stretched(0.0, stretch_a), stretched(start, stretch_b)
    apart = is_apart(device, ([a] * 2, [b] * 2), ([poses[0]] * 2, [poses[1]] * 2), [distance, 0.5 * distance])
    np.testing.assert_array_equal(apart, [False, case != "A's face is moved"])


@wp.kernel
def leaves_kernel(within: wp.float64, trees: Trees, out: wp.array[int]):
    """Compare the box of each of A's two faces with B's."""
    i = wp.tid()
    pose = pair_pose(True, trees, 0, 1, within)
    a = load_node(trees.states, pose.node_a + 2 + i)
    b = load_node(trees.states, pose.node_b + 1)
    posed_a = pose_box(a.lower, a.upper, wp.transpose(pose.rotation32), pose.back32, pose.margin)
    posed_b = pose_box(b.lower, b.upper, pose.rotation32, pose.translation32, pose.margin)
    out[i] = wp.where(boxes_overlap(posed_a, posed_b), 1, 0)


def test_widened_boxes_allow_for_frames_off_orthonormal(device):
    """Corners of A at (1, 1, 1) and (-1, -1, -1), B about the middle: sqrt(3) along a column that is longer than 1."""
    spread = 2.0**-20 * np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    scene = scene_with(device, model_of_faces([1 - spread, spread - 1]), model_of_faces(spread - 2.0**-21))
    trees = scene.batch().trees
    third, across = np.ones(3) / np.sqrt(3.0), np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    turn = np.stack([third, across, np.cross(third, across)], 1) * (1 + 2.0**-12)
    trees.objects.rotation.assign(np.stack([np.eye(3), turn]))
    for within, expected in ((math.sqrt(3.0), 1), (0.99 * math.sqrt(3.0), 0)):
        assert launch(leaves_kernel, device, 2, within, trees).tolist() == [expected] * 2
