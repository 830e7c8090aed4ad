"""Contact points found part by part, in short lists: the same bytes as in lists for all pairs at once."""

import gc
import weakref

import numpy as np
import pytest
import trimesh
import warp as wp
from helpers.bodies import about, model_of

import warp_abtree as ab
from warp_abtree.query import point_parts
from warp_abtree.query.operator import Operator

GAP, SIDE = 0.06, 4
BALL = model_of(trimesh.creation.icosphere(subdivisions=3, radius=0.52))
RING = model_of(trimesh.creation.torus(0.4, 0.16))


def grid(device, solids=False):
    """Return a scene of balls and rings that just reach their neighbours, turned at random, and their poses."""
    rng, scene = np.random.default_rng(1), ab.Scene(device)
    places = np.stack(np.meshgrid(*[np.arange(SIDE)] * 2, [0]), -1).reshape(-1, 3) * 0.95
    poses = [[*(place + rng.normal(size=3) * 0.01), *about(rng.normal(size=3), 3.0)] for place in places]
    scene.add_many([(BALL, RING)[i % 3 == 0] for i in range(len(places))], poses, solids=solids)
    return scene, np.array(poses)


def bytes_of(result):
    """Return the bytes of what a result has, by name, but for its counts of tests."""
    made = {"pairs": result.pairs, "any": result.any, "count": result.count, **result.points}
    return {name: np.ascontiguousarray(array).tobytes() for name, array in made.items()}


def shorten_lists(monkeypatch, hits=300, uncertain=2000):
    """Let longer lists serve parts of the pairs."""
    monkeypatch.setattr(point_parts, "HITS_AT_ONCE", hits)
    monkeypatch.setattr(point_parts, "UNCERTAIN_AT_ONCE", uncertain)


def both(monkeypatch, make, rounds):
    """Return what a query finds whole and in parts, of each round, which moves objects; and the query in parts."""
    found = []
    for at_once in ((10**9, 10**9), (300, 2000)):
        shorten_lists(monkeypatch, *at_once)
        scene, poses, query = make()
        own = []
        for move in range(rounds):
            shift = np.sin(np.arange(3 * len(poses))).reshape(-1, 3) * (np.arange(len(poses)) % 2)[:, None]
            scene.set_poses(poses + np.pad(0.02 * move * shift, ((0, 0), (0, 4))))
            own.append(bytes_of(query.run()))
        found.append(own)
    return *found, query


OPTIONS = {
    "crossing": {},
    "gap": {"gap": GAP},
    "remembered": {"gap": GAP, "remember": 0.01},
    "originals": {"gap": GAP, "originals": True},
    "many points": {"gap": GAP, "points": 32},
}


# Options, whether objects are solids and pairs given, and the regime: each option as either.
REGIMES = ("threads", "warps")
ROWS = [(name, given, REGIMES[(given + k) % 2]) for k, name in enumerate(OPTIONS) for given in (False, True)]


