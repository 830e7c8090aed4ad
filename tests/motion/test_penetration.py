"""Ways out by first contact backwards: known ones, against brute force by projection, and Minkowski differences."""

from itertools import product

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.motions import pose_matrices
from helpers.questions import captured, in_a_row, pairs_of, random_case, scene_of
from helpers.samples import random_poses, sample
from helpers.scenes import everything, scene_with
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from oracles.motion import posed
from oracles.penetration import convex_exits, last_touch

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.scene import penetration

FINE = 2.0**-40  # tolerance
CUBE = [d for d in product((-1, 0, 1), repeat=3) if any(d)]


def random_directions(rng, *shape):
    return rng.normal(size=(*shape, 3)) * 10.0 ** rng.uniform(-200, 200, (*shape, 1))


def units(vectors):
    vectors = vectors / np.abs(vectors).max(-1, keepdims=True)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def moved_by(poses, way, part=1.0, more=0.0):
    """Return poses of objects (2 p) of which the second of each pair goes a part of its way out, and more."""
    poses = np.array(poses)
    poses[1::2, :3] += (part * way.depth + more)[:, None] * way.direction
    return poses


def block(*sizes, about=(0, 0, 0)):
    """Return a closed box of sizes (3,) about a point."""
    mesh = trimesh.creation.box(sizes)
    return ab.Model.from_arrays(mesh.vertices + about, mesh.faces, base_faces=12)


KNOWN = {
    "pin through a plate": ((12, 12, 1), (1, 1, 10), (0, 0, 0), 5.5),
    "crossing bars": ((6, 1, 1), (1, 6, 0.6), (0, 0, 0), 0.8),
    "press fit": ((1, 1, 1), (0.5, 0.5, 0.5), (0.1, 0.2, 0.73), 0.02),
    "nested": ((4, 4, 4), (1, 1, 1), (0.5, 0, 0), (0, 2.0)),  # as surfaces, and as solids
    "apart": ((4, 4, 4), (1, 1, 1), (3, 0, 0), 0),
}


@pytest.mark.parametrize("solid", [False, True])
@pytest.mark.parametrize(("first", "second", "offset", "truth"), KNOWN.values(), ids=KNOWN)
def test_known_ways_out(device, first, second, offset, truth, solid):
    """In both orders, posed as one body; of a pair alone, and of all that the broad phase finds."""
    truth, models = truth[solid] if isinstance(truth, tuple) else truth, [block(*first), block(*second)]
    for whole in random_poses(np.random.default_rng(1), 4, 30.0):
        place = pose_matrices(whole[None])[0]
        poses = np.array([whole, whole])
        poses[1, :3] = place[:3, :3] @ offset + place[:3, 3]
        scene = scene_with(device, *zip(models, poses), solid=solid)
        found = scene.penetration([(0, 1), (1, 0)])
        np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1)
        assert found.pairs.tolist() == [[0, 1], [1, 0]]
        assert (truth - 1e-12 <= found.depth).all() and (found.depth <= truth + 2e-5 * (truth > 0)).all()
        every = scene.penetration(tolerance=FINE)
        assert len(every.pairs) or not truth
        np.testing.assert_allclose(every.depth, truth, rtol=0, atol=1e-9)


def test_objects_of_one_size_in_both_orders(device):
    """Whichever is named first, the same axes are tried."""
    poses = random_poses(np.random.default_rng(3), 12, 0.3)
    scene = scene_with(device, *((block(1, 0.7, 0.4), pose) for pose in poses))
    pairs = np.array([(i, i + 1) for i in range(0, 12, 2)])
    there, back = (scene.penetration(p, tolerance=FINE) for p in (pairs, pairs[:, ::-1]))
    assert there.depth.all()
    np.testing.assert_allclose(there.depth, back.depth, rtol=1e-9)
    np.testing.assert_allclose(there.direction, -back.direction, atol=1e-12)


@pytest.mark.parametrize("names", [("torus", "capsule"), ("soup", "crumbs"), ("lattice soup", "three")])
def test_each_direction_against_brute_force(device, names):
    """Meshes at LODs, open and not manifold; alone, each direction has the depth that the least of many is taken of."""
    rng = np.random.default_rng(3)
    cases = [random_case(rng, names[:: 1 if k % 2 else -1], 60) for k in range(25)]
    scene, pairs, directions = scene_of(device, cases), pairs_of(cases), random_directions(rng, 25, 6)
    hit, truths = scene.intersect(pairs).any, np.zeros((25, 6))
    for p in np.flatnonzero(hit):
        meshes = [(*model.mesh_at(lod)[:2], pose) for model, lod, pose in (cases[p][:3], cases[p][3:])]
        soups = [posed(vertices, pose)[faces] for vertices, faces, pose in meshes]
        truths[p] = [last_touch(*soups, d) for d in units(directions[p])]
    assert 8 < hit.sum() and truths.max() > 0.5
    alone = np.stack([scene.penetration(pairs, directions[:, [k]], FINE).depth for k in range(6)], 1)
    assert (truths - 1e-12 <= alone).all() and (alone <= truths + 1e-9).all()
    least = scene.penetration(pairs, directions, FINE)
    np.testing.assert_allclose(least.depth, alone.min(1), rtol=0, atol=1e-11)
    at = alone.argmin(1)
    np.testing.assert_allclose(least.direction, units(directions)[np.arange(25), np.where(hit, at, 0)])
    coarse = scene.penetration(pairs, directions, 1e-2).depth
    assert (coarse >= alone.min(1) - 1e-11).all() and (coarse <= alone.min(1) + 0.08).all()


