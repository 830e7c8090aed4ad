"""Jobs that take long, in shards: each a file that appears whole or not at all, so that a job can be gone on with.

The same job writes the same bytes, whoever does it; `shard_folder` says what is written and how it is checked.
"""

import dataclasses
import hashlib
import os
from collections import deque
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy, whole_number
from warp_abtree.checks.atomic_write import sweep_up
from warp_abtree.checks.device_lock import device_turn
from warp_abtree.jobs.shard_folder import ShardFolder
from warp_abtree.model.model import Model
from warp_abtree.query.request import check_request
from warp_abtree.scene.poses import QUATERNION_TOLERANCE
from warp_abtree.scene.scene import Scene
from warp_abtree.scene.sweep import sweep

# Poses of a shard, and rows looked at in one piece while a job is checked.
READ_ROWS = SHARD = 65536
# Objects and bytes of tree states of a scene that asks contacts, or LODs that change from pose to pose.
SCENE_POSES, STATE_BYTES, BYTES_A_FACE = 4096, 2**28, 190


class _Rows:
    """Rows of numbers, in memory or in an .npy file of which no more is read than what is asked."""

    path: Any  # of the file; None in memory

    def __init__(self, source, what, width):
        self.what, self.path, self.array = what, None, None
        if isinstance(source, str | os.PathLike):
            self.path = Path(source)
            try:
                mapped = np.load(self.path, mmap_mode="r", allow_pickle=False)
            except FileNotFoundError:
                raise ValueError(f"{what}: {source}: no such file") from None
            except (OSError, ValueError, EOFError) as error:
                raise ValueError(f"{what}: {source} cannot be read as .npy ({error})") from None
            if not isinstance(mapped, np.memmap) or not mapped.flags.c_contiguous:
                raise ValueError(f"{what}: {source} is not an .npy file of one array in C order")
            self.dtype, shape, self.offset = mapped.dtype, mapped.shape, mapped.offset
        else:
            self.array = to_numpy(source, what)
            self.dtype, shape = self.array.dtype, self.array.shape
        if self.dtype.kind not in "iuf":
            raise ValueError(f"{what}: type {self.dtype} holds no real numbers")
        if len(shape) != 2 or shape[1] != width:
            raise ValueError(f"{what}: shape {shape}, not (p, {width})")
        self.count, self.width = shape

    def read(self, start, stop) -> np.ndarray:
        """Return rows, of an array in memory without a copy."""
        if self.array is not None:
            return self.array[start:stop]
        row = self.width * self.dtype.itemsize
        with open(self.path, "rb") as file:
            file.seek(self.offset + start * row)
            rows = np.fromfile(file, self.dtype, (stop - start) * self.width)
        if len(rows) != (stop - start) * self.width:
            raise ValueError(f"{self.what}: {self.path} ends before row {stop}")
        return rows.reshape(-1, self.width)

    def check(self, judge) -> str:
        """Look at all rows and return a hash of them; judge(first row, rows) raises where one is bad."""
        found = hashlib.sha256(f"{self.dtype.str} {self.count}".encode())
        for start in range(0, self.count, READ_ROWS):
            rows = self.read(start, min(start + READ_ROWS, self.count))
            judge(start, rows)
            found.update(rows.tobytes())
        return found.hexdigest()


def _judge_poses(start, rows):
    rows = rows.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        norm = np.sqrt((rows[:, 3:] ** 2).sum(1))
    bad = np.flatnonzero(~np.isfinite(rows).all(1))
    if len(bad):
        raise ValueError(f"poses: pose {start + bad[0]} is not finite")
    bad = np.flatnonzero(~(np.abs(norm - 1) <= QUATERNION_TOLERANCE))
    if len(bad):
        raise ValueError(
            f"poses: pose {start + bad[0]} has a quaternion of norm {norm[bad[0]]:.6g}, "
            f"off 1 by more than {QUATERNION_TOLERANCE}"
        )


