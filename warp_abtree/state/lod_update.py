"""LOD updates that the host plans: which state serves which target, and the faces I, R and D that change."""

from functools import partial
from itertools import pairwise

import numpy as np
import warp as wp

from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.base.arrays import LEVEL_MAX
from warp_abtree.kernels.update import refit
from warp_abtree.kernels.update.work_lists import WHOLE, UpdateLists
from warp_abtree.state.arrays import NO_CORNERS, ModelArrays, StateArrays
from warp_abtree.state.work_lists import WorkLists, block_limits, make_level_lists, partial_limit


def choose_states(states: StateArrays, wanted: set, used: set) -> tuple[list, dict]:
    """Return moves (state, lod, source), and the state of every wanted (model, lod).

    States that stand at a target stay; every other target takes the nearest state that no target keeps, in place,
    else a new state that starts as a copy of the nearest, its source; -1 for none. Nearest is by the length of the
    slice between them.
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

    moves, copies = [], []
    for key in sorted(wanted - chosen.keys()):
        spare = movable.get(key[0], [])
        if spare:
            state = min(spare, key=partial(distance, key))
            spare.remove(state)
            chosen[key] = state
            moves.append((state, key[1], state))
        else:
            copies.append(key)
    sources = [min(by_model.get(key[0], [-1]), key=partial(distance, key)) for key in copies]
    for state, key, source in zip(states.reserve([key[0] for key in copies]), copies, sources, strict=True):
        chosen[key] = state
        moves.append((state, key[1], source))
    return moves, chosen


class LodUpdate(WorkLists):
    """Plan of a change of LODs, one entry an updated state: allocated when made, then launched once.

    Args:
        moves: (state, lod, source) of each update, as `choose_states` returns them.

    Attributes:
        state, lod: State and its new LOD, int32 (u,).
        source: State that each starts from, itself, another, or -1 for none, int32 (u,).
        full: Whether the whole tree is refitted, bool (u,).
        slice_length: Faces in the slice between the LODs, repeats included; 0 where full, int64 (u,).
    """

    def __init__(self, models: ModelArrays, states: StateArrays, moves: list):
        self.models, self.states = models, states
        self.state, self.lod, self.source = np.array(moves, np.int32).reshape(-1, 3).T
        owner = np.array([states.slots[s].model for s in self.state], np.int64)
        self._owner, self._face_count = owner, models.face_count[owner]
        longest, whole = block_limits(models, len(self.state), states.device)
        slice_start = self._measure_slices(partial_limit(models, longest, states.device))
        blocks = np.where(self.full, whole[owner], self.slice_length <= longest[owner])
        lists = self._list_blocks(slice_start, blocks)
        plan, entries, faces, level_room = self._list_work(lists, slice_start, ~blocks)
        super().__init__(plan, int(blocks.sum()), int(models.depth.max()), entries, faces, level_room, states.device)
        self._copies = self._plan_copies()

    def __repr__(self):
        return f"LodUpdate({len(self.state)} states updated, {int(np.sum(self.full))} of them whole)"

    @property
    def k(self) -> np.ndarray:
        """Distinct faces inserted, removed or deformed, int32 (u,). Waits for the device."""
        return self.plan.changed_count.numpy()[self.state]

    @property
    def nodes_refitted(self) -> np.ndarray:
        """Nodes refitted, leaves among them, int32 (u,). Waits for the device.

        At most k (log2 n - log2 k + 2) - 1 where the update is partial (equation 1, n rounded up to a power of two).
        """
        marked = self.plan.marked_count.numpy()[self.state]
        return np.where(self.full, 2 * self._face_count - 1, marked).astype(np.int32)

    def _measure_slices(self, limit):
        """Find the slice of each update: the faces touched between two LODs are contiguous, whatever the distance."""
        start, self.slice_length = (np.zeros(len(self.state), np.int64) for _ in range(2))
        self.full = np.ones(len(self.state), bool)
        for i in np.flatnonzero(self.source >= 0):
            bounds = self.models.split_bounds[self._owner[i]]
            low, high = sorted((int(self.lod[i]), self.states.slots[self.source[i]].lod))
            touched = int(bounds[high] - bounds[low])
            if touched <= limit[self._owner[i]]:
                self.full[i], start[i], self.slice_length[i] = False, bounds[low], touched
        return start

    def _list_blocks(self, slice_start, blocks) -> dict:
        """Return lists of what blocks update, in one transfer: a tenth of the time of one for each."""
        lengths = np.where(self.full, int(WHOLE), self.slice_length)
        counts = np.zeros(len(self.states.slots), np.int64)
        parts = [[blocks.sum()], self.state[blocks], slice_start[blocks], lengths[blocks], counts, counts]
        array = wp.array(np.concatenate(parts), dtype=wp.int32, device=self.states.device)
        names = "block_count", "block_state", "block_start", "block_length", "changed_count", "marked_count"
        ends = [0, *np.cumsum([len(part) for part in parts]).tolist()]
        return {name: array[first:end] for name, (first, end) in zip(names, pairwise(ends), strict=True)}

    def _list_work(self, lists: dict, slice_start, listed):
        """Return the plan for kernels, with level lists of some updates, and room of entries, faces and levels."""
        partial_id, whole = np.flatnonzero(~self.full & listed), np.flatnonzero(self.full & listed)
        if not listed.any():
            return struct_of(UpdateLists, self.states.device, **lists), 0, 0, []
        depth = self.models.depth[self._owner]
        # Deepest first, so that the states that have a level are the first of the list.
        whole = whole[np.argsort(-depth[whole], kind="stable")]
        entry_end, face_end = np.cumsum(self.slice_length[partial_id]), np.cumsum(self._face_count[whole])
        entries = int(entry_end[-1]) if len(partial_id) else 0
        faces = int(face_end[-1]) if len(whole) else 0
        levels = range(int(depth[listed].max()) + 1)
        whole_count = np.array([np.sum(depth[whole] >= level) for level in range(int(LEVEL_MAX))], np.int64)
        marked_room = [min(entries, int(np.sum(depth[partial_id] >= level)) << level) for level in levels]
        level_room = [room + (int(whole_count[level]) << level) for level, room in enumerate(marked_room)]
        plan = struct_of(
            UpdateLists,
            self.states.device,
            **lists,
            partial_total=[(len(partial_id) << 32) + entries],
            partial_state=self.state[partial_id],
            slice_start=slice_start[partial_id],
            entry_end=entry_end,
            full_total=[(len(whole) << 32) + faces],
            full_state=self.state[whole],
            face_end=face_end,
            whole_count=whole_count,
            whole_start=np.zeros(int(LEVEL_MAX)),
        )
        plan.whole_state = plan.full_state
        make_level_lists(plan, marked_room, self.states.device)
        return plan, entries, faces, level_room

    def _plan_copies(self) -> list:
        """Return the launches that copy the source of every state that starts from another: kernel, dim and inputs."""
        models, pool = self.models, self.states.pool
        copied = np.flatnonzero((self.source >= 0) & (self.source != self.state))

        def launches(kernel, rows, lengths):
            if not len(rows):
                return []
            end = np.cumsum(lengths[self._owner[rows]])
            ends = [np.asarray(values, np.int32) for values in (end, self.source[rows], self.state[rows])]
            arrays = [wp.array(values, dtype=wp.int32, device=self.states.device) for values in ends]
            return [(kernel, int(end[-1]), [*arrays, pool])]

        return [
            *launches(refit.copy_face_kernel, copied, models.face_count),
            *launches(refit.copy_node_kernel, copied[~self.full[copied]], models.node_count),
        ]

    def launch(self):
        """Move the states, copies before anything moves; only launches and small transfers."""
        models, states = self.models, self.states
        states.touch()
        if not len(self.state):
            return
        for state, lod in zip(self.state.tolist(), self.lod.tolist()):
            states.slots[state].lod = lod
        states.upload_slots()
        for state in self.state[self.source < 0]:
            slot = states.slots[state]
            end = slot.face_start + int(models.face_count[slot.model])
            states.pool.face_corner[slot.face_start : end].fill_(NO_CORNERS)
        for kernel, threads, inputs in self._copies:
            wp.launch(kernel, dim=threads, inputs=inputs, device=states.device)
        self.relaunch()

    def relaunch(self):
        """Refine meshes and update trees from the LODs that stand there. Launches only."""
        self.update(self.models.pool, self.states.pool)
