"""The command line: what it prints and writes. `run`, `sweep` and bad input have tests of their own."""

import csv
import importlib.util
import io
import json
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.scenes import scene_with
from helpers.viewer import run_command as run

import warp_abtree as ab
import warp_abtree.app as ab_app
from warp_abtree.app.cli import main as cli
from warp_abtree.app.cli import model_commands, report
from warp_abtree.app.playback import MeshPlayback, open_playback
from warp_abtree.model.mesh import describe_mesh, load_mesh

COMMANDS = "info build query clash run sweep view picture bench".split()
VECTORS = ("p0", "p1", "normal_a", "normal_b", "normal")
ASIDE, FAR = (0.8, 0.1, -1e-3, 0.0, 0.6, 0.0, 0.8), (9, 0, 0, 0, 0, 0, 1)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trimesh.creation.icosphere(subdivisions=2).export("ball.obj")
    trimesh.creation.torus(major_radius=1.0, minor_radius=0.3).export("ring.ply")
    trimesh.creation.box().export("box.obj")
    return tmp_path


def test_info(files, capsys):
    shown, errors = run(capsys, "info", "ball.obj")
    assert re.search(r"^faces +320$", shown, re.M) and re.search(r"^open edges +0$", shown, re.M) and not errors
    found = json.loads(run(capsys, "info", "ball.obj", "--json", "--device", "cpu")[0])
    assert found["faces"] == 320 and found["components"] == 1 and found["closed"] is True
    assert found == describe_mesh(load_mesh("ball.obj"))
    trimesh.creation.box().apply_translation((4512345.25, 612345.5, 100.0)).export("far.obj", digits=9)
    shown, _ = run(capsys, "info", "far.obj")
    assert re.search(r"^bounds +4512344.75 612345 99.5 4512345.75 612346 100.5$", shown, re.M)


def test_build(files, capsys):
    shown, _ = run(capsys, "build", "ball.obj", "ball.npz", "--base-faces", 40)
    assert re.search(r"^faces +320$", shown, re.M) and re.search(r"^share +lod +faces +error_inward", shown, re.M)
    assert len(ab.Model.open("ball.npz").mesh_at(0)[1]) <= 40
    found = json.loads(run(capsys, "build", "ball.obj", "ball.npz", "--json")[0])
    assert found["faces"] == 320 and found["base_faces"] <= 10 and len(found["errors"]) == 5
    model = ab.Model.open("ball.npz")
    lods = [model.lod_for(fraction=x) for x in (0.5, 0.2, 0.1, 0.05, 0.01)]
    for side in ("inward", "outward"):
        assert [row[f"error_{side}"] for row in found["errors"]] == [model.error_at(lod, side=side) for lod in lods]
    assert found["diagonal"] == pytest.approx(2 * 3**0.5, rel=0.02)
    assert sorted(path.name for path in files.glob("ball*")) == ["ball.npz", "ball.obj"]


def test_build_of_many_files(files, capsys):
    """A bad mesh costs a line and the status; the others are built."""
    (files / "models").mkdir()
    meshes = ["ball.obj", "junk.obj", "ring.ply", "missing.obj"]
    assert cli.main(["build", *meshes, "models", "--json", "--base-faces", "40"]) == 2
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert [row["file"] for row in found["models"]] == ["models/ball.npz", "models/ring.npz"] and found["failed"] == 2
    assert [line.split(":")[1].strip() for line in shown.err.splitlines()] == ["junk.obj", "missing.obj"]
    assert sorted(path.name for path in (files / "models").iterdir()) == ["ball.npz", "ring.npz"]
    for mesh in ("ball.obj", "ring.ply"):
        built = ab.Model.load(mesh, base_faces=40)
        assert ab.Model.open(f"models/{Path(mesh).stem}.npz").digest == built.digest
    assert cli.main(["build", "ball.obj", "models"]) == 0
    assert re.search(r"^models/ball.npz +[\d,]+ +320 ", capsys.readouterr().out, re.M)


# query.


def answer(capsys, *arguments, device="cpu"):
    return json.loads(run(capsys, "query", *arguments, "--device", device, "--json")[0])


