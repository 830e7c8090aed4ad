"""Profiles of nested objects on a screw: each face is within its profile, in longer numbers; nested threads."""

import numpy as np
import pytest
import warp as wp
from helpers.motions import find
from helpers.questions import launch, pairs_of, scene_of
from helpers.samples import random_poses
from oracles.motion import pose_between
from oracles.path import HAS_LONG, LONG
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.base.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.base.poses import place_trees
from warp_abtree.kernels.motion.path import Paths, bound_motion, pair_skew, prepare_path_kernel, start_motion
from warp_abtree.kernels.motion.profile import CELLS, box_heights, frame_of_a, frame_of_b, image_face, radii_of
from warp_abtree.kernels.motion.screw import screw_frame

COUNT, SAMPLES, N = 400, 300, int(CELLS)


@wp.kernel(module="unique", module_options={"fuse_fp": False})
def profile_kernel(
    slack: wp.float64,
    paths: Paths,
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    out: wp.array2d(dtype=wp.float64),
):
    """Write least radii of an object's first face in each cell, greatest ones, and whether it is reached.

    Points are off the screw by twice a slack, where it is above 0.
    """
    i = wp.tid()
    a = (i / 2) * 2
    b = a + 1
    pose = place_trees(models, states, objects.state[a], objects.state[b])
    motion = start_motion(paths, models, states, objects, wp.vec2i(a, b))
    motion = bound_motion(motion, states, pose, pair_skew(objects, a, motion.first))
    if slack > wp.float64(0.0):
        motion.slack = slack
    screw = screw_frame(motion)
    heights_a, _ = box_heights(states, pose.node_a + 1, screw.away_a, screw.axis_a)
    heights_b, _ = box_heights(states, pose.node_b + 1, screw.away_b, screw.axis_b)
    frame = frame_of_a(motion, screw, heights_b)
    if i == b:
        frame = frame_of_b(motion, screw, frame, heights_a)
    image = image_face(models, states, frame, wp.where(i == b, pose.corner_b, pose.corner_a))
    for k in range(CELLS):
        out[i, k] = wp.float64(wp.inf)
        out[i, CELLS + k] = wp.float64(0.0)
    cell = image.first
    while cell <= image.last:
        radii = radii_of(image, cell)
        j = cell & (CELLS - 1)
        out[i, j] = wp.min(out[i, j], wp.float64(wp.float32(radii[0])))
        out[i, CELLS + j] = wp.max(out[i, CELLS + j], wp.float64(wp.float32(radii[1])))
        cell += 1
    out[i, 2 * CELLS] = wp.where(image.reached, wp.float64(1.0), wp.float64(0.0))


