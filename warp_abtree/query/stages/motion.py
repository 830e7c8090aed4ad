"""First contacts of moving objects, continuous collision detection (CCD): `FirstContactQuery`.

In unit time each object goes from its pose in the scene to an end pose: its frame's origin on a straight line at
constant speed, turning at constant angular velocity, the shortest way; or on a screw, along whose axis the object moves
as it turns about it, at constant speed; straight where it turns by less than 2^-19 rad. Or each vertex on a straight
line, at constant speed, from one posed mesh to the other. For each object pair:

* time, from 0 to 1: the surfaces, at their LODs, are proved apart at all earlier times, for the motion as real numbers
  and all rounding (`warp_abtree.kernels.motion.path`). 1 where they are for all of the motion. 0 where the exact test
  says that they intersect at first.
* clear: whether the surfaces are proved apart for all of the motion, its end included.
* undecided: whether contact is neither proved nor excluded: faces that slide or graze at a distance which takes more
  steps than are made (`kernels.motion.face_pair.STEPS_MAX`). Where a pair is neither clear nor undecided, two faces
  intersect by `time` + tolerance as float64 is certain of their coordinates then, or come as near at `time` as
  coordinates err: some 2^-43 of the sizes of models and motion.

The answer is the same, bit for bit, on CPU and CUDA.
"""

from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, flag, to_numpy
from warp_abtree.checks.cpu_threads import launch_on_cores
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.motion import face_pair, group, kinds, path, search, start
from warp_abtree.kernels.motion import linear as straight
from warp_abtree.query.commands import Commands
from warp_abtree.query.operator import Operator
from warp_abtree.query.result import Found
from warp_abtree.query.stage import Array, Rooms, Stage, fields
from warp_abtree.query.stages.distance import PAIRS_A_CORE
from warp_abtree.query.stages.inside import InsideStage
from warp_abtree.query.stages.intersect import IntersectStage
from warp_abtree.query.staging import first_rows
from warp_abtree.state.poses import PoseSetter

CONTACT_COUNTERS = 4
TOLERANCE_LEAST = 2.0**-40


def check_time_tolerance(tolerance) -> float:
    """Return a tolerance of times; raise ValueError for no number from 2^-40 up to below 1."""
    value = to_numpy(tolerance, "tolerance")
    if value.shape != () or value.dtype.kind not in "iuf" or not TOLERANCE_LEAST <= value < 1:
        raise ValueError(f"tolerance: {tolerance!r} is no number of 2^-40 or more, below 1")
    return float(value)


class SweptBoxes:
    """Boxes of objects on their way, for a `BroadPhase`."""

    def __init__(self, stage: "FirstContactStage"):
        self._stage = stage

    def given(self) -> tuple:
        """Return the numbers that they depend on."""
        return (self._stage.screw,)

    def make(self, launch, guard, boxes):
        """Make the launch that writes the boxes."""
        stage, operator = self._stage, self._stage.operator
        inputs = [stage.linear, stage.screw, operator.batch.trees, stage.ends, guard.record(), boxes]
        return launch(start.sweep_box_kernel, dim=len(boxes.lower), inputs=inputs, device=operator.device)


class HalfTurnError(ValueError):
    """A motion that turns by half a revolution.

    Attributes:
        row: Of which pair of a query.
    """

    def __init__(self, row: int, what: str):
        super().__init__(
            f"end_poses: {what} turns by half a revolution, which has no shortest way; split its motion in two"
        )
        self.row = row


