"""Model only what a scene requires: nothing is allocated for outputs, stages, LODs or objects that nobody asks for.

Every allocation of the device is booked, so what is held is counted where it is made, not where it is meant to be.
"""

import gc
from contextlib import contextmanager

import numpy as np
import pytest
import warp as wp
from helpers.gpu_query import GpuQuery
from helpers.samples import random_poses, sample

import warp_abtree as ab
from warp_abtree.scene import sweep as pose_sweep

CHUNK = 1024  # poses of a sweep at a time
SLACK = 4096  # counters of a few bytes, and what an allocator rounds up to


class Allocations:
    """What the allocator of a device holds [bytes]."""

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

    @property
    def held(self):
        return sum(self.size_of.values())

    @contextmanager
    def gained(self):
        """Yield a list that holds at the end what was gained within."""
        gc.collect()  # scenes and their queries hold each other
        before, found = self.held, []
        yield found
        gc.collect()
        found.append(self.held - before)


@pytest.fixture
def allocations(device, monkeypatch):
    return Allocations(device, monkeypatch)


def make_scene(device, count=40, lods=(None,), models=("ball",)):
    scene = ab.Scene(device)
    for i, pose in enumerate(random_poses(np.random.default_rng(1), count, 3.0)):
        model = sample(models[i % len(models)])
        lod = lods[i % len(lods)]
        scene.add(model, pose, lod=None if lod is None else model.lod_for(fraction=lod))
    return scene


def test_allocations_are_counted(device, allocations):
    with allocations.gained() as gained:
        array = wp.empty(1000, dtype=wp.float64, device=device)
    assert gained[0] == array.capacity == 8000
    with allocations.gained() as gained:
        del array
    assert gained == [-8000]


def test_a_scene_that_is_not_asked_holds_nothing(device, allocations):
    sample("ball")
    with allocations.gained() as gained:
        scene = make_scene(device)
    assert gained == [0] and scene.object_count == 40


@pytest.mark.parametrize("lods", [(None,), (0.1,), (0.1, None), (0.1, 0.3, 0.5, 1.0)])
def test_states_are_those_in_use(device, allocations, lods):
    """One state a model and LOD that stands, whatever the number of objects; a coarse one needs no finer one."""
    whole = make_scene(device, 1)
    with allocations.gained() as one:
        whole.batch()
    for models in (("ball",), ("ball", "torus")):
        scene = make_scene(device, 80, lods, models)
        scene.batch()
        states, objects = scene.batch().states, scene.batch().objects
        used = sorted({(scene.object_model[i], lod) for i, lod in enumerate(scene.lods.tolist())})
        assert sorted((slot.model, slot.lod) for slot in states.slots) == used
        assert states.node_room == sum(sample(models[m]).tree.node_count for m, _ in used)
        assert states.face_room == sum(sample(models[m]).face_count for m, _ in used)
        assert len(states.pool.node_box) == 2 * states.node_room and len(states.pool.face_corner) == states.face_room
        assert set(objects.state) == set(range(len(used)))
    with allocations.gained() as more:
        many = make_scene(device, 1000)
        many.batch()
    assert more[0] < one[0] + 1000 * 120 + SLACK, "objects that share a state cost no more than a pose and a number"


