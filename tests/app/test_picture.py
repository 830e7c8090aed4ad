"""Pictures: what is drawn where, in which colours, and one line with status 2 for anything bad."""

import json
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import trimesh
from helpers.viewer import BODIES, make_models, make_source, write_scene

import warp_abtree as ab
from warp_abtree.app.cli import main as cli
from warp_abtree.app.pictures import picture, plot
from warp_abtree.app.recording import record_run
from warp_abtree.app.viewer.playback import open_source

EYE, UP = (0.4, 0.35, 1.0), (0, 1, 0)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    trimesh.creation.icosphere(2).export("ball.obj")
    Path("bad.toml").write_text("[scene]\nspeed = 3\n")
    return tmp_path


def run(capsys, *arguments, status=0):
    assert cli.main(["picture", *map(str, arguments)]) == status
    captured = capsys.readouterr()
    return captured.out, captured.err.splitlines()


def count(path, colour, reach=0.12):
    """Count pixels whose colour is in the direction of another: light only makes it darker."""
    image = matplotlib.image.imread(path)[:, :, :3].reshape(-1, 3).astype(float)
    length = np.linalg.norm(image, axis=1)
    near = np.linalg.norm(image / np.maximum(length, 1e-6)[:, None] - np.array(colour) / np.linalg.norm(colour), axis=1)
    return int(np.count_nonzero((near < reach) & (length > 0.15)))


def test_struck_faces_are_coloured(device):
    source = make_source(make_models(), device)
    scene, moment = source.scene, source.again("faces")
    panel, legend = picture.make_panel(scene, moment, np.arange(3), EYE, UP)
    assert len(panel.triangles) == 2 * 320 + 576 and len(legend) == 4
    hits = moment.result.faces
    struck = {(int(moment.result.pairs[row[0], side]), row[1 + side]) for row in hits.tolist() for side in (0, 1)}
    bright = np.array([plot.COLOURS[0][1], plot.COLOURS[1][1]])
    marked = (panel.colours[:, None] == bright).all(axis=2).any(axis=1)
    assert marked.sum() == len(struck)
    expected = []
    for i, face in sorted(struck):
        vertices, faces, ids = scene.models[scene.object_model[i]].mesh_at(int(moment.lods[i]))
        expected.append(plot.place(moment.poses[i], vertices[faces[ids == face][0]]))
    found = np.ascontiguousarray(panel.triangles[marked]).reshape(-1, 9)
    expected = np.array(expected).reshape(-1, 9)
    assert {tuple(row) for row in np.round(found, 6).tolist()} == {tuple(row) for row in np.round(expected, 6).tolist()}
    assert f"{len(hits):,} intersecting face pairs" in panel.title and "3 objects, 1,216 faces" in panel.title
    alone, _ = picture.make_panel(scene, moment, np.array([0]), EYE, UP)
    assert len(alone.triangles) == 320 and not (alone.colours[:, None] == bright).all(axis=2).any()
    assert alone.title == "1 object, 320 faces\n0 intersecting face pairs"


def test_lines_are_ribbons_that_face_the_eye(device):
    source = make_source(make_models(), device)
    moment = source.again("contacts")
    panel, legend = picture.make_panel(source.scene, moment, np.arange(3), EYE, UP, contacts=True, level=1)
    faces = 2 * 320 + 576
    contacts = len(moment.result.contacts)
    assert len(panel.triangles) == faces + 2 * contacts + 2 * 12 * 6
    assert [label for _, label in legend[-2:]] == ["contacts", "active nodes at level 1"]
    camera = plot.Camera.around(np.array([[-1.0, -1, -1], [1, 1, 1]]), EYE, UP)
    lines = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]], [[0, 0, 0], 2 * camera.frame[2]]])
    first, second = np.split(picture.ribbons(lines, camera, 0.1), 2)
    eye = camera.centre + camera.distance * camera.frame[2]
    for strip in (first, second):
        normal = np.cross(strip[:, 1] - strip[:, 0], strip[:, 2] - strip[:, 0])
        # Half the strip: of length 1, and dots as long as they are wide.
        assert np.allclose(0.5 * np.linalg.norm(normal, axis=1), [0.05, 0.005, 0.005], rtol=0.02)
        way = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        view = eye - lines.mean(axis=1)
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        assert np.allclose(np.abs(np.einsum("ij,ij->i", way, view)), 1, atol=0.1)
    middle = 0.5 * (first + second).mean(axis=1)
    lift = np.einsum("ij,ij->i", middle - lines.mean(axis=1), view)
    assert np.allclose(lift, picture.LINE_LIFT * camera.radius), "before what they lie on"


