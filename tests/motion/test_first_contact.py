"""First contacts, on screws too: never late and hardly early, against dense sampling, other proofs, and fractions."""

from fractions import Fraction

import numpy as np
import pytest
from helpers import refused
from helpers.motions import ANSWERS, STILL, find, random_motions, to_bytes
from helpers.questions import captured, in_a_row, pairs_of, scene_of, starts_of
from helpers.samples import model_of_faces, random_poses, sample
from helpers.scenes import scene_with
from oracles.motion import pose_between, translation_contact
from scipy.spatial.transform import Rotation

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.motion import group


def meets(scene, cases, ends, times):
    """Return which pairs intersect at times, each pair at its own, exactly for the poses there."""
    times = np.repeat(np.broadcast_to(times, len(cases)), 2)
    scene.set_poses(np.array([pose_between(*row) for row in zip(starts_of(cases), ends, times)]))
    return scene.intersect(pairs_of(cases)).any


@pytest.mark.parametrize("tolerance", [1e-6, 1e-3])
def test_never_late_and_early_by_the_tolerance(device, tolerance):
    cases, ends = random_motions(np.random.default_rng(1), 160)
    scene = scene_of(device, cases)
    result = scene.first_contact(pairs_of(cases), ends, tolerance=tolerance)
    time = result.time
    assert not result.undecided.any()
    np.testing.assert_array_equal(meets(scene, cases, ends, 0.0), (time == 0))
    assert 5 < (time == 0).sum() < 100 and 20 < result.clear.sum() < 120
    np.testing.assert_array_equal(time[result.clear], 1.0)
    touching = ~result.clear & (time > 0)
    assert touching.sum() > 20
    # Nothing meets before, up to the time itself; all that is decided does after the tolerance.
    for part in (*np.linspace(0.02, 0.98, 25), 1 - 1e-3, 1 - 1e-6, 1.0):
        assert not meets(scene, cases, ends, part * time)[time > 0].any()
    np.testing.assert_array_equal(meets(scene, cases, ends, np.minimum(time + tolerance, 1))[touching], True)


@pytest.mark.parametrize("far", [1, 2**14])
def test_translations_against_fractions(device, far):
    """Small soups that pass each other near the middle of their way, which is long or not."""
    rng = np.random.default_rng(3)
    cases, ends, truths = [], [], []
    while len(cases) < 30:
        # Faces on a grid of 2^-10, in general position.
        a, b = (np.round(300 * (rng.normal(size=(4, 1, 3)) + rng.normal(size=(4, 3, 3)))) / 1024 for _ in range(2))
        way, off = (np.round(1024 * rng.normal(size=3)) / 1024 for _ in range(2))
        start, end = off - far * way, off + 2 * far * way
        still, pose = STILL, np.concatenate([start, STILL[3:]])
        models = [model_of_faces(soup, base_faces=4) for soup in (a, b)]
        cases.append([models[0], models[0].lod_max, still, models[1], models[1].lod_max, pose])
        ends += [still, np.concatenate([end, STILL[3:]])]
        truths.append(translation_contact(a, b + start, end - start))
    result, tolerance = find(device, cases, np.array(ends)), Fraction(1e-6)
    met = scene_of(device, cases).intersect(pairs_of(cases)).any
    assert sum(truth is not None for truth in truths) > 10 and not result.undecided.any()
    for truth, hit, time, clear in zip(truths, met, result.time.tolist(), result.clear, strict=True):
        if hit:
            assert time == 0
        else:
            assert clear == (truth is None)
            assert truth is None or truth - tolerance <= Fraction(time) <= truth


def test_order_of_objects_and_of_pairs_changes_nothing(device):
    rng = np.random.default_rng(5)
    cases, ends = random_motions(rng, 40)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    first = scene.first_contact(pairs, ends)
    assert to_bytes(scene.first_contact(pairs[:, ::-1], ends)) == to_bytes(first)
    order = rng.permutation(40)
    mixed = scene.first_contact(pairs[order], ends)
    for name in ANSWERS:
        np.testing.assert_array_equal(getattr(mixed, name), getattr(first, name)[order])


@pytest.mark.parametrize("linear", [False, True])
def test_regimes_agree(device, linear):
    cases, ends = random_motions(np.random.default_rng(6), 40, faces=500)
    first = to_bytes(find(device, cases, ends, linear=linear))
    for warps, length in ((True, None), (True, 129), (None, 200)):
        with testing.regime(warps=warps, stack_length=length, cpu_threads=1 if length else 2):
            assert to_bytes(find(device, cases, ends, linear=linear)) == first


