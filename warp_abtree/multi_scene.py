"""`MultiScene`: a scene whose worlds are dealt to several devices of one machine.

A CPU is asked by worker processes, a GPU by a thread of this process. What objects there are, where they stand and at
which LODs is kept here, so that a worker that ends costs nothing but its start. What grows with the number of objects
or pairs is done in the parts, at the same time; here it is copied in whole pieces, where worlds and pairs follow each
other.
"""

import contextlib
import pickle
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks import to_numpy, whole_number
from warp_abtree.contact import contact_dtypes
from warp_abtree.cores import core_count
from warp_abtree.intersect import Result, check_request, check_within
from warp_abtree.scene import Scene, TreeState, check_poses
from warp_abtree.scene_part import SAME, MultiResult, ProcessPart, ThreadPart, are_sound, as_slice

# Cost of a candidate pair and of a triangle test in node tests (docs/scaling.md).
PAIR_COST, TRIANGLE_COST = 200.0, 5.0
# How uneven devices may be for the sake of worlds that follow each other.
UNEVEN = 1.01


def work_of(answer) -> np.ndarray:
    """Return the cost of each pair of an answer in node tests, float64 (p,)."""
    return PAIR_COST + answer["node_tests"] + TRIANGLE_COST * answer["triangle_tests"]


class _Split:
    """Pairs that were handed in, dealt to parts.

    Attributes:
        pairs: As they were checked.
        places: For each part that is asked the places of its own among them.
        sent: What each of these is sent: its pairs, or `SAME` once it has them.
        sure: Whether they were handed in twice: then they are asked at once, and compared while the parts work.
    """

    def __init__(self, given, pairs, places, sent):
        self.given, self.pairs, self.places, self.sent = given, pairs, places, sent
        self.sure = False

    def holds(self, given) -> bool:
        """Return whether pairs are these, or are taken to be until they are compared."""
        if self.given.dtype != given.dtype or self.given.shape != given.shape:
            return False
        if not self.sure:
            self.compare(given)
        return self.sure

    def compare(self, given):
        self.sure = np.array_equal(self.given, given)


