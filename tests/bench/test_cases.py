"""Benchmarks at their smallest sizes, through the command: rows make sense. No time is judged."""

import contextlib
import json
import math
from functools import partial
from pathlib import Path

import pytest
import warp as wp

from bench import __main__ as main
from bench import timing
from bench.baselines import newton_nuts
from bench.baselines.newton import SDF_RESOLUTION
from bench.cases import budget, build, distance, host
from bench.contacts import points
from bench.gate import compare
from bench.tables import pick
from warp_abtree import testing

pytestmark = pytest.mark.slow
PLOTS = {"budget": ["budget-rain.svg", "budget-focus.svg"], "scale": ["scale_time.svg", "scale_memory.svg"]}


def check_assembly(rows):
    assert rows[-1]["case"] == "hammered" and rows[-1]["steps"] == 4 and rows[-1]["tunnelled"] == 0
    for row in rows[:-1]:
        if "skipped" in row:
            assert "ABTREE_MESHES" in row["skipped"] or row["case"] == "newton"
            continue
        if row.get("case") == "newton":
            assert row["ours_same_bits"] and row["ours_30um_same_bits"] and row["ours_worlds"] == row["worlds"] == 1
            assert (row["ours_ms"] > 0 and "bvh_same_gap_ms" in row) or "sdf_same_gap_ms" in row
            continue
        assert row.get("fcl_differs", 0) == 0 and row["poses"] == 3 and row["faces_ms"] > 0 < row["any_one_ms"]
        assert (row["meet"] == 3) == row["workload"].endswith("crossing") and (row["hits"] > 0) == (row["meet"] > 0)


def check_query(rows):
    assert [row["pairs"] for row in rows] == [1, 4]
    for row in rows:
        assert row["peer_hits"] - row["peer_invented"] + row["peer_missed"] == row["hits"] and row["ours_wrong"] == 0
        assert row["ratio"] == pytest.approx(row["peer_ms"] / row["ours_ms"], rel=0.2, abs=0.02)
        assert row["node_tests_per_s"] == pytest.approx(1e3 * row["node_tests"] / row["ours_ms"], rel=0.01)
        for name in ("newton_bvh", f"newton_sdf{SDF_RESOLUTION}"):
            assert (f"{name}_ms" in row) != (f"{name}_skipped" in row), "a baseline runs or is named as skipped"


def check_update(rows):
    assert {row["faces"] for row in pick(rows, case="one state")} == {168, 576}
    for row in pick(rows, case="one state"):
        assert row["k"] <= row["nodes_refitted"] <= row["bound"] and row["entries"] >= row["k"]
        share = testing.current_regime().full_refit["cpu" if row["device"] == "CPU" else "cuda"]
        assert row["full"] == (row["entries"] > share * row["faces"]) and row["arrays_mib"] > 0
    many = pick(rows, case="many states")
    assert [row["states"] for row in many] == [1, 12] and many[1]["nodes_refitted"] > 10 * many[0]["nodes_refitted"]
    assert testing.current_regime().full_refit == {"cpu": 0.5, "cuda": 0.2}, "what was forced is put back"


def check_scale(rows):
    pairs, meshes, worlds = (pick(rows, sweep=name) for name in ("pairs", "faces", "worlds"))
    assert [row["pairs"] for row in pairs] == [1, 4, 16]
    assert [(row["faces"], row["pairs"]) for row in meshes] == [(168, 1), (576, 1), (168, 3), (576, 3)]
    grown = 2**20 * (meshes[1]["arrays_mib"] - meshes[0]["arrays_mib"]) / (576 - 168)
    assert 180 < grown < 340, "bytes a face, of the model and its state, on a GPU with slabs of nodes"
    assert [(row["worlds"], row["objects"]) for row in worlds] == [(1, 4), (8, 32)]
    assert all(row["pairs"] <= 6 * row["worlds"] for row in worlds) and worlds[1]["hits"] > worlds[0]["hits"]
    slopes = [row for row in rows if row["sweep"].endswith("slope")]
    assert len(slopes) == 4 and all(0 < row["arrays_mib_slope"] <= 1.05 for row in slopes)


def check_sweep(rows):
    assert [(row["case"], row["poses"]) for row in rows] == [("launch", 16), ("sweep", 16), ("sweep", 40)]
    assert all(0 < row["meet"] < 1 for row in rows) and rows[0]["peer_missed"] == rows[0]["peer_invented"] == 0


def check_frame(rows):
    assert [row["ladder"] for row in rows] == [False, True] and rows[0]["hits"] == rows[1]["hits"] > 0


def check_broad(rows):
    assert [(row["objects"], row["worlds"]) for row in rows] == [(16, 1), (64, 16)]
    for row in rows:
        assert row["pairs"] > 0 and row["ratio"] == pytest.approx(row["peer_ms"] / row["ours_ms"], rel=0.05)


