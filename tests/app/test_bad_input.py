"""Bad input to any command: one line on stderr that says what and where, status 2, and nothing is written."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.samples import SHUTTLE_SCENE
from helpers.viewer import run_command, write_scene

import warp_abtree as ab
from warp_abtree.app import load_scene
from warp_abtree.app.recording import record_run

NOTHING = [
    ((), "COMMAND"),
    (("fly",), "fly"),
    (("bench",), "name a benchmark"),
]
MODELS = [
    (("info",), "MESH"),
    (("info", "gone.obj"), "gone.obj: no such file"),
    (("info", "."), "folder"),
    (("info", "nan.obj"), "not finite"),
    (("info", "junk.obj"), "junk.obj"),
    (("info", "text.mesh"), "unknown extension"),
    (("info", "warp:cat"), "warp:cat"),
    (("info", "ball.obj", "--speed"), "--speed"),
    (("info", "ball.obj", "--device", "cuda:99"), "no device 'cuda:99'"),
    (("build", "ball.obj", "gone/ball.npz"), "no folder gone"),
    (("build", "ball.obj", "ball.txt"), "must end in .npz"),
    (("build", "ball.obj", "ball.npz", "--base-faces", "0"), "--base-faces"),
    (("build", "nan.obj", "ball.npz"), "not finite"),
]
QUERY = [
    (("query", "ball.obj"), "B"),
    (("query", "ball.obj", "gone.npz"), "gone.npz: no such file"),
    (("query", "ball.obj", "junk.npz"), "junk.npz"),
    (("query", "ball.obj", "ball.obj", "--pose", "1", "2"), "--pose"),
    (("query", "ball.obj", "ball.obj", "--pose", *"0 0 0 0 0 0 x".split()), "--pose"),
    (("query", "ball.obj", "ball.obj", "--pose", *"0 0 0 0 0 0 2".split()), "norm 2"),
    (("query", "ball.obj", "ball.obj", "--pose", *"-inf 0 0 0 0 0 1".split()), "not finite"),
    (("query", "ball.obj", "ball.obj", "--lod-a", "1.5"), "--lod-a"),
    (("query", "ball.obj", "ball.obj", "--lod-b", "-3"), "--lod-b"),
    (("query", "ball.obj", "ball.obj", "--lod-b", "99999"), "--lod-b"),
    (("query", "ball.obj", "ball.obj", "--lod-b", "tol:-1"), "--lod-b"),
    (("query", "ball.obj", "ball.obj", "--lod-b", "fine"), "--lod-b"),
    (("query", "ball.obj", "ball.obj", "--output", "depth"), "--output"),
    (("query", "ball.obj", "ball.obj", "--precision", "half"), "--precision"),
    (("query", "ball.obj", "ball.obj", "--precision"), "--precision"),
    (("query", "ball.obj", "ball.obj", *"--output contacts --record out.json".split()), "must end in .csv or .npz"),
    (("query", "ball.obj", "ball.obj", *"--output contacts --record out".split()), "must end in .csv or .npz"),
    (("query", "ball.obj", "ball.obj", *"--output contacts --record gone/out.csv".split()), "no folder gone"),
    (("query", "ball.obj", "ball.obj", *"--output contacts --record ball.obj/out.csv".split()), "no folder ball.obj"),
    (("query", "ball.obj", "ball.obj", *"--output contacts --record folder.npz".split()), "is a folder"),
    (("query", "ball.obj", "ball.obj", "--record", "out.csv"), "ask --output faces or contacts"),
    (("query", "ball.obj", "ball.obj", "--output", "any", "--record", "out.csv"), "ask --output faces or contacts"),
    (("query", "ball.obj", "face.npz", "--record", "face.npz"), "face.npz: is read"),
    (("query", "./face.npz", "ball.obj", "--record", "face.npz"), "face.npz: is read"),
    (("query", "ball.obj", "nan.obj", "--output", "contacts", "--record", "out.npz"), "not finite"),
    (("query", "ball.obj", "ball.obj", "--device", "tpu"), "no device 'tpu'"),
]
RUN = [
    (("run", "gone.toml"), "gone.toml"),
    (("run", "bad.toml"), "bad.toml: scene.speed: unknown key"),
    (("run", "broken.toml"), "line 1"),
    (("run", "scene.toml", "--frames", "0"), "--frames"),
    (("run", "scene.toml", "--picture", "out.jpg"), "must end in .png"),
    (("run", "scene.toml", "--picture", "gone/out.png"), "no folder gone"),
    (("run", "scene.toml", "--record", "rows.xls"), ".csv or .json or .npz"),
    (("run", "scene.toml", "--record", "gone/run.npz"), "no folder gone"),
    (("run", "scene.toml", "--plot", "gone/plots"), "no folder gone"),
    (("run", "scene.toml", "--plot", "ball.obj"), "ball.obj"),
    (("run", "scene.toml", "--objects", "0"), "--objects"),
    (("run", "one.toml", "--objects", "5"), "count or worlds"),
    (("run", "scene.toml", "--budget", "soon"), "'soon' is no time above 0"),
    (("run", "scene.toml", "--budget", "0ms"), "no time above 0"),
    (("run", "scene.toml", "--budget", "-3ms"), "--budget"),
    (("run", "scene.toml", "--budget", "infs"), "no time above 0"),
    (("run", "scene.toml", "--controller", "magic"), "--controller"),
    (("run", "scene.toml", "--controller", "paper"), "needs a budget"),
    (("run", "scene.toml", "--controller", "tolerance"), "needs lod.tolerance"),
    (("run", "scene.toml", "--controller", "none", "--budget", "3"), "holds no budget"),
    (("run", "gone.npz"), "gone.npz: No such file"),
    (("run", "junk.npz"), "junk.npz: not a recording"),
    (("run", "face.npz"), "face.npz: not a recording of a run"),
    (("run", "folder.npz"), "folder.npz"),
    (("run", "junk.npz", "--record", "junk.npz"), "junk.npz: is read"),
    (("run", "junk.npz", "--budget", "3"), "--budget: a recording runs again as it was"),
    (("run", "junk.npz", "--controller", "paper"), "--controller: a recording"),
    (("run", "junk.npz", "--objects", "3"), "--objects: a recording"),
]
PICTURE = [
    (
        (
            "picture",
            "gone.toml",
        ),
        "gone.toml",
    ),
    (
        (
            "picture",
            "bad.toml",
        ),
        "bad.toml: scene.speed: unknown key",
    ),
    (("picture", "ball.obj", "scene.toml"), "a scene file is looked at alone"),
    (("picture", "ball.obj", "--out", "x.jpg"), "must end in .png"),
    (("picture", "ball.obj", "--frame", "-1"), "--frame: -1 is below 0"),
    (("picture", "ball.obj", "--tree", "-1"), "--tree: -1 is below 0"),
    (("picture", "ball.obj", "--tree", "40"), "--tree: the deepest tree ends at level 9"),
    (("picture", "ball.obj", "--size", "9"), "--size: 9 is outside 50 .. 8000"),
    (("picture", "ball.obj", "--eye", "0", "1", "0"), "--eye: eye and up"),
    (("picture", "ball.obj", "--eye", "nan", "1", "0"), "--eye: eye and up"),
    (("picture", "ball.obj", "--world", "3"), "--world: no object is in world 3"),
    (("picture", "run.npz", "--frame", "2"), "--frame: the recording has 2 frames"),
    (("picture", "junk.npz"), "junk.npz"),
    (("picture", "scene.toml", "--lod", "0.5"), "--lod: for meshes"),
    (("picture", "scene.toml", "--pose", *"0 0 0 0 0 0 1".split()), "--pose: for meshes"),
    (("picture", "ball.obj", "--objects", "3"), "--objects: for scene files"),
    (("picture", "ball.obj", "--lod", "9999"), "--lod: model"),
    (("picture", "ball.obj", "--pose", *"0 0 0 0 0 0 1".split()), "--pose: 1 given for the 0 meshes"),
    (("picture", "ball.obj", "face.npz", "--pose", *"0 0 0 0 0 0 2".split()), "--pose: pose 0 has a quaternion"),
]
VIEW = [
    (("view",), "SCENE_OR_MESHES"),
    (("view", "gone.toml"), "gone.toml"),
    (("view", "bad.toml"), "bad.toml: scene.speed: unknown key"),
    (("view", "gone.obj"), "gone.obj"),
    (("view", "box.obj", "scene.toml"), "a scene file is looked at alone"),
    (("view", "box.obj", "--port", "70000"), "--port: 70000 is outside"),
    (("view", "box.obj", "--host", "no.such.host.invalid"), "no.such.host.invalid:0: cannot be served at"),
    (("view", "box.obj", "--frames", "3"), "--frames: of --record"),
    (("view", "box.obj", "--record", "page.txt"), "must end in .html"),
    (("view", "box.obj", "--record", "gone/page.html"), "no folder gone"),
    (("view", "box.obj", "--device", "cuda:77"), "cuda:77"),
    (("view", "box.obj", "--budget", "soon"), "no time above 0"),
    (("view", "--fast"), "SCENE_OR_MESHES"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Give a folder with meshes, models, a scene and a recording, and files that are none."""
    path = tmp_path_factory.mktemp("files")
    trimesh.creation.icosphere(subdivisions=2).export(path / "ball.obj")
    trimesh.creation.box().export(path / "box.obj")
    ab.Model.from_arrays(np.eye(3), [[0, 1, 2]]).save(path / "face.npz")
    scene = write_scene(path)
    record_run(load_scene(scene, device="cpu"), 2)[1].save(path / "run.npz")
    for name, text in (
        ("junk.obj", "hello\n"),
        ("nan.obj", "v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n"),
        ("junk.npz", "junk"),
        ("text.mesh", "hello\n"),
        ("bad.toml", "[scene]\nspeed = 3\n"),
        ("broken.toml", "[scene\n"),
        ("one.toml", SHUTTLE_SCENE),
    ):
        Path(path, name).write_text(text)
    (path / "folder.npz").mkdir()
    return path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [*NOTHING, *MODELS, *QUERY, *RUN, *PICTURE, *VIEW],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_bad_input_gives_one_line(folder, monkeypatch, capsys, arguments, message):
    needs = {"picture": "pyvista", "view": "viser"}.get(arguments[0] if arguments else "")
    if needs is not None:
        pytest.importorskip(needs)
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    out = ("--out", "out.png") if "picture" in arguments and "--out" not in arguments else ()
    shown, errors = run_command(capsys, *arguments, *out, status=2)
    assert len(errors) == 1 and message in errors[0] and errors[0].startswith("warp-abtree: ")
    assert not shown and sorted(folder.iterdir()) == before
