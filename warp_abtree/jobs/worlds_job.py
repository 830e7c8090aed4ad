"""The worlds of a scene file, run frame by frame, as a job."""

import copy
import dataclasses
import hashlib

import numpy as np

from warp_abtree.checks.arguments import whole_number
from warp_abtree.scene.scene import Scene


class WorldsJob:
    """The worlds of a scene file, run frame by frame, as a job for `run_shards`: each shard has some of the worlds.

    Models are built once. Objects of world -1 are in every shard, so none of them may be a rigid body; pairs of two of
    them are not tested.

    Args:
        scene: `SceneFile`.
        frames: Frames to run; None is the file's own number.
        output: "count": a row per world and frame, with the numbers of candidate pairs, intersecting pairs and
            intersecting face pairs. "poses": a row per object and frame, with its pose.
        shard: Worlds per shard.

    Raises:
        ValueError: A scene without worlds, or whose LODs a controller chooses by the clock; a rigid body in world -1;
            an unknown output; frames or shard not a whole number from 1.
    """

    unit = "world"

    def __init__(self, scene, frames=None, output="count", shard=64):
        if output not in ("count", "poses"):
            raise ValueError(f"output {output!r} of worlds is none of 'count', 'poses'")
        if scene.control.controller != "none":
            raise ValueError(f"{scene.path}: [lod] goes by the clock of one device; worlds in shards need fixed LODs")
        self.frames = whole_number(scene.frames if frames is None else frames, "frames", 1, 2**31 - 1)
        self.output, self.shard = output, whole_number(shard, "shard", 1, 2**31 - 1)
        self.worlds = np.unique(scene.worlds[scene.worlds >= 0])
        self.count = len(self.worlds)
        if not self.count:
            raise ValueError(f"{scene.path}: no object is in a world of its own")
        objects = scene.scene
        self._parts = {
            "models": objects.models,
            "object_model": np.array(objects.object_model),
            "static": np.array(objects.object_static, bool),
            "importance": np.array(objects.object_importance),
        }
        free = (scene.worlds < 0) & ~self._parts["static"] & ~scene.kinematic
        if scene.dynamics is not None and free.any():
            raise ValueError(f"{scene.path}: object {np.flatnonzero(free)[0]} is a rigid body in world -1")
        self._scene = scene

    def describe(self) -> dict:
        """Return everything that determines the results, for JSON."""
        return {
            "kind": "worlds",
            "count": self.count,
            "shard": self.shard,
            "models": [model.digest for model in self._parts["models"]],
            "scene": hashlib.sha256(self._scene.text.encode()).hexdigest(),
            "objects": len(self._scene.worlds),
            "frames": self.frames,
            "output": self.output,
        }

    def task(self, start, stop):
        """Return the input of one shard, sent to a worker."""
        return self.worlds[start:stop]

    def runner(self) -> "WorldsRunner":
        """Return the task runner, sent to each worker once; workers make scenes of their own."""
        return WorldsRunner(dataclasses.replace(self._scene, scene=None), self._parts, self.frames, self.output)


class WorldsRunner:
    """Task runner of a `WorldsJob` on one device."""

    def __init__(self, scene, parts, frames, output):
        self.scene, self.parts, self.frames, self.output = scene, parts, frames, output

    def run(self, worlds, device=None) -> dict:
        """Return the columns of a shard, arrays of one length."""
        rows = np.flatnonzero(np.isin(self.scene.worlds, worlds) | (self.scene.worlds < 0))
        part = self._select(rows, device)
        bodies = part.make_bodies()
        frame = part.frame(bodies=bodies)
        own = part.worlds >= 0
        columns: list = []
        for number in range(self.frames):
            if self.scene.sweeps:
                part.scene.set_lods(self.scene.lods_at(number * part.time_step)[rows])
            poses = part.motion.poses(number * part.time_step) if bodies is None else bodies.poses()
            result = frame.step()
            if self.output == "poses":
                poses = poses[own]
                columns.append((np.full(len(poses), number), rows[own], part.worlds[own], poses))
                continue
            world = part.worlds[result.pairs].reshape(-1, 2).max(1, initial=-1)
            shared = world >= 0
            place = np.searchsorted(worlds, world[shared])
            counts = [
                np.bincount(place, values[shared], len(worlds)).astype(np.int64)
                for values in (np.ones(len(world)), result.any, result.count)
            ]
            columns.append((np.full(len(worlds), number), worlds, *counts))
        merged = [np.concatenate(parts) for parts in zip(*columns)]
        if self.output == "poses":
            names = ("frame", "object", "world", "x", "y", "z", "qx", "qy", "qz", "qw")
            return dict(zip(names, (*merged[:3], *np.ascontiguousarray(merged[3].T))))
        return dict(zip(("frame", "world", "pairs", "intersecting", "face_pairs"), merged))

    def _select(self, rows, device):
        """Return the scene file with some of its objects, on a device."""
        whole, parts = self.scene, self.parts
        motion = copy.copy(whole.motion)  # the constructor would normalise quaternions again
        for field in dataclasses.fields(motion):
            setattr(motion, field.name, getattr(whole.motion, field.name)[rows])
        poses, lods = motion.poses(0.0), whole.lods_at(0.0)[rows]
        scene = Scene(device)
        for place, i in enumerate(rows.tolist()):
            model = parts["models"][parts["object_model"][i]]
            importance, static = int(parts["importance"][i]), bool(parts["static"][i])
            scene.add(model, poses[place], int(whole.worlds[i]), int(lods[place]), importance, static)
        return dataclasses.replace(
            whole,
            scene=scene,
            motion=motion,
            sweeps=[],
            worlds=whole.worlds[rows],
            base_lods=lods,
            kinematic=whole.kinematic[rows],
        )
