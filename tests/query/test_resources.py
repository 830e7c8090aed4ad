"""A device that runs out of memory: one clear error, whichever allocation fails, and a scene that goes on as before.

Each operation is repeated on a scene made anew, with its first, second, third ... allocation failing and every later
one too, until it succeeds: that is every point at which memory can run out.
"""

import re
from contextlib import contextmanager

import numpy as np
import pytest
import warp as wp
from helpers.gpu_query import GpuQuery
from helpers.resources import MORE_PAIRS, PAIRS, add_objects, check_scene, describe, make_scene
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree.kernels.contact.summary import CHUNK
from warp_abtree.query import request
from warp_abtree.query.contacts import VECTORS

SHORTAGE = r"Failed to allocate \d+ bytes on device '{}'"


class Memory:
    """The allocator of a device, which can be made to fail from some allocation on, as it does where memory ends."""

    def __init__(self, device, monkeypatch):
        allocator = wp.get_device(device).get_allocator()
        self.device = device
        self.left = None
        self._allocate = allocator.allocate
        monkeypatch.setattr(allocator, "allocate", self.allocate)

    def allocate(self, size):
        if self.left is None:
            return self._allocate(size)
        self.left -= 1
        return self._allocate(size if self.left >= 0 else 2**62)

    def run_out(self, call, count):
        """Return what a call returns that may make a number of allocations, or None and the error of the next."""
        self.left = count
        try:
            return call(), None
        except RuntimeError as error:
            return None, error
        finally:
            self.left = None

    def exhaust(self, make, call, check):
        """Let every allocation of a call fail in turn; return how many there are and what it returns at last.

        Args:
            make: Returns what the call is made on.
            check: Called as check(before, made) after each failure; with before None it returns what must not change.
        """
        for count in range(1000):
            made = make()
            before = check(None, made)
            result, error = self.run_out(lambda made=made: call(made), count)
            if error is None:
                return count, result
            message = str(error)
            assert re.fullmatch(SHORTAGE.format(self.device), message), message
            assert error.__context__ is None, "one error, not an error on the way from another"
            check(before, made)
            self.compare(call(made), make, call)
        raise AssertionError("the call never ends")

    def compare(self, result, make, call):
        """Check that a call that failed once gives what it gives on a scene that saw no failure."""
        assert describe(result) == describe(call(make()))


@pytest.fixture
def memory(device, monkeypatch):
    return Memory(device, monkeypatch)


def test_first_use(device, memory):
    """A scene that never found room for its arrays gets them as soon as there is."""
    whole = check_scene(None, add_objects(device))

    def check(before, scene):
        assert scene.object_count == 4
        assert before is None or check_scene(None, scene) == whole

    count, _ = memory.exhaust(lambda: add_objects(device), lambda scene: scene.intersect(PAIRS, output="faces"), check)
    assert count > 30


@pytest.mark.slow
def test_a_new_object(device, memory):
    """Poses and LODs of the others stay where they were set, not where they were added."""

    def make():
        scene = make_scene(device)
        scene.set_poses(random_poses(np.random.default_rng(2), 4, 0.5))
        answers = describe(scene.intersect(PAIRS, output="faces"))
        scene.add(sample("box"), lod=3)
        return scene, answers

    def check(before, made):
        scene, answers = made
        if before is None:
            return True
        assert scene.object_count == 5 and scene.lods[4] == 3
        assert describe(scene.intersect(PAIRS, output="faces")) == answers

    count, _ = memory.exhaust(make, lambda made: made[0].intersect([(4, 0)], output="faces"), check)
    assert count > 30


MOVES = {
    "in place": [0, 7, 0, 7],
    "one apart": [0, 3, 5, 9],
    "all apart": [2, 30, 11, 60],
    "coarsest": [-1, -1, -1, -1],
}


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.slow
def test_lods(device, memory, move):
    """States that move, that are copied, taken again and new, and a pool that grows."""

    def set_lods(scene):
        return scene.set_lods(np.zeros(4, int) if move == "coarsest" else scene.lods - MOVES[move])

    def make():
        scene = make_scene(device)
        if move == "one apart":
            scene.batch().states.free.clear()  # no state to take again: the pool grows
        return scene

    count, _ = memory.exhaust(make, set_lods, check_scene)
    assert count > 5


