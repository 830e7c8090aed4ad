"""Work for several machines: `RayPool` does the shards of a job on Ray, `WorldsJob` runs a scene's worlds as shards.

`warp-abtree sweep` does both from the command line.
"""

import contextlib
import copy
import dataclasses
import hashlib
import os
import signal
import threading
from collections import deque

import numpy as np

from warp_abtree.checks.arguments import whole_number
from warp_abtree.checks.regime import change_regime
from warp_abtree.jobs.shards import hash_model
from warp_abtree.scene.scene import Scene

# Shards that a worker has at a time, so that it never waits for the next.
AHEAD = 2
# Times that a shard, or the start of a worker, may fail with its worker before the run gives up.
ATTEMPTS = 3


def _import_ray():
    try:
        import ray
    except ImportError:
        raise ValueError("Ray is not installed: pip install ray") from None
    return ray


@contextlib.contextmanager
def _sigterm_kept():
    """Give a program that handles SIGTERM its handler back; Ray puts another in its place."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if callable(before) and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


class _Worker:
    """What an actor holds: the asker of a job, which came once, through the object store."""

    def __init__(self, asker, device):
        change_regime(cpu_threads=1 if device == "cpu" else None)  # an actor a core
        self.asker, self.device = asker, device

    def ready(self):
        return os.getpid()

    def ask(self, item):
        return self.asker.ask(item, self.device)


class RayPool:
    """Does the shards of a job on Ray, an actor a GPU, or a CPU core where there is none.

    What a job is about goes through the object store once. A worker that ends is replaced, and its shards are done
    again; answers are written by whoever asks, so that no machine needs to share a disk.

    Args:
        address: Of a running cluster, as for `ray.init`; None starts Ray here, for as long as the pool is open.
        workers: How many; None is as many as there are GPUs, or CPU cores.

    Attributes:
        workers: How many.
        pids: Process of each worker that runs.
        lost: Workers that ended before their work, in the last job.

    Raises:
        ValueError: Ray is not installed, or does not start or answer; workers is no whole number from 1.
    """

    def __init__(self, address=None, workers=None):
        workers = None if workers is None else whole_number(workers, "workers", 1, 2**16)
        self.ray = _import_ray()
        self.pids: dict = {}
        self.lost = 0
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        self._own = not self.ray.is_initialized()
        if self._own:
            options = {"include_dashboard": False, "num_cpus": workers} if address is None else {}
            try:
                with _sigterm_kept():
                    self.ray.init(
                        address="local" if address is None else address,
                        log_to_driver=False,
                        logging_level="ERROR",
                        **options,
                    )
            except Exception as error:
                raise ValueError(f"Ray at {address or 'this machine'}: {error}") from None
        found = self.ray.cluster_resources()
        self.on_gpus = found.get("GPU", 0) >= 1
        self.workers = workers or max(1, int(found.get("GPU" if self.on_gpus else "CPU", 1)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Stop Ray if this pool started it."""
        if self._own:
            self._own = False
            self.ray.shutdown()

    def _start(self, asker):
        share = {"num_gpus": 1, "num_cpus": 0} if self.on_gpus else {"num_cpus": 1}
        actor = self.ray.remote(_Worker).options(**share).remote(asker, "cuda:0" if self.on_gpus else "cpu")
        return actor, actor.ready.remote()

    def ask(self, job, ranges):
        """Yield (start, stop, columns) of each range, once, in the order in which they are done.

        Raises:
            RuntimeError: A shard lost its worker three times, or workers do not start.
        """
        ray = self.ray
        self.lost = 0
        asker = ray.put(job.asker())
        waiting, under_way = deque(ranges), {}  # reference: (actor, range), range None while it starts
        failed: dict = {}
        actors: list = []

        def start():
            actor, ready = self._start(asker)
            actors.append(actor)
            under_way[ready] = actor, None

        def feed(actor):
            if waiting:
                part = waiting.popleft()
                under_way[actor.ask.remote(job.item(*part))] = actor, part

        def lose(actor, cause):
            """Take back what an actor was doing, and start another."""
            self.lost += 1
            self.pids.pop(actor, None)
            with contextlib.suppress(Exception):
                ray.kill(actor)  # of a machine that went, it may be alive
            actors.remove(actor)
            mine = [ref for ref, (owner, _) in under_way.items() if owner is actor]
            # Only the shard at work can have ended it; those behind had not begun. A start counts for itself.
            for turn, ref in enumerate(mine):
                part = under_way.pop(ref)[1]
                if turn == 0:
                    failed[part] = failed.get(part, 0) + 1
                    if failed[part] == ATTEMPTS:
                        what = "workers do not start" if part is None else f"shard {part} ended its worker"
                        raise RuntimeError(f"{what}, {ATTEMPTS} times: {cause}")
                if part is not None:
                    waiting.appendleft(part)
            start()

        try:
            for _ in range(min(self.workers, len(waiting))):
                start()
            while waiting or any(part is not None for _, part in under_way.values()):
                done, _ = ray.wait(list(under_way), num_returns=1)
                actor, part = under_way[done[0]]
                try:
                    answer = ray.get(done[0])
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                except (ray.exceptions.RayActorError, ray.exceptions.ObjectLostError) as error:
                    lose(actor, " ".join(str(error).split())[:300])
                    continue
                del under_way[done[0]]
                if part is None:
                    self.pids[actor] = answer
                    failed.pop(None, None)
                    for _ in range(AHEAD):
                        feed(actor)
                    continue
                feed(actor)
                del done
                yield *part, answer
        finally:
            self.pids.clear()
            for actor in actors:
                with contextlib.suppress(Exception):
                    ray.kill(actor)


