"""A captured frame: states and answers are those of the scene on the host, in graphs, frame by frame."""

import numpy as np
import pytest
import warp as wp
from helpers.questions import to_matrix
from helpers.samples import random_poses, sample
from helpers.scenes import (
    CROWD,
    add_objects,
    check_same,
    check_states,
    everything,
    random_lods,
    replay,
    set_lods,
    tops,
)
from oracles.triangle import pose_matrix, quaternion_matrix

import warp_abtree as ab
from warp_abtree import testing
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
    launch = replay(frame)
    singles = [add_objects(device, [name]) for name in names]
    lods, top, kinds = scene.lods, tops(scene), []
    for t in range(30):
        lods = random_lods(rng, lods, top)
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


def test_all_states_at_the_crossover(device, monkeypatch):
    """Worklists hold the longest slices that are not refitted whole, of all states at once; few threads take turns."""
    monkeypatch.setattr(work_lists, "THREADS_AT_ONCE", 1)
    names = ["small ball", "crumbs", "torus", "soup", "twins"] * 3
    scene = add_objects(device, names, spread=9.0)
    moves = []
    for model in (scene.models[m] for m in scene.object_model):
        start, half = model.progressive.split_start.astype(int), model.face_count // 2
        high = np.searchsorted(start, start + half, "right") - 1  # the longest slice from each LOD
        low = np.argmax(start[high] - start)
        moves.append((start[high[low]] - start[low], low, high[low]))
        assert moves[-1][0] > 0.9 * half
    lengths, low, high = np.array(moves).T
    with testing.regime(block_updates=False):
        frame = ab.Pipeline(scene)
    plan = frame._update.plan
    starts = np.append(plan.level_start.numpy(), len(plan.level_node))
    for lods in (low, high, low, high):
        set_lods(frame, lods)
        frame.launch()
        scene.set_lods(lods)
        check_states(frame, scene)
        assert (plan.level_count.numpy() <= np.diff(starts)).all()
    assert int(plan.partial_total.numpy()[0]) == (len(names) << 32) + lengths.sum()
    assert lengths.sum() <= frame._update.entry_room


def ask_both(scene, frame, launch, rng, frames, group=None, snap=None, **request):
    """Run frames of random poses and LODs on both paths and compare all answers; return how many hits there were."""
    top, hits = tops(scene), 0
    first = np.arange(len(top)) if group is None else np.unique(group, return_index=True)[1]
    lods = top[first]
    for _ in range(frames):
        poses = random_poses(rng, len(top), 0.9)
        lods = random_lods(rng, lods, top[first])
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


GROUP = np.array([2, 1, 3, 4, 0, 5, 6, 2, 1])
SHARES = [0.5, 1.0, 0.0, 0.5, 0.3]
FRAMES = {
    **{output: dict(output=output) for output in ("any", "count", "faces", "contacts")},
    "given pairs": dict(output="faces", pairs=[(3, 0), (1, 2), (7, 8)]),
    "within": dict(output="faces", within=0.3),
    "float32": dict(output="faces", precision="float32"),
    "groups": dict(output="count", groups=GROUP),
    "one level": dict(output="count", ladder=[1.0]),
    "ladder": dict(output="count", ladder=SHARES),
}


@pytest.mark.parametrize("captured", [True, False])
@pytest.mark.parametrize("case", FRAMES)
def test_answers_are_those_of_the_scene(device, case, captured):
    """Whatever is asked; also where objects share states in groups, or take the levels of a ladder."""
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
    launch = replay(frame) if captured else frame.launch
    assert ask_both(scene, frame, launch, np.random.default_rng(3), 6, group=group, snap=snap, **request) > 50
    check_states(frame, scene)


def test_worlds_statics_filter(device):
    rng = np.random.default_rng(7)
    scene = ab.Scene(device)
    for i, pose in enumerate(random_poses(rng, 12, 0.6)):
        scene.add(sample(CROWD[i % len(CROWD)]), pose, world=i % 3 - 1, static=i % 4 < 2)
    pairs = scene.broad_phase()
    scene.filter(pairs[::3])
    frame = ab.Pipeline(scene, "count")
    kept = len(scene.broad_phase())
    assert 0 < kept < len(pairs)
    assert ask_both(scene, frame, replay(frame), rng, 4, output="count") > 20


def test_the_start_is_the_scene(device):
    """Also where poses were set as matrices; and the scene stays as it was."""
    scene = add_objects(device)
    lods = tops(scene) * np.arange(len(CROWD)) // len(CROWD)
    scene.set_lods(lods)
    poses = random_poses(np.random.default_rng(8), len(CROWD), 0.5)
    scene.set_poses(np.array([to_matrix(*pose_matrix(pose)) for pose in poses]))
    before = everything(scene)
    frame = ab.Pipeline(scene, "count")
    np.testing.assert_array_equal(frame.lods.numpy(), lods)
    np.testing.assert_array_equal(frame.poses.numpy()[:, :3], poses[:, :3])
    for found, given in zip(frame.poses.numpy(), poses, strict=True):
        np.testing.assert_allclose(quaternion_matrix(found[3:]), quaternion_matrix(given[3:]), rtol=0, atol=1e-14)
    frame.lods.zero_()
    frame.poses.assign(random_poses(np.random.default_rng(9), len(CROWD), 0.5))
    frame.launch()
    assert everything(scene) == before
    result = frame.result()
    scene.add(sample("box"))  # does not reach the frame
    scene.filter([(0, 1)])
    frame.launch()
    check_same(frame.result(), result)


def count_launches(monkeypatch, frame):
    launched, launch = [], wp.launch
    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", lambda *args, **options: (launched.append(1), launch(*args, **options)))
        frame.capture()
    return len(launched)


@pytest.mark.parametrize("name, levels", [("five", 4), ("torus", 12)])
def test_launches_of_a_frame(device, monkeypatch, name, levels):
    """As many as the docstring states, however many objects there are and whatever they do."""
    narrow = 4 if wp.get_device(device).is_cuda else 2
    for count in (2, 40):
        scene = add_objects(device, [name] * count)
        large = sum(count << level > 1024 for level in range(levels))  # nodes of all states on a level
        for blocks, options, own in ((True, {}, 3), (False, {}, 6 + large), (True, {"ladder": [[0, 1]]}, 1)):
            with testing.regime(block_updates=blocks):
                frame = ab.Pipeline(scene, "count", **options)
            assert count_launches(monkeypatch, frame) == 1 + own + 2 + narrow + 1
            with testing.regime(block_updates=blocks):
                frame = ab.Pipeline(scene, "count", pairs=[(0, 1)], within=1.0, **options)
            assert count_launches(monkeypatch, frame) == 1 + own + narrow + 2 + 1


def test_a_frame_waits_for_nothing(device, monkeypatch):
    """A launch moves not a byte between host and device, and allocates none."""
    frame = ab.Pipeline(add_objects(device), "faces")

    def refuse(*args, **options):
        raise AssertionError("a frame waits, or moves data")

    for name in ("synchronize", "synchronize_device", "array", "zeros", "empty", "copy"):
        monkeypatch.setattr(wp, name, refuse)
    for name in ("numpy", "assign"):
        monkeypatch.setattr(type(frame.poses), name, refuse)
    frame.launch()