def test_query_against_the_library(files, capsys):
    asked = ("ball.obj", "ring.ply", "--pose", *ASIDE, "--lod-a", 0.25, "--lod-b", "900", "--output", "faces")
    found = answer(capsys, *asked)
    ball, ring = ab.Model.load("ball.obj"), ab.Model.load("ring.ply")
    scene = scene_with("cpu", (ball, {"lod": ball.lod_for(fraction=0.25)}), (ring, ASIDE, {"lod": 900}))
    expected = scene.intersect(np.array([[0, 1]]), output="faces")
    assert found["faces"] == expected.faces[:, 1:].tolist()
    assert found["count"] == expected.count[0] and found["intersects"] is True
    assert found["lods"] == scene.lods.tolist()
    bound = ball.error_at(found["lods"][0]) + ring.error_at(900)
    assert found["bound"] == (pytest.approx(bound) if np.isfinite(bound) else None)
    extents = [np.ptp(model.mesh_at(model.lod_max)[0], axis=0) for model in scene.models]
    assert found["diagonals"] == pytest.approx([(extent @ extent) ** 0.5 for extent in extents])
    apart = answer(capsys, "ball.obj", "ring.ply", "--pose", *FAR, "--output", "distance")
    lower, upper = apart["bracket"]
    assert 0 < lower <= apart["distance"] <= upper and not apart["intersects"]
    between = np.linalg.norm(np.subtract(*apart["points"]))
    assert between == pytest.approx(apart["distance"], rel=1e-12) and len(apart["point_faces"]) == 2
    shown, _ = run(capsys, "query", "ball.obj", "ring.ply", "--pose", *FAR, "--output", "distance")
    assert f"distance                {apart['distance']:.6g}\n" in shown and "\npoints:\n" in shown
    asked = ["ball.obj", "ball.obj", "--pose", 1.5, 0, 0, 0, 0, 0, 1, "--solid", "--output", "distance", "--signed"]
    deep = answer(capsys, *asked)
    assert deep["intersects"] and -0.51 < deep["distance"] < -0.45
    asked = ["ball.obj", "ring.ply", "--pose", *FAR, "--lod-a", 0.2, "--output", "distance"]
    of_originals = answer(capsys, *asked, "--originals", "--relative", 0.3)
    assert of_originals["bracket"][0] <= apart["distance"] <= of_originals["bracket"][1]
    assert answer(capsys, *asked, "--originals")["distance"] == apart["distance"]
    assert answer(capsys, *asked, "--beyond", 2, "--tolerance", 0.1)["bracket"] == [2, None]
    words = [*asked[:10], "--output", "distance", "--beyond", 2.5, "--device", "cpu"]
    shown, _ = run(capsys, "query", *words)
    assert shown.endswith("distance                farther than 2.5\n") and "points" not in shown
    apart = answer(capsys, "ball.obj", "ring.ply", "--pose", *FAR, "--output", "contacts")
    nowhere = [None, None, None]
    assert apart["pair_contacts"] == {"count": 0, "point": nowhere, "normal": nowhere}
    assert apart["count"] == 0 and apart["faces"] == apart["contacts"] == []
    shown, _ = run(capsys, "query", *asked[:10], "--output", "contacts", "--device", "cpu")
    assert "pair contacts           count 0, point none, normal none\n" in shown and "nan" not in shown
    shown, _ = run(capsys, "query", "ball.obj", "ring.ply", "--output", "contacts", "--device", "cpu")
    assert "intersects              yes\n" in shown and len(re.findall(r"^\d+ +\d+$", shown, re.M)) == report.LISTED
    assert re.search(r"^and \d+ more; --json lists all$", shown, re.M) and "face_a  face_b  p0" in shown
    swapped = answer(capsys, "ring.ply", "ball.obj", "--output", "any")
    assert swapped["intersects"] is True and swapped["count"] is None and "faces" not in swapped


