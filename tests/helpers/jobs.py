"""Jobs of poses and of worlds, and what they leave behind."""

import numpy as np

import warp_abtree as ab
from helpers.samples import random_poses, sample

MODELS = ("torus", "small ball")


def pair():
    return [sample(name) for name in MODELS]


def poses_of(count=100, seed=0):
    return random_poses(np.random.default_rng(seed), count, 1.6)


def contents(out):
    return {path.name: path.read_bytes() for path in out.iterdir()}


def stop_after(count):
    def progress(_, done, total):
        if done == count:
            raise KeyboardInterrupt

    return progress


WORLDS = """
[models.ring]
shape = "torus"
major_radius = 0.5
minor_radius = 0.2
major_sections = 16
minor_sections = 10
[models.floor]
shape = "box"
extents = [4, 0.5, 4]
{dynamics}
[[objects]]
model = "floor"
position = [0, -0.25, 0]
world = -1
static = true
[[objects]]
model = "ring"
count = 3
grid = {{ size = [1, 0, 1], spacing = [0.6, 0.35, 0.6] }}
position = [0, 0.15, 0]
worlds = 5
random = {{ position = [0.2, 0, 0.2], rotation = true, turn = 60, velocity = 0.5 }}
{rest}
"""


def load_worlds(tmp_path, dynamics="", rest="", name="scene.toml"):
    (tmp_path / name).write_text(WORLDS.format(dynamics=dynamics, rest=rest))
    return ab.load_scene(tmp_path / name, device="cpu")