@pytest.mark.parametrize("matrices", [False, True])
def test_poses(device, memory, matrices):
    poses = random_poses(np.random.default_rng(3), 4, 0.5)
    if matrices:
        poses = np.tile(np.eye(4), (4, 1, 1)) + 0.1 * np.eye(4, k=3)

    def move(scene):
        scene.set_poses(poses)
        return scene.batch().objects.pool.position.numpy()

    memory.exhaust(lambda: make_scene(device), move, check_scene)


QUESTIONS = {
    "any": dict(),
    "faces": dict(output="faces"),
    "contacts": dict(output="contacts"),
    "within": dict(output="count", within=0.01),
    "float32": dict(output="count", precision="float32"),
}


@pytest.mark.parametrize("pairs", [MORE_PAIRS, None], ids=["given", "found"])
@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.slow
def test_questions(device, memory, question, pairs):
    """More pairs than the scene was asked before, with what belongs to each, and more hits than it had room for."""
    options = QUESTIONS[question]

    def make():
        scene = make_scene(device)
        scene.intersect(PAIRS[:1], **options)
        return scene

    def check(before, scene):
        rooms_agree(scene._queries.values())
        return check_scene(before, scene)

    count, result = memory.exhaust(make, lambda scene: scene.intersect(pairs, **options), check)
    assert count > 5 and result.any.any()


def rooms_agree(queries):
    """Check that all arrays that have an entry a pair or a contact are of one length, or kernels write past an end."""
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


# --- queries that are kept -------------------------------------------------------------------------------------------


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
        return make_query(make_scene(device), **options)

    def check(before, query):
        rooms_agree([query])
        now = [*check_scene(None, query.scene), *describe(query.run())]
        assert before is None or now == before
        return now

    count, _ = memory.exhaust(make, lambda query: query.set_pairs(MORE_PAIRS), check)
    assert count > 5
    query = make()
    query.set_pairs(MORE_PAIRS)
    assert describe(query.run()) == describe(make_query(query.scene, **{**options, "pairs": MORE_PAIRS}).run())


GROWING = {
    "hits": (ab.Query, dict(output="faces", pairs=MORE_PAIRS, capacity=1)),
    "found pairs": (ab.Query, dict(output="faces", capacity=ab.Buffers(pairs=1, hits=1))),
    "found pairs within": (ab.Query, dict(output="count", capacity=ab.Buffers(pairs=1), within=0.01)),
    "contacts": (ab.ContactQuery, dict(pairs=MORE_PAIRS, capacity=1)),
    "found contacts": (ab.ContactQuery, dict(capacity=ab.Buffers(pairs=1, hits=1))),
    "unsure faces": (GpuQuery, dict(output="faces", pairs=[(0, 4), *PAIRS], capacity=ab.Buffers(uncertain=1, hits=1))),
}


@pytest.mark.parametrize("kind", GROWING)
@pytest.mark.slow
def test_a_query_grows(device, memory, kind):
    """Buffers that turn out too small, none of which may be left behind by the others."""
    make_query, options = GROWING[kind]

    def make():
        scene = make_scene(device)
        scene.add(scene.models[0], random_poses(np.random.default_rng(1), 1, 0.4)[0], lod=scene.lods[0])
        return make_query(scene, **options)

    def check(before, query):
        rooms_agree([query])
        return check_scene(before, query.scene)

    count, result = memory.exhaust(make, lambda query: query.run(), check)
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

    count, pairs = memory.exhaust(make, lambda scene: scene.broad_phase(), check)
    assert count > 5 and len(pairs) == 190


def test_the_tree_of_the_broad_phase(device, monkeypatch):
    """Warp allocates it past the allocator; a failure there spoils nothing either."""
    scene = make_scene(device)
    plain = wp.Bvh

    def fail(*args, **options):
        raise RuntimeError("Failed to create BVH: out of memory")

    monkeypatch.setattr(wp, "Bvh", fail)
    for call in (scene.broad_phase, lambda: ab.Query(scene, "faces"), scene.intersect):
        with pytest.raises(RuntimeError, match="BVH"):
            call()
    monkeypatch.setattr(wp, "Bvh", plain)
    expected = make_scene(device).intersect(output="faces")
    assert ab.Query(scene, "faces").run().count.sum() == expected.count.sum() > 0
    assert describe(scene.intersect(output="faces")) == describe(expected)


