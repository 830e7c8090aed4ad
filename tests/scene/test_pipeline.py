"""A captured frame: states and answers of the scene on the host, frame by frame; lost work and bad numbers are told."""

import warnings
from contextlib import nullcontext

import numpy as np
import pytest
import warp as wp
from helpers import refused, scenes
from helpers.questions import GpuQuery, in_a_row, to_matrix
from helpers.samples import random_poses, sample
from helpers.scenes import CROWD, add_objects, check_same, check_states, set_lods, tops
from oracles.triangle import pose_matrix, quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
from warp_abtree.query import operator
from warp_abtree.scene import pipeline
from warp_abtree.state import work_lists

pytestmark = pytest.mark.usefixtures("half_refitted_in_part")

NAMES = ("one", "two", "small ball", "crumbs", "grid", "soup", "lattice soup", "twins")


@pytest.mark.usefixtures("update_path")
def test_random_walk_in_a_graph(device):
    """Bits of a rebuild, and the counters of the host's path, which moves a scene of one object in the same steps."""
    rng = np.random.default_rng(1)
    names = rng.permutation(np.repeat(NAMES, 3))
    scene = add_objects(device, names)
    frame = ab.Pipeline(scene, capacity=ab.Buffers(pairs=1000))
    launch = scenes.replay(frame)
    singles = [add_objects(device, [name]) for name in names]
    lods, top, kinds = scene.lods, tops(scene), []
    for t in range(30):
        lods = scenes.random_lods(rng, lods, top)
        set_lods(frame, lods)
        launch()
        frame.check()
        scene.set_lods(lods)
        if t % 3 == 2:
            check_states(frame, scene)
        changed, marked = frame.changed_count.numpy(), frame.marked_count.numpy()
        for i, single in enumerate(singles):
            stats = single.set_lods(lods[i : i + 1])
            assert changed[i] == sum(stats.k) and marked[i] == sum(stats.nodes_refitted)
            kinds += stats.full.tolist()
    assert kinds.count(True) > 30 and kinds.count(False) > 150


@pytest.mark.parametrize("update_path", ["lists"], indirect=True)
def test_all_states_at_the_crossover(device, monkeypatch, update_path):
    """Worklists hold the longest slices that are not refitted whole, of all states at once; few threads take turns."""
    monkeypatch.setattr(work_lists, "THREADS_AT_ONCE", 1)
    names = ["small ball", "crumbs", "torus", "soup", "twins"] * 3
    scene = add_objects(device, names, spread=9.0)
    moves, frame = [], ab.Pipeline(scene)
    for model in (scene.models[m] for m in scene.object_model):
        start, half = model.progressive.split_start.astype(int), model.face_count // 2
        high = np.searchsorted(start, start + half, "right") - 1  # the longest slice from each LOD
        low = np.argmax(start[high] - start)
        moves.append((start[high[low]] - start[low], low, high[low]))
        assert moves[-1][0] > 0.9 * half
    lengths, low, high = np.array(moves).T
    for lods in (low, high, low, high):
        set_lods(frame, lods)
        frame.launch()
        scene.set_lods(lods)
        check_states(frame, scene)
        plan = frame._update.plan
        assert (plan.level_count.numpy() <= np.diff([*plan.level_start.numpy(), len(plan.level_node)])).all()
    assert int(plan.partial_total.numpy()[0]) == (len(names) << 32) + lengths.sum()
    assert lengths.sum() <= frame._update.entry_room


def ask_both(scene, frame, launch, group=None, snap=None, **request):
    """Run frames of random poses and LODs on both paths and compare all answers; return how many hits there were."""
    rng, top, hits = np.random.default_rng(3), tops(scene), 0
    first = np.arange(len(top)) if group is None else np.unique(group, return_index=True)[1]
    lods = top[first]
    for _ in range(6):
        poses, lods = random_poses(rng, len(top), 0.9), scenes.random_lods(rng, lods, top[first])
        frame.poses.assign(poses)
        set_lods(frame, lods)
        launch()
        result = frame.result()
        result.check()
        frame.check()
        scene.set_poses(poses)
        served = lods if snap is None else snap(lods)
        scene.set_lods(served if group is None else served[group])
        expected = scene.intersect(**request)
        check_same(result, expected)
        hits += int(np.count_nonzero(expected.any) if expected.count is None else expected.count.sum())
    return hits


