"""Pairs proved apart: against brute-force distances, FCL, and what the proof promises of the original meshes."""

import itertools

import numpy as np
import pytest
import trimesh
from helpers import refused
from helpers.nested import FACE_PAIRS, face_pairs
from helpers.questions import captured, far_cases, in_a_row, pairs_of, parted_cases, scene_of, true_distances
from helpers.samples import STILL, contact_poses, model_of_faces, sample
from oracles.triangle_distance import triangle_distance

import warp_abtree as ab
from warp_abtree import testing

NAMES = ("box", "small ball", "crumbs", "soup", "torus", "three", "capsule", "one")
# Pairs that are nearer than a part in 10^9 can tell, or farther from the origin.
NEAR_OR_FAR = {"nearly parallel edges", "shared corners", "nearly touching", "huge and tiny", "far from the origin"}


def check_distances(scene, pairs, distances, close=1e-9):
    """Apart at a little less than the distance, not at it or beyond, and not where the pair intersects."""
    distances = np.array(distances)
    for factor in (0.0, 0.3, 0.9, 1 - close):
        result = scene.intersect(pairs, within=factor * distances)
        np.testing.assert_array_equal(result.apart, distances > 0)
        assert not (result.apart & result.any).any()
    for factor in (1 + close, 1.1, 3.0, 1e6):
        assert not scene.intersect(pairs, within=factor * distances).apart.any()


def test_equals_brute_force(device):
    rng = np.random.default_rng(1)
    cases = parted_cases(rng, [tuple(rng.choice(NAMES, 2)) for _ in range(90)], least=1.0)
    scene = scene_of(device, cases)
    distances = true_distances(scene, cases)
    assert 30 < (distances > 0).sum() < 85
    check_distances(scene, pairs_of(cases), distances)
    check_distances(scene, pairs_of(cases)[:, ::-1], distances)


@pytest.mark.parametrize("kind", [kind for kind in FACE_PAIRS if kind not in NEAR_OR_FAR])
def test_single_faces_equal_brute_force(device, kind):
    """All ways in which two triangles can be closest, parallel ones and faces without area too."""
    found = face_pairs(kind, np.random.default_rng(2), 120)
    kept = [pair for pair in found if min(len(np.unique(face, axis=0)) for face in pair) == 3]
    cases = [(model_of_faces(a), 0, STILL, model_of_faces(b), 0, STILL) for a, b in kept]
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    distances = np.where(scene.intersect(pairs).any, 0.0, [triangle_distance(a, b) for a, b in kept])
    clear = (distances == 0) | (distances > 0.01)
    assert (distances > 0.01).sum() > 24
    check_distances(scene, pairs[clear], distances[clear])


def test_coarse_proof_holds_for_the_original_meshes(device):
    """Apart by more than both errors at any LODs: then the finest meshes do not intersect."""
    rng = np.random.default_rng(4)
    names = ("torus", "ball", "capsule", "soup")
    cases, within = [], []
    for _ in range(300):
        a, b = [sample(name) for name in rng.choice(names, 2)]
        i, j = [int(model.lod_max * rng.random() ** 0.3) for model in (a, b)]
        pose_a, pose_b = contact_poses(rng, a, i, b, j)
        pose_b[:3] += rng.normal(size=3) * rng.random()
        cases.append((a, i, pose_a, b, j, pose_b))
        within.append(a.error_at(i) + b.error_at(j))
    coarse, pairs = scene_of(device, cases), pairs_of(cases)
    fine = scene_of(device, [(a, None, pose_a, b, None, pose_b) for a, _, pose_a, b, _, pose_b in cases])
    result, truth = coarse.intersect(pairs, within=within), fine.intersect(pairs)
    assert not (result.apart & truth.any).any()
    assert result.apart.sum() > 30 and (~result.apart & ~truth.any).sum() > 5
    assert (~coarse.intersect(pairs).any & truth.any).any(), "coarse meshes alone give wrong answers here"


