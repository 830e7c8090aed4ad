"""Benchmarks at their smallest sizes: rows make sense, and the checks catch wrong answers. No time is judged."""

import json
import math

import pytest
import warp as wp
from helpers.samples import sample

import warp_abtree as ab
from bench import __main__ as main
from bench.baselines.newton import SDF_RESOLUTION
from bench.cases import baselines, budget, build, exact, frame, precision, query, scale, scaling, sweep, update
from warp_abtree import testing

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
    assert {row["peer"] for row in rows} == {"fcl-c++", "python-fcl", "trimesh"} and ran
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
    monkeypatch.setattr(budget, "QUICK", {"frames": 63, "selected": 200})
    monkeypatch.setattr(budget, "QUICK_OBJECTS", 12)
    select, *rows = budget.run(device, quick=True, plots=tmp_path)
    assert select["case"] == "select" and select["objects"] == 200
    assert all(select[f"{name}_ms"] > 0 for name in ("view", "paper", "tolerance", "predictive"))
    expected = [(scene, name) for scene in ("rain", "focus") for name in budget.CONTROLLERS]
    assert [(row["scene"], row["controller"]) for row in rows] == expected
    for row in rows:
        assert row["judged"] == 3 and 0 <= row["within"] <= row["within_110_percent"] <= 1 and row["budget_ms"] > 0
        assert (row["error_max"] == 0) == (row["controller"] == "none") and row["cost_ms"] <= row["cost_p95_ms"]
        assert ("adds" in row) == (row["controller"] in ("none", "coarsest"))
        if row["controller"] == "none":
            assert row["cost_ms"] == pytest.approx(3.5 * row["budget_ms"], abs=0.01)
    for name in ("rain", "focus"):
        assert 10_000 < (tmp_path / f"budget-{name}.png").stat().st_size < 150_000


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


# --- the command -----------------------------------------------------------------------------------------------------


def test_command_writes_rows(tmp_path, capsys):
    file = tmp_path / "rows.json"
    assert main.main(["query", "--device", "cpu", "--quick", "--json", str(file)]) == 0
    written = json.loads(file.read_text())
    assert written["warp"] == wp.config.version and len(written["date"]) == 10 and len(written["rows"]) == 2
    assert f"pairs={written['rows'][1]['pairs']}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words", [["query", "--largest", "5"], ["baselines", "--plots", "x"], ["frame", "--count", "1"]]
)
def test_command_refuses_options_of_other_cases(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([*words, "--device", "cpu"])
    assert stop.value.code == 2 and f"{words[0]} takes no {words[1]}" in capsys.readouterr().err