def test_no_direction_is_left_out_for_one_hardly_less_deep(device):
    """Of directions within a hundredth of one another, as little apart in depth, the least is that of each alone."""
    rng = np.random.default_rng(6)
    cases = [random_case(rng, names, 60) for names in (("torus", "capsule"), ("three", "torus")) * 8]
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    directions = rng.normal(size=(16, 1, 3))
    directions = directions + 0.01 * np.linalg.norm(directions, axis=2, keepdims=True) * rng.normal(size=(16, 6, 3))
    alone = np.stack([scene.penetration(pairs, directions[:, [k]], FINE).depth for k in range(6)], 1)
    least = scene.penetration(pairs, directions, FINE)
    np.testing.assert_array_equal(least.depth, alone.min(1))
    assert (alone[:, 0] > alone.min(1)).sum() > 6


def test_directions_along_which_objects_still_meet_are_not_searched(device, monkeypatch):
    """Of 34 the few along which boxes overlap least, and what is free of contact at the depth that they have."""
    searched, find = [], penetration._Approaches.find_depths
    count = lambda self, asked, tolerance: (searched.append(asked.sum()), find(self, asked, tolerance))[1]  # noqa: E731
    monkeypatch.setattr(penetration._Approaches, "find_depths", count)
    scene = scene_with(device, (block(12, 12, 1), (0, 0, 0, 0, 0, 0, 1)), (block(1, 1, 10), (0, 0, 0, 0, 0, 0, 1)))
    assert scene.penetration([(0, 1)]).depth == pytest.approx(5.5, abs=2e-5)
    assert sum(searched) <= 6


def random_overlaps(rng, count, far):
    """Return models of boxes, poses (2 count, 7) at which most pairs overlap, and posed corners (2 count, 8, 3)."""
    models = [block(*rng.uniform(0.2, 1.5, 3), about=rng.uniform(-0.2, 0.2, 3)) for _ in range(2 * count)]
    poses = random_poses(rng, 2 * count, 0.4) + np.array([far, -far, far, 0, 0, 0, 0])
    return models, poses, [posed(m.mesh_at(m.lod_max)[0], pose) for m, pose in zip(models, poses)]


@pytest.mark.parametrize("far", [0, 1e5])
def test_boxes_against_minkowski_differences(device, far):
    """Directions that are given, and the default ones, of which none is shallower."""
    rng, count = np.random.default_rng(4), 40
    models, poses, corners = random_overlaps(rng, count, far)
    scene = scene_with(device, *zip(models, poses), solid=True)
    pairs, directions = np.arange(2 * count).reshape(-1, 2), random_directions(rng, 20)
    hit = scene.intersect(pairs).any
    given_ways, ways = scene.penetration(pairs, directions, FINE), scene.penetration(pairs, tolerance=FINE)
    assert 20 < hit.sum() and (given_ways.depth[~hit] == 0).all() and (ways.depth[~hit] == 0).all()
    rounding = 1e-12 + 2e-14 * far
    for p in np.flatnonzero(hit):
        pair = corners[2 * p], corners[2 * p + 1]
        truth = convex_exits(*pair, units(directions)).min()
        assert -rounding <= given_ways.depth[p] - truth <= 1e-9
        (truth,) = convex_exits(*pair, ways.direction[[p]])
        assert -rounding <= ways.depth[p] - truth <= 1e-9
        sizes = [np.linalg.norm(np.ptp(m.mesh_at(m.lod_max)[0], axis=0)) for m in models[2 * p : 2 * p + 2]]
        axes = pose_matrices(poses)[2 * p + np.argmin(sizes), :3, :3].T
        likely = units(np.concatenate([CUBE, axes, -axes]).astype(float))
        assert ways.depth[p] <= convex_exits(*pair, likely).min() + 1e-9