class FirstContactStage(Stage):
    """Find when the pairs first touch that do not intersect at first.

    Arguments and attributes are those of `FirstContactQuery`, checked.
    """

    motion: wp.array  # of each pair, device `path.Motion` or `linear.LinearMotion` (pair,)
    memory: wp.array  # of each thread of the CPU

    def __init__(self, tolerance=1e-6, screw=False, linear=False):
        self.tolerance, self.screw, self.linear = tolerance, screw, linear
        self._kind: Any = straight.LinearMotion if linear else path.Motion
        self.contacts, self.ends, self._motions = start.FirstContacts(), ObjectPool(), start.Motions()

    def attach(self, operator: Operator):
        """Take the operator; motions end where the objects stand, until other poses are set."""
        super().attach(operator)
        device, batch, placed = operator.device, operator.batch, operator.batch.objects.pool
        self.contacts.counter = wp.zeros(CONTACT_COUNTERS, dtype=wp.int32, device=device)
        self.ends.rotation, self.ends.position = wp.clone(placed.rotation), wp.clone(placed.position)
        self._motions.paths = wp.zeros(batch.object_count, dtype=path.Path, device=device)
        self._motions.ends = self.ends

    def kernels(self, device) -> list:
        """Return what makes motions and follows them."""
        make = group.warp_motion_search if current_regime().uses_warps(device) else search.thread_motion_search
        kernels = make(self._kind), start.contact_starter(self._kind), path.prepare_path_kernel
        return [(kernel, WARP_SIZE) for kernel in kernels]

    def boxes(self, boxes):
        """Return boxes of the whole way."""
        return SweptBoxes(self)

    def arrays(self, rooms: Rooms) -> list[Array]:
        """Return what has an entry a pair or a thread."""
        pairs = rooms.pairs
        return [
            *fields(self.contacts, pairs, time=wp.float64, end=wp.int32),
            Array(self, "motion", self._kind, pairs),
            Array(self, "memory", wp.int64, (self.operator.threads(pairs), search.LIST_WORDS)),
        ]

    def search(self):
        """Find first contacts of the pairs in place that `hits.any_hit` does not mark as met. Launches only."""
        self.begin_motions()
        self.follow_motions()

    def begin_motions(self):
        """Do the first half of `search`: make each pair's motion, and decide what needs none. Launches only."""
        self.operator.launch_all("motions", self._make_motions)

    def follow_motions(self):
        """Do the second half of `search`: follow motions to the first contacts. Launches only."""
        operator = self.operator
        (launch,) = operator.find_launches("first contacts", self._make_contacts)
        launch_on_cores(launch, operator.cores(PAIRS_A_CORE, len(self.memory)))

    def _make_motions(self, launch) -> list:
        operator = self.operator
        launch = partial(launch, device=operator.device)
        inputs = [self.screw, operator.batch.objects.pool, self.ends, self._motions.paths]
        paths = launch(path.prepare_path_kernel, dim=operator.batch.object_count, inputs=inputs)
        inputs = [operator.batch.trees, self._motions, operator.pair_batch, operator.hits, self.contacts, self.motion]
        starter = start.contact_starter(self._kind)
        return [paths, launch(starter, dim=operator.rooms.pairs, inputs=inputs, block_dim=WARP_SIZE)]

    def _make_contacts(self, launch) -> list:
        operator, given = self.operator, kinds.motion_given(self._kind)()
        given.tolerance, given.batch = self.tolerance, operator.pair_batch
        given.ends, given.motion = self.ends, self.motion
        inputs = [operator.batch.trees, given, operator.hits, self.contacts]
        if not operator.uses_warps():
            kernel = search.thread_motion_search(self._kind)
            return [launch(kernel, dim=1, inputs=[*inputs, self.memory], device=operator.device)]
        inputs = [operator.traversal.stack_length(), *inputs]
        threads = {"dim": operator.rooms.pairs * operator.lanes, "block_dim": WARP_SIZE, "device": operator.device}
        return [launch(group.warp_motion_search(self._kind), inputs=inputs, **threads)]

    def read(self, found: Found, device: bool, with_rows: bool):
        """Read times and how motions end; raise ValueError where an object turns by half a revolution."""
        n = len(found.pairs)
        ends = first_rows(self.contacts.end, n).numpy() if n else np.empty(0, np.int32)
        half = np.flatnonzero(ends == int(start.HALF_TURN))
        if len(half):
            pair = (found.pairs.numpy() if device else found.pairs)[half[0]].tolist()
            raise HalfTurnError(int(half[0]), f"one of objects {pair}")
        time = wp.clone(first_rows(self.contacts.time, n))
        found.time = time if device else time.numpy()
        for name, end in (("clear", face_pair.CLEAR), ("undecided", face_pair.UNDECIDED)):
            answers = ends == int(end)
            answers = wp.array(answers, dtype=wp.bool, device=self.operator.device) if device else answers
            setattr(found, name, answers)


class FirstContactQuery(Operator):
    """Times of first contact of many object pairs as an operator: allocates once, launches many times.

    As `Query` otherwise. What each answer is stands in `query.stages.motion`.

    Args:
        scene: As for `Query`: its poses at the time of each launch are where motions start.
        end_poses: As for `set_end_poses`; None for those of the scene as it stands, until others are set.
        pairs, capacity: As for `Query`; the broad phase finds objects whose boxes overlap somewhere on their way, and
            sorts them.
        tolerance: What a time may be early by, as a part of the motion, from 2^-40 up.
        screw: Whether objects move on screws.
        linear: Whether vertices move straight instead, from one posed mesh to the other; whatever the turn.

    Attributes:
        ends: End poses, which each launch reads: device arrays rotation and position of an `ObjectPool`.
        contacts: The last launch's answers, device arrays (pair capacity,) of `kernels.motion.start.FirstContacts`.

    Raises:
        ValueError: As `Query` and `set_end_poses`; a tolerance out of range.
        RuntimeError: A graph is being captured.
    """

    _motions: Any

    def __init__(self, scene, end_poses, pairs=None, capacity=None, tolerance=1e-6, screw=False, linear=False):
        stages = self.plan(tolerance, screw, linear)
        *_, self._motions = stages
        self.contacts, self.ends = self._motions.contacts, self._motions.ends
        super().__init__(scene, stages, pairs, capacity, sort_pairs=True)
        self._end_setter = PoseSetter(self.ends, self.device, self.batch.removed, "end_poses")
        if end_poses is not None:
            self.set_end_poses(end_poses)

    @staticmethod
    def plan(tolerance=1e-6, screw=False, linear=False) -> list[Stage]:
        """Return the stages of a query; raise ValueError for a tolerance out of range, or two paths at a time."""
        if flag(screw, "screw") & flag(linear, "linear"):
            raise ValueError("screw and linear: objects move on one kind of path")
        motions = FirstContactStage(check_time_tolerance(tolerance), bool(screw), bool(linear))
        return [IntersectStage(), InsideStage(), motions]

    def set_end_poses(self, end_poses):
        """Set where each object's motion ends, from the next launch on. (synchronization point)

        Takes the poses of all objects, and raises ValueError, as `Scene.set_poses`; nothing is changed then.
        """
        check_device(self.device, "giving a query end poses")
        self._end_setter.set(end_poses)

    def set_options(self, tolerance=1e-6, screw=False):
        """Take another tolerance, and screws or not, from the next launch on; a captured graph keeps its own.

        Raises:
            ValueError: A tolerance out of range, or no bool.
        """
        asked, motions = (check_time_tolerance(tolerance), flag(screw, "screw")), self._motions
        if asked != (motions.tolerance, motions.screw):
            motions.tolerance, motions.screw = asked
            self.commands = Commands()