@pytest.mark.parametrize(("name", "given", "regime"), ROWS, indirect=["regime"])
def test_parts_find_the_same_bytes(device, monkeypatch, name, given, regime):
    """Whatever is asked, over rounds in which some pairs rest and others do not."""

    def make():
        scene, poses = grid(device, solids=given)
        if "originals" in OPTIONS[name]:
            scene.set_lods([scene.models[k].lod_max // 2 for k in scene.batch().object_model])
        pairs = scene.intersect(output="any", within=GAP).pairs[::-1] if given else None
        return scene, poses, ab.ManifoldQuery(scene, pairs, ab.Buffers(100, None, 100), **OPTIONS[name])

    whole, parted, query = both(monkeypatch, make, 3)
    assert whole == parted
    assert query.parts is not None and query.parts.count > 1


def ask_in_parts(device, monkeypatch, **options):
    """Return a scene, its poses, and a query of it in parts, after its first round."""
    shorten_lists(monkeypatch, 300, 8000)
    scene, poses = grid(device)
    query = ab.ManifoldQuery(scene, None, ab.Buffers(100, 200, 100), gap=GAP, **options)
    query.run()
    return scene, poses, query


@pytest.mark.usefixtures("regime")
def test_lists_of_parts_that_are_too_short_tell_and_grow(device, monkeypatch):
    """A launch tells what it lacked; a run makes parts smaller until lists suffice, down to one pair."""
    scene, poses, query = ask_in_parts(device, monkeypatch)
    parts, alike = query.parts.count, query.run()
    poses[:, :3] *= 0.8
    scene.set_poses(poses)
    query.launch()
    with pytest.raises(ab.CapacityError, match="the query has room for"):
        query.result().check()
    closer = query.run()
    assert closer.count.sum() > 2 * alike.count.sum() and query.parts.count > parts
    shorten_lists(monkeypatch, 10, 10)
    one = ab.ManifoldQuery(scene, None, ab.Buffers(10, None, 10), gap=GAP)
    assert bytes_of(one.run()) == bytes_of(closer) and one.parts.count == len(closer.pairs)
    assert len(one.hits.face) >= closer.count.max()


def test_more_pairs_than_before_are_more_parts(device, monkeypatch):
    """Where the broad phase outgrows its room the parts go on in arrays that are new."""
    shorten_lists(monkeypatch)
    scene, poses = grid(device)
    apart = poses.copy()
    apart[:-3, :3] *= 3
    scene.set_poses(apart)
    query = ab.ManifoldQuery(scene, None, ab.Buffers(10, 2, 10), gap=GAP)
    few = query.run()
    scene.set_poses(poses)
    found = query.run()
    assert len(few.pairs) < len(found.pairs) > 20 and query.parts is not None
    shorten_lists(monkeypatch, 10**9, 10**9)
    assert bytes_of(found) == bytes_of(ab.ManifoldQuery(scene, gap=GAP).run())


# Objects that were removed, as the first two, are in no part. Where hits are too many for one list, what waits has room
# in its list, but perhaps not in that of a part.
@pytest.mark.usefixtures("regime")
@pytest.mark.parametrize(("removed", "at_once", "room"), [([0, 1], (300, 2000), 100), ([], (60, 500), 2**17)])
def test_parts_of_what_is_left_and_lists_that_are_shorter_than_the_querys(device, monkeypatch, removed, at_once, room):
    scene, _poses = grid(device)
    scene.remove(removed)
    whole = bytes_of(ab.ManifoldQuery(scene, gap=GAP).run())
    shorten_lists(monkeypatch, *at_once)
    query = ab.ManifoldQuery(scene, None, ab.Buffers(100, None, room), gap=GAP)
    assert bytes_of(query.run()) == whole and query.parts is not None


def test_parts_are_in_graphs(monkeypatch):
    """A captured launch replays at other poses; one from before the lists grew has no result."""
    if not wp.is_cuda_available():
        pytest.skip("no GPU")
    scene, poses, query = ask_in_parts("cuda:0", monkeypatch, remember=0.01)
    with wp.ScopedCapture("cuda:0") as capture:
        query.launch()
    scene.set_poses(poses + [0.01, 0, 0, 0, 0, 0, 0])
    query.forget()
    wp.capture_launch(capture.graph)
    replayed = bytes_of(query.result())
    query.forget()
    assert replayed == bytes_of(query.run())
    query.make_list_room(hits=4 * query.list_rooms.hits)
    wp.capture_launch(capture.graph)
    with pytest.raises(RuntimeError, match="no result"):
        query.result()


@pytest.mark.parametrize(("by_frames", "regime"), [(False, "threads"), (True, "warps")], indirect=["regime"])
def test_bodies_move_alike_in_parts(device, monkeypatch, by_frames, regime):
    """A heap falls to the same bytes, whatever the lists."""

    def fall():
        scene, _poses = grid(device, solids=True)
        bodies = ab.Dynamics(scene, capacity=ab.Buffers(100, None, 100))
        frame = ab.Frame(scene, bodies.motion(), time_step=0.01)
        for _ in range(6):
            if by_frames:
                frame.step()
            else:
                bodies.step(0.01)
        return scene.poses.tobytes(), bodies.query.parts is not None

    whole, parted = fall()
    assert not parted
    shorten_lists(monkeypatch, 300, 300)
    assert fall() == (whole, True)


@pytest.mark.usefixtures("regime")
def test_parts_whose_growth_was_interrupted_are_linked_by_the_next_run(device, monkeypatch):
    """The query has the lists of its parts, and no graph of before, wherever they were about to be lent."""
    scene, poses, query = ask_in_parts(device, monkeypatch)
    poses[:, :3] *= 0.8
    scene.set_poses(poses)
    whole, link, before = query._link_parts, [KeyboardInterrupt], query.guard.buffers.number

    def interrupted():
        raise link.pop()

    monkeypatch.setattr(query, "_link_parts", interrupted)
    with pytest.raises(KeyboardInterrupt):
        query.run()
    assert query.guard.buffers.number > before
    monkeypatch.setattr(query, "_link_parts", whole)
    query.run()
    operator = query.parts.operator
    assert query.faces is operator.faces and len(query.hits.face) == query.list_rooms.hits


def test_lists_that_parts_replace_are_freed(device, regime, monkeypatch):
    """Recorded launches kept them: half a gigabyte beside the lists of the parts."""
    shorten_lists(monkeypatch, uncertain=10**9)
    scene, _ = grid(device)
    query = ab.ManifoldQuery(scene, gap=GAP)
    query.launch()
    old = [weakref.ref(getattr(query.hits, name)) for name in ("face", "apart")]
    query.run()
    assert query.parts is not None
    gc.collect()
    assert not any(array() is not None for array in old)


@pytest.mark.parametrize("regime", ["warps"], indirect=True)
def test_no_lists_for_all_pairs_come_before_those_of_parts(device, monkeypatch, regime):
    """What a first search counts says that parts are needed, though its lists of face pairs that wait were short."""
    scene, _ = grid(device)
    whole = ab.ManifoldQuery(scene, gap=GAP)
    expected = bytes_of(whole.run())
    shorten_lists(monkeypatch, hits=1500, uncertain=10**9)
    query, made = ab.ManifoldQuery(scene, None, ab.Buffers(100, None, 100), gap=GAP), []
    monkeypatch.setattr(query, "make_room", lambda **rooms: (made.append(rooms), Operator.make_room(query, **rooms)))
    assert bytes_of(query.run()) == expected and query.parts.count > 1
    assert made == [{"hits": 1, "uncertain": 1}]
