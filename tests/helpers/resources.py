"""Scenes that tests interrupt, and what must be the same afterwards."""

import numpy as np

import warp_abtree as ab
from helpers.samples import random_poses, sample
from helpers.scenes import everything
from warp_abtree.state.arrays import SLOT_COLUMNS

PAIRS = np.array([(0, 1), (1, 2), (3, 1)])


MORE_PAIRS = np.array([(i, j) for i in range(4) for j in range(4) if i != j])


def describe(result):
    """Return results, LOD statistics or arrays as comparable bytes."""
    if isinstance(result, ab.Result):
        values = [result.pairs, result.any, result.count, result.faces, result.apart]
        values += [result.contacts, result.pair_contacts]
    elif hasattr(result, "nodes_refitted"):
        values = [result.state, result.lod, result.full, result.k, result.nodes_refitted]
    else:
        values = [result]
    return [None if value is None else np.asarray(value).tobytes() for value in values]


def add_objects(device, count=4):
    scene = ab.Scene(device)
    poses = random_poses(np.random.default_rng(1), count, 0.4)
    for i in range(count):
        model = sample(("small ball", "torus")[i % 2])
        scene.add(model, poses[i], lod=model.lod_for(fraction=(0.4, 0.2)[i % 2]))
    return scene


def make_scene(device):
    """Return a scene that has been asked, with states that are shared, copied and freed."""
    scene = add_objects(device)
    lods = scene.lods
    scene.set_lods(lods - [0, 3, 5, 9])
    scene.set_lods(lods)
    scene.intersect(PAIRS, output="faces")
    return scene


def check_scene(before, scene):
    """Return all that a scene holds and answers, or check that it still does."""
    states = scene.batch().states.pool
    now = [getattr(states, name).numpy().tobytes() for name in SLOT_COLUMNS]
    now += [*everything(scene), *describe(scene.intersect(PAIRS, output="faces"))]
    now += describe(scene.intersect(MORE_PAIRS, output="count"))
    assert before is None or now == before
    return now