def test_warps_that_take_a_group_of_pairs_agree(device):
    cases, ends = random_motions(np.random.default_rng(8), 65, faces=30)
    pairs = np.array([(i, j) for j in range(len(ends)) for i in range(j)])
    assert len(pairs) > int(group.GROUPED_LEAST) and len(pairs) % int(group.GROUP)
    found = []
    for warps in (None, True):
        with testing.regime(warps=warps):
            found.append(scene_of(device, cases).first_contact(pairs, ends))
    few = scene_of(device, cases).first_contact(pairs[:1000], ends)
    assert to_bytes(found[0]) == to_bytes(found[1])
    np.testing.assert_array_equal(found[1].time[:1000], few.time)


def test_screws_end_where_they_should_and_keep_their_distance_from_the_axis(device):
    """A ball on a screw about z, beside a post there: touches if and only if it is as near as that."""
    post, ball = sample("one"), sample("small ball")
    reach = np.linalg.norm(ball.mesh_at(ball.lod_max)[0], axis=1).max()
    vertices = post.mesh_at(post.lod_max)[0]
    middle = vertices.mean(0)
    radius = np.linalg.norm(vertices - middle, axis=1).max() + 1.05 * reach
    half = np.deg2rad(80)
    scene = scene_with(device, (post, (*-middle, 0, 0, 0, 1)), (ball, (radius, 0, -0.1, 0, 0, 0, 1)))
    way = [radius * np.cos(2 * half), radius * np.sin(2 * half), 0.1, 0, 0, np.sin(half), np.cos(half)]
    ends = [[*-middle, 0, 0, 0, 1], way]
    straight, screw = (scene.first_contact([(0, 1)], ends, screw=screw) for screw in (False, True))
    assert screw.clear.all() and not straight.clear.any() and not straight.undecided.any()


@pytest.mark.parametrize("path", [{}, {"screw": True}, {"linear": True}], ids=["straight", "screw", "linear"])
def test_the_broad_phase_finds_all_that_touch(device, path):
    rng = np.random.default_rng(11)
    scene, count = ab.Scene(device), 40
    starts, ends = (random_poses(rng, count, 12.0) for _ in range(2))
    for i, pose in enumerate(starts):
        scene.add(sample("capsule"), pose, world=i % 2, lod=sample("capsule").lod_for(fraction=0.1))
    found = scene.first_contact(None, ends, **path)
    assert 0 < (~found.clear).sum() < len(found.pairs) < count * (count - 2) / 4
    np.testing.assert_array_equal(found.pairs, np.unique(found.pairs, axis=0))
    every = np.array([(i, j) for i in range(count) for j in range(i + 2, count, 2)])
    whole = scene.first_contact(every, ends, **path)
    times = [dict(zip(map(tuple, r.pairs[~r.clear].tolist()), r.time[~r.clear].tolist())) for r in (found, whole)]
    assert times[0] == times[1]


def test_calls_that_repeat_and_graphs_follow_what_is_asked(device):
    """On a GPU they are a graph after a few; tolerance, screws and end poses still count; of graphs end poses too."""
    cases, ends = random_motions(np.random.default_rng(9), 40)
    scene, pairs, seen = scene_of(device, cases), pairs_of(cases), set()
    others = np.roll(ends.reshape(-1, 2, 7), 1, axis=0).reshape(-1, 7)
    for options in ({}, {"tolerance": 1e-2}, {"screw": True}):
        for k in range(7):
            asked = ends if k < 5 else others
            found = scene.first_contact(pairs, asked, **options)
            fresh = ab.FirstContactQuery(scene, asked, pairs, **options).run()
            assert to_bytes(found) == to_bytes(fresh)
            seen.add(found.time.tobytes())
    assert len(seen) == 6, "options change nothing"
    query = ab.FirstContactQuery(scene, ends, pairs)
    first = query.run()
    replay = captured(query)
    query.set_end_poses(starts_of(cases))
    replay()
    assert query.result().clear[first.time > 0].all()
    query.set_end_poses(ends)
    replay()
    assert to_bytes(query.result()) == to_bytes(first)
    on_device = query.result(device=True)
    assert [getattr(on_device, name).numpy().tobytes() for name in ANSWERS] == to_bytes(first)


