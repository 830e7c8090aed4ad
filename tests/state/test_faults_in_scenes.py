"""Memory that ends, and steps that raise, in what is asked of a scene: it goes on as before, whichever step fails.

Out of memory, each call raises one clear error and nothing has changed; interrupted, LODs, poses and answers are as
before.
"""

import numpy as np
import pytest
import warp as wp
from conftest import slow
from helpers import faults
from helpers.faults import MORE_PAIRS, PAIRS, add_objects, check_scene, describe, make_scene
from helpers.samples import random_poses, sample
from helpers.scenes import everything

import warp_abtree as ab

MOVES = {
    "in place": [0, 7, 0, 7],
    "one apart": [0, 3, 5, 9],
    "pool grows": [0, 3, 5, 9],
    "all apart": [2, 30, 11, 60],
    "coarsest": [-1, -1, -1, -1],
}


@pytest.fixture(params=faults.FAULTS)
def fault(request, device, monkeypatch):
    return faults.FAULTS[request.param](device, monkeypatch)


def move_lods(scene, move):
    return scene.set_lods(np.zeros(4, int) if move == "coarsest" else scene.lods - MOVES[move])


@pytest.mark.parametrize("move", ["one apart", *slow("in place", "pool grows", "all apart", "coarsest")])
def test_lods(device, fault, move):
    """States that move, are copied, taken again and new; also the next change is that of a scene without a fault."""

    def make():
        scene = make_scene(device)
        if move == "pool grows":
            scene.batch().states.free.clear()  # no state to take again
        return scene

    def check(before, scene):
        now = fault.check_scene(before, scene)
        if before is not None and isinstance(fault, faults.Interruption):
            expected = make()
            move_lods(scene, move)
            move_lods(expected, move)
            assert faults.check_answers(None, scene) == faults.check_answers(None, expected)
        return now

    assert fault.everywhere(make, lambda scene: move_lods(scene, move), check)[0] > 1


@pytest.mark.parametrize("move", ["one apart", *slow("in place", "all apart", "coarsest")])
def test_graphs_and_queries_beside_lods(device, monkeypatch, move):
    """A query that was made before, and its graph, answer as before or refuse, while the scene is torn and after."""

    def make():
        scene = make_scene(device)
        query = ab.Query(scene, "faces", pairs=PAIRS, capacity=4096)
        with wp.ScopedCapture(device) as captured:
            query.launch()
        return scene, query, captured.graph

    def check(before, made):
        scene, query, graph = made
        if before is None:
            query.launch()
            return query.result().faces.tobytes()
        # In the order in which nothing has mended the scene yet.
        for launch in (lambda: wp.capture_launch(graph), query.launch, lambda: wp.capture_launch(graph)):
            with faults.refusing("interrupted", "replaced"):
                launch()
                assert query.result().faces.tobytes() == before
        assert scene.intersect(PAIRS, output="faces").faces.tobytes() == before
        return None

    faults.Interruption(device, monkeypatch).everywhere(make, lambda made: move_lods(made[0], move), check)


def test_poses(device, fault):
    poses = random_poses(np.random.default_rng(3), 4, 0.5)
    count, _ = fault.everywhere(lambda: make_scene(device), lambda scene: scene.set_poses(poses), check_scene)
    assert count >= 1 or isinstance(fault, faults.MemoryShortage)


def test_first_use(device, fault):
    """A scene whose arrays were never made gets them at the next call."""
    whole = fault.check_scene(None, add_objects(device))

    def check(before, scene):
        assert scene.object_count == 4
        assert before is None or fault.check_scene(None, scene) == whole

    assert fault.everywhere(lambda: add_objects(device), lambda s: s.intersect(PAIRS, output="faces"), check)[0] > 30


@pytest.mark.slow
def test_a_new_object(device, fault):
    """It is there, or not; poses and LODs of the others stay where they were set, not where they were added."""

    def make():
        scene = make_scene(device)
        scene.set_poses(random_poses(np.random.default_rng(2), 4, 0.5))
        return scene, describe(scene.intersect(PAIRS, output="faces"))

    def add(made):
        if made[0].object_count == 4:
            made[0].add(sample("box"), lod=3)
        return made[0].intersect([(4, 0), *PAIRS], output="faces")

    def check(before, made):
        scene, answers = made
        if before is not None:
            assert scene.object_count in (4, 5) and [*scene.lods[4:]] in ([], [3])
            assert describe(scene.intersect(PAIRS, output="faces")) == answers
        return True

    assert fault.everywhere(make, add, check)[0] > 30


def test_pairs_are_filtered_out(device, monkeypatch):
    def check(before, scene):
        found = [*map(tuple, scene.broad_phase().tolist())]
        if before is not None:
            assert set(before) - {(0, 1)} <= set(found) <= set(before)
            scene.filter(PAIRS[:1])
            assert (0, 1) not in map(tuple, scene.broad_phase().tolist())
        return found

    fault = faults.Interruption(device, monkeypatch)
    fault.everywhere(lambda: make_scene(device), lambda scene: scene.filter(PAIRS[:1]), check)


REQUESTS = {
    "any": dict(),
    "faces": dict(output="faces"),
    "contacts": dict(output="contacts"),
    "within": dict(output="count", within=0.01),
    "float32": dict(output="count", precision="float32"),
}


@pytest.mark.parametrize("pairs", ["given", *slow("found")])
@pytest.mark.parametrize("asked", REQUESTS)
@pytest.mark.parametrize("kind", ["interruption", *slow("memory")])
def test_requests(device, monkeypatch, kind, asked, pairs):
    """More pairs than the scene was asked before, with what belongs to each, and more hits than it had room for."""
    fault, options = faults.FAULTS[kind](device, monkeypatch), REQUESTS[asked]
    pairs = MORE_PAIRS if pairs == "given" else None
    untouched = check_scene(None, make_scene(device))
    expected = describe(make_scene(device).intersect(pairs, **options))

    def make():
        scene = make_scene(device)
        scene.intersect(PAIRS[:1], **options)
        return scene

    def check(before, scene):
        if before is None:
            return everything(scene)
        faults.check_buffer_lengths(scene._queries.kept.values())
        assert everything(scene) == before and describe(scene.intersect(pairs, **options)) == expected
        return check_scene(untouched, scene)

    count, result = fault.everywhere(make, lambda scene: scene.intersect(pairs, **options), check)
    assert count >= 4 and result.any.any()
