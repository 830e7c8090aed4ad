"""`warp-abtree run` and `picture`: what they print, record and draw; bad input to any command gives one line."""

import csv
import io
import json
import os
import re
from itertools import pairwise
from pathlib import Path

import matplotlib.image
import numpy as np
import PIL.Image
import pytest
import trimesh
from helpers.viewer import BODIES, SCENE, write_scene
from helpers.viewer import run_command as run
from oracles.motion import posed
from oracles.triangle import brute_force_faces

import warp_abtree as ab
from warp_abtree.app import load_scene
from warp_abtree.app.cli import run_command
from warp_abtree.app.pictures import command, scenes
from warp_abtree.app.playback import open_playback
from warp_abtree.app.styles import COLOURS, STAGE_LABELS


@pytest.fixture
def scene(tmp_path, monkeypatch, capsys):
    """Work in a folder with a scene; give a function that runs it on the CPU."""
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    return lambda words, file="scene.toml": run(capsys, "run", file, "--device", "cpu", *words.split())


def test_run_for_programs(scene):
    found = json.loads(scene("--frames 3 --record rows.json --json")[0])
    rows = json.loads(Path("rows.json").read_text())
    scene("--frames 3 --record rows.csv")
    table = list(csv.DictReader(io.StringIO(Path("rows.csv").read_text())))
    assert [row["hits"] for row in rows] == [int(row["hits"]) for row in table] and len(rows) == 3
    assert [found[name] for name in ("frames", "objects", "models", "worlds")] == [3, 4, 2, 3]
    assert found["hits"]["max"] == max(row["hits"] for row in rows) > 0
    assert found["stages"]["total_ms"]["total"] == pytest.approx(sum(row["total_ms"] for row in rows))
    assert found["lod_min"] == min(row["lod_min"] for row in rows)


def test_run_under_a_budget_which_may_be_impossible(scene):
    shown, errors = scene("--frames 8 --budget 50ms")
    for line in ("controller +predictive", "budget ms +50", "select_ms +[\\d.]+", "budget +frames 4, .*", "objects +4"):
        assert re.search(f"^{line}", shown, re.M), line
    assert not errors
    found = json.loads(scene("--budget 0.05s --controller paper --json")[0])
    assert (found["budget_ms"], found["controller"]) == (50, "paper") and found["budget"] is None
    assert found["stages"]["select_ms"]["total"] > 0 and set(found["stages"]) == {*STAGE_LABELS, "total_ms"}
    parts = sum(found["stages"][name]["total"] for name in STAGE_LABELS)
    assert found["stages"]["total_ms"]["total"] == pytest.approx(parts)
    # One that no level of detail can hold; not one that is easy.
    shown, errors = scene("--frames 8 --budget 0.001ms")
    (said,) = errors
    assert re.fullmatch(r"warp-abtree: a budget of 0.001 ms is impossible here: .* frames take [\d.]+ ms", said)
    assert re.search(r"^coarsest ms +[\d.]+$", shown, re.M)
    found = json.loads(scene("--frames 8 --budget 0.001ms --json")[0])
    assert found["coarsest_ms"] > found["budget_ms"] == 0.001
    assert not scene("--frames 8 --budget 10s")[1]


@pytest.mark.slow
def test_plot(scene):
    shown, _ = scene("--frames 6 --budget 20ms --plot plots")
    assert re.search(f"^written +{Path('plots', 'frames.png')}$", shown, re.M)
    image = matplotlib.image.imread(Path("plots", "frames.png"))[:, :, :3]
    assert image.shape[0] > 800 and np.mean((image > 0.98).all(axis=2)) > 0.3, "background"
    third = len(image) // 3
    for part, colour in enumerate(((0.12, 0.47, 0.71), (1.0, 0.0, 0.0), (0.84, 0.15, 0.16))):
        panel = image[part * third : (part + 1) * third, :780]
        assert (np.abs(panel - colour).max(axis=2) < 0.12).sum() > 100, ("LODs", "budget", "error")[part]
    assert [path.name for path in Path("plots").iterdir()] == ["frames.png"]
    scene("--frames 2 --plot plots")


