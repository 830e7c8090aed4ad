"""Memory that ends, and steps that raise, in queries, frames, sweeps and bodies that are kept.

Out of memory, an operator goes on with what it had; interrupted, its next launch is whole, or it refuses in one
sentence; never another answer."""

import re

import numpy as np
import pytest
import warp as wp
from conftest import slow
from helpers import faults, refused
from helpers.faults import MORE_PAIRS, PAIRS, add_objects, check_scene, describe, make_scene
from helpers.questions import GpuQuery, in_a_row
from helpers.samples import random_poses, sample
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query import request

REFUSALS = ("interrupted", "replaced", "nothing was launched", "make a new one")


@pytest.fixture
def memory(device, monkeypatch):
    return faults.MemoryShortage(device, monkeypatch)


@pytest.fixture
def interruption(device, monkeypatch):
    return faults.Interruption(device, monkeypatch)


QUERIES = {
    "within": lambda scene, **options: ab.Query(scene, "count", within=0.01, **options),
    "as on CUDA": lambda scene, **options: GpuQuery(scene, capacity=ab.Buffers(uncertain=1, hits=1), **options),
    "contacts": lambda scene, **options: ab.ContactQuery(scene, capacity=1, **options),
    "near": lambda scene, **options: ab.ContactQuery(scene, capacity=1, gap=0.02, **options),
    "found": lambda scene, **_: ab.ContactQuery(scene, capacity=ab.Buffers(pairs=1, hits=1)),
}


@pytest.mark.parametrize("kind", QUERIES)
@pytest.mark.slow
def test_a_query_grows(device, memory, kind):
    def make():
        scene = make_scene(device)
        scene.add(scene.models[0], random_poses(np.random.default_rng(1), 1, 0.4)[0], lod=scene.lods[0])
        return scene, QUERIES[kind](scene, pairs=PAIRS[:1])

    def grow(made):
        if kind != "found":
            made[1].set_pairs([(0, 4), *MORE_PAIRS])
        return made[1].run()

    few, many = describe(make()[1].run()), describe(grow(make()))

    def check(before, made):
        faults.check_buffer_lengths([made[1]])
        assert before is None or describe(made[1].run()) in (few, many)
        return faults.check_scene(before, made[0])

    count, result = memory.everywhere(make, grow, check)
    assert count >= 1 and describe(result) == many and result.any.any()


def test_the_broad_phase_grows(device, memory):
    def make():
        scene = in_a_row(device, "box", [0.0] * 20)
        scene.batch()
        return scene

    def check(before, scene):
        assert scene.object_count == 20

    count, pairs = memory.everywhere(make, lambda scene: scene.broad_phase(), check)
    assert count > 5 and len(pairs) == 190


