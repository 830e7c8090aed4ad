"""Distances by graphs, captured by the user or made of calls that are alike: what is in place when they run counts."""

import numpy as np
import pytest
from helpers import refused
from helpers.questions import captured, pairs_of, random_case, scene_of
from helpers.samples import sample

import warp_abtree as ab
from warp_abtree import testing

NAMES = ("torus", "ball"), ("soup", "capsule"), ("twins", "lattice soup"), ("box", "crumbs")
ANSWERS = ("any", "distance", "bracket", "points", "point_faces")


def to_bytes(result):
    return [np.asarray(getattr(result, name)).tobytes() for name in ANSWERS]


def make_turns(rng, device, count):
    """Return a scene, and poses and pairs of a number of turns: many surfaces intersect, many faces are as near."""
    cases = [random_case(rng, names, 60) for names in NAMES * 4]
    identity = np.array([0.0, 0, 0, 0, 0, 0, 1])
    cases += [(sample(name), None, identity) * 2 for name in ("box", "grid")] * 3
    start = np.array([pose for case in cases for pose in (case[2], case[5])])
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


@pytest.mark.parametrize("warps", [True, False])
def test_a_graph_answers_what_is_in_place(device, warps):
    """Captured before there was a launch; and calls one after the other, from the fourth on a graph on a GPU."""
    scene, turns = make_turns(np.random.default_rng(15), device, 8)
    if scene.device.is_cuda and not warps:
        pytest.skip("CUDA has warps alone")
    met = []
    with testing.regime(warps=warps):
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


def test_graphs_captured_first_and_stale_ones(device):
    """The first launch may be that of a graph; one whose tree states were replaced is refused, a new one is not."""
    rng = np.random.default_rng(14)
    cases = [random_case(rng, ("torus", "ball"), 60) for _ in range(4)]
    scene, pairs = scene_of(device, cases), pairs_of(cases)
    query = ab.DistanceQuery(scene, pairs)
    for turn in range(2):
        replay = captured(query)
        for _ in range(3):
            replay()
        assert to_bytes(query.result()) == to_bytes(ab.DistanceQuery(scene, pairs).run())
        scene.set_lods([model.lod_max - 5 * i - 7 * turn for i, model in enumerate(scene.models * 4)])
        replay()
        if turn == 0:
            refused(RuntimeError, "captured before arrays that it uses were replaced", query.result)
