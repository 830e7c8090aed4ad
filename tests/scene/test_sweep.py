"""`sweep` against a scene with an object a pose; what it keeps between calls."""

import gc
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from helpers import refused
from helpers.questions import GpuQuery
from helpers.samples import SHAPES, STILL, random_poses, sample
from helpers.scenes import scene_with

import warp_abtree as ab
from warp_abtree.checks.device_lock import device_lock
from warp_abtree.scene import sweep as pose_sweep


@pytest.fixture(autouse=True)
def kept():
    pose_sweep._kept.clear()
    yield pose_sweep._kept
    pose_sweep._kept.clear()


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(pose_sweep, "CHUNKS", (7,))


def ask_scene(device, models, poses, lod_a=None, **options):
    """Return the faces of a scene with an object a pose."""
    scene = scene_with(device, (models[0], STILL), lod=lod_a)
    for pose in poses:
        scene.add(models[1], pose)
    return scene.intersect([(0, i + 1) for i in range(len(poses))], output="faces", **options)


def mixed_poses(seed=1):
    """Poses of which some meet and some do not, more than three chunks of 7."""
    rng = np.random.default_rng(seed)
    return np.concatenate([random_poses(rng, 13, 1.2), random_poses(rng, 13, 6.0)])


@pytest.mark.parametrize("names, precision", [(("torus", "soup"), "exact"), (("torus", "torus"), "float32")])
def test_same_as_a_scene(device, names, precision, small_chunks):
    models, poses = [sample(name) for name in names], mixed_poses()
    options = {"lod_a": models[0].lod_for(fraction=0.3), "precision": precision}
    expected = ask_scene(device, models, poses, **options)
    assert 3 < expected.any.sum() < 26
    for _ in range(2):  # the second time from what is kept
        for output in ("any", "count", "faces"):
            found = ab.sweep(*models, poses, output=output, device=device, **options)
            np.testing.assert_array_equal(found, getattr(expected, output))
            assert found.dtype == getattr(expected, output).dtype


@pytest.mark.parametrize("kind", ["host", "device"])
def test_poses_proved_apart(device, kind, small_chunks):
    """As of a scene, for distances in turn; never where the surfaces are nearer, as the search of distances says."""
    models, poses = [sample("torus"), sample("soup")], mixed_poses()
    asked = wp.array(poses, dtype=wp.float64, device=device) if kind == "device" else poses
    pairs = [(0, i + 1) for i in range(len(poses))]
    distance = ab.sweep(*models, poses, output="distance", device=device)["distance"]
    for within in (0.5, 0.0, 2.0, 0.5):
        expected = ask_scene(device, models, poses, within=within)
        for output in ("any", "count"):
            found = ab.sweep(*models, asked, output=output, device=device, within=within)
            assert found.dtype.names == (output, "apart")
            np.testing.assert_array_equal(found[output], getattr(expected, output))
            np.testing.assert_array_equal(found["apart"], expected.apart)
            assert not (found["apart"] & (distance <= within)).any()
            assert (found["apart"] | (distance < within + 1e-6)).all() and 0 < found["apart"].sum() < len(pairs)
    assert ab.sweep(*models, poses[:0], within=1.0, device=device).dtype.names == ("any", "apart")
    np.testing.assert_array_equal(ab.sweep(*models, poses, device=device), expected.any)
    bad = np.where(np.arange(26)[:, None] == 16, np.nan, poses)
    refused(ValueError, "pose 16 is not finite", ab.sweep, *models, bad, within=1.0, device=device)


def test_more_poses_than_before_and_fewer(device, kept, monkeypatch):
    monkeypatch.setattr(pose_sweep, "CHUNKS", (2, 5, 20))
    models, poses = [sample("torus"), sample("soup")], mixed_poses()
    expected = ask_scene(device, models, poses)
    for count in (3, 26, 1, 17, 0, 26):
        for output in ("any", "faces"):
            found = ab.sweep(*models, poses[:count], output=output, device=device)
            whole = expected.any[:count] if output == "any" else expected.faces[expected.faces[:, 0] < count]
            np.testing.assert_array_equal(found, whole)
    assert sorted(next(iter(kept.values())).chunks) == [2, 5, 20]


@pytest.mark.slow
def test_lists_that_overflow_lose_nothing(device, kept, monkeypatch, small_chunks):
    """The CUDA regime, with room for one uncertain face pair; boxes lie flush."""
    box = sample("box")
    poses = np.tile(np.array(STILL), (20, 1))
    poses[:, 0] = np.arange(20) / 10
    expected = ask_scene(device, [box, box], poses)
    assert expected.any[:11].all() and not expected.any[11:].any()
    monkeypatch.setattr(pose_sweep, "Query", partial(GpuQuery, capacity=ab.Buffers(uncertain=1)))
    np.testing.assert_array_equal(ab.sweep(box, box, poses, output="faces", device=device), expected.faces)
    (posed,) = kept.values()
    assert len(posed.chunks[7].chunk_query.query.hits.uncertain) > 1


