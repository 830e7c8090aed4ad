"""Memory that ends, and steps that raise, in queries, frames, sweeps and bodies that are kept.

Out of memory, an operator goes on with what it had; interrupted, its next launch is whole, or it refuses in one
sentence; never another answer.
"""

from functools import partial

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.faults import (
    MORE_PAIRS,
    PAIRS,
    Interruption,
    MemoryShortage,
    add_objects,
    check_buffer_lengths,
    check_scene,
    describe,
    make_scene,
)
from helpers.gpu_query import GpuQuery
from helpers.samples import random_poses, sample

import warp_abtree as ab

REFUSED = "interrupted"


@pytest.fixture
def memory(device, monkeypatch):
    return MemoryShortage(device, monkeypatch)


@pytest.fixture
def interruption(device, monkeypatch):
    return Interruption(device, monkeypatch)


QUERIES = {
    "faces": (ab.Query, dict(output="faces", pairs=PAIRS[:1])),
    "within": (ab.Query, dict(output="count", pairs=PAIRS[:1], within=0.01)),
    "as on CUDA": (GpuQuery, dict(output="faces", pairs=PAIRS[:1])),
    "contacts": (ab.ContactQuery, dict(pairs=PAIRS[:1])),
}


@pytest.mark.parametrize("kind", QUERIES)
@pytest.mark.slow
def test_a_query_is_given_more_pairs(device, memory, kind):
    """It goes on with the pairs that it had, and later takes the others."""
    make_query, options = QUERIES[kind]

    def make():
        scene = make_scene(device)
        return scene, make_query(scene, **options)

    def check(before, made):
        scene, query = made
        check_buffer_lengths([query])
        now = [*check_scene(None, scene), *describe(query.run())]
        assert before is None or now == before
        return now

    count, _ = memory.everywhere(make, lambda made: made[1].set_pairs(MORE_PAIRS), check)
    assert count > 5
    scene, query = make()
    query.set_pairs(MORE_PAIRS)
    assert describe(query.run()) == describe(make_query(scene, **{**options, "pairs": MORE_PAIRS}).run())


GROWING = {
    "hits": (ab.Query, dict(output="faces", pairs=MORE_PAIRS, capacity=1)),
    "found pairs": (ab.Query, dict(output="faces", capacity=ab.Buffers(pairs=1, hits=1))),
    "found pairs within": (ab.Query, dict(output="count", capacity=ab.Buffers(pairs=1), within=0.01)),
    "contacts": (ab.ContactQuery, dict(pairs=MORE_PAIRS, capacity=1)),
    "found contacts": (ab.ContactQuery, dict(capacity=ab.Buffers(pairs=1, hits=1))),
    "uncertain pairs": (
        GpuQuery,
        dict(output="faces", pairs=[(0, 4), *PAIRS], capacity=ab.Buffers(uncertain=1, hits=1)),
    ),
}


@pytest.mark.parametrize("kind", GROWING)
@pytest.mark.slow
def test_a_query_grows(device, memory, kind):
    """Buffers that turn out too small, none of which may be left behind by the others."""
    make_query, options = GROWING[kind]

    def make():
        scene = make_scene(device)
        scene.add(scene.models[0], random_poses(np.random.default_rng(1), 1, 0.4)[0], lod=scene.lods[0])
        return scene, make_query(scene, **options)

    def check(before, made):
        check_buffer_lengths([made[1]])
        return check_scene(before, made[0])

    count, result = memory.everywhere(make, lambda made: made[1].run(), check)
    assert count >= 1 and result.any.any()


def test_the_broad_phase_grows(device, memory):
    """Among more objects in one place than it has room for pairs."""

    def make():
        scene = ab.Scene(device)
        for _ in range(20):
            scene.add(sample("box"))
        scene.batch()
        return scene

    def check(before, scene):
        assert scene.object_count == 20

    count, pairs = memory.everywhere(make, lambda scene: scene.broad_phase(), check)
    assert count > 5 and len(pairs) == 190


