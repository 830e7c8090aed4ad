"""A frame on the device: states, answers and errors are those of the host's path, in graphs, frame by frame."""

import copy

import numpy as np
import pytest
import warp as wp
from helpers.samples import random_poses, raw_state, sample
from oracles.triangle import quaternion_matrix

import warp_abtree as ab
from warp_abtree.state import work_lists

pytestmark = pytest.mark.usefixtures("half_refitted_in_part")

NAMES = ("one", "two", "small ball", "crumbs", "grid", "soup", "lattice soup", "twins")


def add_objects(device, names, seed=0, spread=0.6, **options):
    scene = ab.Scene(device)
    for name, pose in zip(names, random_poses(np.random.default_rng(seed), len(names), spread)):
        scene.add(sample(name), pose, **options)
    return scene


def tops(scene):
    return np.array([scene.models[m].lod_max for m in scene.object_model])


def random_lods(rng, lods, top):
    """One LOD each: small steps, jumps to the ends and anywhere, and some that stay."""
    lods = np.clip(lods + rng.integers(-6, 7, len(top)) * rng.choice([0, 1, 1, 4], len(top)), 0, top)
    jump = rng.random(len(top))
    lods = np.where(jump < 0.1, rng.integers(0, top + 1), lods)
    return np.where(jump > 0.93, rng.choice([0, 1]) * top, lods)


def frame_state(frame, scene, i):
    """Return what `raw_state` returns, of the state that serves an object in a frame."""
    pool = frame.batch.states.pool
    state = frame.batch.objects.pool.state.numpy()[i]
    slot = frame.batch.states.slots[state]
    model = scene.models[slot.model]
    nodes = slice(slot.node_start, slot.node_start + model.tree.node_count)
    corners = pool.face_corner.numpy()[slot.face_start : slot.face_start + model.face_count, :3]
    return {
        "lod": int(pool.lod.numpy()[state]),
        "status": pool.node_status.numpy()[nodes],
        **dict(zip(("lower", "upper", "skip"), frame.batch.states.read_nodes(slot, model.tree.node_count))),
        "corner": np.where(corners < 0, -1, corners - frame.batch.models.vertex_start[slot.model]),
    }


def assert_states(frame, scene):
    """Check that every object's state holds the bits of a state built at the scene's LODs."""
    fresh = ab.Scene(scene.device)
    for m, lod in zip(scene.object_model, scene.lods):
        fresh.add(scene.models[m], lod=int(lod))
    for i in range(scene.object_count):
        truth, state = raw_state(fresh, i), frame_state(frame, scene, i)
        for name, value in truth.items():
            assert np.asarray(value).tobytes() == np.asarray(state[name]).tobytes(), (i, name)


def by_pair(result):
    """Return a result's answers with its pairs in order, each a NumPy array."""
    order = np.lexsort((result.pairs[:, 1], result.pairs[:, 0]))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    values = {"pairs": result.pairs[order], "any": result.any[order]}
    for name in ("count", "apart", "pair_contacts"):
        if getattr(result, name) is not None:
            values[name] = getattr(result, name)[order]
    if result.faces is not None:
        faces = np.concatenate([rank[result.faces[:, :1]], result.faces[:, 1:]], 1)
        rows = np.lexsort((faces[:, 2], faces[:, 1], faces[:, 0]))
        values["faces"] = faces[rows]
        if result.contacts is not None:
            values["contacts"] = result.contacts[rows]
            values["contacts"]["pair"] = values["faces"][:, 0]
    return values


def assert_same(result, expected):
    got, wanted = by_pair(result), by_pair(expected)
    assert got.keys() == wanted.keys()
    for name, value in wanted.items():
        assert np.array_equal(got[name].astype(value.dtype).tobytes(), value.tobytes()), name


def replay(frame):
    """Return a function that replays the frame's graph."""
    graph = frame.capture()
    return lambda: wp.capture_launch(graph)


# Trees.