# --- the demand ------------------------------------------------------------------------------------------------------


@contextmanager
def little_memory(device):
    """Leave a device less memory than the largest buffer takes."""
    if wp.get_device(device).is_cuda:
        spare = wp.get_device(device).free_memory - 2**33
        hog = wp.empty((max(spare >> 20, 1), 2**20), dtype=wp.uint8, device=device)
        yield hog
        return
    resource = pytest.importorskip("resource")
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            used = int(file.read().split()[0]) * resource.getpagesize()
    except OSError:
        pytest.skip("no way here to tell how much memory the process uses")
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + 2**33, hard))
    try:
        yield None
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


LARGEST = 2**31 - 1


@pytest.mark.slow
def test_the_error_names_the_demand(device):
    """The largest buffers that may be asked for, for real: so many entries of three or two integers."""
    scene = make_scene(device)
    before = check_scene(None, scene)
    query = ab.Query(scene, "faces", pairs=PAIRS)
    answers = describe(query.run())
    with little_memory(device):
        for size, call in (
            (12 * LARGEST, lambda: ab.Query(scene, "faces", pairs=PAIRS, capacity=LARGEST)),
            (12 * LARGEST, lambda: GpuQuery(scene, "faces", pairs=PAIRS, capacity=ab.Buffers(uncertain=LARGEST))),
            (12 * LARGEST, lambda: query.resize(LARGEST)),
        ):
            with pytest.raises(RuntimeError, match=f"{size} bytes on device '{device}'"):
                call()
            check_scene(before, scene)
            assert describe(query.run()) == answers


def test_more_pairs_than_a_launch_holds(device, monkeypatch):
    monkeypatch.setattr(request, "PAIRS_MAX", len(MORE_PAIRS))
    scene = make_scene(device)
    before = check_scene(None, scene)
    query = ab.Query(scene, "faces", pairs=PAIRS)
    answers = describe(query.run())
    with pytest.raises(ValueError, match="buffers: pairs 13 is outside"):
        ab.Query(scene, "any", capacity=ab.Buffers(pairs=13))
    many = np.concatenate([MORE_PAIRS, PAIRS])
    for call in (lambda: query.set_pairs(many), lambda: scene.intersect(many), lambda: ab.Query(scene, pairs=many)):
        with pytest.raises(ab.CapacityError, match="15 object pairs at a time"):
            call()
        check_scene(before, scene)
        assert describe(query.run()) == answers


def named_demand(query, name):
    """Return the demand that the error of a query's launch names."""
    query.launch()
    with pytest.raises(ab.CapacityError) as caught:
        query.result().check()
    assert "\n" not in str(caught.value)
    return int(re.search(name, str(caught.value)).group(1))


@pytest.mark.parametrize("kind", ["unsure", "pairs"])
@pytest.mark.slow
def test_room_for_the_demand_is_enough(device, kind):
    """As the error of a query that lost work names it; hits are in test_intersect."""
    scene = make_scene(device)
    for _ in range(2):
        scene.add(sample("twins"))
    whole = scene.intersect(output="faces")
    if kind == "unsure":
        options = dict(output="faces", pairs=whole.pairs, capacity=len(whole.faces))
        demand = named_demand(GpuQuery(scene, **options, capacity=ab.Buffers(uncertain=1)), r"uncertain=(\d+)")
        query = GpuQuery(scene, **options, capacity=ab.Buffers(uncertain=demand))
    else:
        demand = named_demand(ab.Query(scene, "faces", capacity=ab.Buffers(pairs=1)), r"pairs=(\d+)")
        assert demand == len(whole.pairs)
        query = ab.Query(scene, "faces", capacity=ab.Buffers(pairs=demand, hits=len(whole.faces)))
    query.launch()
    result = query.result()
    result.check()
    assert len(result.faces) == len(whole.faces) and demand > 1