def test_picture_of_a_controlled_run_shows_its_lods(scene, monkeypatch):
    pytest.importorskip("pyvista")
    titles = []
    monkeypatch.setattr(scenes, "draw", lambda panels, *_, **__: titles.append([panel.title for panel in panels]))
    for words in ("--budget 1s", ""):
        scene(f"--frames 1 --picture out.png {words}")
    # The controller begins at the coarsest LOD; a sweep is drawn at both of its ends.
    top = load_scene("scene.toml", device="cpu").models["ball"].lod_max
    lods = [[re.match(r"ball at LOD (\d+) of (\d+)", title).groups() for title in panels] for panels in titles]
    assert lods[0] == [("0", str(top))]
    assert [of for _, of in lods[1]] == [str(top)] * 2 and int(lods[1][0][0]) == top > int(lods[1][1][0]) > 0


@pytest.mark.slow
def test_picture_of_rigid_bodies(scene):
    pytest.importorskip("pyvista")
    text = SCENE.split("[[lod_sweep]]")[0].replace("shuttle = { by = [0.4, 0, 0], period = 2 }", "velocity = [9, 0, 0]")
    Path("bodies.toml").write_text(text + "[dynamics]\ngravity = [0, 0, 0]\n")
    for frames in (1, 4):
        scene(f"--frames {frames} --picture {frames}.png", "bodies.toml")
    first, last = (matplotlib.image.imread(name) for name in ("1.png", "4.png"))
    assert first.shape != last.shape or not np.array_equal(first, last)


# picture.


def count(path, colour, reach=0.12):
    """Count pixels whose colour is in the direction of another: light only makes it darker."""
    image = matplotlib.image.imread(path)[:, :, :3].reshape(-1, 3).astype(float)
    length = np.linalg.norm(image, axis=1)
    near = np.linalg.norm(image / np.maximum(length, 1e-6)[:, None] - np.array(colour) / np.linalg.norm(colour), axis=1)
    return int(np.count_nonzero((near < reach) & (length > 0.15)))


@pytest.fixture
def drawn(monkeypatch):
    """Panels that would be drawn, without what draws them."""
    panels = []
    monkeypatch.setattr(scenes, "draw", lambda found, *_, **__: panels.extend(found))
    for module in (command, run_command):
        monkeypatch.setattr(module, "import_pyvista", lambda what: None)
    return panels


def check_panel(panel, scene, objects):
    """Compare the colours of a panel, and its count, with the faces of objects and those that meet, which are twice."""
    meshes = {i: scene.models[scene.object_model[i]].mesh_at(scene.lods[i])[:2] for i in objects}
    middles = {i: posed(at, scene.poses[i])[faces].mean(axis=1) for i, (at, faces) in meshes.items()}
    colours, total, pairs = {i: COLOURS[scene.object_model[i]] for i in objects}, 0, 0
    expected = {(i, colours[i][0], 1): middles[i] for i in objects}
    if len(objects) == 2:
        i, j = objects
        hits = brute_force_faces(*meshes[i], *meshes[j], scene.poses[i], scene.poses[j]).T
        pairs = hits.shape[1]
        assert pairs > 100
        # A little above each face and below it.
        expected |= {(k, colours[k][1], 2): middles[k][np.unique(rows)] for k, rows in zip(objects, hits)}
    for (_, colour, times), points in expected.items():
        own = panel.triangles[np.abs(panel.colours - colour).max(axis=1) < 0.5 / 255].mean(axis=1)
        apart, off = np.linalg.norm(own[:, None] - points[None], axis=2), 1e-9 if times == 1 else 0.01
        assert len(own) == times * len(points) and max(apart.min(axis=0).max(), apart.min(axis=1).max()) < off
        total += len(own)
    assert total == len(panel.triangles) and panel.title.endswith(f"\n{pairs:,} intersecting face pairs")