# The shifted twin has coplanar faces beside it; their rounded signs differ from the exact ones.
@pytest.mark.parametrize(
    ("precision", "b", "pose"), [("exact", "ring.ply", ASIDE), ("float32", "box.obj", (0.3, 0.1, 0, 0, 0, 0, 1))]
)
@pytest.mark.slow
def test_contacts_against_the_library(files, capsys, device, precision, b, pose):
    a = "ball.obj" if b == "ring.ply" else b
    scene = scene_with(device, ab.Model.load(a), (ab.Model.load(b), pose))
    expected = scene.intersect(np.array([[0, 1]]), output="contacts", precision=precision)
    words = (a, b, "--pose", *pose, "--output", "contacts", "--precision", precision)
    found = answer(capsys, *words, "--record", "rows.csv", device=device)
    assert found["count"] == expected.count[0] > 0 and found["precision"] == precision
    assert found["faces"] == expected.faces[:, 1:].tolist() == expected.contacts["faces"].tolist()
    assert found["faces"] == [[x["face_a"], x["face_b"]] for x in found["contacts"]]
    rows = list(csv.DictReader(io.StringIO(Path("rows.csv").read_text())))
    assert len(rows) == len(found["contacts"]) == len(expected.contacts)
    for row, entry, contact in zip(rows, found["contacts"], expected.contacts):
        assert [int(row["face_a"]), int(row["face_b"])] == contact["faces"].tolist()
        for name in VECTORS:
            assert entry[name] == [float(row[f"{name}_{axis}"]) for axis in "xyz"] == contact[name].tolist()
        assert entry["coplanar"] is bool(int(row["coplanar"])) is bool(contact["coplanar"])
        assert len(row) == 2 + 3 * len(VECTORS) + 1 and set(entry) == {"face_a", "face_b", *VECTORS, "coplanar"}
    summed = expected.pair_contacts[0]
    assert found["pair_contacts"] == {name: summed[name].tolist() for name in summed.dtype.names}
    assert expected.contacts["coplanar"].any() == (b == "box.obj")
    run(capsys, "query", *words, "--device", device, "--record", "arrays.npz")
    with np.load("arrays.npz") as arrays:
        assert set(arrays) == {"pairs", "any", "count", "faces", "contacts", "pair_contacts"}
        for name in arrays:
            assert arrays[name].dtype == getattr(expected, name).dtype
            assert arrays[name].tobytes() == getattr(expected, name).tobytes()
    assert not list(files.glob("*.partial"))


def test_record_of_each_output(files, capsys):
    for output, names in (("any", {"any"}), ("count", {"any", "count"}), ("faces", {"any", "count", "faces"})):
        found = answer(capsys, "ball.obj", "ring.ply", "--output", output, "--record", "out.npz")
        assert "contacts" not in found and "pair_contacts" not in found
        with np.load("out.npz") as arrays:
            assert set(arrays) == {"pairs", *names} and arrays["any"][0]
    words = "query ball.obj ring.ply --output faces --record out.csv --device cpu"
    assert run(capsys, *words.split())[0].endswith("written                 out.csv\n")
    rows = list(csv.reader(io.StringIO(Path("out.csv").read_text())))
    assert rows[0] == ["face_a", "face_b"] and [[int(x) for x in row] for row in rows[1:]] == found["faces"]


TWO_BALLS = """[models.ball]
shape = "icosphere"
[[objects]]
model = "ball"
name = "left"
[[objects]]
model = "ball"
name = "right"
position = [1.5, 0.1, 0]
[[objects]]
model = "ball"
position = [9, 0, 0]
"""


