"""`MultiScene` against one scene: the same bits however worlds are dealt, and nothing half done where a part fails."""

import itertools
import os
import signal

import numpy as np
import pytest
from samples import STILL, random_poses, sample

import warp_abtree as ab
from bench import scaling
from warp_abtree import multi_scene, scene_part
from warp_abtree.intersect import COUNTERS

OUTPUTS = ("any", "count", "faces", "contacts")
FIELDS = ("pairs", "any", "count", "faces", "contacts", "pair_contacts", "apart")


def fill(scene, worlds=7, seed=0):
    """Add objects of worlds in no order, of two models, and some that are in every world."""
    rng = np.random.default_rng(seed)
    models = sample("torus"), sample("small ball")
    scene.add(models[1], world=-1, static=True)
    for turn, world in enumerate(rng.permutation(np.repeat(np.arange(worlds), 1 + np.arange(worlds) % 3)).tolist()):
        model = models[turn % 2]
        scene.add(model, random_poses(rng, 1, 1.7)[0], 3 * world, [None, 20][turn % 2], static=turn % 4 == 0)
    matrix = np.eye(4)
    matrix[:3, 3] = 0.6, 0.1, 0
    scene.add(models[0], matrix, world=-1)
    scene.filter([[0, 3]])
    return scene


def counted(device):
    """Return what repeats from launch to launch: on a GPU the work done for a pair does not."""
    return (*FIELDS, *COUNTERS) if device == "cpu" else FIELDS


def assert_same(found, expected, device):
    for name in counted(device):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert (ours is None) == (theirs is None), name
        if theirs is not None:
            assert ours.dtype == theirs.dtype and ours.shape == theirs.shape, name
            assert ours.tobytes() == theirs.tobytes(), name


def assert_same_answers(many, one, device, outputs=OUTPUTS):
    for output in outputs:
        assert_same(many.intersect(output=output), one.intersect(output=output), device)


