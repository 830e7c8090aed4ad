"""Bounds of `kernels.motion.screw`: patches that touch at a corner somewhere on a screw are not found apart.

The corner is where each patch reaches farthest along the direction in which they are compared, so that only what
surfaces bend by, and points are off, keeps their bounds from parting.
"""

import numpy as np
import pytest
import warp as wp
from helpers.questions import launch
from helpers.samples import random_poses
from oracles.path import HAS_LONG, LONG
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.motion.path import Paths, bound_motion, pair_skew, prepare_path_kernel, start_motion
from warp_abtree.kernels.motion.screw import TURN_ROUNDING, slides_apart, turn_between
from warp_abtree.kernels.poses import place_trees

COUNT = 300
FACES = [[0, 2, 1], [1, 2, 3], [2, 4, 3], [3, 4, 5]]


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def slide_kernel(
    slack: wp.float64,
    paths: Paths,
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    apart_out: wp.array(dtype=wp.int32),
):
    """Compare two roots whose points are off by a slack, in place of that of rounding where it is above 0."""
    i = wp.tid()
    a, b = 2 * i, 2 * i + 1
    pose = place_trees(models, states, objects.state[a], objects.state[b])
    motion = start_motion(paths, models, states, objects, wp.vec2i(a, b))
    motion = bound_motion(motion, states, pose, pair_skew(objects, a, motion.first))
    if slack > wp.float64(0.0):
        motion.slack = slack
    apart_out[i] = wp.where(slides_apart(models, states, pose, motion, wp.float64(0.0), 1, 1), 1, 0)


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def turn_between_kernel(x: wp.array2d(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    out[i] = turn_between(x[i, 0], x[i, 1])


def random_patch(rng, pitch):
    """Return corners of a flat patch of `FACES` about the point (1, 0, 0), and its normal; some lie along the screw."""
    width = rng.choice([[0.03, 0.03], [0.03, 0.3], [0.3, 0.3], [0.42, 0.02]]) * rng.uniform(0.5, 1, 2)
    u, v = (np.stack(np.meshgrid([-1, 0, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 2) * width).T
    tilt = Rotation.from_rotvec([0, rng.uniform(-1.5, 1.5), rng.uniform(-0.5, 0.5)])
    if rng.random() < 0.5:
        tilt = Rotation.from_rotvec([np.arctan(pitch), 0, 0]) * Rotation.from_rotvec([0, rng.uniform(1.4, 1.7), 0])
    return tilt.apply(np.stack([0 * u, u, v], 1)) + [rng.uniform(0.9, 1.1), 0, 0], tilt.apply([1, 0, 0])


def heights(points, normal, own, pitch, radius):
    """Return p X + tangent Y + q Z of points, X along the radius of their centre; p and q are of the patch `own`."""
    middle = (own.min(0) + own.max(0)) / 2
    out = middle * [1, 1, 0] / np.hypot(*middle[:2])
    p, q = normal @ out, normal[2]
    centre = (points.min(0) + points.max(0)) / 2
    out = centre * [1, 1, 0] / np.hypot(*centre[:2])
    return points @ (p * out - q * pitch / radius * np.cross([0, 0, 1], out) + q * np.array([0, 0, 1]))


def touching_patches(rng, off, drift):
    """Return corners of a resting patch and of a moving one, its turn and its way, such that corners of both meet.

    None where these are not the farthest ones. The moving one's is moved away by `off` along the direction.
    """
    turn, way, t = rng.uniform(0.2, 3), np.array([0, 0, rng.normal()]), rng.choice([0, rng.uniform(), 1])
    (rest, normal), (moving, other) = (random_patch(rng, way[2] / turn) for _ in range(2))
    side = rng.normal(size=3) * [1, 1, 0]
    way += drift * side / np.linalg.norm(side)
    base, pitch = (rest.min(0) + rest.max(0)) / 2, way[2] / turn
    radius, sign, uses_rest = np.hypot(*base[:2]), rng.choice([-1, 1]), rng.random() < 0.5
    moved = moving + rng.uniform(-0.2, 0.2, 3) * [0, 1, 1]
    for j in rng.permutation(6):
        direction, own = (normal, rest) if uses_rest else (other, moved)
        i = np.argmax(sign * heights(rest, direction, own, pitch, radius))
        at = moved + rest[i] - moved[j] + sign * off * direction
        own = rest if uses_rest else at
        far = sign * heights(rest, direction, own, pitch, radius)
        near = sign * heights(at, direction, own, pitch, radius)
        if np.argmax(far) == i and np.argmin(near) == j:
            back = Rotation.from_euler("z", -turn * t)
            return rest, back.apply(at - t * way), turn, way
    return None


def found_apart(rng, device, off=0.0, slack=0.0, drift=0.0):
    """Return which of `COUNT` pairs that touch, but for `off`, are found apart where points are off by a slack."""
    cases = []
    while len(cases) < COUNT:
        found = touching_patches(rng, off, drift)
        if found is not None:
            cases.append(found)
    return slides(rng, device, cases, slack)


def slides(rng, device, cases, slack=0.0):
    """Return which pairs of corners of a resting patch and of a moving one, its turn and its way, are found apart."""
    scene, ends = ab.Scene(device), []
    for rest, moving, turn, way in cases:
        whole = random_poses(rng, 1, 1.0)[0]
        frame = Rotation.from_quat(whole[3:])
        last = [*(frame.apply(way) + whole[:3]), *(frame * Rotation.from_euler("z", turn)).as_quat()]
        both = [(rest, whole), (moving, last)]
        for corners, end in both if len(ends) % 4 else both[::-1]:
            scene.add(ab.Model.from_arrays(corners, FACES, base_faces=4), whole)
            ends.append(end)
    query = ab.FirstContactQuery(scene, np.array(ends), np.arange(2 * COUNT).reshape(-1, 2))
    paths, pools = Paths(), query.batch.pools
    for name in ("axis", "angle", "anchor", "start", "travel"):
        setattr(paths, name, wp.zeros(2 * COUNT, dtype=wp.float64 if name == "angle" else wp.vec3d, device=device))
    wp.launch(prepare_path_kernel, 2 * COUNT, [False, pools[2], query.ends, paths], device=device)
    return launch(slide_kernel, device, COUNT, slack, paths, *pools) != 0


def test_patches_that_touch_on_a_screw_are_not_apart(device):
    rng = np.random.default_rng(1)
    assert not found_apart(rng, device).any()
    # Elsewhere it does tell them apart.
    assert found_apart(rng, device, off=0.2).mean() > 0.2


def test_points_may_be_off_the_screw(device):
    rng = np.random.default_rng(2)
    assert not found_apart(rng, device, drift=0.02).any()
    for slack in (0.01, 0.1):
        assert not found_apart(rng, device, off=0.9 * slack, slack=slack).any()


def blade(radius, out, along, slope, corner):
    """Return corners of a flat patch some radius from the axis, and which of them is farthest out and along.

    Args:
        out, along: Half widths from the axis and around it.
        slope: By which it rises around the axis.
        corner: Signs of the corner outwards and around.
    """
    u, v = np.stack(np.meshgrid([-1, 0, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 2).T
    points = np.stack([radius + out * v, along * u, slope * along * u], 1)
    return points, np.flatnonzero((v == corner[0]) & (u == corner[1]))[0]


# Half widths out and around of the resting patch, 1 from the axis, and of the moving one, of which corners meet.
THIN = 1e-3
BLADES = {
    "around, at a corner of the resting one": ((0.05, 0.4), (THIN, THIN)),
    "around, at a corner of the moving one": ((THIN, THIN), (THIN, 0.4)),
    "out and around, at a corner of the resting one": ((0.25, 0.25), (THIN, THIN)),
    "at an end of either": ((0.3, THIN), (THIN, 0.3)),
}


@pytest.mark.parametrize("kind", BLADES)
def test_patches_that_twist_as_angles_do_are_not_apart(device, kind):
    """Along a screw angles are not what is linear: patches as thin as that leaves them, in the plane of a screw."""
    rng, (rest_widths, (out, along)) = np.random.default_rng(5), BLADES[kind]
    cases = []
    for _ in range(COUNT):
        turn, t, signs = rng.uniform(0.2, 3), rng.choice([0, rng.uniform(), 1]), rng.choice([-1, 1], (2, 2))
        pitch = rng.uniform(0.5, 3) * rng.choice([-1, 1])
        rest, i = blade(1.0, *rest_widths, pitch, signs[0])
        radius = np.sqrt(np.hypot(*rest[i, :2]) ** 2 - along**2) - signs[1][0] * out
        moving, j = blade(radius, out, along, pitch, signs[1])
        angle = np.arctan2(*rest[i, 1::-1]) - np.arctan2(*moving[j, 1::-1])
        moving = Rotation.from_euler("z", angle).apply(moving) + [0, 0, rest[i, 2] - moving[j, 2]]
        way = np.array([0, 0, pitch * turn])
        cases.append((rest, Rotation.from_euler("z", -turn * t).apply(moving - t * way), turn, way))
    assert not slides(rng, device, cases).any()


def test_wide_balls_near_the_axis_say_nothing_of_times(device):
    """The corner that meets the other patch at the end is farther from its box's centre than 1.1 x, x of the radius."""
    cases = []
    for x in np.linspace(0.72, 0.95, COUNT):
        # From the centre (1, 0, 0), x long, to where a line from the axis touches the ball.
        side, angle, turn = x * np.array([-x, np.sqrt(1 - x * x), 0]), np.arcsin(x), 0.5
        u, v = np.stack(np.meshgrid([-1, 0, 1], [-1e-4, 1e-4], indexing="ij"), -1).reshape(-1, 2).T
        moving = [1, 0, 0] + u[:, None] * side + v[:, None] * [0, 0, 1]
        small = np.sqrt(1 - x * x) * np.array([1, 0, 0]) + 1e-3 * np.stack([0 * u, u, v], 1)
        way = np.array([0, 0, 0.1 * turn])
        cases.append((Rotation.from_euler("z", angle + turn).apply(small) + way, moving, turn, way))
    assert not slides(np.random.default_rng(4), device, cases).any()


@pytest.mark.skipif(not HAS_LONG, reason="no floating-point numbers longer than float64")
def test_angles_of_screws_err_by_less_than_said(device):
    angle = np.random.default_rng(3).uniform(0, 2 * np.pi, 5000)
    given = np.stack([np.sin(angle), np.cos(angle)], 1)
    truth = np.arctan2(*given.T.astype(LONG)) % (8 * np.arctan(LONG(1)))
    errors = np.abs(launch(turn_between_kernel, device, len(angle), given) - truth)
    assert errors.max() < float(TURN_ROUNDING) / 4
