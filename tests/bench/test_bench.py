"""Benchmarks at their smallest sizes: rows make sense, and the checks catch wrong answers. No time is judged."""

import json
import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warp_abtree as ab
from bench import __main__ as main
from bench import build, fcl_peer, newton_peer, peer, peers, plots, query, roofline, scale, sweep, timing, update
from bench.shapes import knot, knot_model, pair_poses
from warp_abtree.state import lod_update, work_lists

pytestmark = pytest.mark.slow


def run_case(name, device, **options):
    """Return the rows of a case, every number in them finite and no time or size negative."""
    rows = list(main.CASES[name](device, **options))
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


def cases_of(rows, key, value):
    return [row for row in rows if row.get(key) == value]


@pytest.fixture
def no_real_meshes(monkeypatch):
    monkeypatch.delenv("ABTREE_MESHES", raising=False)


# --- cases -----------------------------------------------------------------------------------------------------------


def test_query(device):
    rows = run_case("query", device, quick=True)
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
        for name in ("newton_bvh", f"newton_sdf{newton_peer.SDF_RESOLUTION}"):
            assert (f"{name}_ms" in row) != (f"{name}_skipped" in row), "a peer runs or is named as skipped"


def test_update(device):
    rows = run_case("update", device, quick=True)
    shares = cases_of(rows, "case", "one state")
    faces = sorted({row["faces"] for row in shares})
    assert len(faces) == 2 and len(cases_of(rows, "case", "crossover")) == 2
    for n in faces:
        k = [row["k"] for row in shares if row["faces"] == n]
        assert 0 < k[0] <= k[1] < k[2] <= n
    for row in shares:
        assert row["k"] <= row["nodes_refitted"] <= row["bound"] and row["entries"] >= row["k"]
        assert row["full"] == (row["entries"] > update.refine.full_share(wp.get_device(device)) * row["faces"])
        assert row["bvh_build_ms"] > 0 and row["wall_ms"] > 0 and row["arrays_mib"] > 0
        assert row["nodes_per_s"] == pytest.approx(1e3 * row["nodes_refitted"] / row["update_ms"], rel=0.01)
    many = cases_of(rows, "case", "many states")
    assert [row["states"] for row in many] == [1, 12]
    assert many[1]["k"] > many[0]["k"] and many[1]["nodes_refitted"] > 10 * many[0]["nodes_refitted"]
    assert update.testing.current_regime().full_refit == {"cpu": 0.5, "cuda": 0.01}, "what was forced is put back"


def test_update_leaves_large_meshes_out(device):
    rows = run_case("update", device, quick=True, largest=300)
    assert {row["faces"] for row in cases_of(rows, "case", "one state")} == {168}