FRAMES = {
    **{output: dict(output=output) for output in ("any", "count", "faces", "contacts")},
    "given pairs": dict(output="faces", pairs=[(3, 0), (1, 2), (7, 8)]),
    "within": dict(output="faces", within=0.3),
    "float32": dict(output="faces", precision="float32"),
    "groups": dict(output="count", groups=np.array([2, 1, 3, 4, 0, 5, 6, 2, 1])),
    "one level": dict(output="count", ladder=[1.0]),
    "ladder": dict(output="count", ladder=[0.5, 1.0, 0.0, 0.5, 0.3]),
}


@pytest.mark.parametrize("captured", [True, False])
@pytest.mark.parametrize("case", FRAMES)
def test_answers_are_those_of_the_scene(device, case, captured):
    options, scene = dict(FRAMES[case]), add_objects(device)
    request = {name: value for name, value in options.items() if name not in ("groups", "ladder")}
    group, snap = options.get("groups"), None
    if "ladder" in options:
        levels = [[int(share * model.lod_max) for share in options["ladder"]] for model in scene.models]
        options["ladder"] = levels

        def snap(lods):
            parts = [levels[m] for m in scene.object_model]
            return np.array([min(level for level in part if level >= lod) for part, lod in zip(parts, lods)])

    hits = 60000 if options["output"] in ("faces", "contacts") else None
    frame = ab.Pipeline(scene, **options, capacity=ab.Buffers(hits, pairs=36))
    if group is not None:
        assert len(frame.lods) == len(frame.batch.states.slots) == len(frame.changed_count) == 7
    if snap is not None:
        assert len(frame.batch.states.slots) == sum(len(np.unique(part)) for part in levels)
        assert frame.changed_count is None and frame.marked_count is None
    launch = scenes.replay(frame) if captured else frame.launch
    assert ask_both(scene, frame, launch, group, snap, **request) > 50
    check_states(frame, scene)


def test_the_start_is_the_scene(device):
    scene = add_objects(device)
    lods = tops(scene) * np.arange(len(CROWD)) // len(CROWD)
    scene.set_lods(lods)
    poses = random_poses(np.random.default_rng(8), len(CROWD), 0.5)
    scene.set_poses(np.array([to_matrix(*pose_matrix(pose)) for pose in poses]))
    before = scenes.everything(scene)
    frame = ab.Pipeline(scene, "count")
    np.testing.assert_array_equal(frame.lods.numpy(), lods)
    np.testing.assert_array_equal(frame.poses.numpy()[:, :3], poses[:, :3])
    for found, given in zip(frame.poses.numpy(), poses, strict=True):
        np.testing.assert_allclose(quaternion_matrix(found[3:]), quaternion_matrix(given[3:]), rtol=0, atol=1e-14)
    frame.lods.zero_()
    frame.poses.assign(random_poses(np.random.default_rng(9), len(CROWD), 0.5))
    frame.launch()
    assert scenes.everything(scene) == before
    result = frame.result()
    scene.add(sample("box"))  # does not reach the frame
    scene.filter([(0, 1)])
    frame.launch()
    check_same(frame.result(), result)


@pytest.mark.parametrize("name, levels", [("five", 4), ("torus", 12)])
def test_launches_of_a_frame(device, monkeypatch, name, levels, update_path):
    """As many as the docstring states, however many objects there are and whatever they do."""
    launched, launch = [], wp.launch
    monkeypatch.setattr(wp, "launch", lambda *args, **options: launched.append(1) or launch(*args, **options))
    cuda = wp.get_device(device).is_cuda  # where poses and traversal are launches of their own, and passes follow
    narrow = 4 if cuda else 1
    for count in (2, 40):
        scene = add_objects(device, [name] * count)
        large = sum(count << level > 1024 for level in range(levels))  # nodes of all states on a level
        states = 1 if testing.current_regime().block_updates else 6 + large
        for options, own in (({}, states), ({"ladder": [[0, 1]]}, 0)):
            for asked, broad in (({}, 2), ({"pairs": [(0, 1)], "within": 1.0}, 2 if cuda else 1)):
                frame = ab.Pipeline(scene, "count", **asked, **options)
                launched.clear()
                frame.capture()
                assert len(launched) == 1 + own + broad + narrow


