"""Frames that lose work or are given bad numbers: served as stated, and told once by the next check."""

import warnings
from contextlib import nullcontext

import numpy as np
import pytest
import warp as wp
from helpers.questions import GpuQuery
from helpers.samples import random_poses, sample
from helpers.scenes import add_objects, check_same, check_states, replay, set_lods, tops

import warp_abtree as ab
from warp_abtree.query import narrow_phase
from warp_abtree.scene import pipeline

pytestmark = pytest.mark.usefixtures("half_refitted_in_part")


def test_bad_poses(device):
    scene = add_objects(device, ["ball"] * 5, spread=0.3)
    frame = ab.Pipeline(scene, "count")
    good = random_poses(np.random.default_rng(10), 5, 0.3)
    frame.poses.assign(good)
    frame.launch()
    before = frame.result()
    launch = replay(frame)
    for column, value in ((0, np.nan), (5, -np.inf), (slice(3, 7), 0.0), (slice(3, 7), 0.6)):
        rows = good.copy()
        rows[3, column] = rows[2, column] = value
        frame.poses.assign(rows)
        launch()
        check_same(frame.result(), before)
        launch()
        frame.poses.assign(good)
        launch()  # a good frame hides nothing
        with pytest.raises(ValueError, match=r"poses: 4 rows .* is 2, and kept"):
            frame.check()
        frame.check()
    rows = good.copy()
    rows[:, 3:] *= [[1.0009], [0.9991], [1], [1], [1]]
    frame.poses.assign(rows)
    launch()
    frame.check()
    scene.set_poses(rows)
    check_same(frame.result(), scene.intersect(output="count"))


@pytest.mark.parametrize("ladder", ["every LOD", "both ends", "short"])
def test_bad_lods(device, ladder):
    """Below the coarsest it is served, beyond the finest the finest; the next check tells which object asked."""
    scene = add_objects(device, ["ball", "torus", "ball"])
    ends = [[0, model.lod_max] for model in scene.models]
    frame = ab.Pipeline(scene, "count", ladder={"every LOD": None, "both ends": ends, "short": [[5, 20], [7]]}[ladder])
    finest = frame.lods.numpy().astype(np.int64)
    np.testing.assert_array_equal(finest, [20, 7, 20] if ladder == "short" else tops(scene))
    launch = replay(frame)
    for i, lod in ((0, finest[0] + 1), (2, 2**31 - 1), *([] if ladder == "short" else [(1, -1), (2, -(2**31))])):
        lods = finest.copy()
        lods[i] = lod
        set_lods(frame, lods)
        launch()
        set_lods(frame, finest)
        scene.set_lods(np.clip(lods, 0, finest))
        check_states(frame, scene)
        launch()
        with pytest.raises(ValueError, match=f"lods: 1 entries .* is {i}, and took"):
            frame.check()
        frame.check()


def test_lost_work_is_told(device):
    """Also frames later, when all is well again; and `run` makes room."""
    scene = add_objects(device, ["ball"] * 6, spread=0.2)
    near = random_poses(np.random.default_rng(11), 6, 0.2)
    far = near + np.arange(6)[:, None] * [9.0, 0, 0, 0, 0, 0, 0]
    scene.set_poses(near)
    expected = scene.intersect(output="faces")
    hits = len(expected.faces)
    scene.set_poses(far)
    for options, message in (
        ({"hits": 2 * hits, "pairs": 14}, "pairs=15.*for 14"),
        ({"hits": hits - 1, "pairs": 15}, f"hits={hits}.* for {hits - 1}"),
        ({"hits": hits, "pairs": 15}, None),
    ):
        frame = ab.Pipeline(scene, "faces", capacity=ab.Buffers(**options))
        launch = replay(frame)
        for poses in (far, near, far):
            frame.poses.assign(poses)
            launch()
        with pytest.raises(ab.CapacityError, match=message) if message else nullcontext():
            frame.check()
        frame.check()
        frame.poses.assign(near)
        check_same(frame.run(), expected)
        frame.launch()
        frame.check()
        check_same(frame.result(), expected)


def test_one_check_tells_all_that_was_wrong(device):
    scene = add_objects(device, ["small ball"] * 2, spread=0.1)
    frame = ab.Pipeline(scene, output="faces", capacity=1)
    poses = frame.poses.numpy().copy()
    frame.poses.fill_(np.nan)
    frame.lods.fill_(10**6)
    frame.launch()
    frame.poses.assign(poses)
    with pytest.raises(ab.CapacityError, match=r"hits=.*poses: 2 rows.*lods: 2 entries"):
        frame.check()


REFUSED = [
    (dict(groups=[0.0, 1.0, 0.0]), "groups: .*type float64"),
    (dict(groups=[0, 0, 1]), "groups: .*group 0 holds objects of several models"),
    (dict(groups=[0, 2, 0]), "groups: .*without gaps"),
    (dict(ladder=[[1]]), "1 lists of LODs given for 2 models"),
    (dict(ladder=[[1], [10**6]]), "LOD 1000000 is outside"),
    (dict(groups=[0, 1, 0], ladder=[[0], [0]]), "give one of them"),
    (dict(output="all"), "none of 'any'"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ab.Pipeline(add_objects("cpu", ["ball", "torus", "ball"]), **options)


@pytest.fixture
def coincident(device, monkeypatch):
    """A scene of coincident objects, asked as on CUDA: float32 leaves many pairs of faces open."""
    monkeypatch.setattr(pipeline, "Query", GpuQuery)
    monkeypatch.setattr(narrow_phase, "UNCERTAIN_ROOM", 16)
    scene = ab.Scene(device)
    for _ in range(3):
        scene.add(sample("twins"))
    return scene


@pytest.mark.slow
def test_the_room_of_the_first_frame(coincident):
    """It is made unless given; one too small is told at construction, and lost frames at the check."""
    frame = ab.Pipeline(coincident, output="count")
    needed = int(frame.run().float64_tests.sum())
    assert len(frame.query.hits.uncertain) >= needed > 16
    with pytest.warns(RuntimeWarning, match=rf"=8\): .* leave {needed} .*uncertain={needed}"):
        frame = ab.Pipeline(coincident, output="count", capacity=ab.Buffers(uncertain=8))
    wp.capture_launch(frame.capture())
    with pytest.raises(ab.CapacityError, match=f"needed .*uncertain={needed}.*room for 8"):
        frame.check()
    expected = coincident.intersect(output="count").count
    for capacity in (None, ab.Buffers(uncertain=needed)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            frame = ab.Pipeline(coincident, output="count", capacity=capacity)
        wp.capture_launch(frame.capture())
        frame.check()
        np.testing.assert_array_equal(frame.result().count, expected)
