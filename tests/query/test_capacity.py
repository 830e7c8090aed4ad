"""Buffers that are too small: the error names the demand, room for the demand is enough, and `run` makes room."""

import re

import numpy as np
import pytest
import warp as wp
from conftest import slow
from helpers import refused
from helpers.faults import MORE_PAIRS, PAIRS, check_scene, describe, make_scene
from helpers.questions import GpuQuery
from helpers.samples import sample

import warp_abtree as ab
from warp_abtree.query import request

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
        with pytest.raises(ab.CapacityError) as caught:
            result.check()
        pattern = rf"(\d+) [\w\s]*, the query has room for {room}: [^\n]*Buffers\({name}=\1\)"
        found = re.fullmatch(pattern, str(caught.value))
        assert found, caught.value
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


@pytest.fixture
def asked(device):
    """A scene, a query about it, and a check that both are as they were."""
    scene = make_scene(device)
    before, query = check_scene(None, scene), ab.Query(scene, "faces", pairs=PAIRS)
    answers = describe(query.run())

    def check():
        check_scene(before, scene)
        assert describe(query.run()) == answers

    return scene, query, check


def test_the_error_names_the_bytes(device, asked, monkeypatch):
    """The largest buffers that may be asked for: so many entries of three integers, refused as a full device does."""
    scene, query, check = asked
    allocator = wp.get_device(device).get_allocator()
    allocate, sizes = allocator.allocate, []

    def refuse_large(size):
        sizes.append(size)
        return allocate(size if size < 2**33 else 2**62)

    monkeypatch.setattr(allocator, "allocate", refuse_large)
    for call in (
        lambda: ab.Query(scene, "faces", pairs=PAIRS, capacity=2**31 - 1),
        lambda: GpuQuery(scene, "faces", pairs=PAIRS, capacity=ab.Buffers(uncertain=2**31 - 1)),
        lambda: query.resize(2**31 - 1),
    ):
        refused(RuntimeError, f"bytes on device '{device}'", call)
        assert sizes[-1] == 12 * (2**31 - 1)
        check()


def test_more_pairs_than_a_launch_holds(asked, monkeypatch):
    monkeypatch.setattr(request, "PAIRS_MAX", len(MORE_PAIRS))
    scene, query, check = asked
    ab.Query(scene, pairs=MORE_PAIRS)  # as many as it holds
    refused(ValueError, "buffers: pairs 13 is outside", ab.Buffers, pairs=13)
    many = np.concatenate([MORE_PAIRS, PAIRS])
    for call in (lambda: query.set_pairs(many), lambda: scene.intersect(many), lambda: ab.Query(scene, pairs=many)):
        refused(ab.CapacityError, "15 object pairs at a time", call)
        check()
