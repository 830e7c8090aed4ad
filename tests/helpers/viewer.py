"""Models, scene files and playbacks that tests of applications use, and a runner of commands."""

import shutil
from functools import cache
from pathlib import Path

import trimesh

import warp_abtree as ab
from helpers.samples import SHUTTLE_SCENE
from warp_abtree.app.cli.main import main
from warp_abtree.app.playback import MeshPlayback

# A browser without a window, and its flags to draw without a GPU.
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SCENE = (
    SHUTTLE_SCENE
    + """
[[objects]]
model = "ring"
world = 1
worlds = 2
[[lod_sweep]]
objects = ["ball"]
from = 1.0
to = 0.1
period = 2
"""
)


BODIES = """
scene = {}
dynamics = {}
models.ball = { shape = "icosphere", subdivisions = 1 }
models.floor = { shape = "box", extents = [4, 1, 4] }
[[objects]]
model = "floor"
static = true
position = [0, -1.4, 0]
[[objects]]
model = "ball"
position = [0, 0.2, 0]
"""


def write_scene(folder, text=SCENE):
    path = Path(folder, "scene.toml")
    path.write_text(text)
    return path


@cache
def make_models():
    return [ab.Model.load(trimesh.creation.icosphere(2)), ab.Model.load(trimesh.creation.torus(1.0, 0.3, 24, 12))]


def make_playback(device):
    """Return a ball in a turned ring, and another ball that meets the ring."""
    models, half = make_models(), 0.5**0.5
    poses = [(0, 0, 0, 0, 0, 0, 1), (0.6, 0.1, 0, half, 0, 0, half), (2.1, 0.2, 0.1, 0, 0, 0, 1)]
    chosen = [models[0], models[1], models[0]]
    return MeshPlayback(chosen, poses, [model.lod_max for model in chosen], device)


def run_command(capsys, *arguments, status=0):
    """Run the command line; return its stdout, and stderr's lines but the word about kernels being compiled."""
    assert main([str(argument) for argument in arguments]) == status
    captured = capsys.readouterr()
    return captured.out, [line for line in captured.err.splitlines() if not line.startswith("compiling kernels")]
