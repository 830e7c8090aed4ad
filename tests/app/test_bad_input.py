"""Bad input to any command: one line on stderr that says what and where, status 2, and nothing is written."""

import os

import numpy as np
import pytest
import trimesh
from helpers.samples import SHUTTLE_SCENE
from helpers.viewer import run_command, write_scene

import warp_abtree as ab

# A command line, and a part of what is said of it.
CASES = [
    ("", "COMMAND"),
    ("fly", "fly"),
    ("bench", "name a benchmark"),
    ("info", "MESH"),
    ("info gone.obj", "gone.obj: no such file"),
    ("info .", "folder"),
    ("info nan.obj", "not finite"),
    ("info junk.obj", "junk.obj"),
    ("info text.mesh", "unknown extension"),
    ("info ball.obj --speed", "--speed"),
    ("info ball.obj --device cuda:99", "no device 'cuda:99'"),
    ("build gone.obj ball.npz", "gone.obj: no such file"),
    ("build ball.obj gone/ball.npz", "no folder gone"),
    ("build ball.obj ball.txt", "must end in .npz"),
    ("build ball.obj ball.npz --base-faces 0", "--base-faces"),
    ("query ball.obj gone.npz", "gone.npz: no such file"),
    ("query ball.obj junk.npz", "junk.npz"),
    ("query ball.obj ball.obj --pose 1 2", "--pose"),
    ("query ball.obj ball.obj --pose 0 0 0 0 0 0 2", "norm 2"),
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
    ("run one.toml --objects 5", "count or worlds"),
    ("run scene.toml --budget soon", "'soon' is no time above 0"),
    ("run scene.toml --budget 8", "'8' has no unit; give 8ms or 8s"),
    ("view scene.toml --budget 0.008", "'0.008' has no unit"),
    ("run scene.toml --budget 0ms", "no time above 0"),
    ("run scene.toml --budget infs", "no time above 0"),
    ("run scene.toml --controller magic", "--controller"),
    ("run scene.toml --controller paper", "needs a budget"),
    ("run scene.toml --controller tolerance", "needs lod.tolerance"),
    ("run scene.toml --controller none --budget 3ms", "holds no budget"),
    ("picture gone.toml --out out.png", "gone.toml"),
    ("picture ball.obj scene.toml --out out.png", "a scene file is looked at alone"),
    ("picture ball.obj --out x.jpg", "must end in .png"),
    ("picture ball.obj --frame -1 --out out.png", "--frame: -1 is below 0"),
    (
        "picture ball.obj --frames 100000 --out out.gif",
        "--frames: 100,000 pictures of 800 x 800 pixels take",
    ),
    ("picture ball.obj --frames 100000 --size 50 --out out.gif", "draw fewer by --every"),
    ("picture ball.obj --size 9 --out out.png", "--size: 9 is outside 50 .. 8000"),
    ("picture ball.obj --eye 0 1 0 --out out.png", "--eye: eye and up"),
    ("picture ball.obj --eye nan 1 0 --out out.png", "--eye: eye and up"),
    ("picture ball.obj --world 3 --out out.png", "--world: no object is in world 3"),
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
    ("view ball.obj --port 70000", "--port: 70000 is outside"),
    ("view ball.obj --host no.such.host.invalid", "no.such.host.invalid:0: cannot be served at"),
]
FILES = {
    "junk.obj": "hello\n",
    "nan.obj": "v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n",
    "junk.npz": "junk",
    "text.mesh": "hello\n",
    "bad.toml": "[scene]\nspeed = 3\n",
    "one.toml": SHUTTLE_SCENE,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Give a folder with a mesh, a model and a scene, and files that are none."""
    path = tmp_path_factory.mktemp("files")
    for name in ("ball.obj", "ball.glb"):
        trimesh.creation.icosphere(subdivisions=2).export(path / name)
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
    shown, errors = run_command(capsys, *words, status=2)
    assert len(errors) == 1 and message in errors[0] and errors[0].startswith("warp-abtree: ")
    assert not shown and sorted(folder.iterdir()) == before