class MultiScene:
    """A `Scene` over several devices: each has some of the worlds, and the objects of world -1.

    Answers are those of one scene, bit for bit, whatever the devices and however worlds are dealt. Every call waits for
    all devices. Pairs of two worlds, which a `Scene` answers where they are named, are refused here. Bad input is
    refused before anything is changed. Where a worker ends or a device fails, that is raised once; poses and LODs are
    as before the call, and the next one starts afresh.

    Args:
        devices: Warp devices, such as ["cuda:0", "cuda:1"] or ["cpu", "cpu"]; None is every GPU, or a CPU process for
            each core where there is none.
        processes: Whether each device is asked by a process of its own; None says so for CPUs, while GPUs are asked by
            threads. Processes import the script that started them: it needs `if __name__ == "__main__":`.
        cores: CPU cores of each process; None shares them evenly.

    Attributes:
        devices: Their names.
        seconds: Time that each device took for the last question, 0 where it was not asked [s].

    Raises:
        ValueError: No such device on this machine, or none at all.
    """

    def __init__(self, devices=None, processes=None, cores=None):
        if devices is None:
            devices = [d.alias for d in wp.get_cuda_devices()] or ["cpu"] * core_count()
        self.devices = [Scene(device).device.alias for device in devices]
        if not self.devices:
            raise ValueError("devices: none given")
        self._processes = processes
        self._cores = None if cores is None else whole_number(cores, "cores", 1, 2**16)
        self.seconds = [0.0] * len(self.devices)
        self._ledger = Scene("cpu")  # checks and keeps what is added; never asked
        self._carriers: list = []
        self._known: list[set] = []
        self._poses: np.ndarray | None = None  # of the last `set_poses`, not yet in the ledger
        self._spare: np.ndarray | None = None  # room for the next
        self._columns: tuple = ()
        self._split: _Split | None = None  # of the pairs that were given last
        self._last: tuple | None = None  # pairs, places, answers and parts of the last question
        self._cost: dict[int, float] | None = None
        self._speed = np.ones(len(self.devices))
        self._loaded: set = set()
        self._dealt = 0
        self._built = self._closed = self._rated = False

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __del__(self):
        with contextlib.suppress(Exception):
            self.close()

    def close(self):
        """Stop all workers; the scene can be asked nothing more."""
        self._closed = True
        self._drop()

    def _drop(self):
        carriers, self._carriers, self._built = self._carriers, [], False
        for carrier in carriers:
            carrier.stop()

    # Objects, as in a scene.

    @property
    def models(self) -> list:
        """Models in use, each once."""
        return self._ledger.models

    @property
    def object_count(self) -> int:
        """Objects added so far."""
        return self._ledger.object_count

    @property
    def lods(self) -> np.ndarray:
        """LOD of each object, int32 (n,)."""
        return self._ledger.lods

    def add(self, model, pose=(0, 0, 0, 0, 0, 0, 1), world=0, lod=None, importance=1, static=False) -> int:
        """Add an object and return its index; arguments and errors as `Scene.add`. Worlds are dealt at the next use."""
        self._keep_poses()
        index = self._ledger.add(model, pose, world, lod, importance, static)
        self._built = False
        return index

    def filter(self, pairs):
        """Exclude object pairs from every later broad phase; errors as `Scene.filter`."""
        self._ledger.filter(pairs)
        self._built = False

    def set_poses(self, poses):
        """Set the pose of every object; arguments and errors as `Scene.set_poses`."""
        if not self.object_count:
            raise ValueError("the scene has no object")
        poses = to_numpy(poses, "poses")
        if poses.shape not in ((self.object_count, 7), (self.object_count, 4, 4)):
            raise ValueError(f"poses: {len(check_poses(poses))} given for {self.object_count} objects")
        kept, self._spare = self._spare, None
        if kept is None or kept.shape != poses.shape:
            kept = np.empty(poses.shape)
        if self._built and not any(isinstance(carrier, ProcessPart) for carrier in self._carriers):
            sound = self._ask("copy_poses", {k: (poses, kept) for k, rows in enumerate(self._members) if len(rows)})
            if not all(sound.values()):
                self._ask("forget_poses", {k: () for k in sound})
                check_poses(kept)  # raises, and names the first
        else:
            kept[:] = poses
            if not are_sound(kept):
                check_poses(kept)
            if self._built:
                self._ask("stage", {k: (kept[as_slice(rows)],) for k, rows in enumerate(self._members) if len(rows)})
        self._poses, self._spare = kept, self._poses

    def _keep_poses(self):
        if self._poses is not None:
            self._ledger._added_pose, self._poses = list(self._poses), None

    def _arrays(self):
        """Return world and model of each object."""
        if not self._columns or len(self._columns[0]) != self.object_count:
            self._columns = np.array(self._ledger._world, np.int64), np.array(self._ledger.object_model, np.int64)
        return self._columns

    def set_lods(self, lods):
        """Bring every object to a LOD; arguments and errors as `Scene.set_lods`."""
        lods = to_numpy(lods, "lods")
        if lods.shape != (self.object_count,):
            raise ValueError(f"lods: shape {lods.shape} given for {self.object_count} objects")
        if not (lods == np.floor(lods)).all():
            raise ValueError(f"lods: type {lods.dtype} holds no whole numbers")
        top = np.array([model.lod_max for model in self.models])[self._arrays()[1]]
        bad = np.flatnonzero((lods < 0) | (lods > top))
        if len(bad):
            i = int(bad[0])
            raise ValueError(f"lods: object {i} asks for LOD {lods[i]}, outside 0 .. {top[i]}")
        lods = lods.astype(np.int64)
        if self._built:
            self._ask("set_lods", {k: (lods[rows],) for k, rows in enumerate(self._members) if len(rows)})
        self._ledger._lod = lods.tolist()

    # Worlds on devices.

    def balance(self) -> float:
        """Deal the worlds anew by the work and the time that the last `intersect` measured.

        Worlds that it did not ask cost as little as a pair. Objects move with their worlds at the next use.

        Returns:
            The time that is expected of the slowest device over the mean of all, 1 where they are even.

        Raises:
            ValueError: Nothing was measured yet, or objects were added since.
        """
        if self._last is None or self._dealt != self.object_count:
            raise ValueError("nothing is measured yet; call intersect first")
        pairs, places, answers = self._last[:3]
        world = np.concatenate([self._world[pairs[place]].max(1, initial=-1) for place in places])
        work = np.concatenate([work_of(answer) for answer in answers])
        worlds, inverse = np.unique(world, return_inverse=True)
        self._cost = dict(zip(worlds.tolist(), np.bincount(inverse, work, len(worlds)).tolist()))
        self._built = False
        times = self._deal()
        return float(times.max() / times.mean()) if times.any() else 1.0

    def _deal(self) -> np.ndarray:
        """Give worlds to devices and return the times that are expected of these.

        Each device gets worlds that follow each other, whose objects and pairs are then copied in one piece, or, where
        that is not even, each world goes to the device that would be done with it first, costly ones first.
        """
        self._take_rates()
        ledger = self._ledger
        world, model = self._arrays()
        self._world = world
        worlds, first, inverse = np.unique(world[world >= 0], return_index=True, return_inverse=True)
        if self._cost is None:
            keys, which = np.unique((model << 32) + np.array(ledger._lod), return_inverse=True)
            counts = [ledger.models[key >> 32].progressive.active_count(key & (2**32 - 1)) for key in keys.tolist()]
            active = np.array(counts)[which]
            cost = np.bincount(inverse, active[world >= 0], len(worlds))
        else:
            cost = np.array([self._cost.get(w, PAIR_COST) for w in worlds.tolist()])
        order = np.argsort(first)
        middle = np.cumsum(cost[order]) - cost[order] / 2
        ends = np.cumsum(self._speed) / self._speed.sum() * cost.sum()
        part = np.empty(len(worlds), int)
        part[order] = np.searchsorted(ends[:-1], middle)
        times = np.bincount(part, cost, len(self.devices)) / self._speed
        if times.max() > UNEVEN * cost.sum() / self._speed.sum():
            times = np.zeros(len(self.devices))
            for w in np.argsort(-cost, kind="stable"):
                part[w] = (times + cost[w] / self._speed).argmin()
                times[part[w]] += cost[w] / self._speed[part[w]]
        every = np.flatnonzero(world < 0)
        self._owner = owner = np.full(len(world), -1)  # -1 is everywhere
        owner[world >= 0] = part[inverse]
        self._members = []
        for k in range(len(self.devices)):
            own = np.flatnonzero(owner == k)
            self._members.append(np.union1d(own, every) if len(own) or k == 0 else own)
        return times

    def _start(self):
        if self._closed:
            raise RuntimeError("this MultiScene is closed")
        if not self.object_count:
            raise ValueError("the scene has no object")
        if self._carriers:
            return
        cpus = self.devices.count("cpu")
        carriers: list = []
        try:
            for device in self.devices:
                if self._processes or (self._processes is None and device == "cpu"):
                    share = max(1, core_count() // (cpus if device == "cpu" else len(self.devices)))
                    carriers.append(ProcessPart(device, self._cores or share))
                else:
                    carriers.append(ThreadPart(device))
        except BaseException:  # an interrupt
            for carrier in carriers:
                carrier.stop()
            raise
        self._carriers = carriers
        self._known = [set() for _ in self.devices]

    def _build(self):
        """Bring every part to where the scene stands."""
        self._start()
        if self._built:
            return
        if self.object_count != self._dealt:
            self._cost = None
        self._dealt = self.object_count
        self._deal()
        self._keep_poses()
        self._split = None
        ledger, packed, asked = self._ledger, {}, {}
        keys = ledger.excluded_keys()
        excluded = np.stack([keys >> 32, keys & (2**32 - 1)], 1)
        added = ledger._added_pose
        poses = np.array(added) if len({pose.shape for pose in added}) == 1 else added
        columns = [np.array(column) for column in (ledger.object_importance, ledger._static)]
        columns = [*self._arrays(), np.array(ledger._lod), *columns]
        for k, rows in enumerate(self._members):
            if not len(rows):
                continue
            world, number, *more = [column[rows] for column in columns]
            models = {}
            for m in sorted(set(number.tolist()) - self._known[k]):
                models[m] = ledger.models[m]
                if isinstance(self._carriers[k], ProcessPart):
                    packed.setdefault(m, pickle.dumps(ledger.models[m], protocol=5))
                    models[m] = packed[m]
            own = poses[rows] if isinstance(poses, np.ndarray) else [poses[i] for i in rows]
            inside = np.isin(excluded, rows).all(1)
            # The first answers for pairs of objects that are in every world.
            shared = world < 0 if k and (world < 0).sum() > 1 else None
            objects = (number, own, world, *more)
            asked[k] = models, rows, objects, np.searchsorted(rows, excluded[inside]), shared
        self._ask("build", asked)
        for k, (models, *_) in asked.items():
            self._known[k] |= set(models)
        self._built = True

    def _ask(self, name, asked, kind=(), meanwhile=None):
        """Ask parts, all at a time, and return their answers: all of them, or an error is raised.

        Args:
            meanwhile: What to call while they work.
        """
        turns = [list(asked)]
        new = [k for k in asked if (k, name, kind) not in self._loaded]
        if new and self._processes is not True:  # kernels load on one thread at a time
            turns = [[k] for k in new] + [[k for k in asked if k not in new]]
        before = wp.get_device()
        replies, k = {}, 0
        try:
            for turn in turns:
                for k in turn:
                    self._carriers[k].begin(name, asked[k])
                if meanwhile is not None and turn is turns[-1]:
                    meanwhile()
                for k in turn:
                    replies[k] = self._carriers[k].finish()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            code = self._carriers[k].exit_code()
            self._drop()
            raise RuntimeError(
                f"worker {k} on {self.devices[k]} ended with exit code {code}; nothing was changed, "
                'and the next call starts new workers (a script needs `if __name__ == "__main__":`)'
            ) from None
        except BaseException:  # an interrupt: answers that nobody waits for are under way
            self._drop()
            raise
        finally:
            if wp.get_device() != before:  # threads share Warp's default
                wp.set_device(before)
        for _, error, _ in replies.values():
            if error is not None:
                self._built = False  # others did what was asked
                raise error
        self._loaded.update((k, name, kind) for k in new)
        self.seconds = [replies[k][2] if k in replies else 0.0 for k in range(len(self.devices))]
        return {k: answer for k, (answer, _, _) in replies.items()}

    # Questions.

    def check_pairs(self, pairs) -> np.ndarray:
        """Return object pairs as int32 (p, 2).

        Raises:
            ValueError: As `Scene.check_pairs`, or a pair of two worlds, which may be on different devices.
        """
        pairs = self._ledger.check_pairs(pairs)
        a, b = self._arrays()[0][pairs.T]
        bad = np.flatnonzero((a != b) & (a >= 0) & (b >= 0))
        if len(bad):
            a, b = a[bad[0]], b[bad[0]]
            raise ValueError(f"pairs: pair {bad[0]} is of the worlds {a} and {b}; a MultiScene asks pairs of one world")
        return pairs

    def broad_phase(self) -> np.ndarray:
        """Return the object pairs whose posed root boxes overlap, as `Scene.broad_phase`."""
        if self.object_count < 2:
            return np.empty((0, 2), np.int32)
        self._build()
        asked = {k: () for k, rows in enumerate(self._members) if len(rows)}
        found = self._ask("broad_phase", asked)
        return self._merge_pairs(list(found.values()))[0]

    def _merge_pairs(self, found):
        """Return all pairs, sorted, and for each part the places of its own, which it has sorted."""
        pairs = np.concatenate(found)
        stops = np.cumsum([len(part) for part in found]).tolist()
        places: list = [slice(start, stop) for start, stop in zip([0, *stops], stops)]
        some = [part for part in found if len(part)]
        if any(part[-1].tolist() > after[0].tolist() for part, after in pairwise(some)):
            order = np.argsort((pairs[:, 0].astype(np.int64) << 32) + pairs[:, 1])
            rank = np.empty(len(pairs), np.int64)
            rank[order] = np.arange(len(pairs))
            pairs, places = pairs[order], [rank[place] for place in places]
        return pairs, places

    def _split_pairs(self, given):
        """Return the `_Split` of pairs that were handed in."""
        if self._built and self._split is not None and self._split.holds(given):
            return self._split
        pairs = self.check_pairs(given)
        self._build()
        part = np.maximum(self._owner[pairs[:, 0]], self._owner[pairs[:, 1]])
        part[part < 0] = 0
        places, sent = {}, {}
        number = np.empty(self.object_count, np.int32)
        for k, rows in enumerate(self._members):
            place = np.flatnonzero(part == k)
            if len(place) or (len(rows) and not places):  # one that has objects answers for none, too
                places[k] = as_slice(place)
                number[rows] = np.arange(len(rows))
                sent[k] = number[pairs[places[k]]]
        self._split = _Split(given.copy(), pairs, places, sent)
        return self._split

    def intersect(self, pairs=None, output="any", precision="exact", within=None, contact_dtype=np.float64) -> Result:
        """Test object pairs for intersection; arguments and errors as `Scene.intersect`, on pairs of one world.

        Returns:
            A `Result` in the order of the pairs, whose `pair`s in faces and contacts are those asked.

        Raises:
            RuntimeError: A worker ended.
        """
        contact_dtypes(contact_dtype)
        check_request("faces" if output == "contacts" else output, precision)
        if within is not None:
            within = to_numpy(within, "within")
            if pairs is None and within.ndim:
                pairs = self.broad_phase()
        given = None if pairs is None else to_numpy(pairs, "pairs")
        split: Any = None if given is None else self._split_pairs(given)
        if within is not None:
            within = check_within(within, None if split is None else len(split.pairs))
        if split is None:
            self._build()
            sent = {k: None for k, rows in enumerate(self._members) if len(rows)}
        else:
            sent = split.sent
        options, asked = (output, precision), {}
        for k, own in sent.items():
            near = within if within is None or within.ndim == 0 else within[split.places[k]]
            asked[k] = own, *options, near, contact_dtype
        guess = split is not None and split.sure
        meanwhile = partial(split.compare, given) if guess else None
        answers = list(self._ask("intersect", asked, (*options, within is None), meanwhile).values())
        if guess and not split.sure:
            return self.intersect(given, output, precision, within, contact_dtype)
        if split is None:
            pairs, places = self._merge_pairs([answer["pairs"] for answer in answers])
        else:
            pairs, places = split.pairs, list(split.places.values())
            split.sent = dict.fromkeys(split.places, SAME)  # parts keep what they were sent
        result = MultiResult(pairs, places, answers)
        counts = [{name: answer[name] for name in ("node_tests", "triangle_tests")} for answer in answers]
        self._last = pairs, places, counts, [(k, self.seconds[k]) for k in asked]
        self._rated = False
        result.check()
        return result

    def _take_rates(self):
        """Find the speed of devices from the last question."""
        if self._last is None or self._rated:
            return
        self._rated = True
        # Devices of one kind are as fast as each other: a rate of a few worlds is mostly that of a launch.
        kinds = [wp.get_device(device).name for device in self.devices]
        spent, done = dict.fromkeys(kinds, 0.0), dict.fromkeys(kinds, 0.0)
        for (k, seconds), answer in zip(self._last[3], self._last[2]):
            spent[kinds[k]] += seconds
            done[kinds[k]] += float(work_of(answer).sum())
        rates = {kind: done[kind] / spent[kind] for kind in spent if done[kind] > 0}
        mean = np.mean(list(rates.values())) if rates else 1.0
        self._speed = np.array([rates.get(kind, mean) / mean for kind in kinds])

    def tree_state(self, i) -> TreeState:
        """Return the AB-Tree of an object at its LOD; errors as `Scene.tree_state`."""
        i = whole_number(i, "object", 0, self.object_count - 1)
        self._build()
        k = next(k for k, rows in enumerate(self._members) if i in rows)
        return self._ask("tree_state", {k: (int(np.searchsorted(self._members[k], i)),)})[k]