def test_the_tree_of_the_broad_phase(device, monkeypatch):
    """Warp allocates it past the allocator; a failure there spoils nothing either."""
    scene = make_scene(device)

    def fail(*args, **options):
        raise RuntimeError("Failed to create BVH: out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(wp, "Bvh", fail)
        for call in (scene.broad_phase, lambda: ab.Query(scene, "faces"), scene.intersect):
            with pytest.raises(RuntimeError, match="BVH"):
                call()
    expected = make_scene(device).intersect(output="faces")
    assert ab.Query(scene, "faces").run().count.sum() == expected.count.sum() > 0
    assert describe(scene.intersect(output="faces")) == describe(expected)


OPERATORS = {
    "faces": lambda scene: ab.Query(scene, "faces", pairs=MORE_PAIRS),
    "found": lambda scene: ab.Query(scene, "count", capacity=ab.Buffers(pairs=2)),
    "within": lambda scene: ab.Query(scene, "count", pairs=MORE_PAIRS, within=0.01),
    "contacts": lambda scene: ab.ContactQuery(scene, pairs=MORE_PAIRS, capacity=8),
    "manifolds": lambda scene: ab.ManifoldQuery(scene, capacity=ab.Buffers(pairs=2, hits=8)),
}
CALLS = {
    "launch": lambda query: query.launch(),
    "run": lambda query: query.run(),
    "set_pairs": lambda query: query.set_pairs([*MORE_PAIRS, *MORE_PAIRS]) if query.broad_phase is None else None,
    "result": lambda query: (query.launch(), query.result()),
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("kind", OPERATORS)
def test_queries(device, interruption, kind, call):
    """After an interruption there is no result until the next launch, which is whole, or the query refuses for good."""

    def make():
        query = OPERATORS[kind](make_scene(device))
        query.run()
        return query

    def check(before, query):
        if before is None:
            return query.run().count.tolist()
        try:
            assert query.result().count.tolist() == before
        except (RuntimeError, ab.CapacityError) as error:
            assert REFUSED in str(error) or "replaced" in str(error) or "nothing was launched" in str(error), error
        try:
            assert query.run().count.tolist() in (before, 2 * before)
        except RuntimeError as error:
            assert "make a new one" in str(error)
        return before

    steps, _ = interruption.everywhere(make, CALLS[call], check)
    assert steps > 1 or (call == "set_pairs" and kind in ("found", "manifolds"))


FRAMES = {
    "states of their own": dict(),
    "ladder": dict(ladder=[np.arange(0, 60, 10), np.arange(0, 60, 10)]),
    "contacts": dict(output="contacts", capacity=4096),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_frames(device, interruption, kind):
    """The next launch, or the replay of a graph captured before, gives what it gives on a frame of its own."""
    options = {"output": "count", "pairs": MORE_PAIRS, **FRAMES[kind]}

    def make():
        frame = ab.Pipeline(add_objects(device), **options)
        graph = frame.capture()
        frame.lods.assign(np.array([20, 41, 9, 33], np.int32))
        return frame, graph

    whole = make()[0]
    whole.launch()
    expected = whole.result().count.tolist()

    def check(before, made, launch):
        if before is None:
            return True
        with pytest.raises(RuntimeError, match=REFUSED):
            made[0].result()
        launch(*made)
        assert made[0].result().count.tolist() == expected
        made[0].check()

    for launch in (lambda frame, _: frame.launch(), lambda _, graph: wp.capture_launch(graph)):
        steps, _ = interruption.everywhere(make, lambda made: made[0].launch(), partial(check, launch=launch))
        assert steps > 3


def test_a_capture(device, interruption):
    """An interrupted capture leaves the frame as it was; it can be captured again."""

    def check(before, frame):
        wp.capture_launch(frame.capture())
        frame.check()
        now = frame.result().count.tolist()
        assert before is None or now == before
        return now

    def make():
        return ab.Pipeline(add_objects(device), output="count", pairs=MORE_PAIRS)

    assert interruption.everywhere(make, lambda frame: frame.capture(), check)[0] > 3


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
    """A step is whole, or has not begun, or the bodies refuse."""

    def make():
        scene = ab.Scene(device)
        scene.add(sample("box"), static=True)
        for height in (0.9, 1.85):
            scene.add(sample("box"), pose=(0.1, 0, height, 0, 0, 0, 1))
        bodies = ab.Dynamics(scene)
        bodies.step(1e-3)
        return bodies

    whole = make()
    whole.step(1e-3)
    expected = whole.poses().tobytes()

    def check(before, bodies):
        if before is None:
            return True
        try:
            bodies.step(1e-3)
            assert bodies.poses().tobytes() == expected
        except RuntimeError as error:
            assert "a step of the bodies was interrupted; make a new Dynamics" in str(error)

    assert interruption.everywhere(make, lambda bodies: bodies.step(1e-3), check)[0] > 10


@pytest.mark.slow
def test_collision_managers(device, interruption):
    ball, ring = trimesh.creation.icosphere(subdivisions=2), trimesh.creation.torus(1.0, 0.3)

    def make():
        manager = ab.CollisionManager(device)
        for k, mesh in enumerate((ball, ring, ball)):
            manager.add_object(str(k), mesh, trimesh.transformations.translation_matrix((0.9 * k, 0, 0)))
        return manager

    def ask(manager):
        found = manager.in_collision_single(ring, return_names=True)
        return found, manager.in_collision_internal(return_names=True)

    expected = ask(make())

    def check(before, manager):
        assert before is None or ask(manager) == expected
        return True

    assert interruption.everywhere(make, ask, check)[0] > 10
