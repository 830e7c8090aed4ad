"""`MultiScene`: a scene whose worlds are dealt to several devices of one machine.

A CPU is asked by worker processes, a GPU by a thread of this process. What objects there are, where they stand and at
which LODs is kept here, so that a worker that ends costs nothing but its start.
"""

import contextlib
import pickle

import numpy as np
import warp as wp

from warp_abtree.checks import to_numpy, whole_number
from warp_abtree.contact import contact_dtypes
from warp_abtree.cores import core_count
from warp_abtree.intersect import COUNTERS, Result, check_request, check_within
from warp_abtree.scene import Scene, TreeState, check_poses
from warp_abtree.scene_part import ProcessPart, ThreadPart

# Cost of a candidate pair and of a triangle test in node tests (docs/scaling.md).
PAIR_COST, TRIANGLE_COST = 200.0, 5.0


def work_of(result) -> np.ndarray:
    """Return the cost of each pair of a result in node tests, float64 (p,)."""
    return PAIR_COST + result.node_tests + TRIANGLE_COST * result.triangle_tests


class MultiResult(Result):
    """What all parts found, as one `Result` in the order that was asked."""

    def __init__(self, pairs, places, answers):
        """Merge answers of parts.

        Args:
            pairs: All pairs, int32 (p, 2).
            places: For each part the place among them of each of its pairs, -1 for those that another part answers.
        """
        self.pairs = pairs
        p = len(pairs)
        for name in ("any", "count", "apart", "pair_contacts", *COUNTERS):
            setattr(self, name, None)
            if answers[0][name] is not None:
                merged = np.zeros(p, answers[0][name].dtype)
                for place, answer in zip(places, answers):
                    merged[place[place >= 0]] = answer[name][place >= 0]
                setattr(self, name, merged)
        self.faces = self.contacts = None
        if answers[0]["faces"] is not None:
            faces = [_move(answer["faces"], answer["faces"][:, 0], place) for answer, place in zip(answers, places)]
            rows = np.concatenate([rows for rows, _ in faces])
            rows[:, 0] = np.concatenate([pair for _, pair in faces])
            order = np.argsort(rows[:, 0], kind="stable")  # sorted within a pair already
            self.faces = rows[order]
            if answers[0]["contacts"] is not None:
                parts = [_move(answer["contacts"], answer["faces"][:, 0], at)[0] for answer, at in zip(answers, places)]
                self.contacts = np.concatenate(parts)[order]
                self.contacts["pair"] = self.faces[:, 0]
        self._pair_demand, self._pair_room = sum(int((place >= 0).sum()) for place in places), p
        self._unsure_room = 0  # parts have checked their own
        self._hit_demand = 0 if self.faces is None else int(self.count.sum())
        self._hit_room = 0 if self.faces is None else len(self.faces)


def _move(rows, pair, place):
    """Return the rows that are kept and the pairs they belong to among all."""
    pair = place[pair]
    return rows[pair >= 0], pair[pair >= 0]


