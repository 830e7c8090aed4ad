"""One frame without the host: poses and LODs in, results out, all on the device, as one graph to capture."""

import warnings
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, to_numpy
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.kernels.io import pipeline as kernels
from warp_abtree.kernels.update.levels import Levels
from warp_abtree.query.operator import Operator
from warp_abtree.query.request import CapacityError, check_capacity
from warp_abtree.query.result import Result
from warp_abtree.query.stages.contacts import ContactQuery
from warp_abtree.query.stages.intersect import Query
from warp_abtree.scene.posed_objects import expect_scene
from warp_abtree.state.device_update import NO_FAULTS, DeviceLodUpdate, LevelStates
from warp_abtree.state.generation import STALE_GRAPH
from warp_abtree.state.poses import QUATERNION_TOLERANCE


def check_groups(groups, object_model) -> np.ndarray:
    """Return the group of each object, int (n,).

    Raises ValueError for a wrong shape, a number from 0 on that no object has, and a group of several models.
    """
    groups = to_numpy(groups, "groups")
    if groups.shape != object_model.shape or groups.dtype.kind not in "iu":
        raise ValueError(f"groups: shape {groups.shape} and type {groups.dtype}, not {len(object_model)} whole numbers")
    names, first, inverse = np.unique(groups, return_index=True, return_inverse=True)
    if not np.array_equal(names, np.arange(len(names))):
        raise ValueError(f"groups: numbered {names[0]} to {names[-1]} for {len(names)} groups, not from 0 without gaps")
    other = np.flatnonzero(object_model != object_model[first][inverse])
    if len(other):
        raise ValueError(f"groups: group {groups[other[0]]} holds objects of several models")
    return groups.astype(np.int64)


def check_ladder(ladder, models) -> list:
    """Return the levels of each model, rising int arrays; raise ValueError for bad ones, or not one list a model."""
    parts = [list(part) for part in ladder]
    if len(parts) != len(models):
        raise ValueError(f"ladder: {len(parts)} lists of LODs given for {len(models)} models")
    levels = [np.unique([model.check_lod(lod) for lod in part]).astype(np.int64) for part, model in zip(parts, models)]
    empty = [i for i, part in enumerate(levels) if not len(part)]
    if empty:
        raise ValueError(f"ladder: no LOD for model {empty[0]}")
    return levels


