"""Distances of object pairs: against brute force, the exact test, and what must not change an answer."""

import itertools

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.questions import in_a_row, pairs_of, random_case, random_lod, scene_of
from helpers.samples import SHAPES, contact_poses, random_poses, sample
from oracles.distance import mesh_distance
from oracles.triangle import quaternion_matrix, triangles_intersect

import warp_abtree as ab
from warp_abtree import testing

NAMES = ("box", "small ball", "crumbs", "soup", "torus", "three", "capsule", "one", "lattice soup", "twins")
ANSWERS = ("distance", "bracket", "points", "point_faces")
FACES = 60


def make_cases(rng, pairs, faces=FACES, away=0.7):
    """Return cases of pairs of samples in contact or moved apart."""
    cases = [random_case(rng, names, faces) for names in pairs]
    for case in cases:
        direction = rng.normal(size=3)
        case[5][:3] += (2 * rng.random()) * direction / np.linalg.norm(direction) * (rng.random() < away)
    return cases


def to_bytes(result, names=ANSWERS):
    return [np.asarray(getattr(result, name)).tobytes() for name in names]


def true_distances(cases, met):
    return np.array([0.0 if hit else mesh_distance(*case) for hit, case in zip(met, cases, strict=True)])


def check_points(result, cases):
    """The points lie on the faces that are named, active ones, as far apart as is said."""
    between = np.linalg.norm(result.points[:, 0] - result.points[:, 1], axis=1)
    np.testing.assert_allclose(between, np.where(result.any, 0, result.distance), rtol=0, atol=1e-13)
    for row, faces, case in zip(result.points, result.point_faces, cases, strict=True):
        for point, face, (model, lod, pose) in zip(row, faces, (case[:3], case[3:]), strict=True):
            vertices, corners, ids = model.mesh_at(lod)
            (at,) = np.flatnonzero(ids == face)
            posed = vertices[corners[at]] @ quaternion_matrix(pose[3:]).T + pose[:3]
            weights = np.linalg.lstsq(np.vstack([posed.T, np.ones(3)]), np.append(point, 1), rcond=None)[0]
            assert weights.min() > -1e-9
            np.testing.assert_allclose(weights @ posed, point, rtol=0, atol=1e-12)


def test_equals_brute_force(device):
    rng = np.random.default_rng(1)
    cases = make_cases(rng, [tuple(rng.choice(NAMES, 2)) for _ in range(120)])
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    result = scene.intersect(pairs, "distance")
    np.testing.assert_array_equal(result.any, scene.intersect(pairs).any)
    np.testing.assert_array_equal(result.distance == 0, result.any)
    assert 20 < result.any.sum() < 100
    truth = true_distances(cases, result.any)
    np.testing.assert_allclose(result.distance, truth, rtol=1e-13, atol=1e-14)
    lower, upper = result.bracket.T
    assert (lower <= truth).all() and (truth <= upper).all()
    assert (lower <= result.distance).all() and (result.distance <= upper).all()
    assert (upper - lower <= 1e-12).all() and np.median((upper - lower)[truth > 0.1] / truth[truth > 0.1]) < 1e-12
    check_points(result, cases)
    apart = scene.intersect(pairs, within=lower * (1 - 1e-9)).apart
    np.testing.assert_array_equal(apart, ~result.any)


def test_order_of_objects_mirrors_the_answer(device):
    rng = np.random.default_rng(2)
    cases = make_cases(rng, [("torus", "soup"), ("box", "crumbs")] * 15)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    one, other = (scene.intersect(p, "distance") for p in (pairs, pairs[:, ::-1]))
    assert to_bytes(one, ["distance", "bracket"]) == to_bytes(other, ["distance", "bracket"])
    np.testing.assert_array_equal(one.points, other.points[:, ::-1])
    np.testing.assert_array_equal(one.point_faces, other.point_faces[:, ::-1])
    # Objects the other way round are compared in the other one's frame: within the brackets.
    turned = scene_of(device, [(*case[3:], *case[:3]) for case in cases]).intersect(pairs, "distance")
    assert (turned.bracket[:, 0] <= one.bracket[:, 1]).all() and (one.bracket[:, 0] <= turned.bracket[:, 1]).all()
    np.testing.assert_allclose(turned.distance, one.distance, rtol=0, atol=1e-13)


