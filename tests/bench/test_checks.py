"""The checks of benchmarks notice wrong answers, and their measures are right on cases known by hand."""

import numpy as np
import pytest
import warp as wp

import warp_abtree as ab
from bench import roofline, timing
from bench.cases import build, query, scale, sweep, update
from bench.shapes import knot_model, pair_poses, random_poses, scene_of_pairs, world_poses
from warp_abtree.state import lod_update, work_lists

pytestmark = pytest.mark.slow


@pytest.fixture
def posed(device):
    """A scene of 3 pairs of knots and all their face pairs."""
    scene, pairs = scene_of_pairs(device, knot_model(300), pair_poses(3, 0.2))
    return scene, scene.intersect(pairs, "faces")


def test_pairs_alone_notice_a_lost_hit(posed):
    scene, result = posed
    scale.check_alone(scene, result)
    result.faces = np.delete(result.faces, len(result.faces) - 1, axis=0)
    with pytest.raises(RuntimeError, match="pair 2 by itself"):
        scale.check_alone(scene, result)


def test_worlds_alone_notice_a_lost_hit(device):
    model, poses = knot_model(200), world_poses(3, 3, 1.0)
    scene = ab.Scene(device)
    for world in range(3):
        for pose in poses[world]:
            scene.add(model, pose, world=world)
    result = scene.intersect(output="faces")
    scale.check_worlds(scene, model, poses, result)
    result.faces = np.delete(result.faces, 0, axis=0)
    with pytest.raises(RuntimeError, match="by itself"):
        scale.check_worlds(scene, model, poses, result)
    result.pairs = result.pairs + [[0, 3]]
    with pytest.raises(RuntimeError, match="different worlds"):
        scale.check_worlds(scene, model, poses, result)


def test_a_timed_query_that_answers_otherwise_is_noticed(posed):
    scene, result = posed
    timed = ab.Query(scene, "faces", pairs=result.pairs)
    result.count[1] += 1
    with pytest.raises(RuntimeError, match="differs from the checked one"):
        scale.time_query(timed, {}, result, 1)


def test_a_query_that_is_wrong_is_noticed(posed):
    """A face pair too few, and one too many, beside a baseline that has them right."""
    scene, result = posed
    model, poses, truth = scene.models[0], pair_poses(3, 0.2), result.faces
    assert query.check_baseline(truth, truth, model, poses)["judged"] == 0
    row = query.check_baseline(truth[1:], truth, model, poses)
    assert (row["judged"], row["ours_wrong"], row["peer_missed"]) == (1, 0, 1)
    apart = np.array([[0, 0, 0]]) if (0, 0, 0) not in set(map(tuple, truth.tolist())) else np.array([[0, 0, 1]])
    for ours in (truth[1:], np.concatenate([truth, apart])):
        with pytest.raises(RuntimeError, match="1 of 1 face pairs"):
            query.check_baseline(truth, ours, model, poses)


def test_a_sweep_that_answers_otherwise_is_noticed(device):
    model = knot_model(200)
    poses = random_poses(20, 2.0).astype(np.float32)
    found = ab.sweep(model, model, poses, device=device)
    sweep.check_sweep(wp.get_device(device), model, poses, found)
    with pytest.raises(RuntimeError, match="differ"):
        sweep.check_sweep(wp.get_device(device), model, poses, ~found)


def test_a_model_whose_error_is_too_small_is_noticed(monkeypatch):
    model = knot_model(600)
    assert build.check_model(model, 100) >= 1
    monkeypatch.setattr(ab.Model, "error_at", lambda self, lod, kept=ab.Model.error_at: 0.5 * kept(self, lod))
    with pytest.raises(RuntimeError, match="beyond its error"):
        build.check_model(model, 1000)
    with pytest.raises(RuntimeError, match="opened model differs"):
        build.check_same(model, knot_model(500))


def moved_scene(device, splits):
    """Return a scene of one knot, LODs some splits below its finest and the finest, and its number of faces."""
    model = knot_model(300)
    scene = ab.Scene(device)
    scene.add(model)
    return scene, [model.lod_max - splits], [model.lod_max], model.face_count