class Pipeline(DeviceMemory):
    """A frame as an operator: sets poses, brings trees to LODs, runs broad and narrow phase, all on the device.

    `launch()` only launches, on arrays that are allocated once, so that a graph can capture it, on CUDA and the CPU,
    together with the kernels of a simulator or an LOD controller that write `poses` and `lods`. The answers are those
    of `set_poses`, `set_lods` and `intersect` of the scene, bit for bit, but for the order of pairs: on CUDA the one in
    which the broad phase found them. No launch waits for the host, and their number depends on nothing but how many
    states there are and how deep their trees (at most 31 levels):

    * 1 for poses, and for levels with a ladder;
    * 1 for LODs; 6 more where there are trees that no block of threads takes (on CUDA from 8,192 faces on, or as many
      times more as there are more states than multiprocessors; from 65,536 on always), and then 1 for each level on
      which their states together have more than 1,024 nodes; none with a ladder;
    * 2 for the broad phase, on CUDA 4 more and a sort where a world has many hundreds of objects; none for given pairs;
    * 2 for the narrow phase on the CPU (outside a graph one of them once a core), 4 on CUDA (3 without exact signs), 2
      more with `within`; for contacts those of `ContactQuery`.

    The frame takes the scene's models, objects, poses, LODs and filter as they are when it is made. States and objects
    are its own: it leaves the scene as it is, and what happens to the scene later does not reach it.

    Tree states, and so memory, come in one of two ways:

    * One an object, or one a group of objects, updated in place by the AB-Tree's own update, a full refit where more
      than half of the faces may change, on CUDA a fifth: any LOD, some 80 to 130 bytes a face and state, up to a tenth
      of that for worklists. They have room for all states to change at once.
    * With a ladder, one a model and level, made beforehand: an LOD change costs an index. The less memory where a model
      has more objects than levels.

    Args:
        scene: `Scene` with all its objects.
        output: "any", "count", "faces" or "contacts".
        groups: Group of each object, int (n,), from 0 without gaps; the objects of a group share model, LOD and state.
            None gives each object a state of its own.
        ladder: LODs that objects may stand at, one list for each of `scene.models`, in any order. The coarsest one that
            is not coarser serves a request.
        request: pairs, capacity, precision and within, as for `Query`; in a graph nothing grows.

    Attributes:
        poses: x y z qx qy qz qw [world units, unit quaternion], device float64 (n, 7); those of the scene at first.
        lods: LOD of each object, with groups of each group, device int32; the scene's at first, of a group's first
            object, as far as a ladder reaches.
        query: The `Query` or `ContactQuery` that answers, with its results in device arrays.
        changed_count, marked_count: Faces that changed and nodes refitted in the last launch, device int32, one entry
            a state; None with a ladder.

    Raises:
        ValueError: Bad groups, a bad ladder or request, an empty scene, or states of 2^30 nodes and more.
    """

    def __init__(self, scene, output="any", groups=None, ladder=None, **request):
        check_device(expect_scene(scene).device, "making a Pipeline")
        self.batch = batch = scene.batch().with_own_states()
        self.device = batch.device
        if groups is not None and ladder is not None:
            raise ValueError("groups and ladder: give one of them; with a ladder objects share states anyway")
        model, lods = batch.object_model, scene.lods
        self._update: DeviceLodUpdate | LevelStates
        if ladder is None:
            group = np.arange(len(lods)) if groups is None else check_groups(groups, model)
            first = np.unique(group, return_index=True)[1]
            batch.replace_states(list(zip(model[first].tolist(), lods[first].tolist())), group)
            self._update = DeviceLodUpdate(batch.models, batch.states, takes_any=group[batch.removed])
        else:
            levels = check_ladder(ladder, scene.models)
            last = np.array([part[-1] for part in levels])[model]
            self._update = LevelStates(batch, levels, np.minimum(lods, last))
        self.lods = self._update.wanted
        self._levels = self._update.levels if isinstance(self._update, LevelStates) else Levels()
        plan = self._update.plan
        self.changed_count = None if plan is None else plan.changed_count
        self.marked_count = None if plan is None else plan.marked_count
        self.poses = wp.empty((batch.object_count, 7), dtype=wp.float64, device=self.device)
        wp.launch(kernels.read_pose_kernel, len(self.poses), [batch.objects.pool, self.poses], device=self.device)
        self._bad_poses = wp.empty(2, dtype=wp.int32, device=self.device)
        self._demand = wp.zeros(5, dtype=wp.int64, device=self.device)
        make: Any = ContactQuery if output == "contacts" else partial(Query, output=output)
        self.query: Operator = make(batch, **request)
        # Loads the kernels, and tells what the poses as they stand take.
        self.launch()
        self._fit_uncertain(request.get("capacity"))
        self.clear_faults()

    def _fit_uncertain(self, capacity):
        """Make room for the uncertain face pairs, unless that room was given; then say what it lacks."""
        given = check_capacity(capacity).uncertain
        needed, room = int(self._read_demand()[2]), len(self.query.hits.uncertain)
        if not 0 < room < needed:
            return
        if given is None:
            self.query.grow_uncertain()
            return
        warnings.warn(
            f"Buffers(uncertain={given}): the poses as they stand leave {needed} face pairs uncertain after float32; "
            f"make it with uncertain={needed}, or without",
            RuntimeWarning,
            stacklevel=3,
        )

    def launch(self):
        """Run one frame on what stands in `poses` and `lods`. Launches only, see above how many.

        Where it is interrupted, the next launch refits all tree states.
        """
        with self.query.guard.launching(self):
            self._set_objects()
            self.query.launch()

    def _set_objects(self):
        update, query = self._update, self.query
        inputs = [QUATERNION_TOLERANCE, self.poses, query.pair_batch, query.hits, self._demand, self._levels]
        inputs += [self.batch.objects.pool, self._bad_poses, query.guard.record()]
        place = partial(wp.launch, kernels.begin_pipeline_kernel, len(self.poses), inputs, device=self.device)
        if isinstance(update, LevelStates):
            update.launch(place)
        else:
            place()
            update.launch()

    def _read_demand(self) -> np.ndarray:
        """Return the greatest demand, that of the last launch included. Waits for the device."""
        inputs = [self.query.pair_batch, self.query.hits, self._demand]
        wp.launch(kernels.tally_demand_kernel, 1, inputs, device=self.device)
        return self._demand.numpy()

    def capture(self) -> wp.Graph:
        """Return `launch()` as a graph for `wp.capture_launch`; it holds as long as the frame does and no buffer grows.

        To capture it with kernels of your own, call `launch()` inside a `wp.ScopedCapture`.
        """
        with wp.ScopedCapture(self.device) as capture:
            self.launch()
        return capture.graph

    def result(self) -> Result:
        """Return the results of the last launch on the host, as `Scene.intersect`. Waits for the device."""
        return self.query.result()

    def run(self) -> Result:
        """Run one frame outside a graph, grow buffers that were too small, and return its result. Waits for the device.

        Serves to size buffers on a hard frame. Graphs captured before a buffer grew must be captured anew.

        Raises:
            ValueError: As `check`.
        """
        check_device(self.device, "Pipeline.run (launch can)")
        with self.query.guard.launching(self):
            self._set_objects()
            result = self.query.run()
            self._demand[4:].zero_()  # what was too small has grown
        self.check()
        return result

    def clear_faults(self):
        """Forget what `check` would raise."""
        check_device(self.device, "Pipeline.clear_faults")
        self._bad_poses.assign(np.array(NO_FAULTS, np.int32))
        self._update.faults.assign(np.array(NO_FAULTS, np.int32))
        self._demand.zero_()
        self.query.guard.clear_stale()

    def check(self):
        """Raise what went wrong in any frame since the last call. Waits for the device.

        Raises:
            RuntimeError: A frame was the replay of a graph captured before a buffer grew; it found nothing.
            ValueError: A pose was not finite or a quaternion off unit length by more than 1e-3 (its object kept the
                pose before); a LOD was out of range (the nearer end was taken).
            CapacityError: Pairs, hits or face pairs that float32 leaves open outran their buffers; names the demand,
                and whatever else was wrong.
        """
        check_device(self.device, "Pipeline.check")
        poses, lods, demand = self._bad_poses.numpy().copy(), self._update.faults.numpy().copy(), self._read_demand()
        found, hits, uncertain, stale = (int(value) for value in demand[:4])
        self.clear_faults()
        stale_frame = [f"a frame since the last check is lost: its graph {STALE_GRAPH}"] if stale else []
        wrong, lost = [], []
        if poses[0]:
            wrong.append(
                f"poses: {poses[0]} rows since the last check were not finite or not of unit quaternions; the first "
                f"object that had one is {poses[1]}, and kept its pose"
            )
        if lods[0]:
            wrong.append(
                f"lods: {lods[0]} entries since the last check were out of range; the first one that had one is "
                f"{lods[1]}, and took the nearer end"
            )
        room = {"pairs": (found, len(self.query.pairs))}
        if self.query.output == "faces":
            room["hits"] = hits, len(self.query.hits.face)
        if len(self.query.hits.uncertain):
            room["uncertain"] = uncertain, len(self.query.hits.uncertain)
        for name, (needs, places) in room.items():
            if needs > places:
                needed = f"Buffers({name}={needs})"
                lost.append(f"a frame since the last check needed {needed}, the pipeline has room for {places}")
        if stale_frame or lost or wrong:
            kind = RuntimeError if stale_frame else CapacityError if lost else ValueError
            raise kind("; ".join([*stale_frame, *lost, *wrong]))