def test_colours_that_run_draws(scene, drawn):
    """Of the world and time of the picture, at both ends of the sweep."""
    write_scene(".", SCENE + "[picture]\ntime = 0.75\n")
    scene("--frames 2 --picture out.png")
    loaded = load_scene("scene.toml", device="cpu")
    finest, coarsest = scenes.panel_lods(loaded)
    assert len(drawn) == 2 and len(drawn[0].triangles) > len(drawn[1].triangles) and (finest >= coarsest).all()
    loaded.scene.set_lods(coarsest)
    loaded.scene.set_poses(loaded.motion.poses(0.75))
    check_panel(drawn[1], loaded.scene, [0, 1])


@pytest.mark.parametrize(
    ("world", "objects", "title"), [(0, [0, 1], "2 objects, 2,368 faces\n"), (2, [3], "1 object, 2,048 faces\n")]
)
@pytest.mark.usefixtures("scene")
def test_picture_of_a_world_of_a_scene_file(capsys, drawn, world, objects, title):
    shown = run(capsys, "picture", "scene.toml", "--world", world, "--json", "--out", "x.png", "--device", "cpu")[0]
    assert json.loads(shown) == {"picture": "x.png", "objects": len(objects), "frame": 0}
    check_panel(*drawn, load_scene("scene.toml", device="cpu").scene, objects)
    assert drawn[0].title.startswith(title)


@pytest.fixture
def picture(scene, capsys):
    """Work in a folder with a scene and a mesh; give a function that draws them."""
    pytest.importorskip("pyvista")
    trimesh.creation.icosphere(2).export("ball.obj")
    return lambda words: run(capsys, "picture", *words.split(), *"--size 250 --device cpu".split())[0]


def test_picture_of_meshes(picture):
    picture("ball.obj ball.obj --out balls.png")
    assert count("balls.png", COLOURS[0][1]) > 200
    shown = picture("ball.obj ball.obj --pose 9 0 0 0 0 0 1 --lod 0.2 --json -o apart.png")
    assert json.loads(shown) == {"picture": "apart.png", "objects": 2, "frame": 0}
    assert not count("apart.png", COLOURS[0][1])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_an_animation_shows_each_frame(picture, kind):
    shown = picture(f"scene.toml --frame 1 --frames 3 --json --out moves.{kind}")
    assert json.loads(shown) == {"picture": f"moves.{kind}", "objects": 2, "frames": 3}
    with PIL.Image.open(f"moves.{kind}") as image:
        assert image.format == kind.upper() and image.n_frames == 3
        frames = []
        for number in range(3):
            image.seek(number)
            frames.append(np.array(image.convert("RGB"), np.int16))
    assert all(np.abs(one - other).max() > 50 for one, other in pairwise(frames))


def test_frames_go_as_far_as_they_are_asked(tmp_path, device):
    playback = open_playback([write_scene(tmp_path, BODIES)], device)
    snapshot = command.go_to(playback, 5, "contacts")
    assert snapshot.number == 5 and snapshot.result.contacts is not None
    other = open_playback([tmp_path / "scene.toml"], device)
    for _ in range(6):
        expected = other.step("count")
    assert np.array_equal(snapshot.poses, expected.poses) and snapshot.poses[1, 1] < 0.5


