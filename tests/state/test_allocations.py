"""Device memory: allocated only for what a scene requires, and neither pickled nor copied."""

import copy
import gc
import pickle
from functools import partial

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.questions import GpuQuery, in_a_row
from helpers.samples import random_poses, sample
from helpers.scenes import add_objects

import warp_abtree as ab
from warp_abtree.checks.cpu_threads import core_count
from warp_abtree.kernels.search import descent
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.scene import sweep as pose_sweep

CHUNK = 1024  # poses of a sweep at a time
SLACK = 4096  # counters of a few bytes, and what an allocator rounds up to


class Allocations:
    """What the allocator of a device holds, by place [bytes]."""

    def __init__(self, device, monkeypatch):
        allocator = wp.get_device(device).get_allocator()
        allocate, deallocate = allocator.allocate, allocator.deallocate
        self.size_of = {}

        def book(size):
            at = allocate(size)
            self.size_of[at] = size
            return at

        def strike(at, size):
            self.size_of.pop(at, None)
            deallocate(at, size)

        monkeypatch.setattr(allocator, "allocate", book)
        monkeypatch.setattr(allocator, "deallocate", strike)

    def gained(self, call):
        """Return how many bytes more are held after a call, and what the call returned."""
        gc.collect()  # scenes and their queries hold each other
        before = sum(self.size_of.values())
        result = call()
        gc.collect()
        return sum(self.size_of.values()) - before, result


@pytest.fixture
def allocations(device, monkeypatch):
    gc.collect()
    gc.freeze()  # what other tests hold: collections are short
    yield Allocations(device, monkeypatch)
    gc.unfreeze()


def make_scene(device, count=40, fractions=(1.0,), names=("ball",)):
    return add_objects(device, (names * count)[:count], seed=1, spread=3.0, fractions=fractions)


def test_a_scene_that_is_not_asked_holds_nothing(device, allocations):
    sample("ball")
    array_bytes, array = allocations.gained(lambda: wp.empty(1000, dtype=wp.float64, device=device))
    assert array_bytes == array.capacity == 8000
    assert allocations.gained(lambda: make_scene(device))[0] == 0


@pytest.mark.parametrize("fractions", [(1.0,), (0.1, 0.3, 0.5, 1.0)])
def test_states_are_those_in_use(device, allocations, fractions):
    """One state a model and LOD that stands, whatever the number of objects; a coarse one needs no finer one."""
    one, _ = allocations.gained(make_scene(device, 1).batch)
    for models in (("ball",), ("ball", "torus")):
        scene = make_scene(device, 80, fractions, models)
        states, objects = scene.batch().states, scene.batch().objects
        used = sorted({(scene.object_model[i], lod) for i, lod in enumerate(scene.lods.tolist())})
        assert sorted((slot.model, slot.lod) for slot in states.slots) == used
        assert states.node_room == sum(sample(models[m]).tree.node_count for m, _ in used)
        assert states.face_room == sum(sample(models[m]).face_count for m, _ in used)
        assert len(states.pool.node_box) == 2 * states.node_room and len(states.pool.face_corner) == states.face_room
        assert set(objects.state) == set(range(len(used)))
    many, _ = allocations.gained(make_scene(device, 1000).batch)
    assert many < one + 1000 * 120 + SLACK, "objects that share a state cost no more than a pose and a number"


def query_bytes(allocations, kind, scene, pairs, output, **options):
    def make():
        query = kind(scene, output, pairs=pairs, **options)
        query.launch()
        return query

    size, query = allocations.gained(make)
    assert query.result().any is not None
    return size


@pytest.mark.parametrize("kind", [ab.Query, GpuQuery])
@pytest.mark.slow
def test_a_query_has_room_for_its_output_alone(device, allocations, kind):
    scene = make_scene(device, 400)
    pairs = np.arange(400).reshape(-1, 2)
    held = partial(query_bytes, allocations, kind, scene, pairs)
    held("faces", within=1.0)  # what compiling and first launches hold
    least = held("any")
    assert held("count") == least and held("faces", capacity=50_000) == least + 12 * 50_000
    assert least < held("any", within=1.0) < least + 100 * len(pairs) + SLACK, "a second answer, asked for"
    rounded = held("any", precision="float32")
    query = kind(scene, "any", pairs=pairs)
    if query.uses_warps():
        room = 100_000
        wide, narrow = (held("any", capacity=ab.Buffers(uncertain=count)) for count in (room, 1))
        assert wide - narrow == 24 * (room - 1) and rounded < least, "the exact stage has a list of its own"
    else:
        most = 300 * len(pairs) + query.traversal.slab_memory.capacity + SLACK
        assert rounded == least < most, "one thread a pair: no lists between stages"