def profiles(rng, device, faces, turn, rise, slack=0.0):
    """Return what `profile_kernel` says of faces (2 n, 3, 3) in frames whose z axis is the screw's, posed at random.

    Of each pair the second turns and rises, or the first does so the other way; so both have the same screw.
    """
    scene, ends, frames = ab.Scene(device), [], random_poses(rng, len(faces) // 2, 1.0)
    for k, face in enumerate(faces):
        whole = frames[k // 2]
        frame, moves = Rotation.from_quat(whole[3:]), (k % 2 == 1) == (k % 4 < 2)
        last = whole[:3] + frame.apply([0, 0, rise[k // 2]]), (frame * Rotation.from_euler("z", turn[k // 2])).as_quat()
        scene.add(ab.Model.from_arrays(face, [[0, 1, 2]], base_faces=1), whole)
        ends.append(np.concatenate(last) if moves else whole)
    query = ab.FirstContactQuery(scene, np.array(ends), np.arange(len(faces)).reshape(-1, 2))
    paths, pools = Paths(), query.batch.pools
    for name in ("axis", "angle", "anchor", "start", "travel"):
        setattr(paths, name, wp.zeros(len(faces), dtype=wp.float64 if name == "angle" else wp.vec3d, device=device))
    wp.launch(prepare_path_kernel, len(faces), [False, pools[2], query.ends, paths], device=device)
    return launch(profile_kernel, device, len(faces), slack, paths, *pools, columns=2 * N + 1)


def random_faces(rng, size, near):
    """Return faces (2 n, 3, 3) of a size some 1 from the z axis, or up to 6 sizes from it."""
    centre = np.zeros((2 * COUNT, 1, 3))
    centre[..., 0] = size * rng.uniform(0, 6, (2 * COUNT, 1)) if near else rng.uniform(0.8, 1.2, (2 * COUNT, 1))
    angle = rng.uniform(0, 2 * np.pi, 2 * COUNT)
    flat = centre + size * rng.normal(size=(2 * COUNT, 3, 3)) * rng.choice([1, 0.1], (2 * COUNT, 1, 3))
    return np.array([Rotation.from_euler("z", a).apply(face) for a, face in zip(angle, flat)])


def points_of(rng, faces):
    """Return points of faces, the same number in each, of their edges and corners too."""
    weights = rng.dirichlet(np.full(3, 0.5), (len(faces), SAMPLES)).astype(LONG)
    weights[:, :100, 0] = 0
    weights[:, 100] = [1, 0, 0]
    weights /= weights.sum(2, keepdims=True)
    return np.einsum("nsk,nkj->nsj", weights, faces.astype(LONG))


def check_inside(found, points, pitch):
    """Check that points (2 n, SAMPLES, 3) of the screw's frame are in the profiles; return how much wider these are."""
    x, y, z = np.moveaxis(points, -1, 0)
    # A's frame of angles starts at its y axis.
    u = z / pitch[:, None].astype(LONG) - (np.arctan2(y, x) - np.arctan2(LONG(1), LONG(0))) / (8 * np.arctan(LONG(1)))
    cell = np.floor(u * N).astype(int) % N
    r, rows = np.hypot(x, y), np.arange(len(points))[:, None]
    low, high = found[rows, cell], found[rows, N + cell]
    assert (low <= r).all() and (r <= high).all()
    return (r - low).min(1), (high - r).min(1)


SIZES = [(0.3, False), (0.05, False), (1e-3, False), (0.05, True), (0.3, True), (1e-3, True)]


@pytest.mark.skipif(not HAS_LONG, reason="no floating-point numbers longer than float64")
@pytest.mark.parametrize(("size", "near"), SIZES)
@pytest.mark.parametrize("slack", [0.0, 1e-4, 1e-2])
def test_points_are_in_the_profiles_of_their_faces(device, size, near, slack):
    """Off the screw by twice the slack too, along the radius, or where u changes most."""
    rng = np.random.default_rng(1)
    turn, rise = rng.uniform(0.5, 2.5, COUNT), rng.uniform(0.2, 2, COUNT) * rng.choice([-1, 1], COUNT)
    faces = random_faces(rng, size, near)
    found = profiles(rng, device, faces, turn, rise, slack)
    pitch = np.repeat(rise / turn * 2 * np.pi, 2)
    points = points_of(rng, faces)
    reached = found[:, -1] != 0
    assert reached.mean() > 0.3
    out = points * [1, 1, 0] / np.hypot(points[..., :1], points[..., 1:2])
    turns = np.cross([0, 0, 1], out) / (2 * np.pi * np.hypot(points[..., :1], points[..., 1:2]))
    steepest = turns - [0, 0, 1] / pitch[:, None, None]
    steepest /= np.sqrt((steepest**2).sum(-1, keepdims=True))
    for way in (0 * out, out, -out, steepest, -steepest):
        moved = points + (2 * slack * (1 - 1e-9)) * way
        check_inside(found[reached], moved[reached], pitch[reached])


@pytest.mark.skipif(not HAS_LONG, reason="no floating-point numbers longer than float64")
def test_cells_are_wider_by_what_angles_err_by(device):
    rng = np.random.default_rng(6)
    turn, rise = rng.uniform(0.5, 2.5, COUNT), rng.uniform(0.2, 2, COUNT) * rng.choice([-1, 1], COUNT)
    faces, pitch = random_faces(rng, 1e-8, False), np.repeat(rise / turn * 2 * np.pi, 2)
    x, y, z = faces.mean(1).T
    # Near the border of a cell.
    u = z / pitch - np.arctan2(-x, y) / (2 * np.pi)
    faces[..., 2] += (((rng.uniform(-2e-6, 2e-6, 2 * COUNT) - u) % (1 / N)) * pitch)[:, None]
    found = profiles(rng, device, faces, turn, rise)
    reached = found[:, -1] != 0
    assert reached.mean() > 0.9
    check_inside(found[reached], points_of(rng, faces)[reached], pitch[reached])


def test_faces_that_the_other_reaches_at_last_count(device):
    """They touch from above or below at one end of the motion, off the screw by twice the slack."""
    rng = np.random.default_rng(2)
    turn, rise = rng.uniform(0.5, 2.5, COUNT), rng.uniform(0.2, 2, COUNT) * rng.choice([-1, 1], COUNT)
    for slack in (0.0, 0.1):
        faces = random_faces(rng, 0.1, False)
        first, second = faces[0::2], faces[1::2]
        # Seen from the first the second rises so much, where it moves or else the first does.
        seen = rise * np.where(np.arange(COUNT) % 2 == 0, 1, -1)
        above, below = first[..., 2].min(1) - second[..., 2].max(1), first[..., 2].max(1) - second[..., 2].min(1)
        second[..., 2] += (np.where(seen > 0, above, below) - (seen + 2 * slack * np.sign(seen)) * (1 - 1e-9))[:, None]
        found = profiles(rng, device, faces, turn, rise, slack)
        assert (found[:, -1] != 0).all()
        second[..., 2] -= (np.sign(seen) * 0.01)[:, None]
        found = profiles(rng, device, faces, turn, rise, slack)
        assert (found[:, -1] == 0).all()


def thread(rng, radius, depth, pitch, length, more=0.0, segments=24, rings=(0, 0.3, 0.5, 0.8)):
    """Return the model of a thread about the z axis: a strip along a screw whose radius changes across it.

    Args:
        length: In pitches.
        more: By how much each corner is farther out.
    """
    steps, rings = np.arange(segments * length + 1), np.array(rings)
    turn = 2 * np.pi / segments * steps[:, None] + 0 * rings
    r = (radius + depth * np.abs(2 * rings - 1) + 0 * turn).ravel() + more
    z, turn = (pitch * (turn / (2 * np.pi) + rings)).ravel(), turn.ravel()
    wide = len(rings)
    i = (np.arange(len(steps) - 1)[:, None] * wide + np.arange(wide - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + wide], 1), np.stack([i + 1, i + wide + 1, i + wide], 1)])
    points = np.stack([r * np.cos(turn), r * np.sin(turn), z], 1)
    return ab.Model.from_arrays(points, rng.permutation(faces), base_faces=4)


def nested_threads(rng, gap, length, burr=0.0, count=8, least=1, short_nut=True, fraction=1.0):
    """Return cases of nuts and bolts, a gap in radius apart, one turned on the other by up to 170 degrees.

    Args:
        length: Of the shorter, in pitches.
        burr: By how much a corner of the longer is towards the shorter, up to 120 degrees ahead of that.
        least: Degrees of the turns.
        short_nut: Whether the nut is the shorter, else the bolt.
        fraction: Of the faces, at which LOD they are.
    """
    cases, ends = [], []
    radii, way = ((1.0, 1.0 + gap), burr) if short_nut else ((1.0 + gap, 1.0), -burr)
    for k in range(count):
        sign, pitch, depth = rng.choice([-1, 1]), rng.uniform(0.2, 0.4), rng.uniform(0.1, 0.3)
        corner = 4 * (24 * (3 + length) + rng.integers(1, 9)) + rng.integers(4)
        long = thread(rng, radii[0], depth, sign * pitch, 10, way * (np.arange(964) == corner))
        short = thread(rng, radii[1], depth, sign * pitch, length)
        whole, turn = random_poses(rng, 1, 1.0)[0], np.deg2rad(rng.uniform(least, 170))
        frame, start = Rotation.from_quat(whole[3:]), 6 * np.pi + (rng.uniform(0, 2 * np.pi) if not burr else 0)
        moves = [
            [*(frame.apply([0, 0, sign * pitch * a / (2 * np.pi)]) + whole[:3])]
            + [*(frame * Rotation.from_euler("z", a)).as_quat()]
            for a in (start, start + turn)
        ]
        both = [
            [long, long.lod_for(fraction=fraction), whole],
            [short, short.lod_for(fraction=fraction), np.array(moves[0])],
        ]
        last = [whole, np.array(moves[1])]
        order = slice(None, None, 1 if k % 2 else -1)
        cases.append([x for rows in both[order] for x in rows])
        ends += last[order]
    return cases, np.array(ends)


@pytest.mark.parametrize("warps", [False, True])
def test_nested_threads_need_no_search(device, warps):
    if not warps and wp.get_device(device).is_cuda:
        pytest.skip("threads take pairs on the CPU alone")
    rng = np.random.default_rng(3)
    cases, ends = nested_threads(rng, 0.08, 4)
    with testing.regime(warps=warps):
        result = find(device, cases, ends)
        still = scene_of(device, cases).intersect(pairs_of(cases))
    assert result.clear.all()
    # What is counted is the test of the start.
    assert (result.triangle_tests == still.triangle_tests).all()


@pytest.mark.parametrize("fraction", [1.0, 0.9])
def test_nested_threads_that_meet_are_never_late(device, fraction):
    rng = np.random.default_rng(4)
    cases, ends = nested_threads(rng, 0.05, 1, burr=0.1, count=16, fraction=fraction)
    result = find(device, cases, ends)
    assert not result.undecided.any() and (result.time > 0).all() and 3 < result.clear.sum() < 13
    starts = np.array([pose for case in cases for pose in (case[2], case[5])])
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    for part in np.linspace(0, 1, 65):
        times = np.repeat(part * result.time, 2)
        scene.set_poses(np.array([pose_between(*row) for row in zip(starts, ends, times)]))
        assert not scene.intersect(pairs).any.any(), part


@pytest.mark.parametrize("short_nut", [True, False])
def test_burrs_of_either_are_met(device, short_nut):
    """Half of them are A's, where a cell has plain faces too: no nut is over those of a bolt alone, nor under."""
    for burr in (0.0, 0.2):
        cases, ends = nested_threads(np.random.default_rng(5), 0.08, 4, burr, least=150, short_nut=short_nut)
        result = find(device, cases, ends)
        assert (result.clear == (burr == 0)).all() and (result.time > 0).all() and not result.undecided.any()