def test_rounding_of_far_poses(device):
    """Boxes that slide off one another's sides are free where they are told to be, as float64 has it."""
    rng, cube, poses = np.random.default_rng(6), block(1, 1, 1), np.zeros((200, 7))
    poses[:, :3] = np.repeat(rng.uniform(-1, 1, (100, 3)) * 10.0 ** rng.integers(0, 9, (100, 1)), 2, 0)
    poses[:, 3:] = np.tile([0, 0, 0, 1], (200, 1))
    poses[1::2, :3] += rng.uniform(-0.5, 0.5, (100, 3))
    scene, pairs = scene_with(device, *[(cube, pose) for pose in poses]), np.arange(200).reshape(-1, 2)
    ways = scene.penetration(pairs, np.concatenate([np.eye(3), -np.eye(3)]), FINE)
    assert scene.intersect(pairs).any.all() and (0.4 < ways.depth).all() and (ways.depth < 1).all()
    scene.set_poses(moved_by(poses, ways))
    assert not scene.intersect(pairs).any.any()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), names=st.tuples(*[st.sampled_from(["box", "small ball", "capsule"])] * 2))
@example(seed=11579, names=("capsule", "capsule"))
def test_free_there_and_not_before(device, seed, names):
    """Convex solids intersect all the way to where they come free, and no farther."""
    rng = np.random.default_rng(seed)
    poses = random_poses(rng, 8, 0.5)
    scene = scene_with(device, *[(sample(names[k % 2]), pose) for k, pose in enumerate(poses)], solid=True)
    pairs = np.arange(8).reshape(-1, 2)
    hit = scene.intersect(pairs).any
    ways = scene.penetration(pairs, random_directions(rng, 4, 5) if seed % 2 else None, FINE)
    np.testing.assert_array_equal(ways.depth > 0, hit)
    scene.set_poses(moved_by(poses, ways, more=1e-12))
    assert not scene.intersect(pairs).any.any()
    for part in (0.5, 0.999, 1 - 1e-9):
        scene.set_poses(moved_by(poses, ways, part, more=-1e-11))  # a shallow depth may be too long by the tolerance
        np.testing.assert_array_equal(scene.intersect(pairs).any, hit)


@pytest.mark.parametrize("directions", [None, np.eye(3)])
def test_the_scene_stays_and_chunks_and_regimes_agree(device, monkeypatch, directions):
    rng = np.random.default_rng(5)
    cases = [random_case(rng, ("torus", "small ball"), 60) for _ in range(20)]
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    query = ab.Query(scene, "count", pairs=pairs)
    before, counts, replay = everything(scene), query.run().count, captured(query)
    whole = scene.penetration(pairs, directions)
    assert everything(scene) == before and 5 < (whole.depth > 0).sum()
    query.hits.count.zero_()
    replay()
    np.testing.assert_array_equal(query.result().count, counts)
    for room, warps in ((1, None), (100, None), (penetration.APPROACHES, True)):
        monkeypatch.setattr(penetration, "APPROACHES", room)
        with testing.regime(warps=warps):
            other = scene_of(device, cases).penetration(pairs, directions)
        np.testing.assert_array_equal(other.depth, whole.depth)
        np.testing.assert_array_equal(other.direction, whole.direction)


def test_bad_input(device):
    scene, pairs = in_a_row(device, "box", (0, 0.5)), [(0, 1)]
    before = everything(scene)
    for bad, message in (
        ([(1, 0, 0), (0, 0, 0)], r"direction 1 is \[0.0, 0.0, 0.0\]"),
        ([[(1, 0, 0)], [(0, np.nan, 1)]], "direction 0 of pair 1"),
        ([(np.inf, 0, 0)], "finite"),
        ([(1, 0, 0, 0)], "shape"),
        ((1, 0, 0), "shape"),
        (np.empty((0, 3)), "shape"),
        (np.empty((1, 0, 3)), "shape"),
        ("x", "directions"),
        ([("a", "b", "c")], "directions"),
        (np.ones((3, 2, 3)), "3 pairs given for 1"),
    ):
        refused(ValueError, message, scene.penetration, pairs, bad)
    for tolerance in (0, 1, np.nan, "a", 2.0**-41):
        refused(ValueError, "tolerance", scene.penetration, pairs, tolerance=tolerance)
    refused(ValueError, "pair 0", scene.penetration, [(0, 2)])
    refused(ValueError, "no object", ab.Scene(device).penetration)
    assert everything(scene) == before
    tiny = scene.penetration(pairs, [(1e-300, 0, 0), (0, 1e300, 0)])
    assert tiny.direction.tolist() == [[1, 0, 0]] and abs(tiny.depth[0] - 0.5) < 1e-5
    for none in (scene.penetration(np.empty((0, 2), int)), in_a_row(device, "box", (0, 3)).penetration()):
        assert none.pairs.shape == (0, 2) and none.depth.shape == (0,) and none.direction.shape == (0, 3)
