"""Arguments and files that are refused, each by one line that names what is wrong; and what answers in their place."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from helpers.samples import sample

import warp_abtree as ab
from warp_abtree.app.cli.main import main
from warp_abtree.lod.selection import Camera

SCENE = """
[models.ball]
shape = "icosphere"
subdivisions = 1
[[objects]]
model = "ball"
count = 3
"""
STILL = (0, 0, 0, 0, 0, 0, 1)


def balls(device, count=2):
    scene = ab.Scene(device)
    for i in range(count):
        scene.add(sample("small ball"), pose=(0.1 * i, 0, 0, 0, 0, 0, 1), world=i)
    return scene


def status_of(capsys, *words):
    """Return the exit status of a command, and its lines on stderr."""
    capsys.readouterr()
    try:
        status = main([str(word) for word in words])
    except SystemExit as end:
        status = end.code
    return status, capsys.readouterr().err.splitlines()


# Scenes.


def test_pairs_that_are_named_are_asked_whatever_their_worlds(device):
    scene = balls(device, 3)
    assert len(scene.broad_phase()) == 0
    assert scene.intersect([(0, 1), (2, 1)], output="any").any.all()


def test_a_scene_without_objects_answers_nothing(device):
    scene = ab.Scene(device)
    for call in (
        lambda: scene.set_lods([]),
        lambda: scene.set_poses(np.empty((0, 7))),
        scene.intersect,
        lambda: scene.intersect([]),
        lambda: ab.Query(scene),
        lambda: ab.Frame(scene),
    ):
        with pytest.raises(ValueError, match=r"^the scene has no object$"):
            call()
    scene.add(sample("small ball"))
    assert scene.broad_phase().shape == (0, 2) and len(scene.intersect().pairs) == 0


@pytest.mark.parametrize("static", ["no", 1, None, np.array([True])])
def test_static_is_a_truth(static):
    scene = ab.Scene("cpu")
    with pytest.raises(ValueError, match="static"):
        scene.add(sample("small ball"), static=static)
    assert scene.object_count == 0
    assert scene.add(sample("small ball"), static=np.bool_(True)) == 0


def test_statistics_of_an_update_can_be_read(device):
    scene = balls(device, 2)
    stats = scene.set_lods([0, 3])
    assert repr(stats) == f"LodUpdate({len(stats.state)} states updated, {stats.full.sum()} of them whole)"
    assert len(stats.state) == 2
    assert "LodUpdate(0 states" in repr(scene.set_lods([0, 3]))


# Scene files.


@pytest.mark.parametrize("count", [0, -1, 1.5, 2.0, "x", True, np.int32(0), np.nan])
def test_a_number_of_objects_is_whole_and_above_0(tmp_path, count):
    path = tmp_path / "s.toml"
    path.write_text(SCENE)
    with pytest.raises(ValueError, match=r"^objects ") as caught:
        ab.load_scene(path, device="cpu", objects=count)
    assert "\n" not in str(caught.value)


def test_a_number_of_objects_of_numpy(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(SCENE)
    loaded = ab.load_scene(path, device="cpu", objects=np.int64(5))
    assert loaded.scene.object_count == 5 and type(loaded.objects) is int


@pytest.mark.parametrize("count", ["0", "-1", "1.5", "x"])
@pytest.mark.parametrize("command", ["run", "view", "picture"])
def test_a_number_of_objects_on_the_command_line(capsys, command, count):
    more = ["--out", "x.png"] if command == "picture" else []
    status, lines = status_of(capsys, command, "rain", *more, "--objects", count)
    assert status == 2 and len(lines) == 1 and f"--objects: '{count}' is no whole number" in lines[0]


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (SCENE + 'static = "no"\n', r"objects\[0\].static: not true or false"),
        (SCENE + '[lod]\ncontroller = "paper"\nbudget_ms = 8\nspacing = "ratio"\n', "lod.spacing: "),
    ],
)
def test_keys_of_scene_files(tmp_path, text, key):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(ab.SceneError, match=rf"s\.toml: {key}"):
        ab.load_scene(path, device="cpu")


def test_the_spacing_of_a_file_may_meet_another_controller(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(SCENE + '[lod]\nbudget_ms = 8\nspacing = "ratio"\n')
    loaded = ab.load_scene(path, device="cpu")
    assert loaded.frame(controller="paper").run(1)


def test_a_flat_mesh_has_no_mass_in_one_line():
    pytest.importorskip("scipy")
    flat = ab.Model.from_arrays(np.eye(3), [[0, 1, 2]], name="sheet")
    scene = ab.Scene("cpu")
    scene.add(flat)
    with pytest.raises(ValueError, match="'sheet' is flat") as caught:
        ab.Dynamics(scene)
    assert "\n" not in str(caught.value)


# Frames, clocks, cameras, controllers.


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("time_step", [0, -1, 0.0, np.nan, np.inf, "x", None]),
        ("output", ["everything", None, 3]),
        ("lods", ["paper", 3, [0, 0]]),
        ("clock", [3.0, "cpu"]),
    ],
)
def test_a_frame_refuses_when_it_is_made(name, values):
    scene = balls("cpu")
    for value in values:
        with pytest.raises(ValueError, match=name):
            ab.Frame(scene, **{name: value})


def test_a_frame_of_contacts(device):
    assert ab.Frame(balls(device), output="contacts").step().contacts is not None


def test_a_summary_is_of_frames():
    frame = ab.Frame(balls("cpu"))
    with pytest.raises(ValueError, match="none has run"):
        frame.summary()
    frame.step()
    assert frame.summary()["frames"] == 1


@pytest.mark.parametrize("name", ["rows.csv", "rows.json"])
def test_a_history_into_a_folder_that_is_not_there(tmp_path, name):
    path = tmp_path / "missing" / name
    frame = ab.Frame(balls("cpu"))
    frame.step()
    with pytest.raises(FileNotFoundError) as caught:
        frame.record(path)
    assert str(path) in str(caught.value) and "partial" not in str(caught.value)


@pytest.mark.parametrize("rate", [np.nan, -1e-9, np.inf, "fast", None, [1.0, 2.0]])
def test_rates_of_work(rate):
    with pytest.raises(ValueError, match="rates: 'query'"):
        ab.WorkClock({"query": rate})
    assert ab.WorkClock({"query": 0}).rates["query"] == 0


NOT_FINITE = np.diag([1.0, np.nan, 1.0])


@pytest.mark.parametrize(
    "view", [np.eye(3) * (1 + 0j), NOT_FINITE, np.full((3, 3), np.inf), np.eye(4), np.ones((3, 3)), "x"]
)
def test_the_view_of_a_camera(view):
    with np.errstate(all="ignore"), pytest.raises(ValueError, match=r"^view: "):
        Camera(np.zeros(3), view)
    with pytest.raises(ValueError, match=r"^eye: "):
        Camera(np.zeros(3) + 1j, np.eye(3))


@pytest.mark.parametrize("value", ["x", "8", None, np.nan, -1.0, [8.0], 1j])
def test_controllers_name_the_argument(value):
    scene = balls("cpu")
    for kind, name in ((ab.PaperController, "budget_ms"), (ab.PredictiveController, "budget_ms")):
        with pytest.raises(ValueError, match=rf"^{name}\b"):
            kind(scene, value)
    with pytest.raises(ValueError, match=r"^tolerance\b"):
        ab.ToleranceController(scene, value)
    if value is not None:
        with pytest.raises(ValueError, match=r"^threshold_ms\b"):
            ab.PaperController(scene, 8.0, threshold_ms=value)


# Meshes and models.


@pytest.mark.parametrize("index", [4, 2**31, 2**63, 10**30, -(10**30)])
@pytest.mark.parametrize("face", ["f 1 2 {}", "f 1 2 3 {}", "f {0}/1 2/1 3/1"])
def test_an_index_of_obj_beyond_the_vertices(tmp_path, index, face):
    path = tmp_path / "big.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + face.format(index) + "\n")
    with pytest.raises(ab.MeshError, match=r"big\.obj: .*vert") as caught:
        ab.load_mesh(path)
    assert "\n" not in str(caught.value)


def test_a_built_model_is_opened_not_loaded(tmp_path):
    path = tmp_path / "ball.npz"
    sample("small ball").save(path)
    for load in (ab.Model.load, ab.load_mesh):
        with pytest.raises(ab.MeshError, match=r"ball\.npz: .*Model\.open"):
            load(path)


def test_info_reads_a_built_model(tmp_path, capsys):
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [5, 5, 5]]
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f 1 3 2", "f 1 2 4", "f 2 3 4", "f 3 1 4", "f 1 5 6"]
    (tmp_path / "m.obj").write_text("\n".join(lines))
    model = ab.Model.load(tmp_path / "m.obj")
    model.save(tmp_path / "m.npz")
    found = {}
    for name in ("m.obj", "m.npz"):
        assert main(["info", str(tmp_path / name), "--json", "--device", "cpu"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    own = {"lods": model.lod_max + 1, "base_faces": len(model.mesh_at(0)[2])}
    of_file = ("file_vertices", "unreferenced_vertices", "welded_vertices")
    assert found["m.obj"]["dropped_faces"] == 1
    assert found["m.npz"] == {key: value for key, value in found["m.obj"].items() if key not in of_file} | own
    assert main(["info", str(tmp_path / "m.npz"), "--device", "cpu"]) == 0
    assert re.search(r"^lods +\d", capsys.readouterr().out, re.M)


# The command line.


@pytest.mark.parametrize("words", [("nosuch",), ("--device", "cpu", "nosuch"), ("query", "--nosuch"), ("paper", "--x")])
def test_a_benchmark_that_there_is_not(capsys, words):
    pytest.importorskip("bench")
    status, lines = status_of(capsys, "bench", *words)
    assert status == 2 and len(lines) == 1
    if "nosuch" in words:
        assert all(f"'{name}'" in lines[0] for name in ("paper", "tradeoff", "all", "query", "update"))


def test_a_study_behind_its_options(capsys):
    pytest.importorskip("bench")
    status, lines = status_of(capsys, "bench", "--device", "cpu", "paper")
    assert status == 2 and len(lines) == 1 and "before its options" in lines[0]


@pytest.mark.slow
def test_the_module_of_the_command_line_runs():
    done = subprocess.run([sys.executable, "-m", "warp_abtree", "info"], capture_output=True, text=True)
    assert done.returncode == 2 and "the following arguments are required: MESH" in done.stderr