def test_an_update_that_forgets_nodes_is_noticed(device, monkeypatch):
    scene, there, back, faces = moved_scene(device, 5)
    k, *_, launches = update.check_update(scene, there, back, faces)
    assert k[0] > 0 and set(launches) == {"update", "full"}
    whole = lod_update.active_update

    def forget(models, states, work):
        if work.full.all():
            return whole(models, states, work)
        work_lists.active_mark(models, states, work)
        counts = work.plan.level_count.numpy().copy()
        counts[: len(work.level_room) - 2] = 0  # a partial update refits but its leaves
        work.plan.level_count.assign(counts)
        work_lists.active_walk(models, states, work)

    monkeypatch.setattr(lod_update, "active_update", forget)
    with pytest.raises(RuntimeError, match="bits"):
        update.check_update(scene, there, back, faces)


def test_replayed_updates_leave_the_bits_of_set_lods(device):
    scene, there, back, faces = moved_scene(device, 20)
    *_, launches = update.check_update(scene, there, back, faces)
    start = update.read_bits(scene)
    for forth, home in launches.values():
        forth()
        fresh = ab.Scene(device)
        fresh.add(scene.models[0], lod=there[0])
        assert update.same_bits(update.read_bits(scene), update.read_bits(fresh))
        home()
        assert update.same_bits(start, update.read_bits(scene))


# --- measures --------------------------------------------------------------------------------------------------------


def test_slope_and_crossover():
    assert timing.fit_slope([1, 10, 100], [2.0, 20.0, 200.0]) == 1 and timing.fit_slope([3], [1.0]) is None
    rows = [{"k": k, "update_ms": k / 100, "full_ms": 1.0} for k in (1, 10, 80, 125, 1000)]
    assert update.find_crossover(rows, "k") == 100
    assert update.find_crossover(rows[:3], "k") is None and update.find_crossover(rows[3:], "k") == 125


def test_bound_of_equation_1():
    """One face of n: its path, log2 n + 1 nodes; all of a full tree: 2 n - 1."""
    assert update.bound_nodes(1, 1024) == 11 and update.bound_nodes(1024, 1024) == 2047
    assert update.bound_nodes(0, 5) == 0


class Counted:
    """1,000 node tests at 32 bytes and 64 operations, a pair of 400 bytes; 100 triangle tests, 10 of them hits."""

    node_tests, triangle_tests = np.array([1000]), np.array([100])
    float64_tests, exact_tests = np.array([3]), np.array([1])
    any, count, faces, pairs = np.array([True]), np.array([10]), (), (0,)


class OtherGpu:
    is_cpu = False

    def __init__(self, name):
        self.name = name


def test_work_of_a_result():
    size, single, double = roofline.count_work(Counted)
    assert size == 32 * 1000 + 128 * 100 + 176 * 3 + 176 + 400 + 12 * 10
    assert single == 64 * 1000 + 140 * 100 + 152 * 7 and double == 129 * 3 + 373
    row = roofline.roofline(Counted, 1.0, (1e9, 1e9, 1e9))
    assert row["floor_ms"] == pytest.approx(max(size, single, double) * 1e-6, rel=1e-3)
    assert row["node_tests_per_s"] == 1e6 and "floor_ms" not in roofline.roofline(Counted, 1.0, None)


def test_work_of_an_update():
    """3 leaves and 5 inner nodes from a slice of 4 entries, in a millisecond at a peak of 1 GB/s."""
    row = roofline.update_roofline(3, 8, 4, 1.0, (1e9, 1e9, 1e9))
    assert row["bytes"] == 24 * 4 + 56 * 8 + 88 * 3 + 64 * 5 and row["nodes_per_s"] == 8000
    assert row["memory_share"] == pytest.approx(row["bytes"] / 1e6, rel=0.01)
    assert "floor_ms" not in roofline.update_roofline(3, 8, 4, 1.0, None)


def test_peaks_by_name():
    names = ("NVIDIA H200", "NVIDIA H100 80GB HBM3", "NVIDIA H100 PCIe")
    memory_peaks = [roofline.find_peaks(OtherGpu(name))[0] for name in names]
    assert memory_peaks == sorted(memory_peaks, reverse=True)
    assert roofline.find_peaks(OtherGpu("Another GPU")) is None
    assert all(peak > 1e6 for peak in roofline.measure_peaks(side=64, words=2**12))
