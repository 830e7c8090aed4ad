"""LOD updates that the device plans, inside a captured graph: LODs are read there, and no launch waits for the host."""

from collections.abc import Callable

import numpy as np
import warp as wp

from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.base.arrays import LEVEL_MAX
from warp_abtree.kernels.update import block_update, work_lists
from warp_abtree.kernels.update import levels as level_kernels
from warp_abtree.state.arrays import ModelArrays, StateArrays
from warp_abtree.state.batch import Batch
from warp_abtree.state.work_lists import WorkLists, block_limits, make_level_lists, partial_limit

# LODs wanted on the device that are out of range, and the lowest index that had one.
NO_FAULTS = (0, 2**31 - 1)


class DeviceLodUpdate(WorkLists):
    """Bring every state of a pool to LODs that stand on the device, planned there: allocates once, launches many.

    The worklists have room for the worst case: every state of a pool that grows no more moves, or those of some ids, by
    the longest slice that is not refitted whole. From the first launch on, LODs are known on the device only.

    Args:
        takes_any: States of which no LOD that is wanted is a fault, those of places without an object.

    Attributes:
        wanted: LOD of each state, device int32 (s,), to be written before a launch.
        faults: LODs wanted out of range (the nearer end is taken) and the lowest state that had one, device int32 (2,).
    """

    def __init__(self, models: ModelArrays, states: StateArrays, moving=None, takes_any=()):
        self.models, self.states = models, states
        device = states.device
        owner = np.array([slot.model for slot in states.slots])[slice(None) if moving is None else moving]
        bounds = [len(bound) for bound in models.split_bounds]
        longest = np.array([bound[-1] - bound[0] for bound in models.split_bounds])
        count = len(owner)
        block_max, block_whole = block_limits(models, count, device)
        partial_max = np.minimum(longest, partial_limit(models, block_max, device))
        # What no block takes has room in the lists.
        entries = np.where(partial_max > block_max, partial_max, 0)[owner]
        faces = np.where(block_whole, 0, models.face_count)[owner]
        depth = np.where(entries + faces > 0, models.depth[owner], -1)
        levels = range(int(depth.max()) + 1)
        level_room = [int(np.sum(depth >= level)) << level for level in levels]
        marked_room = [int(np.minimum(entries, 1 << level)[depth >= level].sum()) for level in levels]
        whole_room = np.array([np.sum((depth >= level) & (faces > 0)) for level in range(int(LEVEL_MAX))])

        self.splits = struct_of(
            work_lists.SplitTable,
            device,
            bound=np.concatenate(models.split_bounds),
            bound_start=np.cumsum(bounds) - bounds,
            partial_max=partial_max,
            block_max=np.minimum(block_max, 2**31 - 1),
            block_whole=block_whole,
        )
        lengths = dict.fromkeys(("partial_total", "full_total", "block_count"), 1)
        lengths |= dict.fromkeys(("block_state", "block_start", "block_length", "partial_state"), count)
        lengths |= dict.fromkeys(("slice_start", "entry_end", "full_state", "face_end"), count)
        lengths |= dict.fromkeys(("changed_count", "marked_count"), len(states.slots))
        lengths |= {"whole_count": int(LEVEL_MAX), "whole_state": int(whole_room.sum())}
        rooms = {name: np.zeros(length, np.int32) for name, length in lengths.items()}
        rooms["takes_any"] = np.isin(np.arange(len(states.slots)), takes_any).astype(np.int32)
        plan = struct_of(work_lists.UpdateLists, device, whole_start=np.cumsum(whole_room) - whole_room, **rooms)
        make_level_lists(plan, marked_room, device)
        self.wanted = wp.array([slot.lod for slot in states.slots], dtype=wp.int32, device=device)
        self.faults = wp.array(NO_FAULTS, dtype=wp.int32, device=device)
        blocks, deepest = count if (block_whole | (block_max > 0)).any() else 0, int(models.depth.max())
        super().__init__(plan, blocks, deepest, int(entries.sum()), int(faces.sum()), level_room, device)

    def launch(self):
        """Refine meshes and update trees. Launches only: one, where there are trees that no block takes six more, and
        one for each level that has much to refit.

        Where it is interrupted, the next launch refits every state whole.
        """
        try:
            self._launch()
        except BaseException:
            self.states.pool.lod.fill_(int(work_lists.UNKNOWN))
            # A whole refit clears no mark, and walks would stop at one that is left.
            self.states.pool.node_mark.zero_()
            raise

    def _launch(self):
        count = len(self.wanted)
        if self.entry_room + self.face_room == 0:
            inputs = [self.models.pool, self._scratch, self.splits, self.wanted]
            inputs += [self.states.pool, self.faults, self.plan]
            self.launch_blocks(block_update.wanted_update, count, inputs)
            return
        wp.launch(work_lists.clear_plan_kernel, max(count, int(LEVEL_MAX)), [self.plan], device=self.device)
        inputs = [self.models.pool, self.splits, self.wanted, self.states.pool, self.plan, self.faults]
        wp.launch(work_lists.plan_update_kernel, count, inputs, device=self.device)
        self.update(self.models.pool, self.states.pool)