def test_common_motion_stays_within_brackets(device):
    rng = np.random.default_rng(3)
    cases = make_cases(rng, [("torus", "capsule")] * 30)
    first = scene_of(device, cases).intersect(pairs_of(cases), "distance")
    for move in random_poses(rng, 4, 3.0):
        moved = []
        for model_a, lod_a, pose_a, model_b, lod_b, pose_b in cases:
            poses = []
            for pose in (pose_a, pose_b):
                matrix = np.eye(4)
                matrix[:3, :3] = quaternion_matrix(move[3:]) @ quaternion_matrix(pose[3:])
                matrix[:3, 3] = quaternion_matrix(move[3:]) @ pose[:3] + move[:3]
                poses.append(matrix)
            moved.append((model_a, lod_a, poses[0], model_b, lod_b, poses[1]))
        found = scene_of(device, moved).intersect(pairs_of(cases), "distance")
        assert (found.bracket[:, 0] <= first.bracket[:, 1] + 1e-14).all()
        assert (first.bracket[:, 0] <= found.bracket[:, 1] + 1e-14).all()


@pytest.mark.parametrize("exponent", [-60, 31])
def test_scaling_by_a_power_of_two_scales_the_answer(device, exponent):
    rng = np.random.default_rng(5)
    cases = make_cases(rng, [("soup", "small ball")] * 20)
    meshes = SHAPES["soup"](), SHAPES["small ball"]()
    a, b = (ab.Model.from_arrays(np.ldexp(points, exponent), faces, base_faces=4) for points, faces in meshes)
    by = np.array([2.0**exponent] * 3 + [1] * 4)
    scaled = [(a, i, by * p, b, j, by * q) for _, i, p, _, j, q in cases]
    one, other = (scene_of(device, some).intersect(pairs_of(cases), "distance") for some in (cases, scaled))
    np.testing.assert_array_equal(one.point_faces, other.point_faces)
    for name in ("distance", "bracket", "points"):
        np.testing.assert_array_equal(np.ldexp(getattr(one, name), exponent), getattr(other, name))


@pytest.mark.parametrize("far", [1e3, 1e9, 1e39, 1e200])
def test_far_pairs(device, far):
    scene = in_a_row(device, "box", (0, far, -far))
    result = scene.intersect([(0, 1), (1, 2), (2, 0)], "distance")
    np.testing.assert_allclose(result.distance, [far - 1, 2 * far - 1, far - 1], rtol=1e-13)
    lower, upper = result.bracket.T
    assert (lower <= result.distance).all() and (upper >= result.distance).all()
    assert (upper - lower <= 1e-12 * far).all()


def test_distances_beyond_float64(device):
    scene = in_a_row(device, "box", (1.7e308, -1.7e308))
    result = scene.intersect([(0, 1)], "distance")
    assert result.distance[0] == np.inf and result.bracket[0, 1] == np.inf and result.bracket[0, 0] > 1e300
    assert (result.point_faces == -1).all() and np.isnan(result.points).all()


def test_far_from_the_origin(device):
    """Coordinates far from their own origin, and objects far away: brackets grow in proportion and hold."""
    rng = np.random.default_rng(6)
    shift = np.array([1e6, -1e6, 3e5, 0, 0, 0, 0])
    vertices, faces, _ = sample("small ball").mesh_at(sample("small ball").lod_max)
    moved = ab.Model.from_arrays(vertices + shift[:3], faces, base_faces=4)
    cases = []
    for model in (sample("torus"), moved) * 10:
        a, b = (model, random_lod(rng, model, FACES)), (sample("soup"), 40)
        pose_a, pose_b = contact_poses(rng, *a, *b)
        pose_b[:3] += 3 * rng.normal(size=3)
        cases.append((*a, pose_a + shift, *b, pose_b + shift))
    result = scene_of(device, cases).intersect(pairs_of(cases), "distance")
    truth = true_distances(cases, result.any)
    lower, upper = result.bracket.T
    assert (lower <= truth + 1e-9).all() and (truth <= upper + 1e-9).all()
    assert (upper - lower < 1e-5).all() and (result.distance > 0.01).sum() > 5


