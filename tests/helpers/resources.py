"""Scenes that faults are injected into, and what must be the same afterwards."""

import numpy as np

import warp_abtree as ab
from helpers.samples import random_poses, sample
from helpers.scenes import everything
from warp_abtree.kernels.contact.summary import CHUNK
from warp_abtree.query.contacts import VECTORS
from warp_abtree.state.arrays import SLOT_COLUMNS

PAIRS = np.array([(0, 1), (1, 2), (3, 1)])
MORE_PAIRS = np.array([(i, j) for i in range(4) for j in range(4) if i != j])


def describe(result):
    """Return results, LOD statistics or arrays as comparable bytes."""
    if isinstance(result, ab.Result):
        values = [result.pairs, result.any, result.count, result.faces, result.apart]
        values += [result.contacts, result.pair_contacts]
    elif hasattr(result, "nodes_refitted"):
        values = [result.state, result.lod, result.full, result.k, result.nodes_refitted]
    else:
        values = [result]
    return [None if value is None else np.asarray(value).tobytes() for value in values]


def add_objects(device, count=4):
    scene = ab.Scene(device)
    poses = random_poses(np.random.default_rng(1), count, 0.4)
    for i in range(count):
        model = sample(("small ball", "torus")[i % 2])
        scene.add(model, poses[i], lod=model.lod_for(fraction=(0.4, 0.2)[i % 2]))
    return scene


def make_scene(device):
    """Return a scene that has been asked, with states that are shared, copied and freed."""
    scene = add_objects(device)
    lods = scene.lods
    scene.set_lods(lods - [0, 3, 5, 9])
    scene.set_lods(lods)
    scene.intersect(PAIRS, output="faces")
    return scene


def check_scene(before, scene):
    """Return all that a scene holds and answers, or check that it still does."""
    states = scene.batch().states.pool
    now = [getattr(states, name).numpy().tobytes() for name in SLOT_COLUMNS]
    now += [*everything(scene), *describe(scene.intersect(PAIRS, output="faces"))]
    now += describe(scene.intersect(MORE_PAIRS, output="count"))
    assert before is None or now == before
    return now


def check_answers(before, scene):
    """Return all that a scene answers, or check that it still does; states may have moved in the pool."""
    now = [scene.lods.tobytes(), *describe(scene.intersect(PAIRS, output="faces"))]
    now += describe(scene.intersect(MORE_PAIRS, output="count"))
    now.append(scene.broad_phase().tobytes())
    for i in range(scene.object_count):
        state = scene.tree_state(i)
        now += [state.lod, *(getattr(state, name).tobytes() for name in ("status", "lower", "upper", "skip"))]
    objects = scene.batch().objects.pool
    now += [objects.rotation.numpy().tobytes(), objects.position.numpy().tobytes()]
    assert before is None or now == before
    return now


def check_buffer_lengths(queries):
    """Check that all arrays with an entry a pair or a contact are of one length, or kernels write past an end."""
    for query in queries:
        rooms = [query.pair_poses]
        for hits in (query.hits, query.near):
            if hits is not None:
                rooms += [hits.any_hit, hits.count, hits.node_tests, hits.triangle_tests, hits.exact_tests]
        if query.near is not None:
            rooms.append(query.within)
        if query.broad_phase is not None:
            rooms.append(query.broad_phase.pairs)
        if isinstance(query, ab.ContactQuery):
            means, sums, contacts = query.pair_contacts, query._sums, query.contacts
            rooms += [means.point, means.normal, means.depth, sums.total, sums.middle, query.start[1:]]
            places = [query.faces, *(getattr(contacts, name) for name in (*VECTORS, "coplanar"))]
            places += [query._key[::2], query._order[::2]]
            assert {len(array) for array in places} == {len(query.hits.face)}
            chunks = [sums.point, sums.normal, sums.length, sums.area, sums.change, sums.front, sums.back, sums.span]
            assert {len(array) for array in chunks} == {len(query.hits.face) // int(CHUNK) + len(query.pairs)}
        assert {len(room) for room in rooms} == {len(query.pairs)}