def check_host(rows):
    assert [(row["pairs"], row["output"]) for row in rows] == [
        (count, name) for count in (1, 4) for name in host.OUTPUTS
    ]
    for row in rows:
        records = {"contacts": 12 + 133, "faces": 12}.get(row["output"], 0) * (row["hits"] or 0)
        of_pairs = {"any": 33, "contacts": 41 + 56}.get(row["output"], 41)
        assert row["bytes"] == records + of_pairs * row["pairs"] and row["goal_ms"] >= row["launches_ms"] > 0


def check_exact(rows):
    *rows, _, _, coincident = rows
    assert coincident["hits"] > 0 and coincident["to_float64"] == 1
    assert len(rows) == 12 and all(row["disagreements"] == 0 for row in rows)
    assert sum(row["pairs"] for row in rows) > 110 and any(row["float32_errors"] > 0 for row in rows)


def check_baselines(rows):
    assert {row["peer"] for row in rows} == {"python-fcl", "trimesh"}
    for row in rows:
        assert row["faces_missed"] == row["faces_invented"] == row["ours_wrong"] == 0
        assert row["meet"] == 3 and row["ours_any_per_s"] > 0 and row["faces_ratio"] > 0


def check_libraries(rows):
    assert [row["library"] for row in rows] == "warp_abtree python-fcl coal MeshLib trueform py-parry3d".split()
    for row in rows:
        if "skipped" not in row:
            assert row["any_us"] > 0 and row["hits"] > 0 == row.get("any_differ", 0) == row.get("faces_missed", 0)
            assert row.get("distance_error", 0) < 1e-6 and ("faces_us" in row) == (row["library"] != "py-parry3d")


def check_distance(rows):
    gaps, points = ([row for row in rows if name in row] for name in ("gap", "points"))
    rows = [row for row in rows if "gap" not in row and "points" not in row]
    assert points[-1]["workload"] == "torus" and 0 < points[-1]["inside"] < 300 and points[-1]["peer_wrong_sides"] <= 3
    assert [row["gap"] for row in gaps] == list(distance.GAPS)
    assert gaps[0]["more"] == 1 < gaps[-1]["more"] and all(row["ratio"] > 0 for row in gaps)
    assert rows[-1]["workload"] == "knot, 3 poses"
    for row in rows:
        assert row["poses"] == 3 > row["meet"] and row["median_gap"] > 0 and 0 < row["face_tests"] < row["node_tests"]
        assert row["again_ms"] > 0 and row.get("fcl_differs", 0) < 1e-12


def check_motion(rows):
    queries, checked, *times = rows
    assert "skipped" in queries or queries["missed"] == 0 < queries["contacts"]
    assert checked["late"] == checked["missed"] == checked["early"] == 0 < checked["clear"] < checked["asked"]
    assert len(times) == 3 and all(row["ms"] > 0 and row["undecided"] == 0 for row in times)
    assert all(row.get("fcl_late", 0) == 0 for row in times)


def check_build(rows):
    assert [row["faces"] for row in rows] == [168, 576]
    for row in rows:
        stages = sum(row[f"{name}_ms"] for name in ("collapse", "error", "tree"))
        assert stages == pytest.approx(row["build_ms"], rel=0.5) and row["error_ms"] > 0
        assert (build.BASELINE + "_ms" in row) != (build.BASELINE + "_skipped" in row)
        assert row["lod_max"] > row["faces"] / 3 and row["file_mib"] > 0


def check_coarse(rows):
    assert [row["fraction"] for row in rows] == [1, 0.1, 0.01] and [row["faces"] for row in rows][:2] == [272, 28]
    for row in rows:
        assert row["hits"] > 0 and row["any_ratio"] == pytest.approx(
            row["peer_any_ms"] / row["any_ms"], rel=0.2, abs=0.02
        )


def check_budget(rows):
    expected = [(scene, name) for scene in ("rain", "focus") for name in budget.CONTROLLERS]
    held, controlled = ([row for row in rows if name in row] for name in ("judged", "ratio"))
    assert [(row["scene"], row["controller"]) for row in held] == expected
    assert {row["scene"] for row in controlled} == set(SMALLER["budget"][budget, "CONTROLLED"])
    for row in controlled:
        assert row["ratio"] == pytest.approx(row["total_ms"] / row["finest_ms"], rel=0.01) and row["select_ms"] > 0
    staged = [row for row in rows if "lods" in row]
    assert [row["scene"] for row in staged[::2]] == list(budget.STAGED) and len(staged) == 2 * len(budget.STAGED)
    for finest, coarsest in zip(staged[::2], staged[1::2]):
        assert finest["hits"] >= coarsest["hits"] and finest["query_ms"] > 0 and finest["total_ms"] > finest["query_ms"]
    assert len(rows) == len(held) + len(controlled) + len(staged)
    for row in held:
        assert row["judged"] == 3 and 0 <= row["within"] <= row["within_110_percent"] <= 1 and row["budget_ms"] > 0
        assert (row["error_max"] == 0) == (row["controller"] == "none") and row["cost_ms"] <= row["cost_p95_ms"]
        if row["controller"] == "none":
            assert row["cost_ms"] == pytest.approx(3.5 * row["budget_ms"], abs=0.01)


