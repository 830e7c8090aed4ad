"""Distances of points from a model and sides of closed ones, against fractions, integers and brute force."""

import gc
from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.samples import corners_of, model_of_faces, random_quaternions, sample
from helpers.solids import model_of, shell, turned, voxel_mesh
from oracles.distance import brute_distances, exact_distance_sq
from oracles.inside import parity
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.model.mesh import MeshError
from warp_abtree.scene import point_distance

NAMES = ("torus", "soup", "crumbs", "one", "twins")


def points_about(rng, corners, count):
    """Return points around and far from triangles, near them, and on their corners, edges and insides."""
    low, size = corners.min((0, 1)), np.ptp(corners, axis=(0, 1)).max()
    weights = rng.dirichlet((1, 1, 1), count) * (rng.random((count, 3)) < 0.7)
    weights[weights.sum(1) == 0, 0] = 1.0
    on = np.einsum("nk,nkx->nx", weights / weights.sum(1, keepdims=True), corners[rng.integers(0, len(corners), count)])
    near = on + rng.normal(size=on.shape) * size * 10.0 ** rng.uniform(-16, -1, (count, 1))
    around = low + size * rng.uniform(-0.5, 1.5, (count, 3))
    far = [scale * around[: count // 4] for scale in (1e6 * size, 2.0**298 / np.abs(around).max())]
    return np.concatenate([around, near, on, corners.reshape(-1, 3)[:count], *far])


@pytest.mark.parametrize(("name", "scale"), [*((name, 1.0) for name in NAMES), ("soup", 1e-6), ("crumbs", 1e6)])
def test_distances_equal_brute_force(device, name, scale):
    """At every part of the LODs; the nearest point lies on the face that is named, as far away."""
    rng, mesh = np.random.default_rng(3), sample(name).mesh_at(sample(name).lod_max)
    model = ab.Model.from_arrays(mesh[0] * scale + 3 * scale, mesh[1], base_faces=4)
    for lod in {0, model.lod_max // 2, model.lod_max}:
        vertices, faces, face_ids = model.mesh_at(lod)
        corners = vertices[faces]
        points = points_about(rng, corners, 24)
        found, nearest, face = ab.signed_distance(model, points, lod, device, signed=False, nearest=True)
        slack = 2.0**-44 * (np.abs(points).max(1) + 10 * scale)
        assert (np.abs(found - brute_distances(points, corners)) <= slack).all()
        assert (np.abs(np.linalg.norm(points - nearest, axis=1) - found) <= slack).all()
        row = {face: k for k, face in enumerate(face_ids.tolist())}
        on = corners[[row[k] for k in face.tolist()]]
        assert all(brute_distances(nearest[k : k + 1], on[k : k + 1]) <= slack[k] for k in range(len(points)))
    for k in rng.integers(0, len(points), 4):
        exact = exact_distance_sq([Fraction(x) for x in points[k].tolist()], corners)
        assert abs(Fraction(found[k]) - Fraction(float(exact) ** 0.5)) <= slack[k]


@pytest.mark.parametrize("kind", ["cube", "shell", "cells", "turned", "torus", "low torus"])
def test_sides_are_exact(device, kind):
    """Of points on the lattice too, in line with edges and corners, and next to a wall; faces may be wound any way."""
    rng = np.random.default_rng(7)
    if "torus" in kind:
        model = sample("torus")
        lod = model.lod_max if kind == "torus" else model.lod_max // 4
    else:
        cells = {"cube": [(0, 0, 0)], "shell": shell(4)}.get(kind, rng.integers(0, 4, (12, 3)))
        vertices, faces = voxel_mesh(cells, rng)
        model = model_of((vertices, turned(faces, rng.random(len(faces)) < 0.5) if kind == "turned" else faces))
        lod = model.lod_max
    corners = corners_of(model, lod)
    low, high = corners.min((0, 1)), corners.max((0, 1))
    size = (high - low).max()
    middles = np.floor(rng.uniform(low - 1, high + 1, (60, 3))) + rng.choice([0.5, 0.25, 0.0], (60, 3))
    wall = corners[rng.integers(0, len(corners), 60)].mean(1)
    wall += rng.normal(size=wall.shape) * size * 10.0 ** rng.uniform(-13, -3, (60, 1))
    points = np.concatenate([middles, wall, rng.uniform(low - 0.1 * size, high + 0.1 * size, (60, 3))])
    points = points[brute_distances(points, corners) > 1e-13 * size][:: 1 + len(corners) // 300]
    truth = np.array([parity(point, corners) for point in points])
    assert truth.any() and not truth.all()
    found = ab.signed_distance(model, points, lod, device)
    assert np.array_equal(found < 0, truth) and np.array_equal(ab.contains(model, points, lod, device), truth)
    np.testing.assert_array_equal(np.abs(found), ab.signed_distance(model, points, lod, device, signed=False))


def test_points_do_not_see_one_another(device, monkeypatch):
    """The same bits in any order, alone, and whatever the points of a thread."""
    rng, model = np.random.default_rng(1), sample("torus")
    points = np.concatenate([rng.uniform(-1, 1, (300, 3)), np.zeros((3, 3)), rng.uniform(-1e-3, 1e-3, (50, 3))])
    whole = ab.signed_distance(model, points, device=device, nearest=True)
    for run in (1, 7, 1000):
        monkeypatch.setattr(point_distance, "RUN", run)
        order = rng.permutation(len(points))
        for part, other in zip(whole, ab.signed_distance(model, points[order], device=device, nearest=True)):
            assert part[order].tobytes() == other.tobytes()
    for k in (0, 120, 301):
        assert ab.signed_distance(model, points[k : k + 1], device=device)[0] == whole[0][k]
    assert ab.signed_distance(model, np.empty((0, 3)), device=device).shape == (0,)
    assert ab.contains(model, np.float32([[0, 0, 0]]), device=device).dtype == bool


@pytest.mark.parametrize("within", [None, 0.1])
def test_warps_and_threads_have_the_same_bits(device, within):
    """Of a model at two LODs, and of a scene with solids and open objects, far from some of them."""
    rng, model = np.random.default_rng(5), sample("torus")
    points = np.concatenate([rng.uniform(-1.5, 1.5, (400, 3)), points_about(rng, corners_of(model), 30)])
    scene = ab.Scene(device)
    for k in range(5):
        scene.add(sample("small ball"), pose=(0.7 * k - 1.2, 0.1 * k, 0, 0, 0, 0, 1), solid=k % 2 == 0)
    flat, middle = model_of_faces([[0, 0, 0], [3, 0, 0], [0, 3, 0]]), [[1.0, 1, 0]]
    answers = []
    for warps in (True, False):
        with testing.regime(warps=warps):
            assert ab.signed_distance(flat, middle, device=device, signed=False) == 0.0
            lods = model.lod_max, model.lod_max // 4
            found = [ab.signed_distance(model, points, lod, device, nearest=True, within=within) for lod in lods]
            found.append(scene.signed_distance(points, nearest=True, within=within))
            answers.append([part.tobytes() for one in found for part in one])
    assert answers[0] == answers[1]


def check_within(whole, part, within):
    """A bounded answer (distance, ..., nearest, face) is the whole one up to the bound, and says nothing beyond."""
    near = np.abs(whole[0]) <= within
    assert near.any() and not near.all()
    for before, now in zip(whole, part):
        assert before[near].tobytes() == now[near].tobytes()
    np.testing.assert_array_equal(part[0][~near], np.where(whole[0][~near] < 0, -np.inf, np.inf))
    assert np.isnan(part[-2][~near]).all() and (part[-1][~near] == -1).all()


@pytest.mark.parametrize("within", [0.0, 0.03, 0.2])
def test_distances_end_at_a_bound(device, within):
    rng, model = np.random.default_rng(4), sample("torus")
    corners = corners_of(model)
    points = np.concatenate([rng.uniform(-1.2, 1.2, (400, 3)), corners[:9, 0]])
    for signed in (True, False):
        options = {"device": device, "signed": signed, "nearest": True}
        whole = ab.signed_distance(model, points, **options)
        check_within(whole, ab.signed_distance(model, points, **options, within=within), within)


def placed_objects(rng, device):
    """Return a scene of solids that overlap and are nested, surfaces, another world and a free place."""
    scene, turns = ab.Scene(device), random_quaternions(rng, 9)
    names = ("torus", "small ball", "soup", "torus", "small ball", "torus", "small ball", "twins", "torus")
    for k, (name, turn) in enumerate(zip(names, turns)):
        model = sample(name)
        place = np.zeros(3) if k in (1, 3) else rng.uniform(-1, 1, 3)
        lod = model.lod_max // (4 if k % 2 else 8)
        scene.add(model, (*place, *turn), (0, 0, 0, -1, 0, 7, 0, 0, 0)[k], lod, solid=name in ("torus", "small ball"))
    scene.remove(4)
    return scene


def test_scene_has_the_least_distance_of_its_objects(device):
    """Against brute force on posed corners, and parity; whichever objects, points and bound there are."""
    rng = np.random.default_rng(11)
    scene = placed_objects(rng, device)
    points = np.concatenate([rng.uniform(-2, 2, (60, 3)), rng.normal(scale=0.3, size=(60, 3))])
    truth = np.full((len(points), scene.object_count), np.inf)
    for i in (0, 1, 2, 3, 6, 7, 8):
        model, pose = scene.models[scene.object_model[i]], scene.poses[i]
        corners, turn = corners_of(model, int(scene.lods[i])), quaternion_matrix(pose[3:])
        truth[:, i] = brute_distances(points, corners @ turn.T + pose[:3])
        if scene.object_solid[i]:
            inside = [parity(point, corners) for point in (points - pose[:3]) @ turn]
            truth[:, i] *= np.where(inside, -1, 1)
    found = scene.signed_distance(points, nearest=True)
    least = truth.min(1)
    assert (least < 0).sum() > 10 and len(np.unique(found[1])) > 5
    np.testing.assert_allclose(found[0], least, atol=1e-13)
    np.testing.assert_allclose(truth[np.arange(len(points)), found[1]], least, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(points - found[2], axis=1), np.abs(least), atol=1e-13)
    surfaces = scene.signed_distance(points, signed=False)
    np.testing.assert_allclose(surfaces[0], np.abs(truth).min(1), atol=1e-13)
    order = rng.permutation(len(points))
    for part, other in zip(found, scene.signed_distance(points[order], nearest=True)):
        assert part[order].tobytes() == other.tobytes()
    bounded = scene.signed_distance(points, within=0.3, nearest=True)
    np.testing.assert_array_equal(bounded[1], np.where(bounded[0] == np.inf, -1, bounded[1]))
    shallow = least >= -0.3  # where solids overlap deeper, any of them may be named
    whole, part = ([part[shallow] for part in (rows[0], *rows[2:])] for rows in (found, bounded))
    check_within(whole, part, 0.3)
    assert (bounded[0][~shallow] == -np.inf).all() and (bounded[3][~shallow] == -1).all() and (~shallow).any()
    other = scene.signed_distance(points, world=7)[1]
    assert set(other) == {3, 5}


def test_scene_of_points_refuses(device):
    scene = ab.Scene(device)
    refused(ValueError, "no object in world 0", scene.signed_distance, np.zeros((1, 3)))
    scene.add(sample("small ball"), world=3)
    refused(ValueError, "no object in world 0", scene.signed_distance, np.zeros((1, 3)))
    refused(ValueError, "no object of world 3 is a solid", scene.signed_distance, np.zeros((1, 3)), world=3)
    refused(ValueError, "within: -1", scene.signed_distance, np.zeros((1, 3)), 3, False, -1)
    refused(ValueError, "points: one distance for all", scene.signed_distance, np.zeros((2, 3)), 3, False, [1, 1])
    refused(ValueError, "point 0 is not finite", scene.signed_distance, [[np.inf, 0, 0]], 3, False)
    assert scene.signed_distance([], 3, False, nearest=True)[2].shape == (0, 3)
    distance, object = scene.signed_distance(np.zeros((0, 3)), 3, False)
    assert distance.shape == object.shape == (0,)


def test_bad_points_and_models_are_refused(device):
    ball, still = sample("small ball"), np.zeros((2, 3))
    refused(ValueError, "points: shape", ab.signed_distance, ball, np.zeros(3), device=device)
    refused(ValueError, "points: shape", ab.contains, ball, np.zeros((2, 4)), device=device)
    refused(ValueError, "point 1 is not finite", ab.contains, ball, [[0, 0, 0], [0, np.nan, 0]], device=device)
    beyond = [[0, 0, 0], [0, 0, -1e160]]
    refused(ValueError, "point 1 has a coordinate beyond", ab.contains, ball, beyond, device=device)
    far = ab.signed_distance(ball, [[2.0**300, 0, -(2.0**299)], [0, 0, 1e80]], device=device)
    np.testing.assert_allclose(far, [np.hypot(2.0**300, 2.0**299), 1e80], rtol=1e-12)
    refused(ValueError, "LOD", ab.contains, ball, still, ball.lod_max + 1, device)
    refused(ValueError, "no device", ab.contains, ball, still, None, "cuda:99")
    refused(ValueError, "signed", ab.signed_distance, ball, still, signed=1)
    refused(TypeError, "not a Model", ab.contains, "ball.obj", still)
    refused(MeshError, "closed", ab.signed_distance, sample("soup"), still, device=device)


def test_points_of_a_gpu_stay_there():
    """With the bytes that the same points on the host have; bad ones are named, and so is another device."""
    if not wp.is_cuda_available():
        pytest.skip("no GPU")
    rng, model = np.random.default_rng(5), sample("torus")
    points = rng.uniform(-1.5, 1.5, (70_000, 3))
    rows = wp.array(points, dtype=wp.vec3d, device="cuda:0")
    host = ab.signed_distance(model, points, device="cuda:0", nearest=True)
    found = ab.signed_distance(model, rows, nearest=True)
    assert [part.device.is_cuda for part in found] == [True] * 3
    assert [part.numpy().tobytes() for part in found] == [part.tobytes() for part in host]
    np.testing.assert_array_equal(ab.contains(model, rows), host[0] < 0)
    scene = ab.Scene("cuda:0")
    scene.add(model, solid=True)
    assert scene.signed_distance(rows)[0].numpy().tobytes() == host[0].tobytes()
    none = wp.empty(0, dtype=wp.vec3d, device="cuda:0")
    assert ab.signed_distance(model, none).shape == (0,)
    elsewhere = "points: on cuda:0, the model or scene is on cpu"
    refused(ValueError, elsewhere, ab.signed_distance, model, rows, device="cpu")
    for bad, what in ((np.nan, "is not finite"), (-np.inf, "is not finite"), (1e160, "has a coordinate beyond")):
        points[[40_000, 60_000], 1] = bad
        rows = wp.array(points, dtype=wp.vec3d, device="cuda:0")
        refused(ValueError, f"point 40000 {what}", ab.signed_distance, model, rows)


def test_what_is_kept_is_bounded_and_goes_with_its_models(device, monkeypatch):
    monkeypatch.setattr(point_distance, "_kept", kept := {})
    cube = voxel_mesh([(0, 0, 0)])
    models = [model_of(cube) for _ in range(point_distance.KEPT_MODELS + 1)]
    for model in models:
        ab.contains(model, [(0.5, 0.5, 0.5)], device=device)
    assert [key[0] for key in kept] == [id(model) for model in models[1:]]
    batch = kept[next(iter(kept))][0]
    assert ab.contains(models[1], [(0.5, 0.5, 0.5)], device=device).all()
    assert [key[0] for key in kept][-1] == id(models[1]) and [*kept.values()][-1][0] is batch, "asked last"
    del models[2:], model
    gc.collect()
    assert [key[0] for key in kept] == [id(models[1])]