def test_query_of_a_scene_file(files, capsys, device, monkeypatch):
    Path("balls.toml").write_text(TWO_BALLS)
    scene = ab_app.load_scene("balls.toml", device=device).scene
    ab.to_trimesh(scene).export("balls.glb")
    found = answer(capsys, "balls.toml", "--record", "out.npz", device=device)
    (row,) = found["pairs"]
    expected = scene.intersect([(0, 1)], output="count")
    assert row == {"first": "left", "second": "right", "any": True, "count": expected.count[0]}
    assert (found["objects"], found["near"], found["intersecting"]) == (3, 1, 1)
    with np.load("out.npz") as arrays:
        assert arrays["pairs"].tolist() == [[0, 1]] and arrays["count"] == expected.count
    asked = ("--output", "distance", "--beyond", 10, "--solid", "--signed", "--record", "out.csv")
    found = answer(capsys, "balls.glb", *asked, device=device)
    assert [row["first"] for row in found["pairs"][:2]] == ["left", "left"] and found["near"] == 3
    assert found["pairs"][0]["distance"] < -0.3 and 6 < found["pairs"][1]["distance"] < 10
    rows = list(csv.DictReader(Path("out.csv").open()))
    assert [float(row["distance"]) for row in rows] == [row["distance"] for row in found["pairs"]]
    shown, _ = run(capsys, "query", "balls.toml", "--device", device)
    assert re.search(r"^first +second +any +count\nleft +right +yes +\d+ *$", shown, re.M)
    monkeypatch.setitem(sys.modules, "rich.table", None)
    shown, _ = run(capsys, "query", "balls.toml", "--device", device)
    assert re.search(r"^first\tsecond\tany\tcount\nleft\tright\tyes\t\d+$", shown, re.M)


