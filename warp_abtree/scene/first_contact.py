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

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, to_numpy
from warp_abtree.checks.cpu_threads import core_count, cores_for, launch_on_cores
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.arrays import ObjectPool
from warp_abtree.kernels.base.lanes import WARP_SIZE
from warp_abtree.kernels.motion import face_pair, group, path, search, start
from warp_abtree.kernels.motion import linear as straight
from warp_abtree.query.broad_phase import BroadPhase
from warp_abtree.query.commands import Commands
from warp_abtree.query.distance import PAIRS_A_CORE
from warp_abtree.query.narrow_phase import Query
from warp_abtree.query.request import refuse_options
from warp_abtree.query.result import Found, Result
from warp_abtree.query.staging import first_rows
from warp_abtree.scene.poses import HostPoses, check_poses, device_rows, place_rows

CONTACT_COUNTERS = 4
TOLERANCE_LEAST = 2.0**-40


def check_time_tolerance(tolerance) -> float:
    """Return a tolerance of times.

    Raises:
        ValueError: No number from 2^-40 up to below 1.
    """
    value = to_numpy(tolerance, "tolerance")
    if value.shape != () or value.dtype.kind not in "iuf" or not TOLERANCE_LEAST <= value < 1:
        raise ValueError(f"tolerance: {tolerance!r} is no number of 2^-40 or more, below 1")
    return float(value)


def check_path(screw, linear):
    """Raise ValueError for two paths at a time."""
    if screw and linear:
        raise ValueError("screw and linear: objects move on one kind of path")


def check_asked_contacts(output, precision, options):
    """Check the options of a sweep of motions.

    Raises:
        TypeError: An option with another name, or no end poses.
        ValueError: A bad option or precision.
    """
    unknown = set(options) - {"end_poses", "tolerance", "screw", "linear"}
    if unknown:
        raise TypeError(f"sweep has no option {sorted(unknown)[0]!r} for output {output!r}")
    if "end_poses" not in options:
        raise TypeError(f"sweep needs end_poses for output {output!r}")
    refuse_options(output, {"precision": precision != "exact"})
    check_time_tolerance(options.get("tolerance", 1e-6))
    check_path(options.get("screw"), options.get("linear"))


class SweptBroadPhase(BroadPhase):
    """Broad phase of objects by swept boxes, for a `FirstContactQuery`."""

    def __init__(self, query, capacity, sorts):
        self._query = query
        super().__init__(query.batch, capacity, sorts)

    def _options(self) -> tuple:
        return (self._query.screw,)

    def _make_boxes(self, launch):
        query = self._query
        inputs = [query.linear, query.screw, self.batch.trees, query.ends, self.guard.record(), self.lower, self.upper]
        return launch(start.sweep_box_kernel, dim=len(self.lower), inputs=inputs, device=self.device)


