"""Distances of object pairs: against brute force, the exact test, what must not change an answer, and by graphs."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers import refused
from helpers.questions import (
    captured,
    check_brackets,
    check_points,
    far_cases,
    in_a_row,
    launch,
    pairs_of,
    parted_cases,
    random_case,
    scale_cases,
    scene_of,
    starts_of,
    to_bytes,
    to_matrix,
    true_distances,
)
from helpers.samples import STILL, corners_of, grid, model_of_faces, random_poses, sample
from helpers.scenes import scene_with
from oracles.triangle import quaternion_matrix, triangles_intersect

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.distance.frame import is_active

NAMES = ("box", "small ball", "crumbs", "soup", "torus", "three", "capsule", "one", "lattice soup", "twins")
ANSWERS = ("distance", "bracket", "points", "point_faces")


def test_equals_brute_force_in_either_order(device):
    rng = np.random.default_rng(1)
    cases = parted_cases(rng, [tuple(rng.choice(NAMES, 2)) for _ in range(120)])
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    result = scene.intersect(pairs, "distance")
    np.testing.assert_array_equal(result.any, scene.intersect(pairs).any)
    np.testing.assert_array_equal(result.distance == 0, result.any)
    assert 20 < result.any.sum() < 100
    truth = true_distances(scene, cases)
    np.testing.assert_allclose(result.distance, truth, rtol=1e-13, atol=1e-14)
    lower, upper = result.bracket.T
    assert (lower <= truth).all() and (truth <= upper).all()
    assert (lower <= result.distance).all() and (result.distance <= upper).all()
    assert (upper - lower <= 1e-12).all() and np.median((upper - lower)[truth > 0.1] / truth[truth > 0.1]) < 1e-12
    between = np.linalg.norm(result.points[:, 0] - result.points[:, 1], axis=1)
    np.testing.assert_allclose(between, np.where(result.any, 0, result.distance), rtol=0, atol=1e-13)
    assert (result.point_faces >= 0).all()
    check_points(result, cases)
    apart = scene.intersect(pairs, within=lower * (1 - 1e-9)).apart
    np.testing.assert_array_equal(apart, ~result.any)

    other = scene.intersect(pairs[:, ::-1], "distance")
    assert to_bytes(result, ["distance", "bracket"]) == to_bytes(other, ["distance", "bracket"])
    for name in ("points", "point_faces", "gradient"):
        np.testing.assert_array_equal(getattr(result, name), getattr(other, name)[:, ::-1])
    # Objects the other way round are compared in the other one's frame: within the brackets.
    turned = scene_of(device, [(*case[3:], *case[:3]) for case in cases]).intersect(pairs, "distance")
    assert (turned.bracket[:, 0] <= upper).all() and (lower <= turned.bracket[:, 1]).all()
    np.testing.assert_allclose(turned.distance, result.distance, rtol=0, atol=1e-13)


@pytest.mark.parametrize("exponent", [-60, 31])
def test_scaling_by_a_power_of_two_scales_the_answer(device, exponent):
    cases = parted_cases(np.random.default_rng(5), [("soup", "small ball")] * 20)
    both = cases, scale_cases(cases, exponent)
    one, other = (scene_of(device, some).intersect(pairs_of(cases), "distance") for some in both)
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
    cases = far_cases(np.random.default_rng(6), 1e6)
    scene = scene_of(device, cases)
    result = scene.intersect(pairs_of(cases), "distance")
    truth = true_distances(scene, cases)
    lower, upper = result.bracket.T
    assert (lower <= truth + 1e-9).all() and (truth <= upper + 1e-9).all()
    assert (upper - lower < 1e-5).all() and (result.distance > 0.01).sum() > 5


TOLERANCES = [{"tolerance": 1e-3}, {"tolerance": 0.3}, {"relative": 1e-3}, {"relative": 0.5}]


@pytest.mark.parametrize("tolerances", TOLERANCES)
def test_tolerance_is_the_width_of_the_bracket(device, tolerances):
    cases = parted_cases(np.random.default_rng(7), [("torus", "ball"), ("soup", "capsule")] * 20, faces=300)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    truth = scene.intersect(pairs, "distance").distance
    check_brackets(scene.intersect(pairs, "distance", **tolerances), truth, **tolerances)
    fresh = [ab.DistanceQuery(scene, pairs, **options).run() for options in ({}, tolerances)]
    assert max(tolerances.values()) < 0.1 or fresh[1].node_tests.sum() < fresh[0].node_tests.sum()


@pytest.mark.parametrize("tolerances", TOLERANCES[1::2])
def test_many_pairs_within_a_tolerance(device, tolerances):
    """So many that warps search each roughly first: what bounds a distance then is not lost."""
    rng = np.random.default_rng(16)
    cases = parted_cases(rng, [("torus", "ball"), ("soup", "capsule")] * 20, faces=150)
    scene, pairs = scene_of(device, cases), np.tile(pairs_of(cases), (30, 1))
    exact = scene.intersect(pairs, "distance")
    with testing.regime(warps=True):
        check_brackets(ab.DistanceQuery(scene, pairs, **tolerances).run(), exact.distance, **tolerances)
        beyond = exact.distance * rng.choice([1 - 1e-3, 1 - 1e-7, 1 + 1e-7, 1 + 1e-3], len(pairs))
        found = ab.DistanceQuery(scene, pairs, beyond=beyond, **tolerances).run()
    assert not np.isinf(found.distance[exact.bracket[:, 1] <= beyond]).any() and np.isinf(found.distance).any()
    near = ~np.isinf(found.distance)
    assert (found.bracket[near, 0] <= exact.bracket[near, 1]).all()
    assert (exact.bracket[:, 0] <= found.bracket[:, 1]).all()


def test_beyond_ends_a_pair_that_is_farther(device):
    cases = parted_cases(np.random.default_rng(8), [("torus", "ball"), ("soup", "capsule")] * 25)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    exact = scene.intersect(pairs, "distance")
    for beyond in (0.0, 0.25, 0.7 * exact.distance, exact.distance * (1 - 1e-11), exact.distance * (1 + 1e-11)):
        found = ab.DistanceQuery(scene, pairs, beyond=beyond).run()
        check_brackets(found, exact.distance, beyond=beyond)
        ended = np.isinf(found.distance)
        assert ended.any() or np.all(beyond >= exact.distance)
        for name in ANSWERS:
            np.testing.assert_array_equal(getattr(found, name)[~ended], getattr(exact, name)[~ended])


def test_equally_near_faces_give_the_lowest(device):
    """Flat sheets over one another, and closed boxes: very many pairs of faces are as near."""
    models = ab.Model.from_arrays(*grid(5), base_faces=4), sample("box")
    scene = scene_with(device, *[(model, (0, 0, z, 0, 0, 0, 1)) for model in models for z in (0, 2)])
    for a, b in ((0, 1), (2, 3)):
        found = scene.intersect([(a, b), (b, a)], "distance")
        vertices, faces, _ = (model := scene.models[scene.object_model[a]]).mesh_at(model.lod_max)
        corners = vertices[faces]
        top, bottom = corners[..., 2].max(), corners[..., 2].min()
        over = np.array([flattened(t, top) for t in corners[(corners[..., 2] == top).any(1)]])
        under = np.array([flattened(t, bottom) for t in corners[(corners[..., 2] == bottom).any(1)]])
        ids = [np.flatnonzero((corners[..., 2] == level).any(1)) for level in (top, bottom)]
        all_pairs = itertools.product(zip(ids[0].tolist(), over), zip(ids[1].tolist(), under))
        near = [(i, j) for (i, one), (j, other) in all_pairs if triangles_intersect(one, other)]
        assert len(near) > 1
        np.testing.assert_array_equal(found.point_faces, [min(near), min(near)[::-1]])


def flattened(corners, level):
    """Return what of a triangle lies at a height, as a triangle at height 0: itself, an edge or a corner."""
    kept = corners[corners[:, 2] == level] * [1, 1, 0]
    return np.concatenate([kept, kept[-1:].repeat(3 - len(kept), 0)])


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
        expected = [{1: 0, 3: 1.5, 2: 2}[i + j] for i, j in pairs]
        np.testing.assert_allclose(scene.intersect(pairs, "distance").distance, expected, rtol=1e-15)


def test_sweeps(device):
    rng = np.random.default_rng(13)
    a, b = sample("torus"), sample("capsule")
    poses = random_poses(rng, 1100, 2.5)
    asked = {"lod_a": a.lod_for(fraction=0.3), "lod_b": b.lod_for(fraction=0.3), "output": "distance", "device": device}
    found = ab.sweep(a, b, poses, **asked)
    some = rng.choice(len(poses), 40, replace=False)
    cases = [(a, asked["lod_a"], STILL, b, asked["lod_b"], poses[i]) for i in some]
    expected = scene_of(device, cases).intersect(pairs_of(cases), "distance")
    for name, of_scene in zip(("distance", "bracket", "points", "faces"), ANSWERS):
        np.testing.assert_array_equal(found[name][some], getattr(expected, of_scene))
    ended = ab.sweep(a, b, poses, beyond=0.5, tolerance=1e-3, **asked)
    np.testing.assert_array_equal(np.isinf(ended["distance"]), found["distance"] > 0.5)
    kept = found["distance"] <= 0.5
    assert (ended["bracket"][kept, 1] - ended["bracket"][kept, 0]).max() < 1.001e-3
    assert ab.sweep(a, b, np.empty((0, 7)), **asked)["points"].shape == (0, 2, 3)
    for options in ({"beyond": -1}, {"tolerance": np.nan}, {"within": 1}):
        refused(ValueError, next(iter(options)), ab.sweep, a, b, poses, **asked, **options)
    for options in ({"beyond": 1.0}, {"originals": True}):
        refused(ValueError, f"{next(iter(options))} means nothing", ab.sweep, a, b, poses, device=device, **options)


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
    refused(ValueError, "originals means nothing for output 'any'", scene.intersect, pairs, originals=True)
    refused(ValueError, "precision", scene.intersect, pairs, "distance", precision="float32")
    refused(ValueError, "DistanceQuery", ab.Query, scene, "distance")
    assert scene.intersect(pairs, "distance").distance[0] == 2


@pytest.mark.parametrize("options", [{}, {"originals": True}, {"originals": True, "tolerance": 5.0}], ids=str)
def test_frames_off_orthonormal(device, options):
    """Rotations off by nearly what scenes refuse: brackets hold the distances of posed meshes, of LODs or originals."""
    rng, model = np.random.default_rng(8), sample("torus")
    scene, posed = ab.Scene(device), ab.Scene(device)
    vertices, faces, _ = model.mesh_at(model.lod_max)
    for i in range(20):
        skew = quaternion_matrix(random_poses(rng, 1, 1)[0, 3:]) + rng.uniform(-2e-7, 2e-7, (3, 3))
        place = np.array([3.0 * i, 0.3 * (i % 2), 0])
        scene.add(model, to_matrix(skew, place), lod=model.lod_for(fraction=0.3) if options else None)
        posed.add(ab.Model.from_arrays(vertices @ skew.T + place, faces))
    pairs = np.stack([np.arange(19), np.arange(1, 20)], 1)
    truth = posed.intersect(pairs, "distance").distance
    lower, upper = scene.intersect(pairs, "distance", **options).bracket.T
    assert (lower - 1e-14 <= truth).all() and (truth <= upper + 1e-14).all()
    assert "tolerance" in options or (upper - lower < 1e-4).all()


@pytest.mark.slow
def test_regimes_agree(device):
    cases = parted_cases(np.random.default_rng(11), [("torus", "ball"), ("soup", "capsule")] * 15, faces=400)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    expected = ab.DistanceQuery(scene, pairs).run()
    for warps, length in itertools.product((True,) if scene.device.is_cuda else (False, True), (None, 140)):
        with testing.regime(warps=warps, stack_length=length, cpu_threads=1 if length else 4):
            assert to_bytes(ab.DistanceQuery(scene, pairs).run()) == to_bytes(expected)


PAIRED = ("torus", "ball"), ("soup", "capsule"), ("twins", "lattice soup"), ("box", "crumbs")


def make_turns(rng, device, count):
    """Return a scene, and poses and pairs of a number of turns: many surfaces intersect, many faces are as near."""
    cases = [random_case(rng, names, 60) for names in PAIRED * 4]
    cases += [(sample(name), None, STILL) * 2 for name in ("box", "grid")] * 3
    start = starts_of(cases)
    turns = []
    for _ in range(count):
        poses = start.copy()
        poses[:-12, :3] += 0.3 * rng.normal(size=(len(poses) - 12, 3))
        # On a lattice, through one another or apart.
        poses[-12:, :3] = rng.integers(-4, 5, (12, 3)) / 8
        poses[-11::2, 2] += rng.choice([0, 2, 3], 6)
        pairs = rng.permutation(pairs_of(cases))
        turns.append((poses, np.where(rng.random(len(pairs))[:, None] < 0.5, pairs, pairs[:, ::-1])))
    return scene_of(device, cases), turns


def test_a_graph_answers_what_is_in_place(device, regime):
    """Captured before there was a launch; and calls one after the other, from the fourth on a graph on a GPU."""
    scene, turns = make_turns(np.random.default_rng(15), device, 8)
    met = []
    first, called = (ab.DistanceQuery(scene, turns[0][1][::-1]) for _ in range(2))
    replay = captured(first)
    for poses, pairs in turns:
        scene.set_poses(poses)
        expected = ab.DistanceQuery(scene, pairs).run()
        for query in (first, called):
            query.set_pairs(pairs)
        replay()
        assert to_bytes(first.result()) == to_bytes(expected)
        assert to_bytes(called.run()) == to_bytes(expected)
        met.append(expected.any.mean())
    assert 0.2 < np.mean(met) < 0.8
    scene.set_lods(np.maximum(scene.lods - np.arange(scene.object_count) % 5, 0))  # more states than there were
    replay()
    refused(RuntimeError, "captured before arrays that it uses were replaced", first.result)


@wp.kernel(module="unique")
def is_active_kernel(trees: Trees, active_out: wp.array(dtype=wp.int32)):
    """Tell of each face of state 0, and of some beyond its last."""
    active_out[wp.tid()] = wp.where(is_active(trees, 0, wp.tid()), 1, 0)


def test_far_moves_cost_no_more_than_a_fresh_search():
    """On the CPU, where the same tests are done each time: the last faces are no use at poses that are unrelated."""
    ring = ab.Model.load(trimesh.creation.torus(0.5, 0.2, 60, 40))
    rng = np.random.default_rng(3)
    poses = random_poses(rng, 200, 1.0)
    poses[:, :3] *= rng.uniform(1.1, 1.4, (200, 1)) / np.linalg.norm(poses[:, :3], axis=1)[:, None]
    poses[0, :3] = 0
    scene = scene_with("cpu", *[(ring, pose) for pose in poses])
    query = ab.DistanceQuery(scene, [(0, k) for k in range(1, 200)])
    apart = ~query.run().any
    scene.set_poses(np.concatenate([poses[:1], rng.permutation(poses[1:])]))
    moved = query.run().node_tests
    query.forget()
    fresh = query.run()
    apart &= ~fresh.any
    assert apart.sum() > 100 and moved[apart].sum() < 1.1 * fresh.node_tests[apart].sum()


def test_searches_never_start_from_faces_that_are_not_there(device):
    """Faces that a LOD lacks, of a ring about its frame's origin and of a ball there or beside it."""
    ring = ab.Model.load(trimesh.creation.torus(0.5, 0.1, major_sections=24, minor_sections=12))
    models, pairs, gone = (ring, model_of_faces(corners_of(sample("ball")) / 8)), np.arange(40).reshape(-1, 2), 0

    def lods_for(fractions):
        return [model.lod_for(fraction=fraction) for model, fraction in zip(models, fractions)]

    def present(lods):
        return [np.isin(np.arange(model.face_count), model.mesh_at(lod)[2]) for model, lod in zip(models, lods)]

    lods, scene = lods_for((0.3, 0.3)), ab.Scene(device)
    for offset in 0.1 * np.random.default_rng(1).normal(size=(20, 3)):
        for model, lod, place in zip(models, lods, (np.zeros(3), offset)):
            scene.add(model, (*place, 0, 0, 0, 1), lod=lod)
    query = ab.DistanceQuery(scene, pairs)
    active = launch(is_active_kernel, device, ring.face_count + 5, scene.batch().trees)
    np.testing.assert_array_equal(active, [*present(lods)[0], *[False] * 5])
    # The last faces of other LODs: some of these are gone.
    for fractions in ((1.0, 1.0), (0.3, 0.3), (1.0, 0.3), (0.3, 0.3), (0.05, 1.0), (0.3, 0.3)):
        found = query.run()
        lods = lods_for(fractions)
        scene.set_lods(np.tile(lods, 20))
        there = present(lods)
        gone += int((~there[0][found.point_faces[:, 0]] | ~there[1][found.point_faces[:, 1]]).sum())
        found, expected = query.run(), ab.DistanceQuery(scene, pairs).run()
        assert to_bytes(found) == to_bytes(expected)
    assert gone > 20