def check_points(rows):
    if "skipped" in rows[0]:
        assert "ABTREE_MESHES" in rows[0]["skipped"]
        return
    assert [(row["case"], row["asked"]) for row in rows] == [(name, n) for name in points.LODS for n in points.ASKED]
    for row in rows:
        assert 0 < row["points"] <= row["asked"] < row["near"] and row["poses"] == row["worlds"] == 2
        assert row["allowed_um"] <= row["worst_pose_um"] <= row["allowed_max_um"] <= 1e6 * 4 * points.GAP
        assert 0 < row["moved_um"] < 1e6 * points.GAP and row["really_um"] <= row["really_worst_pose_um"] < 3
        assert row["one_ratio"] == pytest.approx(row["one_ms"] / row["faces_ms"], rel=0.02)


def check_gradients(rows):
    (row,) = rows
    assert row["pairs"] == 56 > row["near"] >= row["overlapping"] > 5
    assert row.get("fcl_differ", 0) == 0 and row.get("fcl_agree", 1) == 1
    assert row["warp_differ"] == 0 < row["warp_agree"] and row["warp_ratio"] > 0


def check_robot(rows):
    assert [row["output"] for row in rows] == ["any", "distance", "distance", "edges"]
    assert rows[0]["differ_from_fcl"] == 0 and 0 < rows[0]["meet"] < 1 and rows[3]["clear"] > 0


def check_gate(rows):
    assert rows[0]["case"] == "trees" and rows[-1]["digests_differ"] == 0 < rows[-1]["first_now_s"]
    kinds = [row["case"] for row in rows]
    assert kinds.count("digest") >= 40 and kinds.count("time") == len(LAUNCHES)
    assert not [row for row in rows if row["case"] == "digest" and row["now"] is None]


LAUNCHES = ("query, 1 pair", "coarse 0.1, any", "distance 8, again", "motion, 8", "update, 0.1", "frame, 16 objects")
LAUNCHES += ("host 1, any",)


class FewLaunches(compare.Tree):
    """A checkout whose worker times one launch of each kind."""

    def ask(self, do, **command):
        found = super().ask(do, **command)
        if do == "list":
            assert set(LAUNCHES) < set(found["times"])
        return found | {"times": LAUNCHES} if do == "list" else found


# This machine's kernel cache, for the empty one that a first answer is timed with.
KEPT_KERNELS = contextlib.nullcontext(str(Path(wp.config.kernel_cache_dir).parent))
# What cases do at smaller sizes still: modules, names in them, and what stands there.
SMALLER = {
    "assembly": {(newton_nuts, "OURS"): {name: newton_nuts.OURS[name] for name in ("ours", "ours_30um")}},
    "budget": {
        (budget, "QUICK_FRAMES"): 63,
        (budget, "QUICK_OBJECTS"): 12,
        (budget, "CONTROLLED"): ("focus", "rain"),
        (budget, "STAGED"): ("focus", "rain"),
        (budget, "collect"): lambda: None,
    },
    "gate": {(compare, "Tree"): FewLaunches, (compare.tempfile, "TemporaryDirectory"): lambda: KEPT_KERNELS},
    "points": {
        (points, "LODS"): {name: points.LODS[name] for name in ("all faces", "30 um")},
        (points, "penetration_allowed"): partial(points.penetration_allowed, count=200),
    },
}


@pytest.fixture(scope="module")
def built_models(tmp_path_factory):
    """Give a folder in which models stay from one case to the next."""
    return str(tmp_path_factory.mktemp("models"))


@pytest.mark.parametrize("name", main.CASES)
def test_case(name, device, tmp_path, monkeypatch, capsys, built_models):
    monkeypatch.delenv("ABTREE_MESHES", raising=False)
    monkeypatch.setenv("WARP_ABTREE_CACHE", built_models)
    monkeypatch.setattr(timing, "WARM_UP", 0)
    for (owner, attribute), value in SMALLER.get(name, {}).items():
        monkeypatch.setattr(owner, attribute, value)
    for library in {"baselines": ["fcl"], "robot": ["fcl", "yourdfpy"]}.get(name, []):
        pytest.importorskip(library)
    file, more = tmp_path / "rows.json", ["--plots", str(tmp_path)] if name in PLOTS else []
    assert main.main([name, "--device", device, "--quick", "--json", str(file), *more]) == 0
    written = json.loads(file.read_text())
    assert written["warp"] == wp.config.version and f"{[*written['rows'][-1]][-1]}=" in capsys.readouterr().out
    for row in written["rows"]:
        for key, value in row.items():
            assert not isinstance(value, float) or math.isfinite(value), (key, row)
            if value is not None and key.endswith(("_ms", "_s", "_mib", "bytes")):
                assert value >= 0, (key, row)
            if key.endswith("_p95_ms"):
                assert value >= row[key.replace("_p95", "")] > 0
    globals()[f"check_{name}"](written["rows"])
    if name in PLOTS:
        pytest.importorskip("matplotlib")
        assert all((tmp_path / picture).stat().st_size > 10_000 for picture in PLOTS[name])


def test_models_are_kept(device, tmp_path):
    assert main.main(["update", "--device", device, "--quick", "--models", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"knot-200-base10.npz", "knot-600-base10.npz"}