def test_an_lod_that_was_left_is_used_again(device, allocations):
    """LODs that wander for long hold one state, and what was allocated stays where it is."""
    scene = make_scene(device, 3)
    scene.batch()
    lods = [scene.lods // 2, scene.lods // 3, scene.lods]
    for target in lods:
        scene.set_lods(target)
    with allocations.gained() as gained:
        for target in lods * 3:
            scene.set_lods(target)
    assert len(scene.batch().states.slots) == 1 and abs(gained[0]) <= SLACK


def query_bytes(allocations, kind, scene, pairs, output, **options):
    with allocations.gained() as gained:
        query = kind(scene, output, pairs=pairs, **options)
        query.launch()
    assert query.result().any is not None
    return gained[0]


@pytest.mark.parametrize("kind", [ab.Query, GpuQuery])
@pytest.mark.slow
def test_a_query_has_room_for_its_output_alone(device, allocations, kind):
    scene = make_scene(device, 400)
    pairs = np.arange(400).reshape(-1, 2)
    scene.batch()
    query_bytes(allocations, kind, scene, pairs, "faces", within=1.0)  # what compiling and first launches hold
    held = {
        output: query_bytes(allocations, kind, scene, pairs, output, **options)
        for output, options in (("any", {}), ("count", {}), ("faces", {"capacity": 50_000}))
    }
    assert held["any"] == held["count"] and held["faces"] == held["any"] + 12 * 50_000
    near = query_bytes(allocations, kind, scene, pairs, "any", within=1.0)
    assert near > held["any"] and near - held["any"] < 100 * len(pairs) + SLACK, "a second answer, asked for"
    rounded = query_bytes(allocations, kind, scene, pairs, "any", precision="float32")
    if kind(scene, "any", pairs=pairs).uses_warps():
        room = 100_000
        wide = query_bytes(allocations, kind, scene, pairs, "any", capacity=ab.Buffers(uncertain=room))
        narrow = query_bytes(allocations, kind, scene, pairs, "any", capacity=ab.Buffers(uncertain=1))
        assert wide - narrow == 24 * (room - 1) and rounded < held["any"], "the exact stage has a list of its own"
    else:
        assert rounded == held["any"] < 300 * len(pairs) + SLACK, "one thread a pair: no lists between stages"


def test_given_pairs_need_no_broad_phase(device, allocations):
    scene = make_scene(device, 400)
    scene.batch()
    pairs = np.arange(400).reshape(-1, 2)
    scene.broad_phase()
    given = query_bytes(allocations, ab.Query, scene, pairs, "any")
    found = query_bytes(allocations, ab.Query, scene, None, "any", capacity=ab.Buffers(pairs=len(pairs)))
    assert found > given + 400 * 24, "boxes of all objects"
    assert ab.Query(scene, "any", pairs=pairs).broad_phase is None
    fresh = make_scene(device, 400)
    fresh.intersect(pairs, output="any")
    assert fresh._broad_phase is None


@pytest.mark.slow
def test_contacts_cost_only_those_who_ask(device, allocations):
    scene = make_scene(device, 60)
    scene.batch()
    pairs = np.arange(60).reshape(-1, 2)
    for output in ("any", "faces", "contacts"):
        make_scene(device, 60).intersect(pairs, output=output)
    with allocations.gained() as faces:
        scene.intersect(pairs, output="faces")
    with allocations.gained() as again:
        for _ in range(3):
            scene.intersect(pairs, output="faces")
    assert abs(again[0]) <= SLACK
    with allocations.gained() as contacts:
        scene.intersect(pairs, output="contacts")
    assert contacts[0] > faces[0]


def test_a_sweep_needs_no_more_for_more_poses(device, allocations):
    """Besides models and states, a chunk; the same for twenty chunks."""
    pose_sweep._kept.clear()
    ball, poses = sample("ball"), random_poses(np.random.default_rng(2), 20 * CHUNK, 3.0)
    pair = make_scene(device, 1)
    with allocations.gained() as whole:
        pair.batch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pose_sweep, "CHUNKS", (CHUNK,))
        with allocations.gained() as one:
            ab.sweep(ball, ball, poses[:CHUNK], device=device)
        with allocations.gained() as twenty:
            ab.sweep(ball, ball, poses, device=device)
    rows = (
        24 * 65536 + 2**22 if wp.get_device(device).is_cuda else 0
    )  # lists between stages and slots of the load balance
    assert 0 < one[0] < whole[0] + 512 * CHUNK + rows + SLACK
    assert abs(twenty[0]) <= SLACK
    pose_sweep._kept.clear()