def test_given_pairs_need_no_broad_phase(device, allocations):
    scene = make_scene(device, 400)
    pairs = np.arange(400).reshape(-1, 2)
    scene.broad_phase()
    ab.Query(scene, "any", pairs=pairs)  # slabs of the models, made at the first query of a GPU
    given = query_bytes(allocations, ab.Query, scene, pairs, "any")
    found = query_bytes(allocations, ab.Query, scene, None, "any", capacity=ab.Buffers(pairs=len(pairs)))
    assert found > given + 400 * 24, "boxes of all objects"
    assert ab.Query(scene, "any", pairs=pairs).broad_phase is None
    fresh = make_scene(device, 400)
    fresh.intersect(pairs, output="any")
    assert "broad phase" not in fresh._kept


def test_a_sweep_needs_no_more_for_more_poses(device, allocations, monkeypatch):
    """Besides models and states, a chunk; the same for twenty chunks."""
    pose_sweep._kept.clear()
    monkeypatch.setattr(pose_sweep, "CHUNKS", (CHUNK,))
    ball, poses = sample("ball"), random_poses(np.random.default_rng(2), 20 * CHUNK, 3.0)
    whole, _ = allocations.gained(make_scene(device, 1).batch)
    one, _ = allocations.gained(lambda: ab.sweep(ball, ball, poses[:CHUNK], device=device))
    twenty, _ = allocations.gained(lambda: ab.sweep(ball, ball, poses, device=device))
    # Lists between stages and slots of the load balance; on the CPU what each thread keeps slabs in.
    slabs = 4 * core_count() * descent.slab_memory_words(ball.tree.depth)
    rows = 24 * 65536 + 2**22 if wp.get_device(device).is_cuda else slabs
    assert 0 < one < whole + 512 * CHUNK + rows + SLACK
    assert abs(twenty) <= SLACK
    pose_sweep._kept.clear()


WAYS = {"pickle": pickle.dumps, "deepcopy": copy.deepcopy, "copy": copy.copy}
MAKERS = {
    "Scene": lambda scene: scene,
    "CollisionManager": lambda scene: ab.CollisionManager(scene.device),
    "Batch": lambda scene: scene.batch(),
    "ModelArrays": lambda scene: scene.batch().models,
    "StateArrays": lambda scene: scene.batch().states,
    "ObjectArrays": lambda scene: scene.batch().objects,
    "BroadPhase": lambda scene: BroadPhase(scene.batch()),
    "Query": lambda scene: ab.Query(scene, "any"),
    "ContactQuery": ab.ContactQuery,
    "ManifoldQuery": ab.ManifoldQuery,
    "DistanceQuery": ab.DistanceQuery,
    "FirstContactQuery": lambda scene: ab.FirstContactQuery(scene, None),
    "PoseInput": ab.PoseInput,
    "Pipeline": ab.Pipeline,
    "Frame": ab.Frame,
    "Dynamics": ab.Dynamics,
    "PaperController": lambda scene: ab.PaperController(scene, 8.0),
    "PredictiveController": lambda scene: ab.PredictiveController(scene, 8.0),
    "ToleranceController": lambda scene: ab.ToleranceController(scene, 1e-3),
    "LodUpdate": lambda scene: scene.set_lods([0, 0]),
    "Result": lambda scene: scene.intersect(device=True),
}


@pytest.fixture(scope="module")
def scenes():
    return {}


@pytest.mark.parametrize("name", MAKERS)
def test_device_memory_is_not_copied(device, name, scenes):
    scene = scenes.setdefault(device, in_a_row(device, "small ball", [0.0, 0.1]))
    made = MAKERS[name](scene)
    assert type(made).__name__ == name
    for held in (made, [made], {"a": made}):
        for way in WAYS.values():
            if way is copy.copy and held is not made:
                continue
            refused(TypeError, f"^this {name} holds device memory and cannot be pickled or copied; ", way, held)


def test_what_lies_on_the_host_is_copied(device):
    scene = in_a_row(device, "small ball", [0.0, 0.1])
    result = scene.intersect(output="contacts")
    for made in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result), copy.copy(result)):
        assert made.contacts.tobytes() == result.contacts.tobytes() and len(made) == len(result)
        made.check()
    motion = ab.Kinematic(np.zeros((2, 3)))
    ab.Frame(scene, motion=motion).run(1)
    for made in (scene.models[0], ab.Ladder(scene.models), scene.tree_state(0), ab.Buffers(hits=5), motion):
        assert type(pickle.loads(pickle.dumps(copy.deepcopy(made)))) is type(made)