OPERATORS = {
    "faces": lambda scene: ab.Query(scene, "faces", pairs=MORE_PAIRS),
    "found": lambda scene: ab.Query(scene, "count", capacity=ab.Buffers(pairs=2)),
    "within": lambda scene: ab.Query(scene, "count", pairs=MORE_PAIRS, within=0.01),
    "contacts": lambda scene: ab.ContactQuery(scene, pairs=MORE_PAIRS, capacity=8),
    "manifolds": lambda scene: ab.ManifoldQuery(scene, capacity=ab.Buffers(pairs=2, hits=8)),
}
CALLS = {
    "run": lambda query: query.run(),
    "set_pairs": lambda query: query.set_pairs([*MORE_PAIRS, *MORE_PAIRS]) if query.broad_phase is None else None,
    "result": lambda query: (query.launch(), query.result()),
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("kind", OPERATORS)
def test_queries(device, interruption, kind, call):
    def make():
        query = OPERATORS[kind](make_scene(device))
        query.run()
        return query

    def check(before, query):
        if before is None:
            return query.run().count.tolist()
        with faults.refusing(*REFUSALS[:3], kind=(RuntimeError, ab.CapacityError)):
            assert query.result().count.tolist() == before
        with faults.refusing(REFUSALS[3]):
            assert query.run().count.tolist() in (before, 2 * before)
        return before

    steps, _ = interruption.everywhere(make, CALLS[call], check)
    assert steps >= 1 or (call == "set_pairs" and kind in ("found", "manifolds"))


FRAMES = {
    "states of their own": dict(),
    "ladder": dict(ladder=[np.arange(0, 60, 10), np.arange(0, 60, 10)]),
    "contacts": dict(output="contacts", capacity=4096),
}


@pytest.mark.parametrize("replayed", [False, True])
@pytest.mark.parametrize("kind", FRAMES)
def test_frames(device, interruption, kind, replayed):
    def make():
        frame = ab.Pipeline(add_objects(device), **{"output": "count", "pairs": MORE_PAIRS, **FRAMES[kind]})
        graph = frame.capture()
        frame.lods.assign(np.array([20, 41, 9, 33], np.int32))
        return frame, graph

    whole, _ = make()
    whole.launch()
    expected = whole.result().count.tolist()

    def check(before, made):
        if before is not None:
            frame, graph = made
            refused(RuntimeError, REFUSALS[0], frame.result)
            wp.capture_launch(graph) if replayed else frame.launch()
            assert frame.result().count.tolist() == expected
            frame.check()
        return True

    assert interruption.everywhere(make, lambda made: made[0].launch(), check)[0] >= 2


def test_no_mark_is_left(device, interruption):
    """After an interrupted update by level lists and a whole one, a partial update leaves the bits of any other."""

    def make():
        with testing.regime(block_updates=False, full_refit={"cpu": 1e6, "cuda": 1e6}):
            frame = ab.Pipeline(add_objects(device), "count", pairs=MORE_PAIRS)
        for lod in (40, 39):
            frame.launch()
            frame.lods.fill_(lod)
        return frame

    def move_on(frame):
        for lod in (39, 40):
            frame.lods.fill_(lod)
            frame.launch()
        return frame.batch.states.pool.node_box.numpy().tobytes()

    expected = move_on(make())

    def check(before, frame):
        assert before is None or move_on(frame) == expected
        return True

    assert interruption.everywhere(make, lambda frame: frame.launch(), check)[0] > 6


def test_a_capture(device, interruption):
    def check(before, frame):
        wp.capture_launch(frame.capture())
        frame.check()
        now = frame.result().count.tolist()
        assert before in (None, now)
        return now

    def make():
        return ab.Pipeline(add_objects(device), output="count", pairs=MORE_PAIRS)

    assert interruption.everywhere(make, lambda frame: frame.capture(), check)[0] > 2


def test_sweeps(device, interruption):
    poses = random_poses(np.random.default_rng(4), 60, 0.6)

    def ask(_=None):
        return ab.sweep(sample("torus"), sample("small ball"), poses, output="faces", device=device)

    expected = ask().tobytes()

    def check(before, _):
        assert ask().tobytes() == expected
        return True

    assert interruption.everywhere(lambda: None, ask, check)[0] > 1


def test_bodies(device, interruption):
    def make():
        placed = [((0, 0, 0), {"static": True}), ((0.1, 0, 0.9), {}), ((0.1, 0, 1.85), {})]
        bodies = ab.Dynamics(scene_with(device, *[(sample("box"), (*p, 0, 0, 0, 1), own) for p, own in placed]))
        bodies.step(1e-3)
        return bodies

    whole = make()
    whole.step(1e-3)
    expected = whole.poses().tobytes()

    def check(before, bodies):
        if before is not None:
            with faults.refusing("a step of the bodies was interrupted; make a new Dynamics"):
                bodies.step(1e-3)
                assert bodies.poses().tobytes() == expected
        return True

    assert interruption.everywhere(make, lambda bodies: bodies.step(1e-3), check)[0] > 10


# Operator, options (pairs are found by the broad phase unless given), and the buffer that is too small.
KINDS = {
    "hits": (ab.Query, dict(output="faces", pairs=...), "hits"),
    "contacts": (ab.ContactQuery, dict(pairs=...), "hits"),
    "found pairs": (ab.Query, dict(output="faces"), "pairs"),
    "pairs of contacts": (ab.ContactQuery, {}, "pairs"),
    "uncertain pairs": (GpuQuery, dict(output="faces", pairs=...), "uncertain"),
}


@pytest.fixture
def crowd(device):
    scene = make_scene(device)
    for _ in range(2):
        scene.add(sample("twins"))
    return scene


@pytest.mark.parametrize("kind", [*list(KINDS)[:-1], *slow("uncertain pairs")])
def test_overflow_names_the_demand(crowd, kind):
    """Counts are whole all the same, and what there was room for are rows of the whole answer, in order."""
    operator, options, name = KINDS[kind]
    whole = crowd.intersect(output="contacts")
    options = {**options, **({"pairs": whole.pairs} if "pairs" in options else {})}
    ample = {} if name == "hits" else {"hits": len(whole.faces)}

    def named_demand(room):
        query = operator(crowd, **options, capacity=ab.Buffers(**{**ample, name: room}))
        query.launch()
        result = query.result()
        said = rf"^(\d+) [\w\s]*, the query has room for {room}: [^\n]*Buffers\({name}=\1\)$"
        found = re.search(said, str(refused(ab.CapacityError, said, result.check)))
        if name == "hits":
            np.testing.assert_array_equal(result.count, whole.count)
            assert len(result.faces) == room and (np.lexsort(result.faces.T[::-1]) == np.arange(room)).all()
            assert {*map(bytes, result.faces)} <= {*map(bytes, whole.faces)}
        if kind == "contacts":
            assert {*map(bytes, result.contacts)} <= {*map(bytes, whole.contacts)}
            rows = np.searchsorted(result.faces[:, 0], np.arange(len(whole.pairs) + 1))
            np.testing.assert_array_equal(query.start.numpy(), rows)
        grown = query.run()
        assert grown.faces.shape == whole.faces.shape and len(grown.pairs) == len(whole.pairs)
        if "pairs" in options:
            np.testing.assert_array_equal(grown.faces, whole.faces)
        if kind == "contacts":
            assert describe(grown) == describe(whole)
        return int(found.group(1))

    demand = named_demand(1)
    assert demand == {"hits": len(whole.faces), "pairs": len(whole.pairs), "uncertain": demand}[name] > 8
    for room in (demand // 2, demand - 1):
        assert named_demand(room) == demand
    query = operator(crowd, **options, capacity=ab.Buffers(**{**ample, name: demand}))
    query.launch()
    query.result().check()
    assert len(query.result().faces) == len(whole.faces)


def test_what_no_device_or_launch_holds_is_refused(device, monkeypatch):
    """The largest buffers that may be asked for, so many entries of three integers, refused as a full device does.

    And more pairs than a launch holds. A scene and a query about it are as they were.
    """
    scene = make_scene(device)
    before, query = check_scene(None, scene), ab.Query(scene, "faces", pairs=PAIRS)
    answers = describe(query.run())

    def check():
        check_scene(before, scene)
        assert describe(query.run()) == answers

    allocator = wp.get_device(device).get_allocator()
    allocate, sizes = allocator.allocate, []

    def refuse_large(size):
        sizes.append(size)
        return allocate(size if size < 2**33 else 2**62)

    monkeypatch.setattr(allocator, "allocate", refuse_large)
    for call in (
        lambda: ab.Query(scene, "faces", pairs=PAIRS, capacity=2**31 - 1),
        lambda: GpuQuery(scene, "faces", pairs=PAIRS, capacity=ab.Buffers(uncertain=2**31 - 1)),
        lambda: query.make_room(hits=2**31 - 1),
    ):
        refused(RuntimeError, f"bytes on device '{device}'", call)
        assert sizes[-1] == 12 * (2**31 - 1)
        check()

    monkeypatch.setattr(request, "PAIRS_MAX", len(MORE_PAIRS))
    ab.Query(scene, pairs=MORE_PAIRS)  # as many as it holds
    refused(ValueError, "buffers: pairs 13 is outside", ab.Buffers, pairs=13)
    many = np.concatenate([MORE_PAIRS, PAIRS])
    for call in (lambda: query.set_pairs(many), lambda: scene.intersect(many), lambda: ab.Query(scene, pairs=many)):
        refused(ab.CapacityError, "15 object pairs at a time", call)
        check()