def hash_model(model) -> str:
    """Return a hash of a model's mesh, collapses and tree."""
    found = hashlib.sha256()
    arrays = [getattr(model.progressive, field.name) for field in dataclasses.fields(model.progressive)]
    for array in (*arrays, model.tree.leaf_node):
        found.update(f"{array.dtype.str} {array.shape}".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


class SweepJob:
    """One pair of models at very many poses, or LODs, as a job for `run_shards`.

    All poses and LODs are looked at here, in pieces.

    Args:
        model_a, model_b: `Model`; may be the same.
        poses: (p, 7) as for `sweep`, an array or the path of an .npy file.
        lods: LODs of A and B: (2,) for all poses, or (p, 2), an array or the path of an .npy file; None is the finest.
            Poses whose LODs are those of the pose before, or of others near it, are asked faster.
        output: "any", "count", "faces" or "contacts".
        precision: As for `sweep`.
        shard: Poses a shard.

    Attributes:
        count: Poses.

    Raises:
        TypeError: model_a or model_b is no Model.
        ValueError: Bad poses or LODs, the first of which is named, or an unknown option.
    """

    unit = "pose"

    def __init__(self, model_a, model_b, poses, lods=None, output="any", precision="exact", shard=SHARD):
        for model in (model_a, model_b):
            if not isinstance(model, Model):
                raise TypeError(f"model is a {type(model).__name__}, not a Model")
        check_request("faces" if output == "contacts" else output, precision)
        self.models = (model_a, model_b)
        self.output, self.precision = output, precision
        self.shard = whole_number(shard, "shard", 1, 2**31 - 1)
        self.fixed, self.lods = (model_a.lod_max, model_b.lod_max), None
        if lods is not None and not isinstance(lods, str | os.PathLike) and np.shape(lods) == (2,):
            self.fixed = tuple(model.check_lod(lod) for model, lod in zip(self.models, np.asarray(lods).tolist()))
        elif lods is not None:
            self.lods = _Rows(lods, "lods", 2)
        self.poses = _Rows(poses, "poses", 7)
        self.count = self.poses.count
        if self.lods is not None and self.lods.count != self.count:
            raise ValueError(f"lods: {self.lods.count} given for {self.count} poses")
        asked = self.fixed if self.lods is None else self.lods.check(self._judge_lods)
        self._known = {
            "kind": "sweep",
            "count": self.count,
            "shard": self.shard,
            "models": [hash_model(model) for model in self.models],
            "poses": self.poses.check(_judge_poses),
            "lods": asked,
            "output": output,
            "precision": precision,
        }

    def _judge_lods(self, start, rows):
        top = np.array([model.lod_max for model in self.models])
        bad = np.flatnonzero(~((rows >= 0) & (rows <= top) & (rows == np.floor(rows))).all(1))
        if len(bad):
            raise ValueError(
                f"lods: those of pose {start + bad[0]} are {rows[bad[0]].tolist()}, "
                f"not whole numbers from 0 to {top.tolist()}"
            )

    def describe(self) -> dict:
        """Return all that the answers depend on, for JSON."""
        return self._known

    def item(self, start, stop):
        """Return what a worker is sent for a shard."""
        lods = None if self.lods is None else self.lods.read(start, stop).astype(np.int64)
        return start, self.poses.read(start, stop), lods

    def asker(self) -> "SweepAsker":
        """Return what a worker is sent once."""
        return SweepAsker(self.models, self.fixed, self.output, self.precision)


class SweepAsker:
    """Asks shards of a `SweepJob` on one device; pickled without what it keeps there."""

    def __init__(self, models, fixed, output, precision):
        self.models, self.fixed, self.output, self.precision = models, fixed, output, precision
        self._scene: Any = None  # a Scene once it is asked for

    def __getstate__(self):
        return {**vars(self), "_scene": None}

    def ask(self, item, device=None) -> dict:
        """Return the columns of a shard, arrays of one length."""
        start, poses, lods = item
        if lods is None and self.output != "contacts":
            options = {"output": self.output, "precision": self.precision, "device": device}
            (model_a, model_b), (lod_a, lod_b) = self.models, self.fixed
            found = sweep(model_a, model_b, poses, lod_a, lod_b, **options)
            return {self.output: found} if self.output != "faces" else _name_faces(found, start)
        parts = []
        room = self._make_scene(len(poses), device)
        for first in range(0, len(poses), room):
            part = slice(first, first + room)
            result = self._ask_scene(poses[part], None if lods is None else lods[part], room)
            if self.output in ("any", "count"):
                parts.append({self.output: getattr(result, self.output)})
                continue
            columns = _name_faces(result.faces, start + first)
            if self.output == "contacts":
                names = result.contacts.dtype.names[2:]
                columns |= {name: np.ascontiguousarray(result.contacts[name]) for name in names}
            parts.append(columns)
        return {name: np.concatenate([columns[name] for columns in parts]) for name in parts[0]}

    def _make_scene(self, count, device) -> int:
        """Make a scene with an A and a B for each of so many poses, unless there is one; return how many."""
        if self._scene is None:
            faces = sum(model.face_count for model in self.models)
            room = min(SCENE_POSES, count, max(1, STATE_BYTES // (BYTES_A_FACE * faces)))
            scene = Scene(device)
            for model, lod in zip(self.models, self.fixed):
                for _ in range(room):
                    scene.add(model, lod=lod)
            self._scene = scene
        return self._scene.object_count // 2

    def _ask_scene(self, poses, lods, room):
        """Ask up to `room` poses; objects without one stay where they are."""
        count = len(poses)
        placed = np.zeros((2 * room, 7))
        placed[:, 6] = 1.0
        placed[room : room + count] = poses
        self._scene.set_poses(placed)
        if lods is not None:
            levels = np.tile(lods[-1:], (room, 1))
            levels[:count] = lods
            self._scene.set_lods(levels.T.reshape(-1))
        pairs = np.arange(count)[:, None] + [0, room]
        return self._scene.intersect(pairs, output=self.output, precision=self.precision)


def _name_faces(faces, start) -> dict:
    return {"pose": faces[:, 0].astype(np.int64) + start, "face_a": faces[:, 1], "face_b": faces[:, 2]}


# Doing a job.


class ThisProcess:
    """Does the shards of a job here, on one device or several, a thread for each of these.

    Args:
        device: Warp device, or a list of them; None for Warp's default.
    """

    lost = 0

    def __init__(self, device=None):
        names = list(device) if isinstance(device, list | tuple) else [device]
        if not names:
            raise ValueError("device: an empty list")
        self.devices = [Scene(name).device for name in names]
        self.workers = len(self.devices)

    def ask(self, job, ranges):
        """Yield (start, stop, columns) of each range, once, in any order."""
        askers = [job.asker() for _ in self.devices]
        waiting = deque(ranges)

        def ask(k, part):
            item = job.item(*part)  # each thread reads what it asks
            with device_turn(self.devices[k]):
                return askers[k].ask(item, self.devices[k])

        # Kernels load on one thread at a time.
        for k in range(self.workers):
            if waiting:
                part = waiting.popleft()
                yield *part, ask(k, part)
        if self.workers == 1:
            while waiting:
                part = waiting.popleft()
                yield *part, ask(0, part)
            return
        threads = [ThreadPoolExecutor(1, thread_name_prefix="warp_abtree shard") for _ in askers]
        under_way: dict = {}
        before = wp.get_device()

        def feed(k):
            if waiting:
                part = waiting.popleft()
                under_way[threads[k].submit(ask, k, part)] = k, part

        try:
            for k in [*range(self.workers)] * 2:  # one at work, one ahead
                feed(k)
            while under_way:
                for answered in wait(under_way, return_when=FIRST_COMPLETED).done:
                    k, part = under_way.pop(answered)
                    feed(k)
                    yield *part, answered.result()
        finally:
            for thread in threads:
                thread.shutdown(cancel_futures=True)
            if wp.get_device() != before:  # threads share Warp's default
                wp.set_device(before)


def run_shards(job, out, file="npz", pool=None, progress=None) -> dict:
    """Do a job and write each shard as it comes; shards that are there already are checked and not done again.

    A shard that is damaged, cut short or altered is done again. Memory is that of a few shards, whatever the size of
    the job. One run at a time writes to a folder.

    Args:
        job: `SweepJob`, or `WorldsJob`.
        out: Folder to make, or to go on in.
        file: "npz", or "parquet", which needs pyarrow.
        pool: What does the shards: `RayPool`, or `ThisProcess` by default.
        progress: Called as progress("shards", done, total) after each, those found among them; before that as
            progress("check", done, total) after each that is found and read.

    Returns:
        A dict: shards, found (those that were there and whole), damaged (those that were there and done again), count,
        workers, and lost, workers that ended before their work.

    Raises:
        ValueError: The folder holds another job, a shard of another or something else; bad options. Nothing is written.
        OSError: A file cannot be read or written.
        RuntimeError: Work was lost again and again.
    """
    folder = ShardFolder(out, job, file)
    pool = ThisProcess() if pool is None else pool
    total, left = len(folder.left), folder.left
    folder.open(progress)
    found = done = total - len(left)
    if progress is not None:
        progress("shards", done, total)
    for start, stop, columns in pool.ask(job, list(left)) if left else ():
        if (start, stop) not in left:
            raise RuntimeError(f"shard {start} to {stop} was answered twice")
        folder.write(start, stop, columns)
        del left[start, stop]
        done += 1
        if progress is not None:
            progress("shards", done, total)
    if left:
        raise RuntimeError(f"{len(left)} of {total} shards were not answered")
    sweep_up(folder.path)
    about = {"shards": total, "found": found, "damaged": len(folder.damaged), "count": job.count}
    return {**about, "workers": pool.workers, "lost": pool.lost}
