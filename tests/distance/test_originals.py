"""Distances of originals, whatever the LODs of their objects."""

import numpy as np
import pytest
import warp as wp
from helpers.questions import check_brackets, check_points, pairs_of, random_lod, scene_of
from helpers.samples import STILL, grid, random_poses, sample
from helpers.scenes import scene_with
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warp_abtree as ab

ROWS = ("any", "distance", "bracket", "points", "point_faces")
SAMPLES = ("torus", "ball", "capsule", "soup", "cow")


def random_cases(rng, count):
    """Return cases of samples at random LODs, some at their finest, and poses, from crossing to far apart."""
    cases = []
    for _ in range(count):
        a, b = (sample(rng.choice(SAMPLES)) for _ in range(2))
        pose_a, pose_b = random_poses(rng, 2, 2.5)
        whole = rng.random() < 0.2
        lod_a, lod_b = (model.lod_max if whole else random_lod(rng, model, 2000) for model in (a, b))
        cases.append((a, lod_a, pose_a, b, lod_b, pose_b))
    return cases


def finest(cases):
    return [(a, a.lod_max, pose_a, b, b.lod_max, pose_b) for a, _, pose_a, b, _, pose_b in cases]


OPTIONS = st.fixed_dictionaries(
    {},
    optional={
        "tolerance": st.sampled_from((1e-3, 0.1, 0.5, 100.0)),
        "relative": st.sampled_from((0.01, 0.1, 0.5, 0.9)),
        "beyond": st.sampled_from((0.0, 0.05, 0.5, 2.0)),
    },
)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), options=OPTIONS, swapped=st.booleans())
def test_brackets_hold_the_originals(device, seed, options, swapped):
    cases = random_cases(np.random.default_rng(seed), 8)
    pairs = pairs_of(cases)[:, ::-1] if swapped else pairs_of(cases)
    truth = scene_of(device, finest(cases)).intersect(pairs, "distance").distance
    scene = scene_of(device, cases)
    for _ in range(2):
        result = scene.intersect(pairs, "distance", originals=True, **options)
        check_brackets(result, truth, **options)
        if not swapped:
            check_points(result, finest(cases))


def test_without_tolerance_the_answer_is_that_of_the_finest(device):
    cases = random_cases(np.random.default_rng(2), 20)
    expected = scene_of(device, finest(cases)).intersect(pairs_of(cases), "distance")
    scene = scene_of(device, cases)
    for _ in range(2):
        result = scene.intersect(pairs_of(cases), "distance", originals=True)
        for name in ROWS:
            np.testing.assert_array_equal(getattr(result, name), getattr(expected, name))
    at_finest = scene_of(device, finest(cases)).intersect(pairs_of(cases), "distance", originals=True)
    for name in ROWS:
        np.testing.assert_array_equal(getattr(at_finest, name), getattr(expected, name))


def test_poses_lods_and_objects_change(device):
    rng = np.random.default_rng(4)
    cases = random_cases(rng, 6)
    scene, reference = scene_of(device, cases), scene_of(device, finest(cases))
    options = {"relative": 0.3}
    for turn in range(4):
        result = scene.intersect(pairs_of(cases), "distance", originals=True, **options)
        check_brackets(result, reference.intersect(pairs_of(cases), "distance").distance, **options)
        poses = random_poses(rng, 12, 2.5 + turn)
        scene.set_poses(poses)
        reference.set_poses(poses)
        scene.set_lods([random_lod(rng, scene.models[m], 2000) for m in scene.object_model])
    more = sample("box")
    for one in (scene, reference):
        one.add(more, (1.0, 2.0, 7.0, 0, 0, 0, 1))
    pairs = np.array([[0, 12], [12, 5], [2, 3]])
    result = scene.intersect(pairs, "distance", originals=True, **options)
    check_brackets(result, reference.intersect(pairs, "distance").distance, **options)


@pytest.mark.parametrize("originals", [False, True])
def test_results_on_the_device(device, originals):
    cases = random_cases(np.random.default_rng(6), 10)
    on_cpu = wp.get_device(device).is_cpu
    # Within a tolerance warps answer what they find first.
    options = {"originals": originals, "relative": 0.4 if on_cpu and originals else 0.0}
    for count in (10, 0):
        pairs = pairs_of(cases)[:count]
        kept = scene_of(device, cases).intersect(pairs, "distance", device=True, **options)
        host = scene_of(device, cases).intersect(pairs, "distance", **options)
        for name in ("pairs", *ROWS, *(["node_tests"] if on_cpu else [])):
            np.testing.assert_array_equal(getattr(kept, name).numpy(), getattr(host, name))
            assert getattr(kept, name).device == scene_of(device, cases).device
        host.check()


def test_solids(device):
    cow, ball = sample("cow"), sample("ball")
    small = ab.Model.from_arrays(ball.mesh_at(ball.lod_max)[0] / 9, ball.mesh_at(ball.lod_max)[1])
    away = [(30, 0, 0, 0, 0, 0, 1), (60, 0, 0, 0, 0, 0, 1)]
    coarse = [{"lod": model.lod_for(fraction=0.3)} for model in (ball, small, cow)]
    placed = [(ball, STILL, {**coarse[0], "solid": True}), (small, STILL, coarse[1]), (cow, away[0], coarse[2])]
    scene = scene_with(device, *placed, (ball, away[1]), (small, away[1]))
    pairs = [(0, 1), (1, 2), (3, 4)]
    found = scene.intersect(pairs, "distance", originals=True, relative=0.3)
    np.testing.assert_array_equal(found.any, [True, False, False])
    assert found.distance[0] == 0 < found.distance[2] < found.distance[1]
    scene.set_lods([model.lod_max for model in (ball, small, cow, ball, small)])
    lower, upper = found.bracket.T
    truth = scene.intersect(pairs, "distance").distance
    assert (lower <= truth).all() and (truth <= upper).all()


def test_the_broad_phase_finds_what_lods_leave_out(device):
    """Boxes of LODs that are apart, of originals that are not: sheets with spikes of 0.2 that coarse LODs lack."""
    vertices, faces = grid(8)
    vertices[40, 2] = 1.6
    spike = ab.Model.from_arrays((vertices - [4, 4, 0]) / 8, faces, base_faces=2)
    scene = scene_with(device, *[(spike, (0, 0, z, 0, 0, 0, 1)) for z in (0.0, 0.15)], lod=0)
    assert len(scene.broad_phase()) == 0
    found = scene.intersect(output="distance", originals=True)
    np.testing.assert_array_equal(found.pairs, [[0, 1]])
    assert 0 < found.distance[0] < 0.15 and found.bracket[0, 1] < 0.15


def test_the_broad_phase_of_originals_follows_filters_and_poses(device):
    scene = scene_with(device, *[(sample("ball"), (x, 0, 0, 0, 0, 0, 1)) for x in (0.0, 0.5, 0.9)], lod=0)

    def pairs(**options):
        return scene.intersect(output="distance", originals=True, **options).pairs.tolist()

    assert pairs() == [[0, 1], [0, 2], [1, 2]]
    scene.filter([(0, 1)])
    assert pairs() == [[0, 2], [1, 2]]
    scene.set_poses(np.array([[0, 0, 0, 0, 0, 0, 1], [50, 0, 0, 0, 0, 0, 1], [90, 0, 0, 0, 0, 0, 1.0]]))
    assert pairs() == [] and pairs(beyond=100.0) == [[0, 2], [1, 2]]