def test_draw_objects(tmp_path, device):
    source = make_source(make_models(), device)
    path = tmp_path / "three.png"
    poses = source.again("count").poses
    picture.draw_objects(source.scene, poses, path, "Three", contacts=True, size=300)
    assert count(path, plot.COLOURS[0][1]) > 200 and count(path, plot.COLOURS[1][1]) > 200
    apart = poses + np.arange(3)[:, None] * [10, 0, 0, 0, 0, 0, 0]
    other = tmp_path / "apart.png"
    picture.draw_objects(source.scene, apart, other, size=300)
    # Two swatches of the legend are all that is left of them.
    assert count(other, plot.COLOURS[0][1]) < 0.9 * count(path, plot.COLOURS[0][1])
    for wrong in ([], [3], [-1]):
        with pytest.raises(ValueError, match="objects: from 3"):
            picture.draw_objects(source.scene, poses, other, objects=wrong)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["apart.png", "three.png"]


def test_picture_of_meshes(files, capsys):
    shown, _ = run(capsys, "ball.obj", "ball.obj", "--contacts", "--out", "balls.png", "--size", 300, "--device", "cpu")
    assert shown == "wrote balls.png\n" and count("balls.png", plot.COLOURS[0][1]) > 300
    words = "--pose 9 0 0 0 0 0 1 --lod 0.2 --tree 2 --json --size 300 --device cpu".split()
    shown, _ = run(capsys, "ball.obj", "ball.obj", *words, "-o", "apart.png")
    assert json.loads(shown) == {"picture": "apart.png", "objects": 2, "frame": 0}
    assert count("apart.png", picture.BOX_COLOUR) > count("balls.png", picture.BOX_COLOUR)


@pytest.mark.slow
def test_picture_of_a_frame(files, capsys):
    for frame in (0, 3):
        run(capsys, "scene.toml", "--frame", frame, "--out", f"{frame}.png", "--size", 200, "--device", "cpu")
    first, last = (matplotlib.image.imread(name) for name in ("0.png", "3.png"))
    assert first.shape != last.shape or not np.array_equal(first, last)
    loaded = ab.load_scene("scene.toml", device="cpu")
    record_run(loaded, 4)[1].save("run.npz")
    run(capsys, "run.npz", "--frame", 3, "--out", "again.png", "--size", 200, "--device", "cpu")
    assert np.array_equal(last, matplotlib.image.imread("again.png"))
    run(capsys, "scene.toml", "--world", 2, "--eye", 0, 0, 1, "--out", "world.png", "--size", 200, "--device", "cpu")
    assert count("world.png", plot.COLOURS[0][0]) < count("0.png", plot.COLOURS[0][0])


def test_frames_go_as_far_as_they_are_asked(tmp_path, device):
    source = open_source([str(write_scene(tmp_path, BODIES))], device)
    moment = picture.go_to(source, 5, "contacts")
    assert moment.number == 5 and moment.result.contacts is not None
    other = open_source([str(tmp_path / "scene.toml")], device)
    for _ in range(6):
        expected = other.step("count")
    assert np.array_equal(moment.poses, expected.poses) and moment.poses[1, 1] < 0.5


BAD = [
    (("gone.toml",), "gone.toml"),
    (("bad.toml",), "bad.toml: scene.speed: unknown key"),
    (("ball.obj", "scene.toml"), "a scene file is looked at alone"),
    (("ball.obj", "--out", "x.jpg"), "must end in .png"),
    (("ball.obj", "--frame", "-1"), "--frame: -1 is below 0"),
    (("ball.obj", "--tree", "-1"), "--tree: -1 is below 0"),
    (("ball.obj", "--tree", "40"), "--tree: the deepest tree ends at level 9"),
    (("ball.obj", "--size", "9"), "--size: 9 is outside 50 .. 8000"),
    (("ball.obj", "--eye", "0", "1", "0"), "--eye: eye and up"),
    (("ball.obj", "--eye", "nan", "1", "0"), "--eye: eye and up"),
    (("ball.obj", "--world", "3"), "--world: no object is in world 3"),
    (("run.npz", "--frame", "2"), "--frame: the recording has 2 frames"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_bad_input_gives_one_line(files, capsys, arguments, message):
    if arguments[0] == "run.npz":
        record_run(ab.load_scene("scene.toml", device="cpu"), 2)[1].save("run.npz")
    before = sorted(files.iterdir())
    out = () if "--out" in arguments else ("--out", "out.png")
    shown, errors = run(capsys, *arguments, *out, status=2)
    assert len(errors) == 1 and message in errors[0] and errors[0].startswith("warp-abtree: ")
    assert not shown and sorted(files.iterdir()) == before


def test_without_matplotlib(files, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    errors = run(capsys, "ball.obj", "--out", "out.png", status=2)[1]
    assert errors == ["warp-abtree: picture needs Matplotlib: pip install matplotlib"]