def test_random_walk_in_a_graph(device):
    """Bits of a rebuild, and the counters of the host's path, which moves a scene of one object in the same steps."""
    rng = np.random.default_rng(1)
    names = rng.permutation(np.repeat(NAMES, 3))
    scene = add_objects(device, names)
    frame = ab.FrameGraph(scene, capacity=ab.Buffers(pairs=1000))
    launch = replay(frame)
    singles = [add_objects(device, [name]) for name in names]
    lods, top, kinds = scene.lods, tops(scene), []
    for t in range(30):
        lods = random_lods(rng, lods, top)
        frame.lods.assign(lods.astype(np.int32))
        launch()
        frame.check()
        scene.set_lods(lods)
        if t % 3 == 2:
            assert_states(frame, scene)
        changed, marked = frame.changed_count.numpy(), frame.marked_count.numpy()
        for i, single in enumerate(singles):
            stats = single.set_lods(lods[i : i + 1])
            assert changed[i] == sum(stats.k) and marked[i] == sum(stats.nodes_refitted)
            kinds += stats.full.tolist()
    assert kinds.count(True) > 30 and kinds.count(False) > 150


@pytest.mark.parametrize("name", ["cow", "fcl-env"])
def test_random_walk_of_real_meshes(device, name):
    rng = np.random.default_rng(2)
    scene = add_objects(device, [name] * 3, spread=3.0)
    frame = ab.FrameGraph(scene)
    launch, top = replay(frame), tops(scene)
    for t in range(12):
        lods = np.clip((top * rng.choice([0.0, 0.1, 0.5, 0.9, 1.0], 3)).astype(int) + rng.integers(-30, 31, 3), 0, top)
        frame.lods.assign(lods.astype(np.int32))
        launch()
        frame.check()
        scene.set_lods(lods)
        if t % 3 == 2:
            assert_states(frame, scene)


