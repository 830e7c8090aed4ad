"""Scenes, and all that can be read of one."""

import numpy as np

from helpers.samples import raw_state


def everything(scene):
    """Return all that a scene holds, as bytes."""
    states, objects = scene.batch().states, scene.batch().objects
    held = [scene.object_count, scene.lods, objects.state, scene.batch().excluded, len(states.slots)]
    pool = objects.pool
    held += [array.numpy() for array in (pool.rotation, pool.position, pool.world, pool.is_static, pool.state)]
    held += [value for i in range(scene.object_count) for value in raw_state(scene, i).values()]
    return [np.asarray(value).tobytes() for value in held]
