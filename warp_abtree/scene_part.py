"""The parts of a `MultiScene`: a scene a device, in a process or a thread that does what it is told; what they answer.

What takes time for each object or pair is done here, in large pieces that let other threads run.
"""

import contextlib
import multiprocessing
import pickle
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.intersect import COUNTERS, Query, Result
from warp_abtree.kernels import pose as pose_kernels
from warp_abtree.scene import QUATERNION_TOLERANCE, Scene, check_poses
from warp_abtree.turns import device_turn

# What of a result goes back: an entry a pair, then an entry a face pair.
PAIR_FIELDS = ("any", "count", "pair_contacts", "apart", *COUNTERS)
FIELDS = (*PAIR_FIELDS, "faces", "contacts")
# Asks the pairs that were given last once more.
SAME = "same"
# Pieces in which objects are copied one after the other; more of them are picked one by one.
RUNS_MAX = 16


def find_runs(rows) -> list | None:
    """Return rising indices as slices, or None where these would be many."""
    if not len(rows):
        return [slice(0, 0)]
    ends = np.flatnonzero(np.diff(rows) != 1) + 1
    if len(ends) >= RUNS_MAX:
        return None
    starts = [0, *ends.tolist()]
    return [slice(int(rows[a]), int(rows[b - 1]) + 1) for a, b in zip(starts, [*starts[1:], len(rows)])]


def as_slice(rows):
    """Return rising indices as a slice where they follow each other, else as they are."""
    runs = find_runs(rows)
    return runs[0] if runs is not None and len(runs) == 1 else rows


def are_sound(poses) -> bool:
    """Return whether `check_poses` takes float64 poses, most of the time without its cost."""
    if poses.ndim == 2 and len(poses):
        square = np.einsum("ij,ij->i", poses[:, 3:], poses[:, 3:])
        near = 0.9 * QUATERNION_TOLERANCE  # rounding is far less than the rest
        if square.min() >= (1 - near) ** 2 and square.max() <= (1 + near) ** 2 and np.isfinite(poses).all():
            return True
    try:
        check_poses(poses)
    except ValueError:
        return False
    return True


class _Part:
    """The objects of one device: what a process or a thread is asked."""

    def __init__(self, device):
        self.device = device
        self.models: dict = {}
        self.scene: Any = None  # a Scene once it is built

    def build(self, models, rows, columns, excluded, shared):
        """Make the scene anew.

        Args:
            models: Those that are not yet here, by number.
            rows: Which objects of all these are, rising.
            columns: Model, pose, world, LOD, importance and static of each.
            excluded: Pairs of these objects to filter.
            shared: Which of these are in every part that asks for them before this one does, or None.
        """
        for key, model in models.items():
            self.models[key] = pickle.loads(model) if isinstance(model, bytes) else model
        self.scene = self._staged = self._pairs = self._own = None  # their memory first
        number, poses, world, lod, importance, static = columns
        scene = Scene(self.device)
        used, number = np.unique(number, return_inverse=True)
        scene.models = [self.models[key] for key in used.tolist()]
        scene.object_model, scene.object_importance = number.tolist(), importance.tolist()
        scene._world, scene._static, scene._lod = world.tolist(), static.tolist(), lod.tolist()
        scene._added_pose = list(poses)
        if len(excluded):
            scene.filter(excluded)
        scene.arrays()
        self._rows, self._runs, self._shared = rows.astype(np.int32), find_runs(rows), shared
        self.scene = scene

    def copy_poses(self, poses, kept):
        """Copy the poses of these objects from those of all, and stage them; return whether they are sound."""
        self._place()
        if self._runs is None:
            own = poses[self._rows].astype(np.float64)
            kept[self._rows] = own
        else:
            for run in self._runs:
                kept[run] = poses[run]
            own = kept[self._runs[0]]
            if len(self._runs) > 1:
                if self._own is None or self._own.shape[1:] != kept.shape[1:]:
                    self._own = np.empty((len(self._rows), *kept.shape[1:]))
                own = np.concatenate([kept[run] for run in self._runs], out=self._own)
        sound = are_sound(own)
        if sound:
            self.stage(own)
        return sound

    def stage(self, poses):
        """Bring sound poses to the device; objects take them at the next question, unless `forget_poses` comes first.

        So no part has moved an object where another one refuses its poses.
        """
        self._place()
        self._staged = wp.array(poses, dtype=wp.float64, device=self.device) if poses.ndim == 2 else poses.copy()

    def forget_poses(self):
        self._staged = None

    def _place(self):
        """Put objects where the staged poses are."""
        staged, self._staged = self._staged, None
        if isinstance(staged, wp.array):
            inputs = [staged, self.scene.arrays()[2].pool]
            wp.launch(pose_kernels.set_pose_kernel, len(staged), inputs, device=self.device)
        elif staged is not None:
            self.scene.set_poses(staged)

    def set_lods(self, lods):
        self.scene.set_lods(lods)

    def tree_state(self, i):
        return self.scene.tree_state(i)

    def _name(self, pairs):
        """Return the pairs as those of all objects, and which of them are answered here, None for all."""
        kept = None
        if self._shared is not None:
            kept = ~(self._shared[pairs[:, 0]] & self._shared[pairs[:, 1]])
            pairs = pairs[kept]
        return self._rows[pairs], kept

    def broad_phase(self):
        self._place()
        return self._name(self.scene.broad_phase())[0]

    def intersect(self, pairs, *options):
        """Return what was found; pairs of the broad phase are named as those of all objects."""
        self._place()
        if isinstance(pairs, str):
            pairs = self._pairs
        elif pairs is not None:
            self._pairs = pairs
        result = self.scene.intersect(pairs, *options)
        answer = {name: getattr(result, name) for name in FIELDS}
        answer["pairs"] = None
        if pairs is None:
            answer["pairs"], kept = self._name(result.pairs)
            if kept is not None:
                _drop(answer, kept)
        return answer