# A command line, and a part of what is said of it.
CASES = [
    ("", "COMMAND"),
    ("fly", "fly"),
    ("bench", "name a benchmark"),
    ("info", "MESH"),
    ("info gone.obj", "gone.obj: no such file"),
    ("info junk.obj", "junk.obj"),
    ("info ball.obj --speed", "--speed"),
    ("info ball.obj --device cuda:99", "no device 'cuda:99'"),
    ("build gone.obj ball.npz", "gone.obj: no such file"),
    ("build ball.obj gone/ball.npz", "no folder gone"),
    ("build ball.obj ball.txt", "must end in .npz"),
    ("build ball.obj ball.npz --base-faces 0", "--base-faces"),
    ("query ball.obj", "ball.obj: B is missing; alone stands a scene file"),
    ("query .", ".: is a folder"),
    ("query torn.glb", "torn.glb: cannot be read"),
    ("query scene.toml --pose 0 0 0 0 0 0 1", "--pose: for two meshes; scene.toml says"),
    ("query scene.toml --lod-b 0.1", "--lod-b: for two meshes; scene.toml says"),
    ("query scene.toml --output distance --signed", "signed: no object"),
    ("query ball.obj gone.npz", "gone.npz: no such file"),
    ("query ball.obj junk.npz", "junk.npz"),
    ("query ball.obj ball.obj --pose 1 2", "--pose"),
    ("query ball.obj ball.obj --pose -inf 0 0 0 0 0 1", "not finite"),
    ("query ball.obj ball.obj --lod-a 1.5", "--lod-a"),
    ("query ball.obj ball.obj --lod-b -3", "--lod-b"),
    ("query ball.obj ball.obj --lod-b fine", "--lod-b"),
    ("query ball.obj ball.obj --output depth", "--output"),
    ("query ball.obj ball.obj --precision half", "--precision"),
    ("query ball.obj ball.obj --record out.json", "must end in .csv or .npz"),
    ("query ball.obj ball.obj --record folder.npz", "is a folder"),
    ("query ball.obj ball.obj --record out.csv", "ask --output faces or contacts"),
    ("query ball.obj face.npz --record face.npz", "face.npz: is read"),
    ("clash gone.glb", "gone.glb: no such file"),
    ("clash ball.glb", "ball.glb: holds one object alone"),
    ("clash two.glb --within -1", "--within: -1.0 is no distance of 0 or more"),
    ("clash two.glb --tolerance nan", "--tolerance: nan is no distance of 0 or more"),
    ("clash two.glb --csv out.txt", "out.txt: the name must end in .csv"),
    ("clash two.glb --glb two.glb", "two.glb: is read, so it is not overwritten"),
    ("clash two.glb --csv no/out.csv", "no/out.csv: there is no folder no"),
    ("run gone.toml", "gone.toml"),
    ("run bad.toml", "bad.toml: scene.speed: unknown key"),
    ("run scene.toml --frames 0", "--frames"),
    ("run scene.toml --picture out.jpg", "must end in .png"),
    ("run scene.toml --record rows.xls", ".csv or .json"),
    ("run scene.toml --plot gone/plots", "no folder gone"),
    ("run scene.toml --plot ball.obj", "--plot: ball.obj is no folder"),
    ("run scene.toml --plot ball.obj/plots", "ball.obj is no folder"),
    ("run scene.toml --plot nowhere", "--plot: nowhere is no folder"),
    ("run scene.toml --plot plot.png", "--plot: plot.png names a picture; give a folder"),
    ("run scene.toml --record pipe.csv", "pipe.csv: is neither a file nor a folder"),
    ("query ball.obj ball.obj --output faces --record pipe.csv", "pipe.csv: is neither a file nor a folder"),
    ("build ball.obj ball.obj/ball.npz", "ball.obj is no folder"),
    ("run ball.obj", "ball.obj: is no scene file, which is TOML (.toml); info, query, view and picture take meshes"),
    ("run ball.glb", "ball.glb: is no scene file, which is TOML (.toml)"),
    ("run face.npz", "face.npz: is no scene file, which is TOML (.toml)"),
    ("run scene.toml --budget soon", "'soon' is no time above 0"),
    ("run scene.toml --budget 8", "'8' has no unit; give 8ms or 8s"),
    ("view scene.toml --budget 0.008", "'0.008' has no unit"),
    ("run scene.toml --budget 0ms", "no time above 0"),
    ("run scene.toml --budget 1e999s", "no time above 0"),
    ("run scene.toml --controller magic", "--controller"),
    ("run scene.toml --controller none --budget 3ms", "holds no budget"),
    ("picture gone.toml --out out.png", "gone.toml"),
    ("picture ball.obj scene.toml --out out.png", "a scene file is looked at alone"),
    ("picture ball.obj --out x.jpg", "must end in .png"),
    ("picture ball.obj --frame -1 --out out.png", "--frame: -1 is below 0"),
    ("picture ball.obj --frames 100000 --out out.gif", "--frames: 100,000 pictures of 800 x 800 pixels take"),
    ("picture ball.obj --frames 5 --out a.png", "a.png: the name must end in .webp or .gif"),
    ("picture ball.obj --out a.webp", "a.webp: the name must end in .png"),
    ("picture ball.obj --frames 1 --out a.webp", "--frames: 1, every 1, is less than two"),
    ("picture ball.obj --frames 4 --every 4 --out a.gif", "--frames: 4, every 4, is less than two"),
    ("picture ball.obj --frames 100000 --size 50 --out out.gif", "draw fewer by --every"),
    ("picture ball.obj --size 9 --out out.png", "--size 9 is outside 50 .. 8000"),
    ("picture ball.obj --eye 0 1 0 --out out.png", "up: points along eye"),
    ("picture ball.obj --eye nan 1 0 --out out.png", "eye: [nan, 1.0, 0.0] is not 3 finite"),
    ("picture ball.obj --world 3 --out out.png", "world: no object is in world 3"),
    ("picture junk.npz --out out.png", "junk.npz"),
    ("picture scene.toml --lod 0.5 --out out.png", "--lod: for meshes"),
    ("picture scene.toml --pose 0 0 0 0 0 0 1 --out out.png", "--pose: for meshes"),
    ("picture ball.obj --objects 3 --out out.png", "--objects: for scene files"),
    ("picture ball.obj --lod 9999 --out out.png", "--lod: model"),
    ("picture ball.obj --pose 0 0 0 0 0 0 1 --out out.png", "--pose: 1 given for the 0 meshes"),
    ("picture ball.obj face.npz --pose 0 0 0 0 0 0 2 --out out.png", "--pose: pose 0 has a quaternion"),
    ("sweep ball.obj ball.obj --out x", "POSES.npy is missing"),
    ("sweep scene.toml --out x", "POSES.npy is missing"),
    ("sweep ball.obj poses.npy --out x", "is no scene; a sweep takes two models, or one twice"),
    ("sweep ball.obj ball.obj ball.obj poses.npy --out x", "two models and POSES.npy"),
    ("sweep scene.toml poses.npy --out x", "takes a scene of two"),
    ("sweep face.npz face.npz poses.npy --out x --lods lods.npy --lod-a 3", "--lods: LODs come from"),
    ("sweep face.npz face.npz poses.npy --out x --lod-b tall", "--lod-b: LOD 'tall'"),
    ("sweep face.npz face.npz poses.npy --out x --workers 2 --ray none", "--workers: they are Ray's"),
    ("view", "SCENE_OR_MESHES"),
    ("view gone.obj", "gone.obj"),
    ("view ball.obj --host no.such.host.invalid", "no.such.host.invalid:0: cannot be served at"),
]
FILES = {
    "junk.obj": "hello\n",
    "junk.npz": "junk",
    "torn.glb": "glTF",
    "bad.toml": "[scene]\nspeed = 3\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Give a folder with a mesh, a model and a scene, and files that are none."""
    path = tmp_path_factory.mktemp("files")
    for name in ("ball.obj", "ball.glb"):
        trimesh.creation.icosphere(subdivisions=2).export(path / name)
    trimesh.Scene([trimesh.creation.box(), trimesh.creation.box()]).export(path / "two.glb")
    os.mkfifo(path / "pipe.csv")
    os.symlink("gone", path / "nowhere")
    ab.Model.from_arrays(np.eye(3), [[0, 1, 2]]).save(path / "face.npz")
    write_scene(path)
    for name, text in FILES.items():
        (path / name).write_text(text)
    (path / "folder.npz").mkdir()
    np.save(path / "poses.npy", np.eye(7)[6:])
    return path


@pytest.mark.parametrize(("line", "message"), CASES, ids=[line for line, _ in CASES])
def test_bad_input_gives_one_line(folder, monkeypatch, capsys, line, message):
    words = line.split()
    needs = {"picture": "pyvista", "view": "viser"}.get(words[0] if words else "")
    if needs is not None:
        pytest.importorskip(needs)
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    shown, errors = run(capsys, *words, status=2)
    assert len(errors) == 1 and message in errors[0] and errors[0].startswith("warp-abtree: ")
    assert not shown and sorted(folder.iterdir()) == before
