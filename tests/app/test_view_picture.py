"""Pictures of scenes made in Python, directions upwards of views and scene files, and boxes of AB-Trees."""

import numpy as np
import PIL.Image
import pytest
import trimesh
from helpers import refused
from helpers.scenes import scene_with
from helpers.viewer import BODIES, make_models, make_playback, write_scene
from oracles.motion import posed

import warp_abtree as ab
from warp_abtree.app import load_scene, picture
from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.pictures import scenes
from warp_abtree.app.scene_view import make_view
from warp_abtree.app.styles import COLOURS

BASE = "scene = {}\nmodels.ball = { shape = 'icosphere', subdivisions = 1 }\nobjects = [{ model = 'ball' }]\n"
FALLS = "[dynamics]\ngravity = [0, 0, -2]\n"
CAMERA = "[camera]\neye = [9, 1, 2]\ntarget = [0, 0, 0]\n"


def make_scene(device):
    """Return a plate, a ball that it cuts a face of, above it along z, and a ball in a world of its own."""
    plate, ball = ab.Model.load(trimesh.creation.box((4, 4, 0.5))), make_models()[0]
    placed = (plate, {"name": "plate"}), (ball, (0, 0, 1.2, 0, 0, 0, 1)), (ball, (9, 0, 0, 0, 0, 0, 1), {"world": 2})
    return scene_with(device, *placed)


def rows_of(path, colour) -> np.ndarray:
    """Return the rows of a picture whose pixels are of a hue, one a pixel, but those of the legend."""
    pixels = np.array(PIL.Image.open(path).convert("RGB"), np.float64)[:-60]
    length = np.linalg.norm(pixels, axis=2).clip(1)
    hue = np.array(colour) / np.linalg.norm(colour)
    return np.nonzero((pixels @ hue > 0.996 * length) & (pixels.min(axis=2) < 200))[0]


def test_picture_of_a_scene_made_in_python(device, tmp_path):
    """Above is above; faces of the result, and no others, are coloured; the scene stays as it was."""
    pytest.importorskip("pyvista")
    scene, path = make_scene(device), tmp_path / "x.png"
    (plate, bright), (ball, _) = COLOURS[0], COLOURS[1]
    assert picture(scene, str(path), size=300, title="plate and ball") == path
    assert rows_of(path, ball).mean() < rows_of(path, plate).mean() - 20
    marked = len(rows_of(path, bright))
    picture(scene, path, size=300, up="-z", result=scene.intersect([(0, 2)], "contacts"))
    assert rows_of(path, ball).mean() > rows_of(path, plate).mean() + 20
    assert marked > 200 > 20 > len(rows_of(path, bright))


def test_legend_names_the_one_object_of_a_model(device, monkeypatch, tmp_path):
    pytest.importorskip("pyvista")
    drawn, scene = [], make_scene(device)
    monkeypatch.setattr(scenes, "draw", lambda *arguments: drawn.append(arguments))
    picture(scene, tmp_path / "x.png", eye=(1, 1, 1), world=2, distances=True)
    _, path, _, legend, eye, up, size = drawn[0]
    assert (path, size) == (tmp_path / "x.png", scenes.SIZE) and not path.exists()
    assert np.allclose(eye, 3**-0.5) and up.tolist() == [0, 0, 1]
    assert [label for _, label in legend] == [scene.models[1].name], "a name by default is no name"
    picture(scene, path)
    labels = [label for _, label in drawn[1][3]]
    ball = scene.models[1].name
    assert labels == ["plate", "plate, intersecting", ball, f"{ball}, intersecting"]
    scene.add(scene.models[0], (0, 0, -9, 0, 0, 0, 1), name="other plate")
    picture(scene, path)
    assert drawn[2][3][0][1] == scene.models[0].name, "of several objects"