def test_a_frame_waits_for_nothing(device, monkeypatch):
    """A launch moves not a byte between host and device, and allocates none."""
    frame = ab.Pipeline(add_objects(device), "faces")

    def refuse(*args, **options):
        raise AssertionError("a frame waits, or moves data")

    steps = [(wp, name) for name in ("synchronize", "synchronize_device", "array", "zeros", "empty", "copy")]
    for owner, name in [*steps, (type(frame.poses), "numpy"), (type(frame.poses), "assign")]:
        monkeypatch.setattr(owner, name, refuse)
    frame.launch()


# Frames that lose work or are given bad numbers: served as stated, and told once by the next check.


def test_bad_poses(device):
    scene = add_objects(device, ["ball"] * 5, spread=0.3)
    frame = ab.Pipeline(scene, "count")
    good = random_poses(np.random.default_rng(10), 5, 0.3)
    frame.poses.assign(good)
    frame.launch()
    before, launch = frame.result(), scenes.replay(frame)
    for column, value in ((0, np.nan), (5, -np.inf), (slice(3, 7), 0.0), (slice(3, 7), 0.6)):
        rows = good.copy()
        rows[3, column] = rows[2, column] = value
        frame.poses.assign(rows)
        launch()
        check_same(frame.result(), before)
        launch()
        frame.poses.assign(good)
        launch()  # a good frame hides nothing
        refused(ValueError, r"poses: 4 rows .* is 2, and kept", frame.check)
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
    launch = scenes.replay(frame)
    for i, lod in ((0, finest[0] + 1), (2, 2**31 - 1), *([] if ladder == "short" else [(1, -1), (2, -(2**31))])):
        lods = finest.copy()
        lods[i] = lod
        set_lods(frame, lods)
        launch()
        set_lods(frame, finest)
        scene.set_lods(np.clip(lods, 0, finest))
        check_states(frame, scene)
        launch()
        refused(ValueError, f"lods: 1 entries .* is {i}, and took", frame.check)
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
    full = (2 * hits, 14, "pairs=15.*for 14"), (hits - 1, 15, f"hits={hits}.* for {hits - 1}"), (hits, 15, None)
    for room, pairs, message in full:
        frame = ab.Pipeline(scene, "faces", capacity=ab.Buffers(room, pairs=pairs))
        launch = scenes.replay(frame)
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
    frame = ab.Pipeline(add_objects(device, ["small ball"] * 2, spread=0.1), output="faces", capacity=1)
    poses = frame.poses.numpy().copy()
    frame.poses.fill_(np.nan)
    frame.lods.fill_(10**6)
    frame.launch()
    frame.poses.assign(poses)
    refused(ab.CapacityError, r"hits=.*poses: 2 rows.*lods: 2 entries", frame.check)


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
    refused(ValueError, message, ab.Pipeline, add_objects("cpu", ["ball", "torus", "ball"]), **options)


@pytest.mark.slow
def test_the_room_of_the_first_frame(device, monkeypatch):
    """Of coincident objects, asked as on CUDA, float32 leaves many pairs open: room is made, or its lack is told."""
    monkeypatch.setattr(pipeline, "Query", GpuQuery)
    monkeypatch.setattr(operator, "UNCERTAIN_ROOM", 16)
    coincident = in_a_row(device, "twins", (0, 0, 0))
    frame = ab.Pipeline(coincident, output="count")
    needed = int(frame.run().float64_tests.sum())
    assert len(frame.query.hits.uncertain) >= needed > 16
    with pytest.warns(RuntimeWarning, match=rf"=8\): .* leave {needed} .*uncertain={needed}"):
        frame = ab.Pipeline(coincident, output="count", capacity=ab.Buffers(uncertain=8))
    wp.capture_launch(frame.capture())
    refused(ab.CapacityError, f"needed .*uncertain={needed}.*room for 8", frame.check)
    expected = coincident.intersect(output="count").count
    for capacity in (None, ab.Buffers(uncertain=needed)):
        with warnings.catch_warnings(action="error"):
            frame = ab.Pipeline(coincident, output="count", capacity=capacity)
        wp.capture_launch(frame.capture())
        frame.check()
        np.testing.assert_array_equal(frame.result().count, expected)