def test_scale(device, tmp_path):
    rows = run_case("scale", device, quick=True, models=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["knot-200.npz", "knot-600.npz"]
    pairs = cases_of(rows, "sweep", "pairs")
    assert [row["pairs"] for row in pairs] == [1, 4, 16]
    assert [row["hits"] for row in pairs] == sorted(row["hits"] for row in pairs)
    meshes = cases_of(rows, "sweep", "faces")
    assert [(row["faces"], row["pairs"]) for row in meshes] == [(168, 1), (168, 3), (576, 1), (576, 3)]
    grown = 2**20 * (meshes[2]["arrays_mib"] - meshes[0]["arrays_mib"]) / (576 - 168)
    assert 180 < grown < 300, "bytes a face, of the model and its state"
    worlds = cases_of(rows, "sweep", "worlds")
    assert [(row["worlds"], row["objects"]) for row in worlds] == [(1, 4), (8, 32)]
    assert all(row["pairs"] <= 6 * row["worlds"] for row in worlds) and worlds[1]["hits"] > worlds[0]["hits"]
    for row in [*pairs, *meshes, *worlds]:
        assert row["bytes"] >= 32 * row["node_tests_per_s"] * 1e-3 * row["ours_ms"] * 0.99 > 0
    slopes = [row for row in rows if row["sweep"].endswith("slope")]
    assert len(slopes) == 4 and all(row["ours_ms_slope"] is not None for row in slopes)
    assert all(0 < row["arrays_mib_slope"] <= 1.05 for row in slopes), "memory grows, and no faster than what is asked"


@pytest.mark.parametrize("name", ["memory", "precision", "sweep"])
def test_other_cases(device, name, no_real_meshes):
    rows = run_case(name, device, quick=True)
    if name == "memory":
        assert [row["objects"] for row in rows] == [2, 32] and rows[1]["states"] == 16
    if name == "precision":
        assert all(row["hits"] > 0 for row in rows[-2:])
    if name == "sweep":
        assert [(row["case"], row["poses"]) for row in rows] == [("launch", 16), ("sweep", 16), ("sweep", 40)]
        assert all(0 < row["meet"] < 1 for row in rows)
        assert rows[0]["peer_missed"] == rows[0]["peer_invented"] == 0 and rows[0]["node_tests_per_s"] > 0


def test_peers(device, no_real_meshes):
    pytest.importorskip("fcl")
    *rows, cores = run_case("peers", device, quick=True)
    ran = [row for row in rows if "skipped" not in row]
    assert {row["peer"] for row in rows} == {"fcl-c++", "python-fcl", "trimesh", "coal"} and ran
    assert cores["cores"] >= 1 and cores["faces_ratio"] > 0
    for row in ran:
        assert row["meet"] == 3 and row["faces_missed"] == row["faces_invented"] == row["ours_wrong"] == 0


def test_build(device, tmp_path):
    *rows, slopes = run_case("build", device, quick=True, models=tmp_path)
    assert [row["faces"] for row in rows] == [168, 576]
    for row in rows:
        assert row["tightness"] >= 1 and row["lod_max"] > row["faces"] / 3
        stages = sum(row[f"{name}_ms"] for name in ("collapse", "error", "tree"))
        assert stages == pytest.approx(row["build_ms"], rel=0.5) and row["error_ms"] > 0
        assert (build.PEER + "_ms" in row) != (build.PEER + "_skipped" in row), "the peer runs or is named as skipped"
        assert ab.Model.open(tmp_path / f"knot-{200 if row['faces'] == 168 else 600}.npz").face_count == row["faces"]
        assert 60 < row["model_bytes_a_face"] < 150 and row["file_mib"] > 0 and row["peak_mib"] is None
    assert slopes["build_ms_slope"] is not None


def test_exact(device):
    rows = run_case("exact", device, count=110, processes=1)
    assert all(row["disagreements"] == 0 for row in rows)
    assert sum(row["pairs"] for row in rows) > 110 and any(row["float32_errors"] > 0 for row in rows)


# --- the command -----------------------------------------------------------------------------------------------------


def test_command_writes_rows(tmp_path, capsys):
    file = tmp_path / "rows.json"
    assert main.main(["query", "--device", "cpu", "--quick", "--json", str(file)]) == 0
    written = json.loads(file.read_text())
    assert written["warp"] == wp.config.version and len(written["date"]) == 10 and len(written["rows"]) == 2
    assert f"pairs={written['rows'][1]['pairs']}" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["query", "--largest", "5"], ["peers", "--plots", "x"], ["memory", "--count", "1"]])