TOLERANCES = [{"tolerance": 1e-3}, {"tolerance": 0.3}, {"relative": 1e-3}, {"relative": 0.5}]


def check_tolerance(exact, found, tolerances):
    lower, upper = found.bracket.T
    assert (lower <= exact.bracket[:, 1]).all() and (exact.bracket[:, 0] <= upper).all()
    asked = np.full(len(lower), tolerances.get("tolerance", 0.0)) + tolerances.get("relative", 0.0) * upper
    assert (upper - lower <= np.maximum(asked, 1e-12)).all()
    assert (lower <= found.distance).all() and (found.distance <= upper).all()
    np.testing.assert_array_equal(found.distance == 0, exact.any)


@pytest.mark.parametrize("tolerances", TOLERANCES)
def test_tolerance_is_the_width_of_the_bracket(device, tolerances):
    rng = np.random.default_rng(7)
    cases = make_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 20, faces=300)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    check_tolerance(scene.intersect(pairs, "distance"), scene.intersect(pairs, "distance", **tolerances), tolerances)
    fresh = [ab.DistanceQuery(scene, pairs, **options).run() for options in ({}, tolerances)]
    assert max(tolerances.values()) < 0.1 or fresh[1].node_tests.sum() < fresh[0].node_tests.sum()


@pytest.mark.parametrize("tolerances", TOLERANCES)
def test_many_pairs_within_a_tolerance(device, tolerances):
    """So many that warps search each roughly first: what bounds a distance then is not lost."""
    rng = np.random.default_rng(16)
    cases = make_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 20, faces=150)
    scene, pairs = scene_of(device, cases), np.tile(pairs_of(cases), (30, 1))
    exact = scene.intersect(pairs, "distance")
    with testing.regime(warps=True):
        check_tolerance(exact, ab.DistanceQuery(scene, pairs, **tolerances).run(), tolerances)
        beyond = exact.distance * rng.choice([1 - 1e-3, 1 - 1e-7, 1 + 1e-7, 1 + 1e-3], len(pairs))
        found = ab.DistanceQuery(scene, pairs, beyond=beyond, **tolerances).run()
    assert not np.isinf(found.distance[exact.bracket[:, 1] <= beyond]).any() and np.isinf(found.distance).any()
    near = ~np.isinf(found.distance)
    assert (found.bracket[near, 0] <= exact.bracket[near, 1]).all()
    assert (exact.bracket[:, 0] <= found.bracket[:, 1]).all()


def test_beyond_ends_a_pair_that_is_farther(device):
    rng = np.random.default_rng(8)
    cases = make_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 25)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    exact = scene.intersect(pairs, "distance")
    for beyond in (0.0, 0.25, 0.7 * exact.distance, exact.distance * (1 - 1e-11), exact.distance * (1 + 1e-11)):
        found = ab.DistanceQuery(scene, pairs, beyond=beyond).run()
        ended = exact.distance > np.broadcast_to(beyond, len(pairs))
        np.testing.assert_array_equal(np.isinf(found.distance), ended)
        assert 0 < ended.sum() or np.all(beyond >= exact.distance)
        np.testing.assert_array_equal(found.bracket[ended, 0], np.broadcast_to(beyond, len(pairs))[ended])
        assert (found.bracket[ended, 1] == np.inf).all() and (found.point_faces[ended] == -1).all()
        for name in ANSWERS:
            np.testing.assert_array_equal(getattr(found, name)[~ended], getattr(exact, name)[~ended])


def test_what_a_search_starts_from_changes_nothing(device):
    """Faces of other poses, of other LODs, some inactive now, and of other pairs."""
    rng = np.random.default_rng(9)
    cases = make_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 15, faces=300)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    query = ab.DistanceQuery(scene, pairs)
    query.run()
    for turn in range(4):
        poses = np.concatenate([[case[2], case[5]] for case in cases])
        poses[:, :3] += 0.3 * rng.normal(size=(len(poses), 3))
        scene.set_poses(poses)
        if turn % 2:
            lods = [random_lod(rng, model, 300) for case in cases for model in (case[0], case[3])]
            scene.set_lods(lods)
        found = query.run()
        fresh = ab.DistanceQuery(scene, pairs).run()
        assert to_bytes(found) == to_bytes(fresh)
    query.set_pairs(pairs[::-1])
    assert to_bytes(query.run()) == to_bytes(ab.DistanceQuery(scene, pairs[::-1]).run())


