"""Benchmarks at their smallest sizes: rows make sense, and the checks catch wrong answers. No time is judged."""

import functools
import json
import math

import numpy as np
import pytest
import warp as wp
from helpers.samples import sample

import warp_abtree as ab
from bench import __main__ as main
from bench import roofline, timing
from bench.baselines.newton import SDF_RESOLUTION
from bench.cases import baselines, budget, build, exact, frame, memory, precision, query, scale, scaling, sweep, update
from bench.shapes import knot_model, pair_poses, random_poses, scene_of_pairs, world_poses
from warp_abtree import testing
from warp_abtree.state import lod_update, work_lists

pytestmark = pytest.mark.slow


def run_case(case, device, **options):
    """Return the rows of a case, every number in them finite and no time or size negative."""
    rows = list(case.run(device, **options))
    assert rows
    for row in rows:
        for key, value in row.items():
            if isinstance(value, float):
                assert math.isfinite(value), (key, row)
            if value is not None and key.endswith(("_ms", "_s", "_mib", "bytes")) and not key.startswith("host"):
                assert value >= 0, (key, row)
        for key in [key for key in row if key.endswith("_p95_ms")]:
            assert row[key] >= row[key.replace("_p95", "")] > 0
    return rows


def rows_of(rows, key, value):
    return [row for row in rows if row.get(key) == value]


@pytest.fixture(autouse=True)
def no_real_meshes(monkeypatch):
    monkeypatch.delenv("ABTREE_MESHES", raising=False)


# --- cases -----------------------------------------------------------------------------------------------------------


def test_query(device):
    rows = run_case(query, device, quick=True)
    assert [row["pairs"] for row in rows] == [1, 4]
    for row in rows:
        assert row["triangle_tests"] >= row["hits"] > 0 and row["node_tests"] > row["triangle_tests"]
        assert row["peer_hits"] - row["peer_invented"] + row["peer_missed"] == row["hits"] and row["ours_wrong"] == 0
        assert row["ratio"] == pytest.approx(row["peer_ms"] / row["ours_ms"], rel=0.2, abs=0.02)
        assert row["bytes"] >= 32 * row["node_tests"] + 120 * row["triangle_tests"] + 12 * row["hits"]
        assert row["node_tests_per_s"] == pytest.approx(1e3 * row["node_tests"] / row["ours_ms"], rel=0.01)
        if "floor_ms" in row:
            shares = [row[f"{name}_share"] for name in ("memory", "float32", "float64")]
            assert max(shares) == pytest.approx(row["floor_ms"] / row["ours_ms"], rel=0.02)
        for name in ("newton_bvh", f"newton_sdf{SDF_RESOLUTION}"):
            assert (f"{name}_ms" in row) != (f"{name}_skipped" in row), "a baseline runs or is named as skipped"


def test_update(device):
    rows = run_case(update, device, quick=True)
    one = rows_of(rows, "case", "one state")
    faces = sorted({row["faces"] for row in one})
    assert len(faces) == 2 and len(rows_of(rows, "case", "crossover")) == 2
    for n in faces:
        k = [row["k"] for row in one if row["faces"] == n]
        assert 0 < k[0] <= k[1] < k[2] <= n
    for row in one:
        assert row["k"] <= row["nodes_refitted"] <= row["bound"] and row["entries"] >= row["k"]
        assert row["full"] == (row["entries"] > update.full_refit_fraction(wp.get_device(device)) * row["faces"])
        assert row["bvh_build_ms"] > 0 and row["wall_ms"] > 0 and row["arrays_mib"] > 0
        assert row["nodes_per_s"] == pytest.approx(1e3 * row["nodes_refitted"] / row["update_ms"], rel=0.01)
    many = rows_of(rows, "case", "many states")
    assert [row["states"] for row in many] == [1, 12]
    assert many[1]["k"] > many[0]["k"] and many[1]["nodes_refitted"] > 10 * many[0]["nodes_refitted"]
    assert testing.current_regime().full_refit == {"cpu": 0.5, "cuda": 0.01}, "what was forced is put back"


def test_update_leaves_large_meshes_out(device):
    rows = run_case(update, device, quick=True, largest=300)
    assert {row["faces"] for row in rows_of(rows, "case", "one state")} == {168}