def test_all_states_at_the_crossover(device, monkeypatch):
    """Worklists hold the longest slices that are not refitted whole, of all states at once; few threads take turns."""
    monkeypatch.setattr(work_lists, "THREADS_AT_ONCE", 1)
    names = ["small ball", "crumbs", "torus", "soup", "twins"] * 3
    scene = add_objects(device, names, spread=9.0)
    moves = []
    for m in scene.object_model:
        model = scene.models[m]
        start, half = model.progressive.split_start.astype(int), model.face_count // 2
        spans = [(start[b] - start[a], a, b) for a in range(model.lod_max) for b in range(a + 1, model.lod_max + 1)]
        moves.append(max(span for span in spans if span[0] <= half))
    lengths, low, high = np.array(moves).T
    assert (lengths > 0.9 * np.array([scene.models[m].face_count // 2 for m in scene.object_model])).all()
    frame = ab.FrameGraph(scene)
    plan = frame._update.plan
    starts = np.append(plan.level_start.numpy(), len(plan.level_node))
    for lods in (low, high, low, high):
        frame.lods.assign(lods.astype(np.int32))
        frame.launch()
        scene.set_lods(lods)
        assert_states(frame, scene)
        assert (plan.level_count.numpy() <= np.diff(starts)).all()
    assert int(plan.partial_total.numpy()[0]) == (len(names) << 32) + lengths.sum()
    assert lengths.sum() <= frame._update.entry_room


# Answers.


def ask_both(scene, frame, launch, rng, frames, group=None, snap=None, **request):
    """Run frames of random poses and LODs on both paths and compare all answers; return how many hits there were."""
    top, hits = tops(scene), 0
    first = np.arange(len(top)) if group is None else np.unique(group, return_index=True)[1]
    lods = top[first]
    for _ in range(frames):
        poses = random_poses(rng, len(top), 0.9)
        lods = random_lods(rng, lods, top[first])
        frame.poses.assign(poses)
        frame.lods.assign(lods.astype(np.int32))
        launch()
        result = frame.result()
        result.check()
        frame.check()
        scene.set_poses(poses)
        served = lods if snap is None else snap(lods)
        scene.set_lods(served if group is None else served[group])
        expected = scene.intersect(**request)
        assert_same(result, expected)
        hits += int(np.count_nonzero(expected.any) if expected.count is None else expected.count.sum())
    return hits


CROWD = ("small ball", "torus", "soup", "lattice soup", "twins", "crumbs", "one", "small ball", "torus")


@pytest.mark.parametrize("captured", [True, False])
@pytest.mark.parametrize("output", ["any", "count", "faces", "contacts"])
def test_answers_of_the_scene(device, output, captured):
    scene = add_objects(device, CROWD)
    frame = ab.FrameGraph(
        scene, output, capacity=ab.Buffers(60000 if output in ("faces", "contacts") else None, pairs=36)
    )
    launch = replay(frame) if captured else frame.launch
    assert ask_both(scene, frame, launch, np.random.default_rng(3), 5, output=output) > 50


def test_groups_share_states(device):
    scene = add_objects(device, CROWD)
    group = np.array([2, 1, 3, 4, 0, 5, 6, 2, 1])
    frame = ab.FrameGraph(scene, "count", groups=group)
    assert len(frame.lods) == len(frame.batch.states.slots) == len(frame.changed_count) == 7
    assert ask_both(scene, frame, replay(frame), np.random.default_rng(4), 6, group=group, output="count") > 50
    assert_states(frame, scene)


@pytest.mark.parametrize("shares", [[1.0], [0.5, 1.0, 0.0, 0.5, 0.3]])
def test_ladder(device, shares):
    scene = add_objects(device, CROWD)
    rungs = [[int(share * model.lod_max) for share in shares] for model in scene.models]
    frame = ab.FrameGraph(scene, "count", ladder=rungs)
    assert len(frame.batch.states.slots) == sum(len(np.unique(part)) for part in rungs)
    assert frame.changed_count is None and frame.marked_count is None

    def snap(lods):
        parts = [rungs[m] for m in scene.object_model]
        return np.array([min(rung for rung in part if rung >= lod) for part, lod in zip(parts, lods)])

    assert ask_both(scene, frame, replay(frame), np.random.default_rng(5), 6, snap=snap, output="count") > 50
    assert_states(frame, scene)


@pytest.mark.parametrize("request_", [{"pairs": [(3, 0), (1, 2), (7, 8)]}, {"within": 0.3}, {"precision": "float32"}])
def test_requests_of_a_query(device, request_):
    scene = add_objects(device, CROWD)
    frame = ab.FrameGraph(scene, "faces", capacity=60000, **request_)
    assert ask_both(scene, frame, replay(frame), np.random.default_rng(6), 4, output="faces", **request_) > 50


def test_worlds_statics_filter(device):
    rng = np.random.default_rng(7)
    scene = ab.Scene(device)
    for i, pose in enumerate(random_poses(rng, 12, 0.6)):
        scene.add(sample(CROWD[i % len(CROWD)]), pose, world=i % 3 - 1, static=i % 4 < 2)
    pairs = scene.broad_phase()
    scene.filter(pairs[::3])
    frame = ab.FrameGraph(scene, "count")
    kept = len(scene.broad_phase())
    assert 0 < kept < len(pairs)
    assert ask_both(scene, frame, replay(frame), rng, 4, output="count") > 20


def test_one_object(device):
    scene = add_objects(device, ["ball"])
    frame = ab.FrameGraph(scene, "faces")
    frame.lods.fill_(3)
    wp.capture_launch(frame.capture())
    result = frame.result()
    result.check()
    frame.check()
    assert len(result.pairs) == len(result.faces) == 0
    scene.set_lods([3])
    assert_states(frame, scene)


@wp.kernel
def control_kernel(
    top: wp.array(dtype=wp.int32),
    time_inout: wp.array(dtype=wp.int32),
    lods_out: wp.array(dtype=wp.int32),
    poses_out: wp.array2d(dtype=wp.float64),
):
    i = wp.tid()
    t = time_inout[i] + 1
    time_inout[i] = t
    lods_out[i] = (top[i] * ((3 * t + 5 * i) % 11)) / 10
    poses_out[i, 0] = wp.float64(0.15) * wp.float64((t + 2 * i) % 9)


def test_a_controller_in_the_same_graph(device):
    """Nothing comes from the host between frames: a kernel writes poses and LODs, and the graph goes on from them."""
    scene = add_objects(device, CROWD)
    frame = ab.FrameGraph(scene, "faces", capacity=60000)
    start, top = frame.poses.numpy().copy(), tops(scene)
    time = wp.zeros(len(top), dtype=wp.int32, device=device)
    inputs = [wp.array(top, dtype=wp.int32, device=device), time, frame.lods, frame.poses]
    wp.launch(control_kernel, len(top), inputs, device=device)
    with wp.ScopedCapture(device) as capture:
        wp.launch(control_kernel, len(top), inputs, device=device)
        frame.launch()
    hits = 0
    time.zero_()
    for t in range(1, 9):
        wp.capture_launch(capture.graph)
        poses = start.copy()
        poses[:, 0] = 0.15 * ((t + 2 * np.arange(len(top))) % 9)
        scene.set_poses(poses)
        scene.set_lods(top * ((3 * t + 5 * np.arange(len(top))) % 11) // 10)
        expected = scene.intersect(output="faces")
        assert_same(frame.result(), expected)
        hits += len(expected.faces)
    frame.check()
    assert hits > 500


def test_the_start_is_the_scene(device):
    """Also where poses were set as matrices; and the scene stays as it was."""
    scene = add_objects(device, CROWD)
    lods = tops(scene) * np.arange(len(CROWD)) // len(CROWD)
    scene.set_lods(lods)
    poses = random_poses(np.random.default_rng(8), len(CROWD), 0.5)
    scene.set_poses(poses)
    before = copy.deepcopy([raw_state(scene, i) for i in range(len(CROWD))])
    frame = ab.FrameGraph(scene, "count")
    np.testing.assert_array_equal(frame.lods.numpy(), lods)
    np.testing.assert_array_equal(frame.poses.numpy()[:, :3], poses[:, :3])
    turned = [
        np.abs(quaternion_matrix(q[3:]) - quaternion_matrix(p[3:])).max() for q, p in zip(frame.poses.numpy(), poses)
    ]
    assert max(turned) < 1e-14
    assert_same(frame.result(), scene.intersect(output="count"))

    frame.lods.zero_()
    frame.poses.assign(random_poses(np.random.default_rng(9), len(CROWD), 0.5))
    frame.launch()
    np.testing.assert_array_equal(scene.lods, lods)
    for i, state in enumerate(before):
        for name, value in raw_state(scene, i).items():
            np.testing.assert_array_equal(state[name], value)
    scene.add(sample("box"))  # does not reach the frame
    scene.filter([(0, 1)])
    result = frame.result()
    frame.launch()
    assert_same(frame.result(), result)


# What it costs.


def count_launches(monkeypatch, call):
    launched, launch = [], wp.launch

    def record(kernel, *args, **options):
        launched.append(kernel.key)
        launch(kernel, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", record)
        call()
    return launched


@pytest.mark.parametrize("name, levels", [("five", 4), ("small ball", 10), ("torus", 12)])
def test_launches_of_a_frame(device, monkeypatch, name, levels):
    """As many as the docstring states, however many objects there are and whatever they do."""
    narrow = 4 if wp.get_device(device).is_cuda else 2
    for count in (2, 40):
        scene = add_objects(device, [name] * count)
        large = sum(count << level > 1024 for level in range(levels))  # nodes of all states on a level
        for options, own in (({}, 6 + large), ({"ladder": [[0, 1]]}, 1)):
            frame = ab.FrameGraph(scene, "count", **options)
            launched = count_launches(monkeypatch, frame.capture)
            assert len(launched) == 1 + own + 2 + narrow + 1
            frame = ab.FrameGraph(scene, "count", pairs=[(0, 1)], within=1.0, **options)
            assert len(count_launches(monkeypatch, frame.capture)) == 1 + own + narrow + 2 + 1


def test_a_frame_waits_for_nothing(device, monkeypatch):
    """A launch moves not a byte between host and device, and allocates none."""
    frame = ab.FrameGraph(add_objects(device, CROWD), "faces")

    def refuse(*args, **options):
        raise AssertionError("a frame waits, or moves data")

    for name in ("synchronize", "synchronize_device", "array", "zeros", "empty", "copy"):
        monkeypatch.setattr(wp, name, refuse)
    for name in ("numpy", "assign"):
        monkeypatch.setattr(type(frame.poses), name, refuse)
    frame.launch()


# What goes wrong.


def test_bad_poses(device):
    scene = add_objects(device, ["ball"] * 5, spread=0.3)
    frame = ab.FrameGraph(scene, "count")
    good = random_poses(np.random.default_rng(10), 5, 0.3)
    frame.poses.assign(good)
    frame.launch()
    before = frame.result()
    launch = replay(frame)
    for column, value in ((0, np.nan), (2, np.inf), (4, np.nan), (5, -np.inf), (slice(3, 7), 0.0), (slice(3, 7), 0.6)):
        rows = good.copy()
        rows[3, column] = rows[2, column] = value
        frame.poses.assign(rows)
        launch()
        assert_same(frame.result(), before)
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
    assert_same(frame.result(), scene.intersect(output="count"))


@pytest.mark.parametrize("with_ladder", [False, True])
def test_bad_lods(device, with_ladder):
    scene = add_objects(device, ["ball", "torus", "ball"])
    ladder = [[0, model.lod_max] for model in scene.models] if with_ladder else None
    frame = ab.FrameGraph(scene, "count", ladder=ladder)
    launch, top = replay(frame), tops(scene)
    for i, wish, served in ((1, -1, 0), (0, top[0] + 1, top[0]), (2, 2**31 - 1, top[2]), (2, -(2**31), 0)):
        lods = top.copy()
        lods[i] = wish
        frame.lods.assign(lods.astype(np.int32))
        launch()
        frame.lods.assign(top.astype(np.int32))
        lods[i] = served
        scene.set_lods(lods)
        assert_states(frame, scene)
        launch()
        with pytest.raises(ValueError, match=f"lods: 1 entries .* is {i}, and took"):
            frame.check()
        frame.check()


def test_a_wish_beyond_the_ladder(device):
    scene = add_objects(device, ["ball", "torus"])
    frame = ab.FrameGraph(scene, "count", ladder=[[5, 20], [7]])
    np.testing.assert_array_equal(frame.lods.numpy(), [20, 7])
    frame.lods.assign(np.array([21, 7], np.int32))
    frame.launch()
    with pytest.raises(ValueError, match=r"lods: 1 entries .* is 0"):
        frame.check()
    scene.set_lods([20, 7])
    assert_states(frame, scene)


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
        frame = ab.FrameGraph(scene, "faces", capacity=ab.Buffers(**options))
        launch = replay(frame)
        for poses in (far, near, far):
            frame.poses.assign(poses)
            launch()
        if message is None:
            frame.check()
        else:
            with pytest.raises(ab.CapacityError, match=message):
                frame.check()
            frame.check()
        frame.poses.assign(near)
        assert_same(frame.run(), expected)
        frame.launch()
        frame.check()
        assert_same(frame.result(), expected)


def test_refused(device):
    scene = add_objects(device, ["ball", "torus", "ball"])
    with pytest.raises(ValueError, match="no object"):
        ab.FrameGraph(ab.Scene(device))
    for groups, message in (
        ([0, 1], "shape"),
        ([0.0, 1.0, 0.0], "type float64"),
        ([0, 0, 1], "group 0 holds objects of several models"),
        ([0, 2, 0], "without gaps"),
        ([-1, 0, -1], "numbered -1 to 0"),
    ):
        with pytest.raises(ValueError, match=f"groups: .*{message}"):
            ab.FrameGraph(scene, groups=groups)
    for ladder, message in (
        ([[1]], "1 lists of LODs given for 2 models"),
        ([[1], []], "no LOD for model 1"),
        ([[1], [10**6]], "LOD 1000000 is outside"),
    ):
        with pytest.raises(ValueError, match=message):
            ab.FrameGraph(scene, ladder=ladder)
    with pytest.raises(ValueError, match="give one of them"):
        ab.FrameGraph(scene, groups=[0, 1, 0], ladder=[[0], [0]])
    with pytest.raises(ValueError, match="none of 'any'"):
        ab.FrameGraph(scene, "all")
