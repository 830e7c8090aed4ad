"""LOD change: which state serves which target, the faces I, R and D that change, and the update of every tree at
once."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.arrays import LEVEL_MAX
from warp_abtree.kernels.update import refine, refit
from warp_abtree.kernels.update import work_lists as plan_kernels
from warp_abtree.model.tree import UpdateBatch, UpdateWork, active_update, launch_items, make_level_lists
from warp_abtree.state.arrays import ModelArrays, ObjectArrays, StateArrays


def full_refit_fraction(device) -> float:
    """Return the fraction of its faces past which a state is refitted whole."""
    return current_regime().full_refit["cuda" if device.is_cuda else "cpu"]


# Wishes on the device that could not be met, and the lowest index that had one.
NO_FAULTS = (0, 2**31 - 1)


class UpdateStats:
    """What a change of LODs did, one entry an updated state.

    Attributes:
        state, lod: State and its new LOD, int32 (u,).
        full: Whether the whole tree was refitted, bool (u,).
    """

    def __init__(self, batch: UpdateBatch):
        self._batch = batch
        self.state = batch.state
        self.lod = batch.lod
        self.full = batch.full

    def __repr__(self):
        return f"UpdateStats({len(self.state)} states updated, {int(np.sum(self.full))} of them whole)"

    @property
    def k(self) -> np.ndarray:
        """Distinct faces inserted, removed or deformed, int32 (u,). Waits for the device."""
        return self._batch.plan.changed_count.numpy()[self.state]

    @property
    def nodes_refitted(self) -> np.ndarray:
        """Nodes refitted, leaves among them, int32 (u,). Waits for the device.

        At most k (log2 n - log2 k + 2) - 1 where the update is partial (equation 1, n rounded up to a power of two).
        """
        marked = self._batch.plan.marked_count.numpy()[self.state]
        return np.where(self.full, 2 * self._batch.face_count - 1, marked).astype(np.int32)


@dataclass
class Plan:
    """Which states move where: state id, LOD and the state that it starts from (itself, another, or -1 for none)."""

    state: list
    lod: list
    source: list


def _plan(states: StateArrays, wanted: set, used: set) -> tuple[Plan, dict]:
    """Choose a state for every wanted (model, lod).

    States that stand at a target stay; every other target takes the nearest state that no target keeps, in place,
    else a new state that starts as a copy of the nearest. Nearest is by the length of the slice between them.

    Returns the plan, and the state of every wanted (model, lod).
    """
    stand = {(states.slots[s].model, states.slots[s].lod): s for s in used}
    chosen = {key: stand[key] for key in wanted if key in stand}
    kept = set(chosen.values())
    by_model: dict[int, list[int]] = {}
    for s in sorted(used):
        by_model.setdefault(states.slots[s].model, []).append(s)
    movable = {model: [s for s in ids if s not in kept] for model, ids in by_model.items()}

    def distance(key, state):
        if state < 0:  # there is no state of this model yet
            return 0
        bounds = states.models.split_bounds[key[0]]
        return abs(int(bounds[states.slots[state].lod]) - int(bounds[key[1]]))

    plan = Plan([], [], [])
    copies = []
    for key in sorted(wanted - chosen.keys()):
        spare = movable.get(key[0], [])
        if spare:
            state = min(spare, key=partial(distance, key))
            spare.remove(state)
            chosen[key] = state
            plan.state.append(state)
            plan.lod.append(key[1])
            plan.source.append(state)
        else:
            copies.append(key)
    sources = [min(by_model.get(key[0], [-1]), key=partial(distance, key)) for key in copies]
    for state, key, source in zip(states.reserve([key[0] for key in copies]), copies, sources, strict=True):
        chosen[key] = state
        plan.state.append(state)
        plan.lod.append(key[1])
        plan.source.append(source)
    return plan, chosen


def _make_batch(models: ModelArrays, states: StateArrays, plan: Plan) -> UpdateBatch:
    """Turn a plan into slices: the faces touched between two LODs are one contiguous slice, whatever the distance."""
    start, length, full = [], [], []
    for state, lod, source in zip(plan.state, plan.lod, plan.source, strict=True):
        model = states.slots[state].model
        bounds = models.split_bounds[model]
        from_lod = states.slots[source].lod if source >= 0 else -1
        low, high = (min(lod, from_lod), max(lod, from_lod)) if source >= 0 else (0, 0)
        touched = int(bounds[high] - bounds[low])
        whole = source < 0 or touched > full_refit_fraction(states.device) * models.face_count[model]
        full.append(whole)
        start.append(0 if whole else int(bounds[low]))
        length.append(0 if whole else touched)
    owner = [states.slots[s].model for s in plan.state]
    return UpdateBatch(
        np.array(plan.state, np.int32),
        np.array(plan.lod, np.int32),
        np.array(full, bool),
        np.array(start, np.int64),
        np.array(length, np.int64),
        models.depth[owner],
        models.face_count[owner],
        len(states.slots),
        states.device,
    )


def _plan_copies(models: ModelArrays, states: StateArrays, plan: Plan, batch: UpdateBatch) -> list:
    """Return the launches that copy the source of every state that starts from another: kernel, threads and inputs."""
    copies = []
    for state, source, full in zip(plan.state, plan.source, batch.full, strict=True):
        if source >= 0 and source != state:
            copies.append((source, state, states.slots[state].model, full))

    def launches(kernel, rows, lengths):
        if not rows:
            return []
        end = np.cumsum(lengths)
        ends = [np.asarray(values, np.int32) for values in (end, [r[0] for r in rows], [r[1] for r in rows])]
        arrays = [wp.array(values, dtype=wp.int32, device=states.device) for values in ends]
        return [(kernel, int(end[-1]), [*arrays, states.pool])]

    partial = [r for r in copies if not r[3]]
    return [
        *launches(refit.copy_face_kernel, copies, [models.face_count[r[2]] for r in copies]),
        *launches(refit.copy_node_kernel, partial, [models.node_count[r[2]] for r in partial]),
    ]


def refine_meshes(models: ModelArrays, states: StateArrays, work: UpdateWork):
    """Set the active ancestors of every face corner that changes. Launches only."""
    inputs = [models.pool, work.plan, states.pool]
    launch_items(refine.refine_slice_kernel, work.entry_room, inputs, states.device)
    inputs = [models.pool, states.pool, work.plan]
    launch_items(refine.refine_all_kernel, work.face_room, inputs, states.device)


class _StateMove:
    """Brings states to their LODs, copies before anything moves: allocates first, then launches."""

    def __init__(self, models: ModelArrays, states: StateArrays, plan: Plan):
        self.models, self.states, self.plan = models, states, plan
        self.batch = _make_batch(models, states, plan)
        self._copies = _plan_copies(models, states, plan, self.batch)

    def launch(self):
        """Move the states; only launches and small transfers."""
        models, states, plan = self.models, self.states, self.plan
        states.touch()
        if not plan.state:
            return
        for state, lod in zip(plan.state, plan.lod, strict=True):
            states.slots[state].lod = lod
        states.upload_slots()
        for state, source in zip(plan.state, plan.source, strict=True):
            if source < 0:
                slot = states.slots[state]
                end = slot.face_start + int(models.face_count[slot.model])
                states.pool.face_corner[slot.face_start : end].fill_(wp.vec4i(-1, -1, -1, -1))
        for kernel, threads, inputs in self._copies:
            wp.launch(kernel, dim=threads, inputs=inputs, device=states.device)
        refine_meshes(models, states, self.batch)
        active_update(models.pool, states.pool, self.batch)


def build_states(models: ModelArrays, states: StateArrays, state_model, lods) -> list:
    """Make a state for each model and LOD of two lists, of its own each, and return their ids.

    Raises:
        ValueError: The pool would pass 2^30 nodes.
    """
    ids = states.reserve(state_model)
    _StateMove(models, states, Plan(ids, [int(lod) for lod in lods], [-1] * len(ids))).launch()
    return ids


class LodUpdate(UpdateWork):
    """Bring every state of a pool to LODs that stand on the device, planned there: allocates once, launches many.

    The worklists have room for the worst case: every state moves, by the longest slice that is not refitted whole.
    From the first launch on, LODs of states are known on the device only (`StatePool.lod`).

    Args:
        models, states: A pool that grows no more.

    Attributes:
        wanted: LOD of each state, device int32 (s,), to be written before a launch.
        faults: LODs wanted out of range (the nearer end is taken) and the lowest state that had one, device int32 (2,).
    """

    def __init__(self, models: ModelArrays, states: StateArrays):
        self.models, self.states = models, states
        device = states.device
        owner = np.array([slot.model for slot in states.slots])
        bounds = [len(bound) for bound in models.split_bounds]
        longest = np.array([bound[-1] - bound[0] for bound in models.split_bounds])
        partial_max = np.minimum(longest, np.floor(full_refit_fraction(device) * models.face_count).astype(np.int64))
        entries, depth = partial_max[owner], models.depth[owner]
        levels = range(int(depth.max()) + 1)
        level_room = [int(np.sum(depth >= level)) << level for level in levels]
        marked_room = [int(np.minimum(entries, 1 << level)[depth >= level].sum()) for level in levels]
        whole_room = np.array([np.sum(depth >= level) for level in range(int(LEVEL_MAX))])
        count = len(owner)

        def upload(values):
            return wp.array(np.asarray(values, np.int64), dtype=wp.int32, device=device)

        def room(length, dtype=wp.int32):
            return wp.zeros(length, dtype=dtype, device=device)

        self.splits = plan_kernels.SplitTable()
        self.splits.bound = upload(np.concatenate(models.split_bounds))
        self.splits.bound_start = upload(np.cumsum(bounds) - bounds)
        self.splits.partial_max = upload(partial_max)
        self.splits.depth = upload(models.depth)
        plan = plan_kernels.UpdatePlan()
        plan.partial_total, plan.full_total = room(1, wp.int64), room(1, wp.int64)
        for name in ("partial_state", "slice_start", "entry_end", "full_state", "face_end"):
            setattr(plan, name, room(count))
        plan.changed_count, plan.marked_count = room(count), room(count)
        plan.whole_count = room(int(LEVEL_MAX))
        plan.whole_start = upload(np.cumsum(whole_room) - whole_room)
        plan.whole_state = room(int(whole_room.sum()))
        make_level_lists(plan, marked_room, device)
        self.wanted = upload([slot.lod for slot in states.slots])
        self.faults = wp.array(NO_FAULTS, dtype=wp.int32, device=device)
        super().__init__(plan, int(entries.sum()), int(models.face_count[owner].sum()), level_room, device)

    def launch(self):
        """Refine meshes and update trees. Launches only: six, and one for each level that has much to refit.

        Where it is interrupted, the next launch refits every state whole.
        """
        try:
            self._launch()
        except BaseException:
            self.states.pool.lod.fill_(int(plan_kernels.UNKNOWN))
            raise

    def _launch(self):
        count = len(self.wanted)
        wp.launch(plan_kernels.clear_plan_kernel, max(count, int(LEVEL_MAX)), [self.plan], device=self.device)
        inputs = [self.models.pool, self.splits, self.wanted, self.states.pool, self.plan, self.faults]
        wp.launch(plan_kernels.plan_update_kernel, count, inputs, device=self.device)
        refine_meshes(self.models, self.states, self)
        active_update(self.models.pool, self.states.pool, self)


class LodLadder:
    """Serve LODs that stand on the device from states made beforehand: no tree is ever updated.

    Args:
        rungs: LODs of each model that states are made for, rising.
        lods: LOD that each object starts at, int (n,).

    Attributes:
        wanted: LOD of each object, device int32 (n,), to be written before a launch; the coarsest rung that is not
            coarser serves it.
        faults: LODs wanted below 0 or beyond the last rung (the nearer end is taken) and the lowest object that had
            one, device int32 (2,).

    Raises:
        ValueError: The pool would pass 2^30 nodes.
    """

    def __init__(self, models: ModelArrays, states: StateArrays, objects: ObjectArrays, object_model, rungs, lods):
        self.states, self.objects, self.device = states, objects, states.device
        starts = np.concatenate([[0], np.cumsum([len(part) for part in rungs])])
        build_states(models, states, np.repeat(np.arange(len(rungs)), np.diff(starts)), np.concatenate(rungs))
        objects.set_states(starts[object_model])
        self.rung_start = wp.array(starts, dtype=wp.int32, device=self.device)
        self.wanted = wp.array(np.asarray(lods), dtype=wp.int32, device=self.device)
        self.faults = wp.array(NO_FAULTS, dtype=wp.int32, device=self.device)

    def launch(self):
        """Point objects at other states. One launch."""
        inputs = [self.states.pool, self.rung_start, self.wanted, self.objects.pool, self.faults]
        wp.launch(plan_kernels.pick_state_kernel, len(self.wanted), inputs, device=self.device)


def set_object_lods(
    models: ModelArrays, states: StateArrays, objects: ObjectArrays, object_model: np.ndarray, lods: np.ndarray
) -> UpdateStats:
    """Bring every object to a LOD: refine meshes, update trees, share states; states that no object uses are freed.

    All that it needs is allocated before the first state in use changes (`StateArrays.change`).

    Args:
        object_model: Model of each object, int (n,).
        lods: Target LOD of each object, int (n,), within its model's range.
    """
    keys, inverse = np.unique((object_model.astype(np.int64) << 32) + lods, return_inverse=True)
    wanted = [(key >> 32, key & (2**32 - 1)) for key in keys.tolist()]
    used = set(np.unique(objects.state[objects.state >= 0]).tolist())
    plan, chosen = _plan(states, set(wanted), used)
    move = _StateMove(models, states, plan)
    serving = np.array([chosen[key] for key in wanted], np.int32)[inverse.reshape(-1)]
    moved = not np.array_equal(serving, objects.state)
    staged = objects.stage_states(serving, states.generation) if moved else None
    move.launch()
    if moved:
        for state in used - set(chosen.values()):
            states.free.setdefault(states.slots[state].model, []).append(state)
        objects.set_states(serving, staged)
    return UpdateStats(move.batch)