class FirstContactQuery(Query):
    """Times of first contact of many object pairs as an operator: allocates once, launches many times.

    As `Query` otherwise. What each answer is stands in `warp_abtree.scene.first_contact`.

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

    _memory: wp.array
    _motion: wp.array

    def __init__(self, scene, end_poses, pairs=None, capacity=None, tolerance=1e-6, screw=False, linear=False):
        check_path(screw, linear)
        self._kind = straight.LinearMotion if linear else path.Motion
        self.tolerance, self.screw, self.linear = check_time_tolerance(tolerance), bool(screw), bool(linear)
        self.contacts, self.ends, self._motions = start.FirstContacts(), ObjectPool(), start.Motions()
        self.contacts.counter = wp.zeros(CONTACT_COUNTERS, dtype=wp.int32, device=scene.device)
        super().__init__(scene, "any", pairs, capacity, sort_pairs=True)
        paths = path.Paths()
        for name in ("axis", "angle", "anchor", "start", "travel"):
            dtype = wp.float64 if name == "angle" else wp.vec3d
            setattr(paths, name, wp.zeros(self.batch.object_count, dtype=dtype, device=self.device))
        self._make_ends()
        self._motions.paths, self._motions.ends = paths, self.ends
        self._host_ends = HostPoses(self.ends, self.device)
        if end_poses is not None:
            self.set_end_poses(end_poses)

    def _make_ends(self):
        """Make room for end poses, at first those of the scene; once."""
        if self.ends.rotation is None:
            self.ends.rotation = wp.clone(self.batch.objects.pool.rotation)
            self.ends.position = wp.clone(self.batch.objects.pool.position)

    def _make_broad_phase(self, capacity, sorts: bool) -> BroadPhase:
        self._make_ends()
        return SweptBroadPhase(self, capacity, sorts)

    def set_end_poses(self, end_poses):
        """Set where each object's motion ends, from the next launch on.

        Args:
            end_poses: Of all objects, as for `Scene.set_poses`. (synchronization point)

        Raises:
            ValueError: As `Scene.set_poses`; nothing is changed.
        """
        check_device(self.device, "giving a query end poses")
        rows = device_rows(end_poses, self.device, "end_poses")
        poses = check_poses(end_poses, "end_poses") if rows is None else rows
        if len(poses) != self.batch.object_count:
            raise ValueError(f"end_poses: {len(poses)} given for {self.batch.object_count} objects")
        if rows is None:
            self._host_ends.place(poses)
        else:
            place_rows(rows, self.ends)

    def set_options(self, tolerance=1e-6, screw=False):
        """Take another tolerance, and screws or not, from the next launch on; a captured graph keeps its own.

        Raises:
            ValueError: A tolerance out of range.
        """
        asked = check_time_tolerance(tolerance), bool(screw)
        if asked != (self.tolerance, self.screw):
            self.tolerance, self.screw = asked
            self._commands = Commands()

    def _kernels(self, with_distances: bool) -> list:
        make = group.warp_search if self.uses_warps() else search.thread_search
        kernels = [make(self._kind), start.contact_starter(self._kind), path.prepare_path_kernel]
        return [*[(kernel, WARP_SIZE) for kernel in kernels], *super()._kernels(with_distances)]

    def _pair_arrays(self, room: int) -> list:
        made = super()._pair_arrays(room)
        made.append((self.contacts, "time", wp.empty(room, dtype=wp.float64, device=self.device)))
        made.append((self.contacts, "end", wp.empty(room, dtype=wp.int32, device=self.device)))
        made.append((self, "_motion", wp.empty(room, dtype=self._kind, device=self.device)))
        threads = 0 if self.uses_warps() else min(room, current_regime().cpu_threads or core_count())
        memory = wp.empty((threads, search.LIST_WORDS), dtype=wp.int64, device=self.device)
        return [*made, (self, "_memory", memory)]

    def traverse(self):
        """Decide which pairs in place intersect at first, and find first contacts of the others. Launches only."""
        super().traverse()
        self.search()

    def search(self):
        """Find first contacts of the pairs in place that `hits.any_hit` does not mark as met. Launches only."""
        if len(self.pairs):
            self.begin_motions()
            self.follow_motions()

    def begin_motions(self):
        """Do the first half of `search`: make each pair's motion, and decide what needs none. Launches only."""
        for launch in self._find_launches("motions", self._make_motions):
            launch()

    def follow_motions(self):
        """Do the second half of `search`: follow motions to the first contacts. Launches only."""
        (launch,) = self._find_launches("first contacts", self._make_contacts)
        if self.device.is_capturing or self.uses_warps():
            launch()
        else:
            launch_on_cores(launch, cores_for(len(self.pairs), PAIRS_A_CORE, len(self._memory)))

    def _find_launches(self, name, make) -> list:
        return self._commands.find_callables(name, self.guard.given(), self.device, make)

    def _make_motions(self, launch) -> list:
        objects = self.batch.objects.pool
        room, launch = len(self.pairs), partial(launch, device=self.device)
        inputs = [self.screw, objects, self.ends, self._motions.paths]
        paths = launch(path.prepare_path_kernel, dim=self.batch.object_count, inputs=inputs)
        inputs = [self.batch.trees, self._motions, self.pair_batch, self.hits, self.contacts, self._motion]
        return [paths, launch(start.contact_starter(self._kind), dim=room, inputs=inputs, block_dim=WARP_SIZE)]

    def _make_contacts(self, launch) -> list:
        objects = self.batch.objects.pool
        room, launch = len(self.pairs), partial(launch, device=self.device)
        poses = straight.EndPoses()
        poses.rotation, poses.position = objects.rotation, objects.position
        poses.end_rotation, poses.end_position = self.ends.rotation, self.ends.position
        inputs = [self.tolerance, self.batch.trees, poses, self.pair_batch, self._motion]
        if self.uses_warps():
            dim = room * (WARP_SIZE if self.device.is_cuda else 1)
            inputs = [self._stack_length(), *inputs, self.hits, self.contacts]
            return [launch(group.warp_search(self._kind), dim=dim, inputs=inputs, block_dim=WARP_SIZE)]
        inputs += [self.hits, self.contacts, self._memory]
        return [launch(search.thread_search(self._kind), dim=1, inputs=inputs)]

    def _make_result(self, found: Found, device: bool, with_rows: bool = True) -> Result:
        n = len(found.pairs)
        ends = first_rows(self.contacts.end, n).numpy() if n else np.empty(0, np.int32)
        result_of = super()._make_result
        half = np.flatnonzero(ends == int(start.HALF_TURN))
        found.time = wp.clone(first_rows(self.contacts.time, n))
        found.clear, found.undecided = ends == int(face_pair.CLEAR), ends == int(face_pair.UNDECIDED)
        if device:
            found.clear = wp.array(found.clear, dtype=wp.bool, device=self.device)
            found.undecided = wp.array(found.undecided, dtype=wp.bool, device=self.device)
        else:
            found.time = found.time.numpy()
        result = result_of(found, device, with_rows)
        if len(half):
            pairs = found.pairs.numpy() if device else found.pairs
            raise ValueError(
                f"end_poses: one of objects {pairs[half[0]].tolist()} turns by half a revolution, which has no "
                "shortest way; split its motion in two"
            )
        return result