@pytest.mark.parametrize("processes", [True, False])
def test_same_bits_as_one_scene(device, processes):
    one = fill(ab.Scene(device))
    rng = np.random.default_rng(3)
    with fill(ab.MultiScene([device, device], processes)) as many:
        np.testing.assert_array_equal(many.broad_phase(), one.broad_phase())
        expected = one.intersect(output="count")
        assert 10 < len(expected.pairs) and 5 < expected.any.sum() < len(expected.pairs)
        assert_same_answers(many, one, device)
        order = rng.permutation(len(expected.pairs))
        asked = expected.pairs[order][:, ::-1].copy()  # in another order, named the other way
        near = rng.uniform(0, 0.5, len(asked))
        for output in OUTPUTS:
            asking = {"output": output, "within": near, "contact_dtype": np.float32}
            assert_same(many.intersect(asked, **asking), one.intersect(asked, **asking), device)
        assert_same(many.intersect(within=0.3), one.intersect(within=0.3), device)
        assert_same(many.intersect([], "faces"), one.intersect([], "faces"), device)
        many.balance()
        for seed in (4, 5):  # worlds are dealt anew at the first use, then they are where they are
            for scene in (many, one):
                scene.set_poses(random_poses(np.random.default_rng(seed), scene.object_count, 0.8))
                scene.set_lods(scene.lods // 2)
            assert_same_answers(many, one, device, ["contacts"])
        matrices = np.tile(np.eye(4), (one.object_count, 1, 1))
        matrices[:, :3, 3] = rng.uniform(-0.7, 0.7, (one.object_count, 3))
        for scene in (many, one):
            scene.set_poses(matrices)
        assert_same_answers(many, one, device, ["faces"])
        for scene in (many, one):
            scene.add(sample("box"), STILL, world=6)
            scene.filter([[1, 2], [0, 5]])
        assert_same_answers(many, one, device, ["faces"])
        state, other = many.tree_state(5), one.tree_state(5)
        assert state.lod == other.lod and np.array_equal(state.lower, other.lower)


def test_worlds_are_all_dealt_and_every_part_has_some(device):
    with fill(ab.MultiScene([device] * 3, processes=False)) as many:
        many.intersect()
        world = np.array(many._ledger._world)
        own = [set(world[rows][world[rows] >= 0].tolist()) for rows in many._members]
        assert all(own) and sorted(itertools.chain(*own)) == sorted(set(world[world >= 0].tolist()))
        for rows in many._members:
            assert {0, many.object_count - 1} <= set(rows.tolist())  # of world -1


@pytest.mark.parametrize("speeds", [(1.0, 1.0), (1.0, 2.5)])
def test_worlds_are_dealt_evenly_by_measured_work(speeds):
    """Against the best of all deals: longest first is never worse by more than a third on equal devices."""
    rng = np.random.default_rng(1)
    many = ab.MultiScene(["cpu", "cpu"], processes=False)
    for world in range(9):
        many.add(sample("box"), world=world)
    many._cost = dict(enumerate(rng.uniform(1, 20, 9).tolist()))
    many._speed = np.array(speeds)
    times = many._deal()
    cost, total = np.array(list(many._cost.values())), np.zeros(2)
    for world, part in enumerate(many._owner):
        total[part] += cost[world] / speeds[part]
    np.testing.assert_allclose(times, total)
    deals = (np.array(deal) for deal in itertools.product((0, 1), repeat=9))
    best = min(max(cost[deal == 0].sum() / speeds[0], cost[deal == 1].sum() / speeds[1]) for deal in deals)
    assert best <= times.max() <= 7 / 6 * best


def test_balance_takes_the_counters(device):
    """Worlds in contact cost more than worlds apart, however many faces they have."""
    with ab.MultiScene([device, device], processes=False) as many:
        with pytest.raises(ValueError, match="nothing is measured yet"):
            many.balance()
        for world in range(6):
            for x in (0.0, 0.3 if world in (0, 2) else 50.0):
                many.add(sample("torus"), (x, 0, 0, 0, 0, 0, 1), world=world)
        pairs = np.arange(12).reshape(6, 2)
        result = many.intersect(pairs, output="count")
        assert set(np.flatnonzero(result.any)) == {0, 2}
        assert many._owner[0] == many._owner[4]  # of equal size: dealt in turn
        many.balance()
        assert many._owner[0] != many._owner[4]
        expected = result.count
        np.testing.assert_array_equal(many.intersect(pairs, output="count").count, expected)


def test_a_worker_that_ends_changes_nothing():
    one = fill(ab.Scene("cpu"))
    with fill(ab.MultiScene(["cpu", "cpu"])) as many:
        assert_same_answers(many, one, "cpu", ["faces"])
        os.kill(many._carriers[1].process.pid, signal.SIGKILL)
        with pytest.raises(RuntimeError, match="worker 1 on cpu ended with exit code -9; nothing was changed"):
            many.set_poses(random_poses(np.random.default_rng(9), many.object_count, 0.3))
        assert_same_answers(many, one, "cpu", ["faces"])
        workers = [carrier.process for carrier in many._carriers]
    assert all(not worker.is_alive() for worker in workers)
    with pytest.raises(RuntimeError, match="closed"):
        many.intersect()


@pytest.mark.parametrize("error", [MemoryError("no room"), KeyboardInterrupt()])
def test_a_part_that_fails_changes_nothing(device, monkeypatch, error):
    one = fill(ab.Scene(device))
    with fill(ab.MultiScene([device, device], processes=False)) as many:
        assert_same_answers(many, one, device, ["faces"])
        broken, before = many._carriers[1], many.lods
        if isinstance(error, Exception):
            monkeypatch.setattr(broken.part, "set_lods", lambda lods: (_ for _ in ()).throw(error))
        else:
            monkeypatch.setattr(broken, "finish", lambda: (_ for _ in ()).throw(error))
        with pytest.raises(type(error)):
            many.set_lods(many.lods // 3)
        np.testing.assert_array_equal(many.lods, before)
        monkeypatch.undo()
        assert_same_answers(many, one, device, ["faces"])


def test_bad_input_is_refused_before_anything_is_sent(device, monkeypatch):
    with fill(ab.MultiScene([device, device], processes=False)) as many:
        many.intersect()
        monkeypatch.setattr(many, "_ask", lambda *_: pytest.fail("was sent"))
        n = many.object_count
        poses = np.tile(np.array(STILL), (n, 1))
        world = np.array(many._ledger._world)
        mixed = [[int(np.flatnonzero(world == 0)[0]), int(np.flatnonzero(world == 3)[0])]]
        for call, what in (
            (lambda: many.set_poses(poses[1:]), f"{n - 1} given for {n} objects"),
            (lambda: many.set_poses(poses[:, :6]), "is neither"),
            (lambda: many.intersect(5), "not whole numbers of shape"),
            (lambda: many.intersect([[0, 1]], within=[0.1, 0.2]), "given for 1 pairs"),
            (lambda: many.set_lods(np.full(n, 10**6)), "object 0 asks for LOD 1000000, outside"),
            (lambda: many.set_lods(np.full(n, 0.5)), "no whole numbers"),
            (lambda: many.intersect(mixed), "pair 0 is of the worlds 0 and 3"),
            (lambda: many.intersect([[0, n]]), f"the scene has {n} objects"),
            (lambda: many.intersect(output="some"), "output 'some'"),
            (lambda: many.intersect(within=-1.0), "within"),
            (lambda: many.tree_state(n), f"object {n} is outside"),
            (lambda: many.tree_state(0.5), "object 0.5 is not a whole number"),
            (lambda: many.add(sample("box"), world=-2), "world -2 is outside"),
        ):
            with pytest.raises(ValueError, match=what):
                call()
        with pytest.raises(TypeError, match="not a Model"):
            many.add("box")
        assert many.object_count == n


@pytest.mark.parametrize("processes", [True, False])
def test_bad_poses_move_no_object(device, processes):
    """Wherever the bad one stands, the error is that of one scene, and poses are those of the last good call."""
    one = fill(ab.Scene(device))
    rng = np.random.default_rng(6)
    with fill(ab.MultiScene([device] * 2, processes)) as many:
        for turn, i in enumerate((0, 4, 9)):
            good = random_poses(rng, one.object_count, 0.8)
            matrices = np.tile(np.eye(4), (len(good), 1, 1))
            matrices[:, :3, 3] = good[:, :3]
            bad = random_poses(rng, one.object_count, 0.8)
            bad_matrices = matrices.copy()
            bad_matrices[:, :3, 3] = bad[:, :3]
            bad_matrices[i, 0, 0] = -1
            bad[[i, -2], 2 + turn] = [np.nan, 40.0, np.inf][turn]  # the first of several is named
            for scene in (one, many):
                scene.set_poses([good, matrices][turn % 2])
            for refused in (bad, bad_matrices, bad.astype(np.float32)):
                messages = []
                for scene in (one, many):
                    with pytest.raises(ValueError, match="poses: ") as found:
                        scene.set_poses(refused)
                    messages.append(str(found.value))
                assert messages[0] == messages[1] and f" {i} " in messages[0]
            assert_same_answers(many, one, device, ["count"])


def test_sound_poses_are_those_that_pass_the_check():
    rng = np.random.default_rng(7)
    poses = random_poses(rng, 300, 1.0)
    for size in (1 - 1.0001e-3, 1 - 0.9999e-3, 1 - 0.9e-3, 1.0, 1 + 0.9e-3, 1 + 0.9999e-3, 1 + 1.0001e-3, 1e100, 0.0):
        row = poses[:1].copy()
        row[0, 3:] *= size
        assert scene_part.are_sound(np.concatenate([poses, row])) == (abs(size - 1) < 1e-3)
    for column in range(7):
        for value in (np.nan, np.inf, -np.inf):
            bad = poses.copy()
            bad[rng.integers(len(bad)), column] = value
            assert not scene_part.are_sound(bad)
    matrices = np.tile(np.eye(4), (3, 1, 1))
    assert scene_part.are_sound(matrices) and not scene_part.are_sound(2 * matrices)
    assert scene_part.are_sound(poses[:0])


def test_runs_of_indices():
    assert scene_part.find_runs(np.array([], int)) == [slice(0, 0)]
    assert scene_part.find_runs(np.array([3, 4, 5])) == [slice(3, 6)]
    assert scene_part.as_slice(np.array([7])) == slice(7, 8)
    assert scene_part.find_runs(np.array([0, 2, 3, 9])) == [slice(0, 1), slice(2, 4), slice(9, 10)]
    for count in (scene_part.RUNS_MAX, scene_part.RUNS_MAX + 1):
        runs = scene_part.find_runs(2 * np.arange(count))
        assert (runs is None) == (count > scene_part.RUNS_MAX)


@pytest.mark.parametrize("order, processes", [("by world", False), ("mixed", False), ("mixed", True)])
def test_pairs_asked_again_and_others(device, order, processes):
    """The same pairs, the same array with other pairs in it, fewer of them, and poses in between, in any order."""
    rng = np.random.default_rng(8)
    worlds = np.repeat(np.arange(40), 2)
    if order == "mixed":
        worlds = rng.permutation(worlds)
    scenes = ab.Scene(device), ab.MultiScene([device] * 2, processes)
    for world in worlds.tolist():
        pose = random_poses(rng, 1, 0.6)[0]
        for scene in scenes:
            scene.add(sample("small ball"), pose, world=world)
    one, many = scenes
    members = np.argsort(worlds, kind="stable").reshape(-1, 2)
    with many:
        pairs = members.copy()
        for turn in range(12):
            if turn in (4, 5, 9):
                pairs[:] = members[rng.permutation(40)][:, :: 1 - 2 * (turn % 2)]
            asked = pairs[: 17 if turn == 7 else 40]
            if turn % 3:
                poses = random_poses(rng, len(worlds), 0.6).astype([np.float64, np.float32][turn % 2])
                for scene in scenes:
                    scene.set_poses(poses)
            if turn == 6 and not processes:
                many._drop()  # parts are built anew from what is kept here
            output = OUTPUTS[turn % 4]
            found = many.intersect(asked, output, within=0.1 if turn % 2 else None)
            assert_same(found, one.intersect(asked, output, within=0.1 if turn % 2 else None), device)
            found.pairs[:] = 0  # which is nobody else's
            if turn == 6:
                with pytest.raises(ValueError, match="no finite distance"):
                    many.intersect(asked[:5], within=-1.0)
            if turn == 10:
                for scene in scenes:
                    scene.add(sample("small ball"), STILL, world=int(worlds[0]))
                worlds = np.append(worlds, worlds[0])
        assert_same_answers(many, one, device, ["faces"])
        bad = pairs.copy()
        bad[3] = 0, len(worlds)
        with pytest.raises(ValueError, match=f"the scene has {len(worlds)} objects"):
            many.intersect(bad)
        assert_same(many.intersect(pairs), one.intersect(pairs), device)


def test_poses_handed_in_may_change_afterwards(device):
    one = fill(ab.Scene(device))
    with fill(ab.MultiScene([device] * 2, processes=False)) as many:
        for turn in range(3):
            poses = random_poses(np.random.default_rng(turn), one.object_count, 0.8)
            one.set_poses(poses)
            many.set_poses(poses)
            poses[:] = np.nan
            assert_same_answers(many, one, device, ["count"])
        many._drop()  # parts are built anew from what is kept here
        assert_same_answers(many, one, device, ["count"])


def test_worlds_that_follow_each_other_stay_together():
    """Where that is even: then objects and pairs of a device are a slice of all."""
    with ab.MultiScene(["cpu"] * 3, processes=False) as many:
        for row in range(60):
            many.add(sample("box"), (0.1 * row, 0, 0, 0, 0, 0, 1), world=59 - row // 2)
        many._deal()
        assert (np.diff(many._owner) >= 0).all() and np.bincount(many._owner).tolist() == [20, 20, 20]
        many._cost = dict.fromkeys(range(60), 1.0) | {30: 40.0, 31: 40.0, 32: 40.0}
        times = many._deal()
        assert times.max() <= 50 and len(set(many._owner[2 * (59 - np.array([30, 31, 32]))].tolist())) == 3


def test_devices():
    with pytest.raises(ValueError, match="devices: none given"):
        ab.MultiScene([])
    with pytest.raises(ValueError, match="no device 'cuda:77'"):
        ab.MultiScene(["cpu", "cuda:77"])
    with pytest.raises(ValueError, match="the scene has no object"):
        ab.MultiScene(["cpu"], processes=False).intersect()
    assert ab.MultiScene().devices


def test_objects_in_every_world_alone(device):
    """Two objects of world -1 meet once, whatever the number of parts."""
    with ab.MultiScene([device, device], processes=False) as many:
        for x in (0.0, 0.5):
            many.add(sample("torus"), (x, 0, 0, 0, 0, 0, 1), world=-1)
        assert many.intersect().pairs.tolist() == [[0, 1]]
        for world in (4, 5):
            many.add(sample("box"), (9, 9, 9, 0, 0, 0, 1), world=world)
        result = many.intersect(output="faces")
        assert result.pairs.tolist() == [[0, 1]] and len(result.faces) == result.count[0] > 0


def test_a_device_without_a_world_is_not_asked(device):
    """The slower of two devices gets none of one world, also where it comes first."""
    with ab.MultiScene([device, device], processes=False) as many:
        for x in (0.0, 0.5, 9.0):
            many.add(sample("torus"), (x, 0, 0, 0, 0, 0, 1))
        many._speed = np.array([1.0, 4.0])
        assert many.intersect([[0, 1], [0, 2]]).any.tolist() == [True, False]
        assert [len(rows) for rows in many._members] == [0, 3]
        assert many.intersect().pairs.tolist() == [[0, 1]]
        assert len(many.intersect(np.empty((0, 2), int)).any) == 0


def test_merged_results_say_what_is_lost():
    with fill(ab.MultiScene(["cpu"], processes=False)) as many:
        result = many.intersect(output="faces")
        result.check()
        answer = {name: getattr(result, name) for name in scene_part.FIELDS}
        answer["faces"] = answer["faces"][:-1]
        with pytest.raises(ab.CapacityError, match="face pairs intersect"):
            multi_scene.MultiResult(result.pairs, [np.arange(len(result.pairs))], [answer]).check()


# The bench of it.


def test_cost_is_fitted(device):
    rng = np.random.default_rng(2)
    rows = rng.uniform(1, 100, (20, 3))
    np.testing.assert_allclose(scaling.fit_cost(rows, rows @ [3.0, 0.5, 0.25]), [3.0, 0.5, 0.25])
    cost = scaling.fit_cost(rows, rows @ [3.0, -0.01, 0.25])
    assert cost[1] == 0 and cost[0] > 0 and cost[2] > 0
    sizes = scaling.QUICK
    row = scaling.run_cost(scaling.wp.get_device(device), sizes)
    assert row["samples"] == 12 and row["node_us"] >= 0 and row["off_mean"] <= row["off_worst"]


@pytest.mark.parametrize("count", [1, 2, 4, 5])
def test_numbers_of_devices(count):
    numbers = {1: [1], 2: [1, 2], 4: [1, 2, 4], 5: [1, 2, 4, 5]}[count]
    assert scaling.list_sizes(["cpu"] * count) == sorted({(n, times) for n in numbers for times in (1, n)})


def check_rows(rows, name):
    assert [(row["way"], row["devices"]) for row in rows] == [("strong", 1), ("strong", 2), ("weak", 1), ("weak", 2)]
    sizes = [row[name] for row in rows]
    assert sizes[:3] == sizes[:1] * 3 and sizes[3] == 2 * sizes[0]
    assert rows[0]["efficiency"] == rows[2]["efficiency"] == 1
    assert scaling.ab.Query.cores is None


def test_frames_on_devices_are_timed(device, monkeypatch):
    model = sample("small ball")
    rows = list(scaling.run_frames([device, device], model, scaling.QUICK))
    check_rows(rows, "worlds")
    assert all(row["frame_ms"] > 0 for row in rows)
    whole = scaling.Frames.answer
    monkeypatch.setattr(scaling.Frames, "answer", lambda self, rows: whole(self, rows)[:-1])
    with pytest.raises(RuntimeError, match="frames: 2 devices answer otherwise than one"):
        list(scaling.run_frames([device, device], model, scaling.QUICK))


def test_shards_on_devices_are_timed(device):
    model = sample("small ball")
    rows = list(scaling.run_shards([device, device], model, scaling.QUICK))
    check_rows(rows, "poses")
    assert rows[3]["mposes_s"] > 0
    driver = scaling.run_driver(model, 4096)
    assert driver["driver_mposes_s"] > 0 and driver["check_mposes_s"] > 0


def test_prediction():
    rows = [
        {"case": "worker", "device": "it", "worker_mposes_s": 2.0},
        {"case": "driver", "driver_mposes_s": 100.0},
    ]
    found = {(row["poses"], row["devices"]): row for row in scaling.predict_rows(rows)}
    many = found[10**12, 1000]
    assert many["seconds"] == pytest.approx(10 + 500 + 65536 / 2e6, rel=1e-3)
    assert many["drivers"] == 20 and many["one_driver_seconds"] == pytest.approx(10010, rel=1e-3)
    assert many["efficiency"] == pytest.approx(500 / many["seconds"], abs=1e-3)
    assert found[10**9, 1000]["efficiency"] < 0.05 < 0.97 < found[10**9, 1]["efficiency"]