def test_equally_near_faces_give_the_lowest(device):
    """Flat sheets over one another, and closed boxes: very many pairs of faces are as near."""
    scene = ab.Scene(device)
    for name in ("grid", "box"):
        scene.add(sample(name))
        scene.add(sample(name), (0, 0, 2, 0, 0, 0, 1))
    for a, b in ((0, 1), (2, 3)):
        found = scene.intersect([(a, b), (b, a)], "distance")
        vertices, faces, _ = (model := scene.models[scene.object_model[a]]).mesh_at(model.lod_max)
        corners = vertices[faces]
        top, bottom = corners[..., 2].max(), corners[..., 2].min()
        over = np.array([flattened(t, top) for t in corners[(corners[..., 2] == top).any(1)]])
        under = np.array([flattened(t, bottom) for t in corners[(corners[..., 2] == bottom).any(1)]])
        ids = [np.flatnonzero((corners[..., 2] == level).any(1)) for level in (top, bottom)]
        near = [
            (int(ids[0][i]), int(ids[1][j]))
            for i, j in itertools.product(range(len(over)), range(len(under)))
            if triangles_intersect(over[i], under[j])
        ]
        assert len(near) > 1
        np.testing.assert_array_equal(found.point_faces, [min(near), min(near)[::-1]])


def flattened(corners, level):
    """Return what of a triangle lies at a height, as a triangle at height 0: itself, an edge or a corner."""
    kept = corners[corners[:, 2] == level] * [1, 1, 0]
    return np.concatenate([kept, kept[-1:].repeat(3 - len(kept), 0)])


def test_captured_graphs(device):
    query, _ = small_query(device)
    expected = to_bytes(query.result())
    with wp.ScopedCapture(query.device) as capture:
        query.launch()
    query.distances.distance.fill_(7.0)
    wp.capture_launch(capture.graph)
    assert to_bytes(query.result()) == expected


def small_query(device):
    rng = np.random.default_rng(10)
    cases = make_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 10)
    query = ab.DistanceQuery(scene_of(device, cases), pairs_of(cases))
    query.run()
    return query, cases


def test_results_on_the_device(device):
    query, _ = small_query(device)
    host, kept = query.result(), query.result(device=True)
    for name in ANSWERS:
        array = getattr(kept, name)
        assert isinstance(array, wp.array) and array.device == query.device
        np.testing.assert_array_equal(array.numpy(), getattr(host, name))


def test_no_pairs_and_the_broad_phase(device):
    scene = in_a_row(device, "box", (0, 0.5, 3))
    empty = scene.intersect(np.empty((0, 2), int), "distance")
    assert empty.distance.shape == (0,) and empty.bracket.shape == (0, 2)
    assert empty.points.shape == (0, 2, 3) and empty.point_faces.shape == (0, 2)
    found = scene.intersect(output="distance")
    np.testing.assert_array_equal(found.pairs, [[0, 1]])
    np.testing.assert_array_equal(ab.DistanceQuery(scene, capacity=ab.Buffers(pairs=1)).run().distance, [0])
    # Buffers grow, and shrink to fewer pairs.
    for pairs in ([(0, 1)], [(0, 1), (2, 1), (0, 2)], [(2, 0)]):
        np.testing.assert_allclose(
            scene.intersect(pairs, "distance").distance, [{1: 0, 3: 1.5, 2: 2}[i + j] for i, j in pairs], rtol=1e-15
        )