# Worlds of a scene.


class WorldsJob:
    """A scene file's worlds, run frame by frame, as a job for `run_shards`: worlds are dealt to shards.

    The models are built here, once. Objects of world -1 are in every shard, so none of them may be a rigid body; two of
    them are asked in none.

    Args:
        scene: `SceneFile`.
        frames: Frames to run; None is the file's own number.
        output: "count": a row a world and frame, with the candidate pairs, those that intersect, and the intersecting
            face pairs. "poses": a row an object and frame, with its pose.
        shard: Worlds a shard.

    Raises:
        ValueError: A scene without worlds, or whose LODs a controller chooses by the clock; a rigid body in world -1;
            an unknown output, or frames or worlds a shard that are no whole number from 1.
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
            "static": np.array(objects._static, bool),
            "importance": np.array(objects.object_importance),
        }
        free = (scene.worlds < 0) & ~self._parts["static"] & ~scene.kinematic
        if scene.dynamics is not None and free.any():
            raise ValueError(f"{scene.path}: object {np.flatnonzero(free)[0]} is a rigid body in world -1")
        self._scene = scene

    def describe(self) -> dict:
        """Return all that the answers depend on, for JSON."""
        return {
            "kind": "worlds",
            "count": self.count,
            "shard": self.shard,
            "models": [hash_model(model) for model in self._parts["models"]],
            "scene": hashlib.sha256(self._scene.text.encode()).hexdigest(),
            "objects": len(self._scene.worlds),
            "frames": self.frames,
            "output": self.output,
        }

    def item(self, start, stop):
        """Return what a worker is sent for a shard."""
        return self.worlds[start:stop]

    def asker(self) -> "WorldsAsker":
        """Return what a worker is sent once."""
        # Cameras and scenes stay here: workers make scenes of their own.
        return WorldsAsker(dataclasses.replace(self._scene, scene=None), self._parts, self.frames, self.output)


class WorldsAsker:
    """Runs shards of a `WorldsJob` on one device."""

    def __init__(self, scene, parts, frames, output):
        self.scene, self.parts, self.frames, self.output = scene, parts, frames, output

    def ask(self, worlds, device=None) -> dict:
        """Return the columns of a shard, arrays of one length."""
        rows = np.flatnonzero(np.isin(self.scene.worlds, worlds) | (self.scene.worlds < 0))
        part = self._cut(rows, device)
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

    def _cut(self, rows, device):
        """Return the scene file of some objects, on a device."""
        whole, parts = self.scene, self.parts
        motion = copy.copy(whole.motion)  # made anew, it would normalise once more
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
            body={name: values[rows] for name, values in whole.body.items()},
        )
