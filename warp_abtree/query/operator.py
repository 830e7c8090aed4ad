"""Operator of queries about object pairs: its pairs and their buffers, replaced whole or not at all, and its stages.

A launch runs the broad phase, unless pairs are given, then what each stage searches, in their order, and then what each
stage reports of the hits. Where a buffer was too small, `run` makes room and searches again before anything is
reported.
"""

from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, flag
from warp_abtree.checks.cpu_threads import core_count, cores_for
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.kernel_loading import loading
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.query.broad_phase import BroadPhase, PosedBoxes
from warp_abtree.query.commands import Commands
from warp_abtree.query.readout import Readout, operator_kernels
from warp_abtree.query.request import LIST_MAX, check_capacity, check_pair_room, more_room
from warp_abtree.query.result import Found, Result
from warp_abtree.query.stage import Array, PairDistance, Rooms, Stage
from warp_abtree.state.batch import Batch, scene_or_batch
from warp_abtree.state.generation import LaunchGuard

# Face pairs that the float32 stage leaves uncertain: about one in a hundred. The list grows as needed.
UNCERTAIN_ROOM = 65536


class Operator(DeviceMemory):
    """Base of operators: allocates once, launches many times.

    Args:
        scene: `Scene` or `Batch`.
        stages: In the order in which they are launched; the first that has `hits` is what the others go on from.
        pairs, capacity, sort_pairs: As for `Query`.
        output: What `Query` calls so, "faces" where hits are listed.

    Attributes:
        batch, device, regime: What it is about, and where and how it launches.
        pair_batch: `PairBatch` of the pairs queried.
        hits: Device arrays of the last launch, `kernels.intersect.face_pairs.Hits`.
        counts: Counters of `hits`, device int64; rows: count, then `COUNTERS`.
        traversal: `Traversal` of the hits, which stages share.
        lists_hits: Whether a result has the hits as rows, which are sorted while the host still launches.
        given: Pairs on the host, int32 (p, 2), unless the broad phase finds them.
        commands, guard: Its recorded launches, and what became of them.
        growth: Room that `run` makes, over the demand.
    """

    growth = 1
    broad_phase: Any = None
    near: Any = None
    hits: Any
    lists_apart = False  # whether warps list all face pairs that are apart and may be near
    parts: Any = None  # `PointParts` where parts of the pairs take turns in lists of their own
    counts: wp.array
    traversal: Any
    lists_hits = False
    given: Any = None

    def __init__(self, scene, stages: list[Stage], pairs=None, capacity=None, output="any", sort_pairs=False):
        check_device(scene_or_batch(scene).device, f"making a {type(self).__name__}")
        room, sort_pairs = check_capacity(capacity), flag(sort_pairs, "sort_pairs")
        self.device, self.regime, self.stages, self.output = scene.device, current_regime(), stages, output
        self.lanes = WARP_SIZE if self.device.is_cuda else 1  # threads of a warp
        with loading(self.device, operator_kernels(self.device, stages, output)):
            self.batch = batch = scene if isinstance(scene, Batch) else scene.batch()
            if self.uses_warps() and self.regime.slabs:
                batch.make_slabs()
        if pairs is not None:
            self.given = batch.check_pairs(pairs)
        self._torn = False
        self.commands = Commands()
        filtered = batch.filter_generation if pairs is None else None
        self.guard = LaunchGuard(self.device, batch.states.generation, filtered)
        self.pair_batch = PairBatch()
        self.pair_batch.launched = self.guard.launched
        self._attach_stages()
        places = self._find_places(room.pairs, sort_pairs)
        self.readout = Readout(self)
        uncertain = (room.uncertain or UNCERTAIN_ROOM) if self.uses_warps() else 0
        usual = 0 if self.broad_phase is None or room.pairs else self.broad_phase.usual_room
        hits = (room.hits or max(1024, 16 * max(places, usual))) if output == "faces" else 0
        self.rooms = Rooms()
        self.make_room(places, hits, uncertain)

    def _attach_stages(self):
        """Give the stages this operator, and check the distances that they were given."""
        for stage in self.stages:
            stage.attach(self)
        # Of stages that have one, looked up once: a call of the host takes some 40 us.
        self._searches, self._reports, self.readers, self._fitted = (
            [getattr(stage, name) for stage in self.stages if getattr(type(stage), name) is not getattr(Stage, name)]
            for name in ("search", "report", "read", "fits_states")
        )
        given = [stage.distance for stage in self.stages if stage.distance is not None]
        self._distances: dict[str, PairDistance] = {distance.name: distance for distance in given}
        for distance in given:
            if distance.value is not None:
                distance.value = distance.check(None, None if self.given is None else len(self.given))

    def _find_places(self, room: int | None, sort_pairs: bool) -> int:
        """Make the broad phase, unless pairs are given, and return how many pairs there is to be room for."""
        asked, batch = self.pair_batch, self.batch
        if self.given is not None:
            asked.count = wp.zeros(1, dtype=wp.int32, device=self.device)
            return max(room or 0, len(self.given))
        self._excluded_count = len(batch.excluded)
        boxes = PosedBoxes(batch)
        for stage in self.stages:
            boxes = stage.boxes(boxes)
        self.broad_phase = BroadPhase(batch, room, sort_pairs, boxes, self.guard)
        asked.count, asked.pairs = self.broad_phase.pair_count, self.broad_phase.pairs
        return len(asked.pairs)

    @property
    def pairs(self) -> wp.array:
        """Return the pairs queried, device vec2i, as many as there is room for."""
        return self.pair_batch.pairs

    @property
    def pair_count(self) -> wp.array:
        """Return how many pairs there are, device int32 (1,)."""
        return self.pair_batch.count

    @property
    def pair_poses(self) -> wp.array:
        """Return the pose of each pair, device `PairPose`."""
        return self.pair_batch.poses

    def uses_warps(self) -> bool:
        """Return whether warps work on the pairs; on the CPU each thread takes one pair after the other."""
        return self.regime.uses_warps(self.device)

    def threads(self, pairs: int) -> int:
        """Return how many threads of the CPU have memory of their own, for so many pairs; none where warps work."""
        return 0 if self.uses_warps() else min(pairs, self.regime.cpu_threads or core_count())

    def cores(self, least: int, threads: int) -> int:
        """Return how many cores share a launch, of so many pairs each at least; one where warps do, or for a graph."""
        if self.uses_warps() or self.device.is_capturing:
            return 1
        return cores_for(self.rooms.pairs, least, threads)

    def _make(self, rooms: Rooms) -> list:
        """Return (owner, attribute, new array) of all that other rooms take, before anything is replaced."""
        check_pair_room(rooms.pairs)
        for stage in self.stages:
            stage.prepare(rooms)
        asked = [Array(self.pair_batch, "poses", PairPose, rooms.pairs)]
        if self.broad_phase is None:
            asked.append(Array(self.pair_batch, "pairs", wp.vec2i, rooms.pairs))
        asked += [array for stage in self.stages for array in stage.arrays(rooms)]
        made = [(array.owner, array.name, array.make(self.device)) for array in asked if not array.is_in_place()]
        if self.broad_phase is not None and rooms.pairs != len(self.broad_phase.pairs):
            found = self.broad_phase.make_arrays(rooms.pairs)
            pairs = next(array for _, name, array in found if name == "pairs")
            made += [*found, (self.pair_batch, "pairs", pairs)]
        return made

    def make_room(self, pairs: int | None = None, hits: int | None = None, uncertain: int | None = None):
        """Make room for other numbers of entries, None for those of before: for all, or nothing changes.

        Raises CapacityError for more than there can be room for.
        """
        asked = zip((pairs, hits, uncertain), self.rooms, strict=True)
        rooms = Rooms(*(now if wanted is None else wanted for wanted, now in asked))
        self._replace(self._make(rooms), rooms)

    @property
    def list_rooms(self) -> Rooms:
        """Return the room of the lists that hits are found in."""
        return self.rooms

    def make_list_room(self, hits: int | None = None, uncertain: int | None = None):
        """Make room for lists of which so much was needed, and some to spare."""
        spare = None if hits is None else self.growth * hits
        self.make_room(hits=spare, uncertain=None if uncertain is None else more_room(uncertain))

    def _replace(self, made: list, rooms: Rooms):
        """Put new arrays, (owner, attribute, array), in the place of old ones."""
        self.guard.buffers.advance()
        with self.changing():
            self.commands = Commands()  # those recorded would keep the old ones
            for owner, name, array in made:
                setattr(owner, name, array)
            has_other_pairs, self.rooms = rooms.pairs != self.rooms.pairs, rooms
            for stage in self.stages:
                stage.link()
            self.readout.link()
            if has_other_pairs:
                if self.broad_phase is None:
                    self.readout.write_pairs(self.given)
                for distance in self._distances.values():
                    distance.fill()

    @contextmanager
    def changing(self):
        """Refuse the operator for good where a change of what belongs together is interrupted."""
        before, self._torn = self._torn, True
        yield
        self._torn = before

    def check_whole(self):
        """Raise RuntimeError where a change of buffers was interrupted."""
        if self._torn:
            raise RuntimeError("this query was interrupted while its buffers changed; make a new one")

    def distances_of(self, name: str) -> wp.array:
        """Return the distances of pairs of a name, such as "within", device float64 (pair capacity,)."""
        return self._distances[name].rows

    def set_pairs(self, pairs, within=None):
        """Query other pairs from now on, in the room there is if they fit; within None keeps the distances.

        Raises:
            ValueError: Bad pairs or distances, a query that runs the broad phase, or distances for one made without.
        """
        self.ask_pairs(pairs, within=within)

    def ask_pairs(self, pairs, **distances):
        """Do what `set_pairs` does, with distances by their names; those of None stay."""
        if self.broad_phase is not None:
            raise ValueError("this query takes its pairs from the broad phase")
        check_device(self.device, "giving a query other pairs")
        self.check_whole()
        pairs = self.batch.check_pairs(pairs)
        for name, value in distances.items():
            if value is not None and name not in self._distances:
                raise ValueError(f"this query was made without {name}")
        checked = {name: taken.check(distances.get(name), len(pairs)) for name, taken in self._distances.items()}
        self.replace_pairs(pairs, **checked)

    def replace_pairs(self, pairs: np.ndarray, **distances):
        """Do what `ask_pairs` does, with pairs and distances that are checked; those left out stay."""
        self.check_whole()
        # What may fail for lack of memory comes before anything that changes the query.
        rooms = Rooms(max(len(pairs), self.rooms.pairs), *self.rooms[1:])
        made = self._make(rooms) if rooms != self.rooms else []
        with self.changing():
            if made:
                self._replace(made, rooms)
            self.guard.forget()
            self.readout.write_pairs(pairs)
            self.given = pairs
            for name, value in distances.items():
                self._distances[name].value = value
            for distance in self._distances.values():
                distance.fill()

    def is_asked(self, pairs: np.ndarray, **distances) -> bool:
        """Return whether pairs and distances, checked, None without, are those in place."""
        same = len(pairs) == len(self.given) and pairs.tobytes() == self.given.tobytes()
        for name, value in distances.items():
            now: Any = None if value is None else self._distances[name].value
            same = same and (value is now or np.array_equal(value, now))
        return same

    def launch(self, between=None):
        """Run broad phase (unless pairs were given), `between`, as to time them, and narrow phase. Launches only.

        Raises:
            RuntimeError: The scene's objects changed since the query was made, or its filter where the broad phase
                runs; or a change of the query's buffers was interrupted.
        """
        self.check_scene()
        with self.guard.launching(self):
            self.launch_search(between)
            self.report()

    def launch_search(self, between=None):
        """Launch the broad phase and what the stages search."""
        if self.broad_phase is not None:
            self.broad_phase.launch()
        if between is not None:
            between()
        self.search()

    def search(self):
        """Search the pairs in place. Launches only, after making room for tree states that are new."""
        if self.rooms.pairs:
            self.fit_states()
            for search in self._searches:
                search()

    def fit_states(self):
        """Make room for tree states that are new, unless a graph is being captured."""
        if self._fitted and not self.device.is_capturing and not all(fits() for fits in self._fitted):
            self.make_room()

    def report(self, count: int | None = None):
        """Compute further outputs of the hits, of which there are so many; None: all that have room. Launches only."""
        if self.rooms.pairs:
            for report in self._reports:
                report(count)

    def is_filtered(self) -> bool:
        """Return whether pairs were filtered out of the scene that the broad phase would find."""
        return self.broad_phase is not None and len(self.batch.excluded) > self._excluded_count

    def check_scene(self):
        """Raise RuntimeError where the scene is another one, or a graph is being captured."""
        check_device(self.device)
        self.check_whole()
        self.batch.check("query")
        if self.is_filtered():
            raise RuntimeError("pairs were filtered out of the scene since this query was made; make a new one")

    def find_launches(self, name: str, make, *given) -> list:
        """Return the launches that `make` lists, as callables, recorded while arrays and what is given stand."""
        # The generations are brought up to date first: kernels read the record.
        return self.commands.find_callables(name, (*self.guard.given(), *given), self.device, make)

    def launch_all(self, name: str, make):
        """Launch what `make` lists, in this order, see `Commands.find`; into a graph, too."""
        for launch in self.find_launches(name, make):
            launch()

    def launch_kernel(self, kernel, dim: int | tuple, inputs: list, block_dim=256, given: tuple = ()):
        """Launch a kernel, recorded until the arrays are replaced, or dim or what else is given changes."""

        def make(launch):
            return [launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)]

        for launch in self.find_launches(kernel.key, make, dim, *given):
            launch()

    def launch_warps(self, kernel, count: int, inputs: list):
        """Launch a kernel with a warp for each of so many items, on the CPU a thread."""
        self.launch_kernel(kernel, count * self.lanes, inputs, WARP_SIZE)

    def result(self, device: bool = False) -> Result:
        """Return the results of the last launch, sorted; on the device, as arrays that no later launch changes. Waits.

        Raises:
            RuntimeError: There are none: nothing was launched, a launch was interrupted, or it was the replay of a
                graph whose arrays were replaced.
        """
        return self.readout.read(device)

    def run(self, device: bool = False) -> Result:
        """Launch, grow buffers that were too small, and return the whole result, as `result`. Waits for the device."""
        read, device = self.readout, flag(device, "device")
        first = partial(read.launch_and_bring, self.launch_search) if read.repeats_calls(device) else None
        result = read.make_result(self._grow(partial(read.read_pairs, device), first=first), device)
        result.check()
        return result

    def grow(self, between=None):
        """Launch as `launch` does, and again with more room until nothing is lost. Waits for the device.

        Raises:
            CapacityError: More pairs or hits than there can be room for.
            RuntimeError: As `launch`; or a graph is being captured.
        """
        self._grow(self.readout.read_demand, between)

    def _grow(self, read, between=None, first=None) -> Found:
        """Launch as `grow` and return what `read` finds of the last launch; `first` does both the first time."""
        check_device(self.device, f"{type(self).__name__}.run (launch can)")
        self.check_scene()
        with self.guard.launching(self):
            if first is None:
                self.launch_search(between)
            found = read() if first is None else first()
            if found.totals.pairs > self.rooms.pairs:
                self.make_room(pairs=self.growth * found.totals.pairs)
                self.launch_search()
                found = read()
            found = self._grow_uncertain(read, found)
            while found.totals.hits > self.list_rooms.hits:
                self.make_list_room(hits=found.totals.hits)
                self.search()
                found = self._grow_uncertain(read, read())  # parts may have a shorter list
            self.report(found.totals.hits)
        return found

    def grow_uncertain(self):
        """Make room for the face pairs that wait, as far as there can be, and launch again until all find it."""
        first = self.readout.read_demand()
        if self._grow_uncertain(self.readout.read_demand, first) is not first:
            self.report()

    def _grow_uncertain(self, read, found: Found) -> Found:
        # How many wait varies for `any`, where the first hit of a pair ends its traversal.
        while 0 < self.list_rooms.uncertain < min(LIST_MAX, found.totals.uncertain):
            # Most hits are known by now: lists that serve parts of the pairs are not made for all of them first.
            hits = found.totals.hits if found.totals.hits > self.list_rooms.hits else None
            self.make_list_room(hits=hits, uncertain=found.totals.uncertain)
            self.search()
            found = read()
        return found