class MultiScene:
    """A `Scene` over several devices: each has some of the worlds, and the objects of world -1.

    Answers are those of one scene, bit for bit, whatever the devices and however worlds are dealt. Every call waits for
    all devices. Bad input is refused before anything is sent. Where a worker ends or a device fails, that is raised
    once; poses and LODs are as before the call, and the next one starts afresh.

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
        self._last: tuple | None = None  # the pairs of the last question, and the cost of each
        self._cost: dict[int, float] | None = None
        self._speed = np.ones(len(self.devices))
        self._loaded: set = set()
        self._dealt = 0
        self._built = self._closed = False

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
        poses = check_poses(poses)
        if len(poses) != self.object_count:
            raise ValueError(f"poses: {len(poses)} given for {self.object_count} objects")
        if self._built:
            self._ask("set_poses", {k: (poses[rows],) for k, rows in enumerate(self._members) if len(rows)})
        self._poses = poses

    def _keep_poses(self):
        if self._poses is not None:
            self._ledger._added_pose, self._poses = list(self._poses), None

    def set_lods(self, lods):
        """Bring every object to a LOD; arguments and errors as `Scene.set_lods`."""
        lods = to_numpy(lods, "lods")
        if lods.shape != (self.object_count,):
            raise ValueError(f"lods: shape {lods.shape} given for {self.object_count} objects")
        if not (lods == np.floor(lods)).all():
            raise ValueError(f"lods: type {lods.dtype} holds no whole numbers")
        top = np.array([model.lod_max for model in self.models])[self._ledger.object_model]
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
        pairs, work = self._last
        worlds, inverse = np.unique(self._world[pairs].reshape(-1, 2).max(1, initial=-1), return_inverse=True)
        self._cost = dict(zip(worlds.tolist(), np.bincount(inverse, work, len(worlds)).tolist()))
        self._built = False
        times = self._deal()
        return float(times.max() / times.mean()) if times.any() else 1.0

    def _deal(self) -> np.ndarray:
        """Give each world to the device that would be done with it first, costly ones first; return expected times."""
        ledger = self._ledger
        world = self._world = np.array(ledger._world)
        worlds, inverse = np.unique(world[world >= 0], return_inverse=True)
        if self._cost is None:
            active = [
                ledger.models[m].progressive.active_count(lod) for m, lod in zip(ledger.object_model, ledger._lod)
            ]
            cost = np.bincount(inverse, np.array(active)[world >= 0], len(worlds))
        else:
            cost = np.array([self._cost.get(w, PAIR_COST) for w in worlds.tolist()])
        times, part = np.zeros(len(self.devices)), np.zeros(len(worlds), int)
        for w in np.argsort(-cost, kind="stable"):
            part[w] = (times + cost[w] / self._speed).argmin()
            times[part[w]] += cost[w] / self._speed[part[w]]
        every = np.flatnonzero(world < 0)
        self._owner = owner = np.full(len(world), -1)  # -1 is everywhere
        owner[world >= 0] = part[inverse]
        self._members = []
        for k in range(len(self.devices)):
            own = np.flatnonzero(owner == k)
            # The first answers for pairs of objects that are in every world.
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
        for device in self.devices:
            if self._processes or (self._processes is None and device == "cpu"):
                share = max(1, core_count() // (cpus if device == "cpu" else len(self.devices)))
                self._carriers.append(ProcessPart(device, self._cores or share))
            else:
                self._carriers.append(ThreadPart(device))
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
        ledger, packed, asked = self._ledger, {}, {}
        keys = ledger.excluded_keys()
        excluded = np.stack([keys >> 32, keys & (2**32 - 1)], 1)
        for k, rows in enumerate(self._members):
            if not len(rows):
                continue
            models = {}
            for m in sorted({ledger.object_model[i] for i in rows} - self._known[k]):
                models[m] = ledger.models[m]
                if isinstance(self._carriers[k], ProcessPart):
                    packed.setdefault(m, pickle.dumps(ledger.models[m], protocol=5))
                    models[m] = packed[m]
            columns = (ledger.object_model, ledger._added_pose, ledger._world, ledger._lod)
            more = (ledger.object_importance, ledger._static)
            objects = [tuple(column[i] for column in (*columns, *more)) for i in rows]
            inside = np.isin(excluded, rows).all(1)
            asked[k] = models, objects, np.searchsorted(rows, excluded[inside])
        self._ask("build", asked)
        for k, (models, _, _) in asked.items():
            self._known[k] |= set(models)
        self._built = True

    def _ask(self, name, asked, kind=()):
        """Ask parts, all at a time, and return their answers: all of them, or an error is raised."""
        turns = [list(asked)]
        if (name, kind) not in self._loaded and self._processes is not True:
            turns = [[k] for k in asked]  # kernels load on one thread at a time
        before = wp.get_device()
        replies, k = {}, 0
        try:
            for turn in turns:
                for k in turn:
                    self._carriers[k].begin(name, asked[k])
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
        self._loaded.add((name, kind))
        self.seconds = [replies[k][2] if k in replies else 0.0 for k in range(len(self.devices))]
        return {k: answer for k, (answer, _, _) in replies.items()}

    # Questions.

    def check_pairs(self, pairs) -> np.ndarray:
        """Return object pairs as int32 (p, 2).

        Raises:
            ValueError: As `Scene.check_pairs`, or a pair of two worlds, which may be on different devices.
        """
        pairs = self._ledger.check_pairs(pairs)
        world = np.array(self._ledger._world)[pairs].reshape(-1, 2)
        bad = np.flatnonzero((world[:, 0] != world[:, 1]) & (world >= 0).all(1))
        if len(bad):
            a, b = world[bad[0]]
            raise ValueError(f"pairs: pair {bad[0]} is of the worlds {a} and {b}; a MultiScene asks pairs of one world")
        return pairs

    def broad_phase(self) -> np.ndarray:
        """Return the object pairs whose posed root boxes overlap, as `Scene.broad_phase`."""
        if self.object_count < 2:
            return np.empty((0, 2), np.int32)
        self._build()
        asked = {k: () for k, rows in enumerate(self._members) if len(rows)}
        found = self._ask("broad_phase", asked)
        return self._merge_pairs(found)[0]

    def _merge_pairs(self, found):
        """Return all pairs, sorted, and for each part the places of its own, -1 where the first answers."""
        everywhere = self._world < 0
        named, kept = [], []
        for k, pairs in found.items():
            named.append(self._members[k][pairs].reshape(-1, 2))
            kept.append(~everywhere[named[-1]].all(1) if k else np.ones(len(pairs), bool))
        rows = np.concatenate([pairs[keep] for pairs, keep in zip(named, kept)]).astype(np.int32)
        order = np.lexsort((rows[:, 1], rows[:, 0]))
        rank = np.empty(len(rows), np.int64)
        rank[order] = np.arange(len(rows))
        places, start = [], 0
        for keep in kept:
            place = np.full(len(keep), -1)
            place[keep] = rank[start : start + keep.sum()]
            start += int(keep.sum())
            places.append(place)
        return rows[order], places

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
        if pairs is not None:
            pairs = self.check_pairs(pairs)
        if within is not None:
            within = check_within(within, None if pairs is None else len(pairs))
        self._build()
        options = (output, precision)
        asked, places = {}, []
        if pairs is None:
            for k, rows in enumerate(self._members):
                if len(rows):
                    asked[k] = (None, *options, within, contact_dtype)
        else:
            part = np.maximum(self._owner[pairs].reshape(-1, 2).max(1, initial=-1), 0)
            for k, rows in enumerate(self._members):
                place = np.flatnonzero(part == k)
                if len(place) or k == 0:  # one answers for none, too
                    near = within if within is None or within.ndim == 0 else within[place]
                    asked[k] = (np.searchsorted(rows, pairs[place]), *options, near, contact_dtype)
                    places.append(place)
        answers = self._ask("intersect", asked, (*options, within is None))
        if pairs is None:
            pairs, places = self._merge_pairs({k: answer["pairs"] for k, answer in answers.items()})
        result = MultiResult(pairs, places, list(answers.values()))
        self._measure(result, list(answers), places)
        result.check()
        return result

    def _measure(self, result, parts, places):
        work = work_of(result)
        self._last = result.pairs, work
        # Devices of one kind are as fast as each other: a rate of a few worlds is mostly that of a launch.
        kinds = [wp.get_device(device).name for device in self.devices]
        spent, done = dict.fromkeys(kinds, 0.0), dict.fromkeys(kinds, 0.0)
        for k, at in zip(parts, places):
            spent[kinds[k]] += self.seconds[k]
            done[kinds[k]] += float(work[at[at >= 0]].sum())
        rates = {kind: done[kind] / spent[kind] for kind in spent if done[kind] > 0}
        mean = np.mean(list(rates.values())) if rates else 1.0
        self._speed = np.array([rates.get(kind, mean) / mean for kind in kinds])

    def tree_state(self, i) -> TreeState:
        """Return the AB-Tree of an object at its LOD; errors as `Scene.tree_state`."""
        if not 0 <= i < self.object_count:
            raise ValueError(f"object {i} is outside 0 .. {self.object_count - 1}")
        self._build()
        k = next(k for k, rows in enumerate(self._members) if i in rows)
        return self._ask("tree_state", {k: (int(np.searchsorted(self._members[k], i)),)})[k]