def shares_levels(object_model, levels) -> np.ndarray:
    """Return of each model whether its objects share tree states, one a level: where there are fewer levels than them.

    `object_model` has the model of each object, int (n,), `levels` the LODs of each model, a list of arrays.
    """
    lengths = np.array([len(part) for part in levels])
    return np.bincount(object_model, minlength=len(lengths)) > lengths


class LevelStates:
    """Serve LODs that stand on the device: objects stand at levels of LOD ladders, and change them on the device.

    A model's levels have a tree state each, made beforehand, so that a change of LOD costs an index; or each of its
    objects has a state of its own, updated in place. Takes over the states of a batch; the host's side of it follows by
    `read` (`Batch.follow`).

    Args:
        batch: Whose objects are served.
        levels: LODs that objects of each model may stand at, rising.
        lods: LOD that each object starts at, int (n,).
        shared: Models whose levels have states, bool (models,); None is all.
        wanted: What to take for the attribute of this name; None makes one.

    Attributes:
        wanted: LOD of each object, device int32 (n,), to be written before a launch; the coarsest level that is not
            coarser serves it.
        faults: LODs wanted below 0 or beyond the last level (the nearer end is taken) and the lowest object that had
            one, device int32 (2,).
        levels: `kernels.update.levels.Levels`.
        level_model, level_lod: Model and LOD of each level, int arrays.
        plan: `UpdateLists` of states that are updated; None where there are none.
    """

    def __init__(self, batch: Batch, levels, lods, shared=None, wanted=None):
        self.batch, self.device = batch, batch.device
        model, shared = batch.object_model, np.full(len(levels), True) if shared is None else shared
        starts = np.concatenate([[0], np.cumsum([len(part) for part in levels])])
        self.level_model, self.level_lod = np.repeat(np.arange(len(levels)), np.diff(starts)), np.concatenate(levels)
        keys = (self.level_model << 32) + self.level_lod
        placed = np.minimum(np.searchsorted(keys, (model << 32) + np.asarray(lods)), starts[model + 1] - 1)
        beforehand, own = np.flatnonzero(shared[self.level_model]), np.flatnonzero(~shared[model])
        # States of levels first, then those of objects.
        made = np.full(len(keys), -1)
        made[beforehand] = np.arange(len(beforehand))
        serving = made[placed]
        serving[own] = len(beforehand) + np.arange(len(own))
        state_level = np.concatenate([beforehand, placed[own]])
        asked = zip(self.level_model[state_level].tolist(), self.level_lod[state_level].tolist())
        ids = batch.replace_states(list(asked), serving)
        self._level_state = np.where(made >= 0, ids[made], -1)
        self._update, self.plan = None, None
        if len(own):
            self._update = DeviceLodUpdate(batch.models, batch.states, ids[len(beforehand) :])
            self.plan = self._update.plan
        if wanted is None:
            wanted = wp.array(self.level_lod[placed], dtype=wp.int32, device=self.device)
        self.wanted = wanted
        self.faults = wp.array(NO_FAULTS, dtype=wp.int32, device=self.device)
        self.levels = struct_of(
            level_kernels.Levels,
            self.device,
            object_model=model,
            wanted=self.wanted,
            faults=self.faults,
            start=starts,
            lod=self.level_lod,
            state=self._level_state,
            level=placed,
            direction=0 * placed,
            count=np.bincount(placed, minlength=len(self.level_lod)),
            state_lod=[] if self._update is None else self._update.wanted,
            change=0 * placed,
        )

    def launch(self, place: Callable[[], None]):
        """Bring objects to their levels: those of `place`, and those of `DeviceLodUpdate` where states are updated.

        `place` launches a kernel that calls `place_level` for each object.
        """
        try:
            place()
            if self._update is not None:
                self._update.launch()
        except BaseException:
            if self.batch.follows(self):
                self.batch.tear()
            raise

    def load(self):
        """Load the kernels that update states, by launching them while every state is at its LOD."""
        if self._update is not None:
            self._update.launch()

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return LOD and tree state of every object as the last launch has left them. Waits for the device."""
        level = self.levels.level.numpy()
        state = self._level_state[level]
        return self.level_lod[level], np.where(state >= 0, state, self.batch.objects.state)
