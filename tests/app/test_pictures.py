"""Pictures: what is drawn where, in which colours, and one line with status 2 for anything bad."""

import json

import matplotlib.image
import numpy as np
import pytest
import trimesh
from helpers.viewer import BODIES, make_models, make_playback, write_scene
from helpers.viewer import run_command as run

from warp_abtree.app import load_scene
from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.open_playback import open_playback
from warp_abtree.app.pictures import command, scenes
from warp_abtree.app.pictures.render import camera_around
from warp_abtree.app.recording import record_run
from warp_abtree.app.render_data import Settings, compose
from warp_abtree.app.styles import COLOURS

SMALL = ("--size", 200, "--device", "cpu")
EYE, UP = (0.4, 0.35, 1.0), (0, 1, 0)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    trimesh.creation.icosphere(2).export("ball.obj")
    return tmp_path


def count(path, colour, reach=0.12):
    """Count pixels whose colour is in the direction of another: light only makes it darker."""
    image = matplotlib.image.imread(path)[:, :, :3].reshape(-1, 3).astype(float)
    length = np.linalg.norm(image, axis=1)
    near = np.linalg.norm(image / np.maximum(length, 1e-6)[:, None] - np.array(colour) / np.linalg.norm(colour), axis=1)
    return int(np.count_nonzero((near < reach) & (length > 0.15)))


def test_a_panel_holds_what_the_title_counts(device):
    playback = make_playback(make_models(), device)
    cache, snapshot = geometry.MeshCache(playback.scene), playback.query("contacts")
    settings = Settings()
    data = compose(cache, snapshot, np.arange(3), settings)
    panel = scenes.make_panel(cache, data)
    # Plain faces come first, then both sides of each intersecting one.
    faces, hits = 2 * 320 + 576, snapshot.result.faces
    met = {(int(snapshot.result.pairs[row[0], side]), row[1 + side]) for row in hits.tolist() for side in (0, 1)}
    assert len(panel.triangles) == len(panel.colours) == faces + 2 * len(met)
    first = playback.scene.models[0].mesh_at(int(snapshot.lods[0]))
    assert np.allclose(panel.triangles[:320], first[0][first[1]] + snapshot.poses[0, :3])
    bright = np.array([COLOURS[0][1], COLOURS[1][1]])
    marked = (panel.colours[:, None] == bright).all(axis=2).any(axis=1)
    assert marked.sum() == 2 * len(met) and not marked[:faces].any()
    assert panel.title == f"3 objects, 1,216 faces\n{len(hits):,} intersecting face pairs"
    assert [len(lines) for lines, _ in panel.lines] == [len(snapshot.result.contacts)]
    labels = [label for _, label in scenes.make_legend(playback.scene, [data])]
    assert len(labels) == 5 and labels[-1] == "contacts"
    alone = scenes.make_panel(cache, compose(cache, snapshot, np.array([0]), Settings()))
    assert len(alone.triangles) == 320 and alone.title == "1 object, 320 faces\n0 intersecting face pairs"


def test_the_camera_sees_all_points():
    points = np.random.default_rng(3).normal(size=(500, 3)) * [5, 1, 0.2] + [10, 0, 0]
    camera = camera_around(points, EYE, UP)
    assert np.allclose(camera.view[2], np.array(EYE) / np.linalg.norm(EYE)) and camera.view[1, 1] > 0
    local = (points - camera.eye) @ camera.view.T
    assert (local[:, 2] < 0).all()
    assert np.abs(local[:, :2] / local[:, 2:]).max() <= np.tan(0.5 * camera.field_of_view)


def test_picture_of_meshes(files, capsys):
    pytest.importorskip("pyvista")
    run(capsys, "picture", *"ball.obj ball.obj --contacts --out balls.png --size 300 --device cpu".split())
    assert count("balls.png", COLOURS[0][1]) > 300
    words = "ball.obj ball.obj --pose 9 0 0 0 0 0 1 --lod 0.2 --json --size 300 --device cpu -o apart.png"
    shown, _ = run(capsys, "picture", *words.split())
    assert json.loads(shown) == {"picture": "apart.png", "objects": 2, "frame": 0}
    assert not count("apart.png", COLOURS[0][1])


@pytest.mark.slow
def test_picture_of_a_frame(files, capsys):
    pytest.importorskip("pyvista")
    for frame in (0, 3):
        run(capsys, "picture", "scene.toml", "--frame", frame, "--out", f"{frame}.png", *SMALL)
    first, last = (matplotlib.image.imread(name) for name in ("0.png", "3.png"))
    assert first.shape != last.shape or not np.array_equal(first, last)
    loaded = load_scene("scene.toml", device="cpu")
    record_run(loaded, 4)[1].save("run.npz")
    run(capsys, "picture", "run.npz", "--frame", 3, "--out", "again.png", *SMALL)
    assert np.array_equal(last, matplotlib.image.imread("again.png"))
    run(capsys, "picture", "scene.toml", *"--world 2 --eye 0 0 1 --out world.png".split(), *SMALL)
    assert count("world.png", COLOURS[0][0]) < count("0.png", COLOURS[0][0])


def test_frames_go_as_far_as_they_are_asked(tmp_path, device):
    playback = open_playback([str(write_scene(tmp_path, BODIES))], device)
    snapshot = command.go_to(playback, 5, "contacts")
    assert snapshot.number == 5 and snapshot.result.contacts is not None
    other = open_playback([str(tmp_path / "scene.toml")], device)
    for _ in range(6):
        expected = other.step("count")
    assert np.array_equal(snapshot.poses, expected.poses) and snapshot.poses[1, 1] < 0.5
