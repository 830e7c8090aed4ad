"""Captured graphs whose arrays were replaced, and captures of what was never launched: one error, never an answer."""

import gc
import weakref

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.questions import captured, in_a_row
from helpers.samples import STILL, sample
from helpers.scenes import add_objects

import warp_abtree as ab

PAIRS = np.array([(0, 1), (1, 2), (0, 2), (2, 3), (3, 0)])
OPERATORS = {
    "count": lambda scene, **options: ab.Query(scene, "count", **options),
    "faces": lambda scene, **options: ab.Query(scene, "faces", **options),
    "within": lambda scene, **options: ab.Query(scene, "count", within=0.01, **options),
    "contacts": lambda scene, **options: ab.ContactQuery(scene, **options),
    "manifolds": lambda scene, **options: ab.ManifoldQuery(scene, **options),
}
STALE = "captured before arrays that it uses were replaced"


@pytest.fixture(params=OPERATORS)
def operator(request):
    return OPERATORS[request.param]


def make_scene(device, count=4):
    return add_objects(device, ["torus"] * count, seed=1, spread=0.3)


LEVELS = sample("torus").lod_max - 7 * np.arange(4)


CHANGES = {
    "more tree states": lambda scene: scene.set_lods(LEVELS),
    "another object": lambda scene: (scene.add(sample("torus")), scene.intersect([(0, 4)])),
    "filtered pairs": lambda scene: scene.filter(PAIRS[:1]),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("pairs", [PAIRS, None], ids=["given", "found"])
def test_a_replay_after_arrays_were_replaced_is_refused(device, operator, pairs, change):
    """A launch and a new capture are not, where the query still fits the scene; filters concern found pairs alone."""
    scene = make_scene(device)
    query = operator(scene, pairs=pairs, capacity=20_000)
    replay = captured(query)  # the broad phase's tree is built in it: nothing was launched before
    replay()
    assert query.result().count.sum() == scene.intersect(pairs, output="count").count.sum() > 100
    CHANGES[change](scene)
    replay()
    if change == "filtered pairs" and pairs is not None:
        assert query.result().count[0] > 0
        query.launch()
        assert query.result().count[0] > 0
        return
    refused(RuntimeError, STALE, query.result)
    if change != "more tree states":
        refused(RuntimeError, "filtered" if change == "filtered pairs" else "new one", query.launch)
        found = operator(scene, pairs=pairs, capacity=20_000).run().pairs
        assert ([0, 1] in found.tolist()) == (change != "filtered pairs")
        return
    expected = scene.intersect(pairs, output="count").count.sum()
    query.launch()
    assert query.result().count.sum() == expected > 100
    replay()
    refused(RuntimeError, STALE, query.result)
    captured(query)()
    assert query.result().count.sum() == expected


@pytest.mark.parametrize("room", [True, False])
@pytest.mark.parametrize("kind", ["count", "contacts"])
def test_changes_of_lods(device, kind, room):
    """A graph goes on while they take no more states than there were; else an answer is right, or refused."""
    rng, scene, lost = np.random.default_rng(5), make_scene(device), 0
    if room:
        scene.set_lods(LEVELS)
    query = OPERATORS[kind](scene, pairs=PAIRS, capacity=20_000)
    replay = captured(query)
    ladder = np.linspace(0, sample("torus").lod_max, 60).astype(int)
    in_room = [LEVELS - 3, np.zeros(4, int), LEVELS[::-1], np.full(4, 40), LEVELS - 9]
    for lods in [*in_room, *rng.choice(ladder, (12, 4))]:
        scene.set_lods(lods)
        replay()
        try:
            query.result()
        except RuntimeError:
            lost += 1
            replay = captured(query)
            replay()
        fresh = make_scene(device)
        fresh.set_lods(lods)
        np.testing.assert_array_equal(query.result().count, fresh.intersect(PAIRS, output="count").count)
    assert lost == 0 if room else 1 <= lost <= 4


def test_buffers_that_grow(device, operator):
    """The replay writes into memory that is still the graph's own, and its results are refused."""
    scene = make_scene(device)
    query = operator(scene, pairs=PAIRS[:1], capacity=8)
    replay = captured(query)
    query.set_pairs(PAIRS)
    expected = query.run().count
    query.launch()
    replay()
    refused(RuntimeError, STALE, query.result)
    query.launch()
    np.testing.assert_array_equal(query.result().count, expected)


class OwnQuery(ab.Query):
    """A query of a user's own class."""


def test_a_graph_keeps_its_arrays(device):
    """Those of the query, of the scene and of the broad phase, until the query goes."""
    scene = make_scene(device)
    query = OwnQuery(scene, "faces", capacity=8)
    replay, states, objects = captured(query), query.batch.states.pool, query.batch.objects.pool
    kept = [query.hits.face, query.hits.any_hit, query.pair_poses, query.pairs, query.traversal.work.counter]
    kept += [states.node_box, states.face_corner, states.lod, objects.state, objects.rotation]
    found = query.broad_phase
    kept += [found.lower, found.filter.excluded, found.filter.group, query.guard.launched]
    alive = [weakref.ref(array) for array in kept]
    query.run()
    known, ids = objects.state, objects.state.numpy().tolist()
    scene.set_lods(LEVELS)
    assert known.numpy().tolist() == ids, "the states of the pool that the graph knows, and no others"
    del known
    scene.add(sample("box"))
    del kept, states, objects, found
    gc.collect()
    assert all(reference() is not None for reference in alive)
    replay()
    refused(RuntimeError, STALE, query.result)
    del query, replay
    gc.collect()
    assert not any(reference() is not None for reference in alive[:5])


def test_results_without_a_launch(device, operator):
    query = operator(make_scene(device), pairs=PAIRS, capacity=20_000)
    for change, why in (
        (lambda: None, "nothing was launched"),
        (lambda: query.set_pairs(PAIRS[:2]), "nothing was launched"),
        (lambda: query.make_room(hits=30_000), "buffers were replaced"),
    ):
        change()
        refused(RuntimeError, why, query.result)
        query.launch()
        query.result()


def test_a_frame_whose_buffers_grow(device):
    """`run` outside a graph grows them; the graph of before says so, at the result and at the check."""
    frame = ab.Pipeline(make_scene(device), output="faces", pairs=PAIRS, capacity=8)
    graph = frame.capture()
    expected = frame.run().faces
    wp.capture_launch(graph)
    refused(RuntimeError, STALE, frame.result)
    frame.launch()
    np.testing.assert_array_equal(frame.result().faces, expected)
    refused(RuntimeError, f"a frame since the last check is lost.*{STALE}", frame.check)
    frame.check()
    wp.capture_launch(frame.capture())
    np.testing.assert_array_equal(frame.result().faces, expected)
    frame.check()


def test_poses_of_a_graph(device):
    scene = make_scene(device)
    poses = ab.PoseInput(scene)
    replay = captured(poses)
    for change in (lambda: None, lambda: scene.set_lods(LEVELS)):  # which replaces nothing that poses lie in
        change()
        replay()
        poses.check()
    scene.add(sample("torus"))
    replay()
    refused(RuntimeError, f"poses since the last check are lost.*{STALE}", poses.check)


def test_bodies_of_a_graph(device):
    """Contacts that outgrow their buffers in `step` end the graphs of `launch`."""
    scene = in_a_row(device, "torus", (0, 3, 6))
    bodies = ab.Dynamics(scene, gravity=(0, 0, 0), capacity=ab.Buffers(8, pairs=1))
    bodies.step(1e-4)
    replay = captured(bodies, 1e-4)
    replay()
    bodies.check()
    scene.set_poses([(0.2 * k, 0, 0, 0, 0, 0, 1) for k in range(3)])
    bodies.step(1e-4)
    replay()
    refused(RuntimeError, STALE, bodies.check)


CALLS = {
    "set_poses": lambda scene, *_: scene.set_poses(np.tile(STILL, (4, 1))),
    "set_lods": lambda scene, *_: scene.set_lods([3] * 4),
    "add": lambda scene, *_: scene.add(sample("torus")),
    "broad_phase": lambda scene, *_: scene.broad_phase(),
    "intersect": lambda scene, *_: scene.intersect(PAIRS),
    "tree_state": lambda scene, *_: scene.tree_state(0),
    "Query": lambda scene, *_: ab.Query(scene, "count"),
    "ContactQuery": lambda scene, *_: ab.ContactQuery(scene, capacity=1000),
    "DistanceQuery": lambda scene, *_: ab.DistanceQuery(scene),
    "Pipeline": lambda scene, *_: ab.Pipeline(scene),
    "PoseInput": lambda scene, *_: ab.PoseInput(scene),
    "sweep": lambda scene, *_: ab.sweep(sample("torus"), sample("torus"), [STILL], device=scene.device),
    "run": lambda _, query, __: query.run(),
    "result": lambda _, query, __: query.result(),
    "set_pairs": lambda _, query, __: query.set_pairs(PAIRS[:1]),
    "frame run": lambda *made: made[2].run(),
    "frame result": lambda *made: made[2].result(),
    "frame check": lambda *made: made[2].check(),
}


@pytest.mark.parametrize("call", CALLS)
def test_what_waits_is_refused_in_a_capture(device, call):
    """In one sentence, and nothing has changed: neither the scene nor the graph."""
    scene = make_scene(device)
    query, frame = ab.Query(scene, "count", pairs=PAIRS), ab.Pipeline(scene, output="count", pairs=PAIRS)
    expected = query.run().count
    lods = scene.lods
    with wp.ScopedCapture(device) as begun:
        query.launch()
        with pytest.raises(RuntimeError, match="cannot be captured in a graph; call it before the capture begins"):
            CALLS[call](scene, query, frame)
    wp.capture_launch(begun.graph)
    np.testing.assert_array_equal(query.result().count, expected)
    np.testing.assert_array_equal(scene.intersect(PAIRS, output="count").count, expected)
    np.testing.assert_array_equal(scene.lods, lods)
    assert scene.object_count == 4
