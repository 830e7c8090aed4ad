"""Scenes, and all that can be read of one."""

import numpy as np

import warp_abtree as ab
from helpers.samples import raw_state, sample

TURN = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])


def pair_scene(device):
    """Return a scene of three objects at several LODs, one in every world, with a pair filtered out."""
    scene = ab.Scene(device)
    scene.add(sample("small ball"), lod=30)
    scene.add(sample("box"), (0.5, 0.25, 0, 0, 0, 0, 1))
    scene.add(sample("small ball"), (0, 0.5, 0, 0, 0, 0, 1), world=-1, static=True, lod=12)
    scene.filter([(0, 1)])
    return scene


def everything(scene):
    """Return all that a scene holds, as bytes."""
    states, objects = scene.batch().states, scene.batch().objects
    held = [scene.object_count, scene.lods, objects.state, scene.batch().excluded, len(states.slots)]
    pool = objects.pool
    held += [array.numpy() for array in (pool.rotation, pool.position, pool.world, pool.is_static, pool.state)]
    held += [value for i in range(scene.object_count) for value in raw_state(scene, i).values()]
    return [np.asarray(value).tobytes() for value in held]