@pytest.mark.parametrize("kind", ["host", "device"])
def test_the_first_bad_pose_is_named(device, kind, small_chunks):
    torus, poses = sample("torus"), mixed_poses()

    def ask(asked):
        asked = wp.array(asked, dtype=wp.float64, device=device) if kind == "device" else asked
        return ab.sweep(torus, torus, asked, output="faces", device=device)

    expected = ask(poses)
    for column, factor, what in (
        (2, np.nan, "pose 16 is not finite"),
        (5, np.inf, "pose 16 is not finite"),
        (slice(3, 7), 3.0, "pose 16 has a quaternion of norm 3"),
        (slice(3, 7), 1.001001, "pose 16 has a quaternion of norm 1"),
    ):
        bad = poses.copy()
        bad[[16, 18, 25], column] *= factor
        refused(ValueError, what, ask, bad)
        np.testing.assert_array_equal(ask(poses), expected)
    just = poses.copy()
    just[:, 3:] *= 1.000999
    assert len(ab.sweep(torus, torus, just, device=device)) == len(poses)


def test_refused(device, kept):
    torus = sample("torus")
    asked = {"model_a": torus, "model_b": torus, "poses": [STILL, STILL], "device": device}
    for what, options in (
        ("shape", {"poses": np.zeros((2, 6))}),
        ("matrix 2 is not rigid", {"poses": np.eye(4) * [[[1.0]], [[1.0]], [[2.0]]]}),
        ("LOD", {"lod_b": 10**6}),
        ("ContactQuery", {"output": "contacts"}),
        ("within means nothing", {"output": "faces", "within": 1.0}),
        ("within means nothing", {"output": "distance", "within": 1.0}),
        ("within: -1.0 ", {"within": -1}),
        ("one distance for all", {"within": [1.0, 2.0]}),
        ("precision 'half'", {"precision": "half"}),
        ("solid", {"solid": "yes"}),
        ("no device", {"device": "cuda:99"}),
        ("not a Model", {"model_b": "torus"}),
    ):
        refused(TypeError if what == "not a Model" else ValueError, what, ab.sweep, **{**asked, **options})
    assert not kept


def new_model(name="box"):
    return ab.Model.from_arrays(*SHAPES[name](), base_faces=4)


def test_a_pair_of_models_is_set_up_once(device, kept):
    a, b, poses = new_model(), new_model("torus"), mixed_poses()
    first = ab.sweep(a, b, poses, device=device)
    (posed,) = kept.values()
    (chunk,) = posed.chunks.values()
    query = chunk.chunk_query
    assert np.array_equal(ab.sweep(a, b, poses, device=device), first)
    assert chunk.chunk_query is query and [*kept.values()] == [posed]
    ab.sweep(a, b, poses, output="count", device=device)
    assert chunk.chunk_query is not query and [*kept.values()] == [posed], "of one output: memory is bounded"
    for models, options in (((a, b), {"lod_a": 0}), ((a, b), {"lod_b": 3}), ((b, a), {})):
        ab.sweep(*models, poses, device=device, **options)
    assert len(kept) == 4


def test_what_is_kept_is_bounded_and_goes_with_its_models(device, kept):
    poses = mixed_poses()[:2]
    models = [new_model() for _ in range(pose_sweep.KEPT_PAIRS + 2)]
    other = new_model("torus")
    for model in models:
        ab.sweep(model, other, poses, device=device)
    assert len(kept) == pose_sweep.KEPT_PAIRS
    assert [key[0] for key in kept] == [id(model) for model in models[2:]]
    ab.sweep(models[2], other, poses, device=device)
    assert [key[0] for key in kept][-1] == id(models[2]), "the oldest is that asked longest ago"
    del models[-1], model
    gc.collect()
    assert len(kept) == pose_sweep.KEPT_PAIRS - 1
    del other
    gc.collect()
    assert not kept


def test_long_lists_are_not_kept(device, kept, monkeypatch):
    a, poses = sample("torus"), np.tile(np.array(STILL), (3, 1))
    for rows in (2**17, 100):
        monkeypatch.setattr(pose_sweep, "KEPT_ROWS", rows)
        ab.sweep(a, a, poses, output="faces", device=device)
        (posed,) = kept.values()
        assert (posed.chunks[1024].chunk_query is None) == (rows == 100)


def test_two_threads(device):
    """Each has its own buffers while both ask about the same models; on a GPU they take turns."""
    stream = wp.get_stream(device) if wp.get_device(device).is_cuda else None
    models, poses = [sample("torus"), sample("soup")], [mixed_poses(seed) for seed in (1, 2)]
    expected = [ab.sweep(*models, rows, output="count", device=device) for rows in poses]
    found = [[], []]

    def ask(i):
        for _ in range(10):
            found[i].append(ab.sweep(*models, poses[i], output="count", device=device))

    with ThreadPoolExecutor(2) as threads:
        list(threads.map(ask, range(2)))
    for answers, values in zip(found, expected, strict=True):
        assert len(answers) == 10 and all(np.array_equal(answer, values) for answer in answers)
    if stream is not None:  # where they do not, Warp may be left on the null stream, which cannot be captured
        assert wp.get_stream(device) is stream
        with wp.ScopedCapture(device):
            wp.zeros(3, device=device).fill_(1.0)


def test_threads_take_turns_on_a_gpu_alone():
    first, same, other = (SimpleNamespace(is_cuda=True, alias=f"cuda:{i}") for i in (98, 98, 99))

    def enters(device):
        """Whether another thread has a turn at once while this one has one on the first GPU."""
        entered = threading.Event()

        def work():
            with device_lock(device):
                entered.set()

        with device_lock(first), device_lock(first):  # within its own turn a thread may ask again
            thread = threading.Thread(target=work)
            thread.start()
            at_once = entered.wait(0.2)
        thread.join()
        assert entered.is_set()
        return at_once

    assert not enters(same) and enters(other) and enters(SimpleNamespace(is_cuda=False, alias="cpu"))