def test_sweeps(device):
    """Chunks of poses, answered as objects are."""
    rng = np.random.default_rng(13)
    a, b = sample("torus"), sample("capsule")
    poses = random_poses(rng, 1100, 2.5)
    asked = {"lod_a": a.lod_for(fraction=0.3), "lod_b": b.lod_for(fraction=0.3), "output": "distance", "device": device}
    found = ab.sweep(a, b, poses, **asked)
    some = rng.choice(len(poses), 40, replace=False)
    cases = [(a, asked["lod_a"], (0, 0, 0, 0, 0, 0, 1), b, asked["lod_b"], poses[i]) for i in some]
    expected = scene_of(device, cases).intersect(pairs_of(cases), "distance")
    for name, of_scene in zip(("distance", "bracket", "points", "faces"), ANSWERS):
        np.testing.assert_array_equal(found[name][some], getattr(expected, of_scene))
    ended = ab.sweep(a, b, poses, beyond=0.5, tolerance=1e-3, **asked)
    np.testing.assert_array_equal(np.isinf(ended["distance"]), found["distance"] > 0.5)
    kept = found["distance"] <= 0.5
    assert (ended["bracket"][kept, 1] - ended["bracket"][kept, 0]).max() < 1.001e-3
    assert ab.sweep(a, b, np.empty((0, 7)), **asked)["points"].shape == (0, 2, 3)
    for options, error in (
        ({"beyond": -1}, ValueError),
        ({"tolerance": np.nan}, ValueError),
        ({"within": 1}, ValueError),
    ):
        refused(error, next(iter(options)), ab.sweep, a, b, poses, **asked, **options)
    refused(ValueError, "beyond means nothing", ab.sweep, a, b, poses, device=device, beyond=1.0)


def test_bad_input(device):
    scene = in_a_row(device, "box", (0, 3))
    pairs = [(0, 1)]
    bad = [{"tolerance": value} for value in (-1, np.nan, np.inf, "x", [1.0])]
    bad += [{"relative": value} for value in (-1e-3, 1.0, np.nan)]
    bad += [{"beyond": value} for value in (-1, np.nan, np.inf, [1.0, 2.0])]
    for options in bad:
        for ask in (
            lambda options=options: scene.intersect(pairs, "distance", **options),
            lambda options=options: ab.DistanceQuery(scene, pairs, **options),
        ):
            refused(ValueError, next(iter(options)), ask)
    refused(ValueError, "within means nothing", scene.intersect, pairs, "distance", within=1.0)
    refused(ValueError, "beyond means nothing", scene.intersect, pairs, "any", beyond=1.0)
    refused(ValueError, "precision", scene.intersect, pairs, "distance", precision="float32")
    refused(ValueError, "DistanceQuery", ab.Query, scene, "distance")
    assert scene.intersect(pairs, "distance").distance[0] == 2


def test_frames_off_orthonormal(device):
    """Rotations off by nearly what scenes refuse: distances of the posed meshes stay within their brackets."""
    rng = np.random.default_rng(12)
    box = sample("box")
    vertices = box.mesh_at(box.lod_max)[0]
    for _ in range(20):
        matrices = []
        for place in ([0.0, 0, 0], [4.0, 0.3, -0.2]):
            matrix = np.eye(4)
            matrix[:3, :3] = quaternion_matrix(random_poses(rng, 1, 1)[0, 3:]) + rng.uniform(-2e-7, 2e-7, (3, 3))
            matrix[:3, 3] = place
            matrices.append(matrix)
        scene = ab.Scene(device)
        for matrix in matrices:
            scene.add(box, matrix)
        lower, upper = scene.intersect([(0, 1)], "distance").bracket[0]
        posed = [ab.Model.from_arrays(vertices @ m[:3, :3].T + m[:3, 3], box.mesh_at(box.lod_max)[1]) for m in matrices]
        still = scene_of(device, [(posed[0], None, (0, 0, 0, 0, 0, 0, 1), posed[1], None, (0, 0, 0, 0, 0, 0, 1))])
        truth = still.intersect([(0, 1)], "distance").distance[0]
        assert lower - 1e-14 <= truth <= upper + 1e-14
        assert upper - lower < 1e-4


@pytest.mark.slow
def test_regimes_agree(device):
    rng = np.random.default_rng(11)
    cases = make_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 15, faces=400)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    expected = ab.DistanceQuery(scene, pairs).run()
    for warps, length in itertools.product((True,) if scene.device.is_cuda else (False, True), (None, 140)):
        with testing.regime(warps=warps, stack_length=length, cpu_threads=1 if length else 4):
            assert to_bytes(ab.DistanceQuery(scene, pairs).run()) == to_bytes(expected)