@pytest.mark.parametrize("far", [1e3, 1e6])
def test_far_from_the_origin(device, far):
    """Both objects far away; a mesh with coordinates far from its own origin. What is lost is in proportion."""
    cases = far_cases(np.random.default_rng(6), far)
    scene = scene_of(device, cases)
    distances = true_distances(scene, cases)
    clear = distances > 0.01
    assert clear.sum() > 5
    check_distances(scene, pairs_of(cases)[clear], distances[clear], 1e-9 + 1e-11 * far)


@pytest.mark.parametrize("far", [1e9, 1e39, 1e299])
def test_far_pairs_and_huge_distances(device, far):
    scene = in_a_row(device, "box", (0, far, -far))
    pairs = [(0, 1), (1, 0), (1, 2)]
    for within, apart in ((0, 1), (far / 2, 1), (0.99 * far, 1), (1.01 * far, 0), (2.1 * far, 0), (1.7e308, 0)):
        result = scene.intersect(pairs, within=within)
        np.testing.assert_array_equal(result.apart, [apart, apart, within < 2 * far])
        assert not result.any.any()
    scene = in_a_row(device, "box", (1.7e308, -1.7e308))
    assert scene.intersect([(0, 1)], within=1e300).apart[0] and not scene.intersect([(0, 1)], within=1.7e308).any[0]


@pytest.mark.parametrize("far", [1.6e38, 1.72e38, 3.5e38, 1e40, 1e300])
def test_all_faces_are_within_a_huge_gap(device, regime, far):
    """Slabs and boxes of float32, too, where the objects are farther apart than its numbers go."""
    ring = ab.Model.load(trimesh.creation.torus(1.0, 0.3, 10, 6))
    with testing.regime(warps_per_pair=1):
        scene = ab.Scene(device)
        scene.add_many([ring, ring], [STILL, (far, -far, 0.3 * far, 0, 0, 0, 1)])
        for gap, found in ((0.9 * far, 0), (4 * far, ring.face_count**2)):
            assert len(scene.intersect([(0, 1)], "contacts", gap=gap).faces) == found


@pytest.mark.slow
def test_regimes_and_outputs_agree(device):
    rng = np.random.default_rng(8)
    cases = parted_cases(rng, [("torus", "soup")] * 30, faces=400, least=1.0)
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    within = rng.choice([0, 0.1, 0.5, 1.0], len(pairs))
    expected = scene.intersect(pairs, within=within)
    assert 3 < expected.apart.sum() < 27
    # On CUDA only warps work on pairs: the thread's visit is in the CPU's vector instructions.
    for warps, output in itertools.product((True,) if scene.device.is_cuda else (False, True), ("any", "faces")):
        with testing.regime(warps=warps, warps_per_pair=20):
            query = ab.Query(scene, output, pairs=pairs, within=within)
        result, plain = query.run(), scene.intersect(pairs, output)
        np.testing.assert_array_equal(result.apart, expected.apart)
        assert plain.apart is None
        for name in ("any", "count", "faces"):
            np.testing.assert_array_equal(getattr(result, name), getattr(plain, name))
    query.near.any_hit.fill_(7)
    captured(query)()
    np.testing.assert_array_equal(query.result().apart, expected.apart)


def test_query_takes_other_pairs_and_distances(device):
    scene = in_a_row(device, "box", (0, 1.5, 4, 9))
    query = ab.Query(scene, "any", pairs=[(0, 1), (1, 2)], within=1.0)
    np.testing.assert_array_equal(query.run().apart, [False, True])
    for given, apart in (
        (([(0, 1), (0, 2), (2, 3)],), [False, True, True]),
        (([(0, 1), (0, 2), (2, 3)], [0.25, 3.5, 3.5]), [True, False, True]),
        (([(2, 3), (0, 1), (0, 2)],), [True, False, False]),
    ):
        query.set_pairs(*given)
        np.testing.assert_array_equal(query.run().apart, apart)
    refused(ValueError, "2 pairs", query.set_pairs, [(0, 1), (0, 2)])
    np.testing.assert_array_equal(query.run().apart, apart)
    refused(ValueError, "without within", ab.Query(scene, "any", pairs=[(0, 1)]).set_pairs, [(0, 1)], within=1.0)
    assert scene.intersect(np.empty((0, 2), int), within=1.0).apart.shape == (0,)
