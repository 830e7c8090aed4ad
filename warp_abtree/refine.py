"""LOD change: which state serves which target, the faces I, R and D that change, and the update of every tree at
once."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.kernels import refine, refit
from warp_abtree.state import ModelArrays, ObjectArrays, StateArrays
from warp_abtree.tree import UpdateBatch, active_update

# Past this share of the faces in its slice, a state is refitted whole. A slice repeats faces, so k is smaller still.
FULL_SHARE = 0.5


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

    @property
    def k(self) -> np.ndarray:
        """Distinct faces inserted, removed or deformed, int32 (u,). Waits for the device."""
        return self._batch.changed_count.numpy()[: len(self.state)]

    @property
    def nodes_refitted(self) -> np.ndarray:
        """Nodes refitted, leaves among them, int32 (u,). Waits for the device.

        At most k (log2 n - log2 k + 2) - 1 where the update is partial (equation 1, n rounded up to a power of two).
        """
        marked = self._batch.marked_count.numpy()[: len(self.state)]
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

    def distance(state, key):
        bounds = states.models.split_bounds[key[0]]
        return abs(int(bounds[states.slots[state].lod]) - int(bounds[key[1]]))

    plan = Plan([], [], [])
    copies = []
    for key in sorted(wanted - chosen.keys()):
        spare = movable.get(key[0], [])
        if spare:
            state = min(spare, key=lambda s, key=key: distance(s, key))
            spare.remove(state)
            chosen[key] = state
            plan.state.append(state)
            plan.lod.append(key[1])
            plan.source.append(state)
        else:
            copies.append(key)
    sources = [
        min(by_model.get(key[0], [-1]), key=lambda s, key=key: distance(s, key) if s >= 0 else 0) for key in copies
    ]
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
        whole = source < 0 or touched > FULL_SHARE * models.face_count[model]
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
        states.device,
    )


def _copy_states(models: ModelArrays, states: StateArrays, plan: Plan, batch: UpdateBatch):
    """Copy the source of every state that starts from another, before anything moves; clear a first one's corners."""
    pairs = []
    for state, source, full in zip(plan.state, plan.source, batch.full, strict=True):
        if source < 0:
            slot = states.slots[state]
            view = states.pool.face_corner[slot.face_start : slot.face_start + int(models.face_count[slot.model])]
            view.fill_(wp.vec3i(-1, -1, -1))
        elif source != state:
            pairs.append((source, state, states.slots[state].model, full))

    def launch(kernel, rows, lengths):
        if not rows:
            return
        end = np.cumsum(lengths)
        ends = [np.asarray(values, np.int32) for values in (end, [r[0] for r in rows], [r[1] for r in rows])]
        arrays = [wp.array(values, dtype=wp.int32, device=states.device) for values in ends]
        wp.launch(kernel, dim=int(end[-1]), inputs=[*arrays, states.pool], device=states.device)

    launch(refit.copy_face_kernel, pairs, [models.face_count[r[2]] for r in pairs])
    partial = [r for r in pairs if not r[3]]
    launch(refit.copy_node_kernel, partial, [models.node_count[r[2]] for r in partial])


def refine_meshes(models: ModelArrays, states: StateArrays, batch: UpdateBatch):
    """Set the active ancestors of every face corner that changes. Launches only."""
    if batch.entry_count:
        wp.launch(
            refine.refine_slice_kernel,
            dim=batch.entry_count,
            inputs=[
                batch.entry_count,
                models.pool,
                batch.entry_end,
                batch.partial_state,
                batch.partial_slice,
                states.pool,
            ],
            device=states.device,
        )
    if batch.full_face_count:
        wp.launch(
            refine.refine_all_kernel,
            dim=batch.full_face_count,
            inputs=[
                models.pool,
                batch.full_face_end,
                batch.full_state,
                batch.full_id,
                states.pool,
                batch.changed_count,
            ],
            device=states.device,
        )


def set_object_lods(
    models: ModelArrays, states: StateArrays, objects: ObjectArrays, object_model: np.ndarray, lods: np.ndarray
) -> UpdateStats:
    """Bring every object to a LOD: refine meshes, update trees, share states; states that no object uses are freed.

    Args:
        object_model: Model of each object, int (n,).
        lods: Target LOD of each object, int (n,), within its model's range.
    """
    keys, inverse = np.unique(np.stack([object_model, lods], 1), axis=0, return_inverse=True)
    wanted = [(int(m), int(lod)) for m, lod in keys]
    used = {int(s) for s in objects.state if s >= 0}
    plan, chosen = _plan(states, set(wanted), used)
    batch = _make_batch(models, states, plan)
    if plan.state:
        for state, lod in zip(plan.state, plan.lod, strict=True):
            states.slots[state].lod = lod
        states.upload_slots()
        _copy_states(models, states, plan, batch)
        refine_meshes(models, states, batch)
        active_update(models.pool, states.pool, batch)
    serving = np.array([chosen[key] for key in wanted], np.int32)[inverse.reshape(-1)]
    if not np.array_equal(serving, objects.state):
        for state in used - set(chosen.values()):
            states.free.setdefault(states.slots[state].model, []).append(state)
        objects.set_states(serving)
    return UpdateStats(batch)