def test_bad_input(device):
    scene = in_a_row(device, "box", (0, 3))
    ends = np.array([STILL, STILL])
    for tolerance in (0, 1, -1, np.nan, "a", 2.0**-41, [1e-6]):
        refused(ValueError, "tolerance", scene.first_contact, [(0, 1)], ends, tolerance=tolerance)
    for bad, message in (
        (ends[:1], "1 given for 2"),
        (ends[0], "shape"),
        (ends * np.nan, "not finite"),
        (ends * 2, "norm"),
        (np.array([STILL, [0, 0, 0, 0, 0, 1, 0]]), "half a revolution"),
        (np.array([STILL, [0, 0, 0, 0, 1, 0, 1e-8]]), "half a revolution"),
    ):
        refused(ValueError, message, scene.first_contact, [(0, 1)], bad)
    half = np.array([STILL, [3, 0, 0, 0, 0, 1, 0]])
    assert scene.first_contact([(0, 1)], half, linear=True).clear.all(), "a straight way has no turn"
    refused(ValueError, "one kind of path", scene.first_contact, [(0, 1)], ends, linear=True, screw=True)
    refused(ValueError, None, scene.first_contact, [(0, 2)], ends)
    assert scene.first_contact([(0, 1)], np.array([STILL, [3, 0, 0, 0, 0, 1, 1e-5]])).clear.all()
    assert len(scene.first_contact(np.empty((0, 2), int), ends).time) == 0


@pytest.mark.parametrize("path", [{}, {"screw": True}, {"linear": True}], ids=["straight", "screw", "linear"])
def test_sweeps(device, path):
    rng = np.random.default_rng(12)
    a, b = sample("torus"), sample("capsule")
    starts, ends = (random_poses(rng, 1500, 3.0) for _ in range(2))
    options = {"output": "first_contact", "tolerance": 1e-3, "lod_a": a.lod_for(fraction=0.1), "device": device, **path}
    rows = ab.sweep(a, b, starts, end_poses=ends, **options)
    scene = scene_with(device, (a, STILL, {"lod": options["lod_a"]}), *[(b, pose) for pose in starts[:100]])
    pairs = np.stack([np.zeros(100, int), np.arange(1, 101)], 1)
    result = scene.first_contact(pairs, [STILL, *ends[:100]], tolerance=1e-3, **path)
    for name in ANSWERS:
        np.testing.assert_array_equal(rows[name][:100], getattr(result, name))
    for bad, error, message in (
        ({"end_poses": ends[:3]}, ValueError, "3 given for 1500"),
        ({"end_poses": np.where(np.arange(1500)[:, None] == 7, np.nan, ends)}, ValueError, "end_poses: pose 7"),
        ({}, TypeError, "end_poses"),
        ({"end_poses": ends, "beyond": 1.0}, ValueError, "beyond"),
        ({"end_poses": ends, "tolerance": 2}, ValueError, "tolerance"),
    ):
        refused(error, message, ab.sweep, a, b, starts, **{**options, **bad})
    if not path:
        apart = np.tile([9.0, 0, 0, 0, 0, 0, 1], (70_000, 1))
        ends = apart.copy()
        ends[69_000] = [9, 0, 0, 0, 0, 1, 0]
        refused(ValueError, "pose 69000 turns by half", ab.sweep, a, b, apart, end_poses=ends, **options)
    assert len(ab.sweep(a, b, np.empty((0, 7)), end_poses=np.empty((0, 7)), **options)) == 0


def test_margins_cover_the_rounding_of_boxes(device):
    """Flat faces meet head on, soon: nothing but margins keeps the boxes from being late."""
    rng = np.random.default_rng(13)
    cube = sample("box").mesh_at(sample("box").lod_max)
    cases, ends, truths = [], [], []
    for _ in range(400):
        axis, models, boxes = rng.integers(3), [], []
        for _ in range(2):
            low, size = rng.normal(size=3), rng.uniform(0.5, 1.5, 3)
            corners = low + (cube[0] - cube[0].min(0)) / np.ptp(cube[0], axis=0) * size
            models.append(ab.Model.from_arrays(corners, cube[1], base_faces=len(cube[1])))
            boxes.append((corners.min(0), corners.max(0)))
        pose = STILL.copy()
        pose[:3] = boxes[0][0] - boxes[1][0]
        pose[axis] = boxes[0][1][axis] - boxes[1][0][axis] + 10 ** rng.uniform(-5, -2)
        end = pose.copy()
        end[axis] -= rng.uniform(0.2, 0.4)
        near = Fraction(boxes[0][1][axis]) - Fraction(boxes[1][0][axis])
        truths.append((Fraction(pose[axis]) - near) / (Fraction(pose[axis]) - Fraction(end[axis])))
        cases.append([models[0], models[0].lod_max, STILL, models[1], models[1].lod_max, pose])
        ends += [STILL, end]
    result = find(device, cases, np.array(ends))
    late = [float(Fraction(time) - truth) for time, truth in zip(result.time.tolist(), truths)]
    assert -1e-6 <= min(late) and max(late) <= 0 and not result.undecided.any()


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
    scene = scene_of(device, cases)
    assert not result.undecided.any() and 10 < result.clear.sum() < COUNT - 10
    for part in np.linspace(0, 1, TIMES):
        assert not meets(scene, cases, ends, part * result.time)[result.time > 0].any(), part