def _drop(answer, kept):
    """Take pairs out of an answer."""
    for name in PAIR_FIELDS:
        if answer[name] is not None:
            answer[name] = answer[name][kept]
    if answer["faces"] is not None:
        rows = kept[answer["faces"][:, 0]]
        for name in ("faces", "contacts"):
            if answer[name] is not None:
                answer[name] = answer[name][rows]
        answer["faces"][:, 0] = (np.cumsum(kept) - 1)[answer["faces"][:, 0]]


def _answer(part, name, arguments):
    """Return (answer, error, seconds) of a call."""
    begin = time.perf_counter()
    try:
        return getattr(part, name)(*arguments), None, time.perf_counter() - begin
    except Exception as error:
        return None, error, time.perf_counter() - begin


def _serve(connection, device, cores):
    """Answer calls until the other end goes away."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for the parent, which stops its workers
    wp.config.log_level = wp.LOG_WARNING
    Query.cores = cores
    part = _Part(device)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            answer, error, seconds = _answer(part, *connection.recv())
            if error is not None:
                try:
                    pickle.loads(pickle.dumps(error))
                except Exception:  # of a library, with arguments of its own
                    error = RuntimeError(f"{type(error).__name__}: {error}")
            connection.send((answer, error, seconds))


class ProcessPart:
    """A part in a process of its own."""

    def __init__(self, device, cores):
        context = multiprocessing.get_context("spawn")  # neither Warp nor CUDA survives a fork
        self.connection, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, device, cores), daemon=True)
        self.process.start()
        far.close()

    def begin(self, name, arguments):
        self.connection.send((name, arguments))

    def finish(self):
        return self.connection.recv()

    def exit_code(self):
        self.process.join(1.0)
        return self.process.exitcode

    def stop(self):
        self.connection.close()  # which ends it, unless it is at work
        self.process.terminate()
        self.process.join()


class ThreadPart:
    """A part in a thread of this process."""

    def __init__(self, device):
        self.part = _Part(device)
        self.pool = ThreadPoolExecutor(1, thread_name_prefix="warp_abtree part")

    def begin(self, name, arguments):
        self.job = self.pool.submit(self._answer, name, arguments)

    def _answer(self, name, arguments):
        with device_turn(wp.get_device(self.part.device)):
            return _answer(self.part, name, arguments)

    def finish(self):
        return self.job.result()

    def stop(self):
        self.pool.shutdown()


# Their answers as one.


class MultiResult(Result):
    """What all parts found, as one `Result` in the order that was asked; pairs and counters are merged once read."""

    def __init__(self, pairs, places, answers):
        """Merge answers of parts.

        Args:
            pairs: All pairs, int32 (p, 2); left as they are.
            places: For each part the places among them of its pairs, indices or a slice.
        """
        self._parts = pairs, places, [{name: answer[name] for name in COUNTERS} for answer in answers]
        for name in ("any", "count", "apart", "pair_contacts"):
            held = answers[0][name] is not None
            setattr(self, name, _merge(len(pairs), places, answers, name) if held else None)
        self.faces = self.contacts = None
        self._pair_demand = self._pair_room = len(pairs)
        self._unsure_room = 0  # parts have checked their own
        self._hit_demand = self._hit_room = 0
        if answers[0]["faces"] is not None:
            self._merge_rows(places, answers)
            self._hit_demand, self._hit_room = int(self.count.sum()), len(self.faces)

    def _merge_rows(self, places, answers):
        self.faces = np.concatenate([answer["faces"] for answer in answers])
        named = []
        for place, answer in zip(places, answers):
            own = answer["faces"][:, 0]
            named.append(own + place.start if isinstance(place, slice) else place[own])
        self.faces[:, 0] = pair = np.concatenate(named)
        if answers[0]["contacts"] is not None:
            self.contacts = np.concatenate([answer["contacts"] for answer in answers])
        if (np.diff(pair) < 0).any():
            order = np.argsort(pair, kind="stable")  # sorted within a pair already
            self.faces = self.faces[order]
            self.contacts = None if self.contacts is None else self.contacts[order]
        if self.contacts is not None:
            self.contacts["pair"] = self.faces[:, 0]

    def __getattr__(self, name):
        if name not in ("pairs", *COUNTERS):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        pairs, places, answers = self._parts
        setattr(self, name, pairs.copy() if name == "pairs" else _merge(len(pairs), places, answers, name))
        return getattr(self, name)

    def check(self):
        if self._hit_demand > self._hit_room:
            super().check()


def _merge(count, places, answers, name) -> np.ndarray:
    merged = np.empty(count, answers[0][name].dtype)
    for place, answer in zip(places, answers):
        merged[place] = answer[name]
    return merged