def test_command_refuses_options_of_other_cases(words, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([*words, "--device", "cpu"])
    assert stop.value.code == 2 and f"{words[0]} takes no {words[1]}" in capsys.readouterr().err


# --- checks: a wrong answer is noticed -------------------------------------------------------------------------------


@pytest.fixture
def posed(device):
    """A scene of 3 pairs of knots and all their face pairs."""
    model = knot_model(300)
    scene = ab.Scene(device)
    for pose in pair_poses(3, 0.2):
        scene.add(model, pose)
    return scene, scene.intersect(np.arange(6).reshape(3, 2), "faces")


def test_pairs_alone_notice_a_lost_hit(posed):
    scene, result = posed
    scale.check_alone(scene, result)
    result.faces = np.delete(result.faces, len(result.faces) - 1, axis=0)
    with pytest.raises(RuntimeError, match="pair 2 by itself"):
        scale.check_alone(scene, result)


def make_worlds(device):
    model = knot_model(200)
    poses = scale.world_poses(3, 3, 1.0)
    scene = ab.Scene(device)
    for world in range(3):
        for pose in poses[world]:
            scene.add(model, pose, world=world)
    return scene, model, poses, scene.intersect(output="faces")


def test_worlds_alone_notice_a_lost_hit(device):
    scene, model, poses, result = make_worlds(device)
    scale.check_worlds(scene, model, poses, result)
    result.faces = np.delete(result.faces, 0, axis=0)
    with pytest.raises(RuntimeError, match="by itself"):
        scale.check_worlds(scene, model, poses, result)
    result.pairs = result.pairs + [[0, 3]]
    with pytest.raises(RuntimeError, match="different worlds"):
        scale.check_worlds(scene, model, poses, result)


def test_a_timed_query_that_answers_otherwise_is_noticed(posed):
    scene, result = posed
    query = ab.Query(scene, "faces", pairs=result.pairs)
    result.count[1] += 1
    with pytest.raises(RuntimeError, match="differs from the checked one"):
        scale.time_query(query, {}, result, scene.device, 1)


def test_an_update_that_forgets_nodes_is_noticed(device, monkeypatch):
    model = knot_model(200)
    scene = ab.Scene(device)
    scene.add(model)
    there, back = [model.lod_max - 5], [model.lod_max]
    k, *_, launches = update.check_update(scene, there, back, model.face_count)
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
        update.check_update(scene, there, back, model.face_count)


def test_a_query_that_is_wrong_is_noticed(posed):
    """A face pair too few, and one too many, beside a peer that has them right."""
    scene, result = posed
    model, poses, truth = scene.models[0], pair_poses(3, 0.2), result.faces
    assert query.judge(truth, truth, model, poses) == {"judged": 0, "ours_wrong": 0}
    assert query.judge(truth[1:], truth, model, poses) == {"judged": 1, "ours_wrong": 0}
    apart = np.array([[0, 0, 0]]) if (0, 0, 0) not in set(map(tuple, truth.tolist())) else np.array([[0, 0, 1]])
    for ours in (truth[1:], np.concatenate([truth, apart])):
        with pytest.raises(RuntimeError, match="1 of 1 face pairs"):
            query.judge(truth, ours, model, poses)


def test_a_sweep_that_answers_otherwise_is_noticed(device):
    model = knot_model(200)
    poses = sweep.random_poses(20, 2.0).astype(np.float32)
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


def test_replayed_updates_leave_the_bits_of_set_lods(device):
    model = knot_model(300)
    scene = ab.Scene(device)
    scene.add(model)
    there, back = [model.lod_max - 20], [model.lod_max]
    *_, launches = update.check_update(scene, there, back, model.face_count)
    start = update.read_bits(scene)
    for forth, home in launches.values():
        forth()
        moved = update.read_bits(scene)
        fresh = ab.Scene(device)
        fresh.add(model, lod=there[0])
        for a, b in zip(moved, update.read_bits(fresh), strict=True):
            assert np.array_equal(a, b)
        home()
        for a, b in zip(start, update.read_bits(scene), strict=True):
            assert np.array_equal(a, b)


# --- parts -----------------------------------------------------------------------------------------------------------


def test_peer_finds_what_brute_force_finds(device):
    """Separate boxes far above the peer's epsilon: 12 faces each, poses without rotation."""
    box = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces = np.array([*faces, [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32)
    poses = np.zeros((4, 7), np.float32)
    poses[:, 6] = 1
    poses[1, :3] = 0.41, 0.27, 0.33
    poses[3, :3] = 3
    found = peer.BvhPeer(box, faces, poses, 144, wp.get_device(device))
    found.launch()
    model = ab.Model.from_arrays(box, faces, base_faces=12)
    scene = ab.Scene(device)
    for pose in poses:
        scene.add(model, pose)
    truth = scene.intersect(np.array([[0, 1], [2, 3]]), "faces").faces
    assert len(truth) > 6 and peer.count_differences(found.result(), truth) == (0, 0)
    found.rebuild()
    found.launch()
    assert np.array_equal(found.result(), truth)
    with pytest.raises(RuntimeError, match="with room for 3"):
        small = peer.BvhPeer(box, faces, poses, 3, wp.get_device(device))
        small.launch()
        small.result()


def test_peer_of_yes_or_no_finds_what_that_of_pairs_finds(device):
    poses = pair_poses(4, 0.2)
    poses[5, :3] += 7
    asked = [*knot(300), poses]
    yes_no = peer.AnyPeer(*asked, wp.get_device(device))
    every = peer.BvhPeer(*asked, 5000, wp.get_device(device))
    for other in (yes_no, yes_no, every):
        other.launch()
    found = np.isin(np.arange(4), every.result()[:, 0])
    assert np.array_equal(yes_no.result(), found) and found.tolist() == [True, True, False, True]


def cube(size=1.0):
    corners = size * np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    return corners, np.array([*faces, [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], np.int32)


def test_fcl_in_cpp_finds_what_brute_force_finds():
    """Two meshes that differ, and one with itself; B is placed by its matrix."""
    try:
        fcl_peer.load_library()
    except ImportError as error:
        pytest.skip(str(error))
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, :3, 3] = [[0.41, 0.27, 0.33], [5, 0, 0], [-0.4, -0.3, 0.2]]
    for a, b in ((cube(), cube(0.7)), (cube(),) * 2):
        found = fcl_peer.FclCppPeer(a, b, matrices)
        assert found.any().tolist() == [True, False, True]
        answers = found.faces()
        for answer, matrix in zip(answers, matrices, strict=True):
            truth = peers.load_oracle().brute_force_faces(*a, *b, np.eye(4), matrix)
            assert sorted(map(tuple, found.face_pairs(answer))) == sorted(map(tuple, truth.tolist()))


def test_fcl_in_cpp_is_named_where_it_cannot_be_compiled(monkeypatch):
    for name, value in (("PATH", "/nowhere"), ("CXX", "no-such-compiler")):
        fcl_peer.load_library.cache_clear()
        with monkeypatch.context() as patch:
            patch.setenv(name, value)
            with pytest.raises(ImportError, match="no "):
                fcl_peer.FclCppPeer(cube(), cube(), np.eye(4)[None])
    fcl_peer.load_library.cache_clear()


def test_best_constructor_is_one_of_them(device):
    name = peer.find_constructor(*knot(200), pair_poses(2, 0.5), wp.get_device(device), repeats=1)
    assert name in peer.CONSTRUCTORS


def test_differences_are_counted():
    truth = np.array([[0, 1, 2], [0, 2, 1], [1, 0, 0]])
    assert peer.count_differences(truth, truth) == (0, 0)
    assert peer.count_differences([[0, 1, 2], [0, 2, 2], [1, 0, 1], [1, 0, 0]], truth) == (1, 2)
    assert peer.count_differences(np.empty((0, 3)), truth) == (3, 0)


def test_slope_and_crossover():
    assert timing.fit_slope([1, 10, 100], [2.0, 20.0, 200.0]) == 1 and timing.fit_slope([3], [1.0]) is None
    rows = [{"k": k, "update_ms": k / 100, "full_ms": 1.0} for k in (1, 10, 80, 125, 1000)]
    assert update.find_crossover(rows, "k") == 100
    assert update.find_crossover(rows[:3], "k") is None and update.find_crossover(rows[3:], "k") == 125


def test_bound_of_equation_1():
    """One face of n: its path, log2 n + 1 nodes; all of a full tree: 2 n - 1."""
    assert update.bound_nodes(1, 1024) == 11 and update.bound_nodes(1024, 1024) == 2047
    assert update.bound_nodes(0, 5) == 0


def test_work_of_a_result():
    """A node test of 32 bytes and 64 operations, a pair of 400 bytes; 100 triangle tests of which 10 meet."""
    numbers = {"node_tests": 1000, "triangle_tests": 100, "float64_tests": 3, "exact_tests": 1}
    result = SimpleNamespace(**{name: np.array([value]) for name, value in numbers.items()})
    result.any, result.count, result.faces, result.pairs = np.array([True]), np.array([10]), [], [0]
    size, single, double = roofline.count_work(result)
    assert size == 32 * 1000 + 128 * 100 + 176 * 3 + 176 + 400 + 12 * 10
    assert single == 64 * 1000 + 140 * 100 + 152 * 7 and double == 129 * 3 + 373
    row = roofline.roofline(result, 1.0, (1e9, 1e9, 1e9))
    assert row["floor_ms"] == pytest.approx(max(size, single, double) * 1e-6, rel=1e-3)
    assert row["node_tests_per_s"] == 1e6 and "floor_ms" not in roofline.roofline(result, 1.0, None)


def test_work_of_an_update():
    """3 leaves and 5 inner nodes from a slice of 4 entries, in a millisecond at a peak of 1 GB/s."""
    row = roofline.update_roofline(3, 8, 4, 1.0, (1e9, 1e9, 1e9))
    assert row["bytes"] == 24 * 4 + 56 * 8 + 88 * 3 + 64 * 5 and row["nodes_per_s"] == 8000
    assert row["memory_share"] == pytest.approx(row["bytes"] / 1e6, rel=0.01)
    assert "floor_ms" not in roofline.update_roofline(3, 8, 4, 1.0, None)


def test_peaks_by_name():
    find = lambda name: roofline.find_peaks(SimpleNamespace(is_cpu=False, name=name))  # noqa: E731
    assert find("NVIDIA H200")[0] > find("NVIDIA H100 80GB HBM3")[0] > find("NVIDIA H100 PCIe")[0]
    assert find("Another GPU") is None
    assert all(peak > 1e6 for peak in roofline.measure_peaks(side=64, words=2**12))


def test_plots(tmp_path, monkeypatch):
    rows = [{"sweep": "pairs", "pairs": n, "ours_ms": 2.0 * n, "peer_ms": 3.0 * n, "arrays_mib": 1.0} for n in (1, 10)]
    lines = plots.find_lines(rows, scale.FIGURES[0]["panels"][0])
    assert lines == {("ours_ms", None): [(1, 2.0), (10, 20.0)], ("peer_ms", None): [(1, 3.0), (10, 30.0)]}
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        assert plots.draw(rows, scale.FIGURES, tmp_path).startswith("plots skipped: ")
    assert not list(tmp_path.iterdir())
    pytest.importorskip("matplotlib")
    assert "scale_time.svg, scale_memory.svg" in plots.draw(rows, scale.FIGURES, tmp_path / "new")
    drawn = (tmp_path / "new" / "scale_time.svg").read_text()
    assert "ours: slope 1.00" in drawn and "time of a launch [ms]" in drawn and "object pairs" in drawn
    assert "faces a mesh" not in drawn, "no panel without rows"
    plots.draw(rows, scale.FIGURES, tmp_path / "new")
    assert (tmp_path / "new" / "scale_time.svg").read_text() == drawn, "the same rows, the same file"


def test_command_draws_earlier_rows(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    file = tmp_path / "rows.json"
    row = {"case": "one state", "faces": 100, "full_ms": 1.0}
    file.write_text(json.dumps({"rows": [row | {"k": k, "update_ms": 0.1 * k} for k in (1, 10)]}))
    assert main.main(["update", "--rows", str(file), "--plots", str(tmp_path)]) == 0
    assert "update_time.svg" in capsys.readouterr().out
    assert "update, 100 faces: slope 1.00" in (tmp_path / "update_time.svg").read_text()
    with pytest.raises(SystemExit):
        main.main(["update", "--rows", str(file)])


def test_newton_is_named_where_it_is_not_asked(device):
    made, skipped = newton_peer.make_peers(*knot(200), pair_poses(1, 0.2), 10, wp.get_device(device), "too many")
    assert made == {} and set(skipped.values()) == {"too many"} and len(skipped) == 2


def test_newton_agrees_on_which_pairs_meet(device):
    pytest.importorskip("newton")
    poses = pair_poses(6, 0.2)
    poses[1::2, :3][3:] += 5
    made, skipped = newton_peer.make_peers(*knot(300), poses, 600, wp.get_device(device))
    assert "newton_bvh" in made, skipped
    for other in made.values():
        other.launch()
        found = other.compare(np.arange(6) < 3)
        assert found["contacts"] > 0 and found["any_missed"] == found["any_invented"] == 0
        assert other.compare(np.arange(6) < 2)["any_invented"] == 1