def test_shells_complete_scenes(tmp_path, capsys):
    pytest.importorskip("shtab")
    with pytest.raises(SystemExit):
        cli.main(["--print-completion", "bash"])
    script, shown = tmp_path / "script", capsys.readouterr().out
    assert all(part in shown for part in ("--lod-a", "sweep", "compgen"))
    script.write_text(shown + "\n_warp_abtree_scenes r\n")
    (tmp_path / "rod.glb").touch()
    found = subprocess.run(["bash", "script"], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["rain", "rod.glb"]


# Numbers as they are given, and as they are shown.
SHOWN = """0:0 -0.0:0 0.3333333333333333:0.333333 1e-16:1e-16 1234.5678:1234.57 123456.789:123456.79
4512345.678:4512345.68 -4512345.678:-4512345.68 999999.996:999999.996 1e6:1000000 1e15:1e+15 inf:inf nan:none""".split()


@pytest.mark.parametrize("case", SHOWN)
def test_numbers_for_people(case):
    value, shown = case.split(":")
    assert report.show_number(float(value)) == shown and report.show_number(np.float32(0.1)) == "0.1"


@pytest.fixture
def assemblies(files):
    """Return files by name with the number of parts of each; those of several clash."""
    ball, box = trimesh.creation.icosphere(3), trimesh.creation.box()
    scene = trimesh.Scene()
    scene.add_geometry(ball, "left", "ball")
    scene.add_geometry(ball, "right", "ball", transform=trimesh.transformations.translation_matrix((0.5, 0, 0)))
    scene.add_geometry(box, "box", "box")
    scene.export("three.glb")
    cube = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "f 1 3 7 5\nf 2 6 8 4\n"
    Path("two.obj").write_text("o a\n" + cube + "o b\n" + cube.replace("f 1 3 7 5", "f 9 11 15 13"))
    Path("one.obj").write_text("o a\ng p\n" + cube + "g q\nusemtl r\nf 1 2 3\n")
    Path("two.stl").write_text(2 * trimesh.exchange.stl.export_stl_ascii(box))
    ball.export("one.glb")
    return {"three.glb": 3, "two.obj": 2, "one.obj": 1, "two.stl": 2, "one.glb": 1, "ring.ply": 1}


def test_a_file_of_parts_is_said_to_be_joined(assemblies, capsys, monkeypatch):
    """By each command that reads meshes; again when the model comes from the cache."""
    monkeypatch.setenv("WARP_ABTREE_CACHE", "models")
    for name, parts in assemblies.items():
        joined = f"{name}: its {parts} parts are joined into one mesh"
        for words in ("info {}", "build {} built.npz", "query {} one.obj --device cpu") * (1 + (parts == 3)):
            assert cli.main([*words.format(name).split(), "--json"]) == 0
            shown = capsys.readouterr()
            assert (joined in shown.err) == (parts > 1) == ("scene_from_file" in shown.err), words
            assert words != "info {}" or json.loads(shown.out)["parts"] == parts
        title = Path(name).stem + (f" ({parts} parts joined)" if parts > 1 else "")
        assert open_playback([name, "box.obj"], "cpu").title == f"{title} and box"
        assert (joined in capsys.readouterr().err) == (parts > 1)
        assert ab.Model.load(name).parts == parts and ab.Model.load(name, orient=True).parts == parts
        if name.endswith(("glb", "obj", "stl")):
            assert ab.scene_from_file(name, "cpu").object_count == parts


def test_a_file_of_parts_is_a_scene(assemblies, capsys, device):
    for name, parts in assemblies.items():
        Path("scene.toml").write_text(f'[models.m]\nmesh = "{name}"\n[[objects]]\nmodel = "m"\n')
        with warnings.catch_warnings(record=True, action="always") as caught:
            ab_app.load_scene("scene.toml", device=device)
        told = [str(each.message) for each in caught if "joined" in str(each.message)]
        start = f"scene.toml: models.m: the {parts} parts of {name} are joined into one mesh; scene_from_file"
        assert len(told) == (parts > 1) and all(each.startswith(start) for each in told)
        playback = open_playback([name], device)
        assert playback.title == Path(name).stem and playback.scene.object_count == parts
        if parts == 1:
            assert isinstance(playback, MeshPlayback)
            continue
        assert not capsys.readouterr().err
        truth = ab.scene_from_file(name, device)
        assert [playback.scene.name(i) for i in range(parts)] == [truth.name(i) for i in range(parts)]
        np.testing.assert_array_equal(playback.step("faces").result.faces, truth.intersect(output="faces").faces)
        found = json.loads(run(capsys, "run", name, "--frames", 2, "--json", "--device", device)[0])
        assert found["objects"] == parts and found["models"] == len(truth.models) == len(found["meshes"])
    if importlib.util.find_spec("pyvista"):
        assert "--lod: for meshes" in run(capsys, "picture", "three.glb", "--lod", 1, "--out", "a.png", status=2)[1][0]
    told = run(capsys, "run", "three.glb", "--objects", 9, status=2)[1][0]
    assert "three.glb: objects: are those of the file" in told


def test_lost_work_is_status_1(files, capsys, monkeypatch):
    def lose(*_):
        raise ab.CapacityError("7 pairs were lost")

    monkeypatch.setattr(model_commands, "describe_mesh", lose)
    assert run(capsys, "info", "ball.obj", status=1)[1] == ["warp-abtree: 7 pairs were lost"]


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        *((f"{name} --help", (f"examples:\n  warp-abtree {name}", "--device")) for name in COMMANDS),
        ("bench --help", ("[--json] NAME\n", "benchmark or study")),
        ("--help", ("exit status:\n  0 ", "examples:")),
        ("--version", (f"warp-abtree {ab.__version__}\n",)),
    ],
)
def test_help_has_examples(capsys, words, parts):
    with pytest.raises(SystemExit) as caught:
        cli.main(words.split())
    shown = capsys.readouterr().out
    assert not caught.value.code and all(part in shown for part in parts)


@pytest.mark.parametrize(
    ("module", "words", "message"),
    [
        ("shtab", "--print-completion bash", "--print-completion needs shtab: pip install shtab"),
        ("msgspec", "run rain", "rain.toml: scene files need msgspec: pip install msgspec"),
        ("viser", "view ball.obj", "view needs viser: pip install viser"),
        ("matplotlib", "run rain --plot .", "--plot needs Matplotlib: pip install matplotlib"),
        ("pyvista", "run rain --picture out.png", "--picture needs pyvista and Matplotlib: pip install"),
        ("pyvista", "picture ball.obj --out out.png", "picture needs pyvista and Matplotlib: pip install"),
    ],
)
def test_an_extra_that_is_missing_is_named(files, capsys, monkeypatch, module, words, message):
    monkeypatch.setitem(sys.modules, module, None)
    shown, errors = run(capsys, *words.split(), status=2)
    assert not shown and len(errors) == 1 and message in errors[0]
