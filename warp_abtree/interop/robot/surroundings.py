"""Surroundings of a robot: objects of a scene or models, in one batch with the robots of a chunk."""

import numpy as np

from warp_abtree.checks.arguments import to_numpy
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene
from warp_abtree.state.arrays import ObjectArrays
from warp_abtree.state.batch import Batch
from warp_abtree.state.poses import check_poses

STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def make_surroundings(world, device) -> tuple[Scene | None, tuple]:
    """Return what surrounds a robot as a scene of a device, None where there is nothing, and what tells it from others.

    `world` as for `Robot.check`: raises TypeError for anything else, ValueError for a scene of another device or of
    several worlds, or a bad pose.
    """
    if isinstance(world, Scene):
        if world.device != device:
            raise ValueError(f"world: a scene on {world.device}, the robot is on {device}")
        if len(set(world.worlds[world.present].tolist()) - {-1}) > 1:
            raise ValueError("world: a scene of several worlds; a robot is in one")
        return (world, (id(world),)) if world.object_count else (None, ())
    listed = [] if world is None else [world] if isinstance(world, Model) else world
    if not isinstance(listed, list | tuple):
        raise TypeError(f"world: a {type(world).__name__} is neither a Scene nor models with poses")
    scene, placed = Scene(device), []
    for k, entry in enumerate(listed):
        alone = isinstance(entry, Model) or not isinstance(entry, list | tuple) or len(entry) != 2
        model, pose = (entry, STILL) if alone else entry
        if not isinstance(model, Model):
            raise TypeError(f"world: entry {k} is neither a Model nor a model with a pose")
        placed.append((model, check_poses(to_numpy(pose, "pose")[None], f"world: pose {k}")[0]))
    for model, pose in placed:
        scene.add(model, pose)
    return (scene if placed else None), tuple((id(model), pose.tobytes()) for model, pose in placed)


def make_batch(around: Scene | None, models: list[Model], room: int, device) -> tuple[Batch, np.ndarray]:
    """Return the batch of what surrounds a robot, a scene at its LODs or None, and then of the parts of many robots.

    With it goes whether the bits of each object around let it meet the robot, whose group is 1, with every bit in its
    mask.
    """
    posed, solid, meets = Scene(device), np.zeros(0, bool), np.zeros(0, bool)
    if around is not None:
        posed.add_many([around.models[m] for m in around.object_model], [STILL] * around.object_count, lods=around.lods)
        solid = np.array(around.object_solid)
        group, mask = around.batch().objects.collision_bits.numpy().reshape(-1, 2).T
        meets = (group != 0) & ((mask & 1) != 0) if len(group) else np.ones(len(solid), bool)
    posed.add_many(models, [STILL] * len(models))
    once = posed.batch()
    chosen = np.concatenate([np.arange(len(meets)), np.tile(np.arange(len(meets), once.object_count), room)])
    none = np.zeros(len(chosen))
    objects = ObjectArrays(none, none, device)
    objects.set_states(once.objects.state[chosen])
    solids = np.concatenate([solid, np.zeros(len(chosen) - len(solid), bool)]) if solid.any() else ()
    return Batch(once.models, once.states, objects, once.object_model[chosen], solid=solids), meets