def test_scale(device, tmp_path):
    rows = run_case(scale, device, quick=True, models=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["knot-200.npz", "knot-600.npz"]
    pairs, meshes, worlds = (rows_of(rows, "sweep", name) for name in ("pairs", "faces", "worlds"))
    assert [row["pairs"] for row in pairs] == [1, 4, 16]
    assert [row["hits"] for row in pairs] == sorted(row["hits"] for row in pairs)
    assert [(row["faces"], row["pairs"]) for row in meshes] == [(168, 1), (168, 3), (576, 1), (576, 3)]
    grown = 2**20 * (meshes[2]["arrays_mib"] - meshes[0]["arrays_mib"]) / (576 - 168)
    assert 180 < grown < 300, "bytes a face, of the model and its state"
    assert [(row["worlds"], row["objects"]) for row in worlds] == [(1, 4), (8, 32)]
    assert all(row["pairs"] <= 6 * row["worlds"] for row in worlds) and worlds[1]["hits"] > worlds[0]["hits"]
    for row in [*pairs, *meshes, *worlds]:
        assert row["bytes"] >= 32 * row["node_tests_per_s"] * 1e-3 * row["ours_ms"] * 0.99 > 0
    slopes = [row for row in rows if row["sweep"].endswith("slope")]
    assert len(slopes) == 4 and all(row["ours_ms_slope"] is not None for row in slopes)
    assert all(0 < row["arrays_mib_slope"] <= 1.05 for row in slopes), "memory grows, and no faster than what is asked"


def test_other_cases(device):
    rows = run_case(memory, device, quick=True)
    assert [row["objects"] for row in rows] == [2, 32] and rows[1]["states"] == 16
    assert all(row["hits"] > 0 for row in run_case(precision, device, quick=True)[-2:])
    rows = run_case(sweep, device, quick=True)
    assert [(row["case"], row["poses"]) for row in rows] == [("launch", 16), ("sweep", 16), ("sweep", 40)]
    assert all(0 < row["meet"] < 1 for row in rows)
    assert rows[0]["peer_missed"] == rows[0]["peer_invented"] == 0 and rows[0]["node_tests_per_s"] > 0
    rows = run_case(frame, device, quick=True)
    assert [row["ladder"] for row in rows] == [False, True] and rows[0]["hits"] == rows[1]["hits"] > 0
    rows = run_case(exact, device, count=110, processes=1)
    assert all(row["disagreements"] == 0 for row in rows)
    assert sum(row["pairs"] for row in rows) > 110 and any(row["float32_errors"] > 0 for row in rows)


def test_baselines(device):
    pytest.importorskip("fcl")
    *rows, cores = run_case(baselines, device, quick=True)
    ran = [row for row in rows if "skipped" not in row]
    assert {row["peer"] for row in rows} == {"fcl-c++", "python-fcl", "trimesh", "coal"} and ran
    assert cores["cores"] >= 1 and cores["faces_ratio"] > 0
    for row in ran:
        assert row["meet"] == 3 and row["faces_missed"] == row["faces_invented"] == row["ours_wrong"] == 0


def test_build(device, tmp_path):
    *rows, slopes = run_case(build, device, quick=True, models=tmp_path)
    assert [row["faces"] for row in rows] == [168, 576]
    for row in rows:
        assert row["tightness"] >= 1 and row["lod_max"] > row["faces"] / 3
        stages = sum(row[f"{name}_ms"] for name in ("collapse", "error", "tree"))
        assert stages == pytest.approx(row["build_ms"], rel=0.5) and row["error_ms"] > 0
        assert (build.BASELINE + "_ms" in row) != (build.BASELINE + "_skipped" in row)
        assert ab.Model.open(tmp_path / f"knot-{200 if row['faces'] == 168 else 600}.npz").face_count == row["faces"]
        assert 60 < row["model_bytes_a_face"] < 150 and row["file_mib"] > 0 and row["peak_mib"] is None
    assert slopes["build_ms_slope"] is not None


def test_budget(device, monkeypatch, tmp_path):
    monkeypatch.setattr(budget, "QUICK", {"frames": 63, "step": 6, "probe": 12, "selected": 200})
    monkeypatch.setattr(budget, "QUICK_OBJECTS", 12)
    monkeypatch.setattr(budget, "SCALES", {"cpu": (1,), "cuda": (1,)})
    coarse = [("256", "64"), ("128", "32"), ("96", "24"), ("80", "20"), ("64]", "16]"), ("64\n", "16\n")]
    monkeypatch.setattr(
        budget, "scale_sections", lambda text, _: functools.reduce(lambda t, c: t.replace(*c), coarse, text)
    )
    select, *rows = budget.run(device, quick=True, plots=tmp_path)
    assert select["case"] == "select" and select["objects"] == 200
    assert all(select[f"{name}_ms"] > 0 for name in ("view", "paper", "tolerance", "predictive"))
    cases = (("probe", (None,)), ("hold", budget.CONTROLLERS), ("step", ("none", "predictive", "paper")))
    expected = [(s, case, name) for s in ("rain", "focus") for case, names in cases for name in names]
    assert [(row["scene"], row["case"], row.get("controller")) for row in rows] == expected
    for row in rows:
        if row["case"] == "probe":
            assert row["finest_ms"] > 0 and row["coarsest_ms"] > 0 and row["taken"]
        if row["case"] == "hold":
            assert row["judged"] == 3 and 0 <= row["within"] <= row["within_tenth"] <= 1 and row["budget_ms"] > 0
            assert (row["error_max"] == 0) == (row["controller"] == "none") and row["cost_ms"] <= row["cost_p95_ms"]
            assert ("adds" in row) == (row["controller"] in ("none", "coarsest"))
            if row["controller"] == "none":
                assert row["cost_ms"] == pytest.approx(3.5 * row["budget_ms"], abs=0.01)
        if row["case"] == "step" and row["controller"] == "none":
            assert row["within_tenth"] <= 0.5 and row["load"] > 0
    for name in ("rain", "focus"):
        kept = json.loads((tmp_path / f"budget-{name}.json").read_text())
        assert len(kept["runs"]) == 5 and all(len(history) == 63 for history in kept["runs"].values())
        picture = tmp_path / f"budget-{name}.png"
        picture.unlink()
        assert budget.draw_saved(tmp_path / f"budget-{name}.json").endswith(f"budget-{name}.png")
        assert 10_000 < picture.stat().st_size < 150_000


def test_sections_are_scaled():
    text = (budget.SCENES / "rain.toml").read_text()
    found = budget.scale_sections(text, 4).splitlines()
    changed = {(a, b) for a, b in zip(text.splitlines(), found) if a != b}
    assert changed == {
        ("cells = [128, 128]", "cells = [512, 512]"),
        ("major_sections = 128", "major_sections = 512"),
        ("minor_sections = 64", "minor_sections = 256"),
        ("sections = [256, 32]", "sections = [1024, 128]"),
        ("sections = [96, 80]", "sections = [384, 320]"),
    }


def test_a_load_rises_when_objects_join():
    poses = np.random.default_rng(0).normal(size=(4, 50, 7))
    motion, out = budget.LoadStep(poses, 2, 0.1), np.empty((50, 7))
    for number in range(6):
        found = motion.poses(0.1 * number, out)
        same = (found == poses[min(number, 3)]).all(axis=1)
        assert same.all() if number >= 2 else 10 < same.sum() < 40
    apart = np.sort(motion.poses(0.0, out)[:, 0])
    assert (np.diff(apart[apart > 500]) > 900).all(), "objects that wait are far from each other"


# --- several devices -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 4, 5])
def test_numbers_of_devices(count):
    numbers = {1: [1], 2: [1, 2], 4: [1, 2, 4], 5: [1, 2, 4, 5]}[count]
    assert scaling.list_sizes(["cpu"] * count) == sorted({(n, times) for n in numbers for times in (1, n)})


def check_scaling(rows, name):
    assert [(row["way"], row["devices"]) for row in rows] == [("strong", 1), ("strong", 2), ("weak", 1), ("weak", 2)]
    sizes = [row[name] for row in rows]
    assert sizes[:3] == sizes[:1] * 3 and sizes[3] == 2 * sizes[0]
    assert rows[0]["efficiency"] == rows[2]["efficiency"] == 1
    assert testing.current_regime().cpu_threads is None


def test_frames_on_devices_are_timed(device, monkeypatch):
    model = sample("small ball")
    rows = list(scaling.scale_frames([device, device], model, scaling.QUICK))
    check_scaling(rows, "worlds")
    assert all(row["frame_ms"] > 0 for row in rows)
    whole = scaling.WorldFrames.answer
    monkeypatch.setattr(scaling.WorldFrames, "answer", lambda self, rows: whole(self, rows)[:-1])
    with pytest.raises(RuntimeError, match="frames: 2 devices answer otherwise than one"):
        list(scaling.scale_frames([device, device], model, scaling.QUICK))


def test_shards_on_devices_are_timed(device):
    model = sample("small ball")
    rows = list(scaling.scale_shards([device, device], model, scaling.QUICK))
    check_scaling(rows, "poses")
    assert rows[3]["mposes_s"] > 0
    driver = scaling.time_driver(model, 4096)
    assert driver["driver_mposes_s"] > 0 and driver["check_mposes_s"] > 0
    assert scaling.time_worker(wp.get_device(device), model, 64, 1)["worker_mposes_s"] > 0


# --- checks: a wrong answer is noticed -------------------------------------------------------------------------------


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
    assert query.check_peer(truth, truth, model, poses)["judged"] == 0
    row = query.check_peer(truth[1:], truth, model, poses)
    assert (row["judged"], row["ours_wrong"], row["peer_missed"]) == (1, 0, 1)
    apart = np.array([[0, 0, 0]]) if (0, 0, 0) not in set(map(tuple, truth.tolist())) else np.array([[0, 0, 1]])
    for ours in (truth[1:], np.concatenate([truth, apart])):
        with pytest.raises(RuntimeError, match="1 of 1 face pairs"):
            query.check_peer(truth, ours, model, poses)


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


# --- the command -----------------------------------------------------------------------------------------------------


def test_command_writes_rows(tmp_path, capsys):
    file = tmp_path / "rows.json"
    assert main.main(["query", "--device", "cpu", "--quick", "--json", str(file)]) == 0
    written = json.loads(file.read_text())
    assert written["warp"] == wp.config.version and len(written["date"]) == 10 and len(written["rows"]) == 2
    assert f"pairs={written['rows'][1]['pairs']}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [["query", "--largest", "5"], ["baselines", "--plots", "x"], ["memory", "--count", "1"]]
)
def test_command_refuses_options_of_other_cases(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([*words, "--device", "cpu"])
    assert stop.value.code == 2 and f"{words[0]} takes no {words[1]}" in capsys.readouterr().err