def test_what_picture_refuses(device, tmp_path):
    pytest.importorskip("pyvista")
    scene, path = make_scene(device), tmp_path / "x.png"
    refused(TypeError, "not a Scene", picture, make_models()[0], path)
    refused(ValueError, "no object", picture, ab.Scene(device), path)
    for said, options in (
        ("size 9 is outside", {"size": 9}),
        ("world: no object is in world 1", {"world": 1}),
        ("up: 'w' is none of", {"up": "w"}),
        ("up: points along eye", {"up": (0, 1, 0), "eye": "-y"}),
        ("result: no faces", {"result": scene.intersect()}),
        ("result: no faces", {"result": scene.intersect(output="faces", device=True)}),
    ):
        refused(ValueError, said, picture, scene, path, **options)
    refused(ValueError, "must end in .png", picture, scene, tmp_path / "x.webp")
    found = scene.intersect(output="faces")
    scene.set_lods([0, 0, 0])
    refused(ValueError, "result: has faces that are not there", picture, scene, path, result=found)
    scene.remove([1, 2])
    other = scene_with(device, make_models()[0])
    refused(ValueError, "result: names an object", picture, other, path, result=found)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z", (1, 2, 3), (1e-200, 0, 1e-200)])
def test_the_eye_is_above_in_front_of_what_it_sees(up):
    view = make_view(up)
    assert np.isclose(np.linalg.norm([view.eye, view.up], axis=1), 1).all()
    assert 0.2 < view.eye @ view.up < 0.5
    if up == "z":
        assert view.eye[0] > 0 > view.eye[1]


@pytest.mark.parametrize(
    ("text", "up", "camera"),
    [
        (BASE, (0, 1, 0), None),
        (BODIES, (0, 1, 0), None),
        (BASE + FALLS, (0, 0, 1), None),
        (BASE + FALLS.replace("-2", "0"), (0, 1, 0), None),
        (BASE + FALLS + CAMERA, (0, 0, 1), (0, 0, 1)),
        (BASE + FALLS + CAMERA + "up = [1, 0, 0]\n", (1, 0, 0), (1, 0, 0)),
        (BASE + FALLS + CAMERA + "[picture]\nup = [-2, 0, 0]\n", (-1, 0, 0), (0, 0, 1)),
    ],
)
def test_up_in_a_scene_file_is_against_gravity_unless_it_says(tmp_path, device, text, up, camera):
    loaded = load_scene(write_scene(tmp_path, text), device=device)
    assert np.allclose(loaded.picture.up, up)
    assert np.allclose(loaded.picture.eye, make_view(up).eye)
    if camera is not None:
        assert np.argmax(loaded.camera(0.0).view[1] @ np.eye(3)) == np.argmax(camera)


@pytest.mark.parametrize(("i", "lod", "level"), [(0, None, 0), (1, None, 3), (1, 40, 2), (1, 40, 10), (1, 40, 11)])
def test_boxes_of_a_level_are_those_of_the_faces_below(device, i, lod, level):
    """Each box, in the world, is that of the posed vertices of the active faces in its half of halves."""
    playback = make_playback(device)
    if lod is not None:
        lods = playback.chosen.copy()
        lods[i] = lod
        playback.hold(lods)
    snapshot, scene = playback.query("count"), playback.scene
    model = scene.models[scene.object_model[i]]
    edges = geometry.tree_boxes(scene, snapshot, i, level)
    vertices, faces, ids = model.mesh_at(int(snapshot.lods[i]))
    leaves, expected = scene.tree_state(i).face_node[ids].tolist(), []
    above = np.array([leaf >> max(leaf.bit_length() - 1 - level, 0) for leaf in leaves])
    for node in range(2**level, 2 ** (level + 1)):
        below = above == node
        if below.any():
            corners = vertices[faces[below]].reshape(-1, 3)
            expected.append((corners.min(axis=0), corners.max(axis=0)))
    assert edges.shape == (12 * len(expected), 2, 3) and (len(expected) > 0) == (level < 11)
    # Back to the model's frame, where edges lie along the axes.
    turn = posed(np.eye(3), np.append([0, 0, 0], snapshot.poses[i, 3:])).T
    for corners, (lower, upper) in zip((edges - snapshot.poses[i, :3]).reshape(-1, 24, 3) @ turn, expected):
        assert np.allclose([corners.min(axis=0), corners.max(axis=0)], [lower, upper], atol=1e-6)
        length = np.abs(corners[::2] - corners[1::2])
        assert np.allclose(np.sort(length, axis=None)[-12:], np.sort(np.repeat(upper - lower, 4)), atol=1e-6)
        assert np.allclose(length.sum(), 4 * (upper - lower).sum(), atol=1e-5)
