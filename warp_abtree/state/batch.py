"""Batch: models, tree states and posed objects on one device, with the object pairs that the broad phase leaves out."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import check_device, to_numpy
from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.state.arrays import ModelArrays, ObjectArrays, StateArrays
from warp_abtree.state.generation import Generation
from warp_abtree.state.lod_update import LodUpdate, choose_states
from warp_abtree.state.solids import SolidArrays

# The search with a gap, since LODs have changed, before which slabs are made at these.
SLAB_SEARCH = 2


class Batch(DeviceMemory):
    """Objects of a device that queries are about, the tree states that they stand at, and their models.

    `Scene.batch()` returns that of a scene, which makes another when objects are added; `Pipeline` and `sweep` make
    their own, on the same models.

    Args:
        models, states, objects: Arrays of one device.
        object_model: Model of each object, int (n,).
        excluded: Keys of pairs that the broad phase leaves out, see `exclusion_keys`.
        solid: Whether each object is a solid, (n,); empty for none.
        removed: Indices that pairs may not name.
        names: Of the objects, or none.

    Attributes:
        solids: `SolidArrays`, None where no object is a solid.
        device: Of the arrays.
        filter_generation: `Generation` of the excluded pairs.
        mean_faces: About how many faces an object has at its LOD, as the host knows it.
    """

    models: ModelArrays
    states: StateArrays
    objects: ObjectArrays

    def __init__(self, models, states, objects, object_model, excluded=(), solid=(), removed=(), names=()):
        self.device = states.device
        self.models, self.states, self.objects = models, states, objects
        self.object_model = np.asarray(object_model)
        self._lods = np.full(len(self.object_model), -1, np.int64)
        self._followed: Any = None
        self.excluded, self.removed, self.names = np.asarray(excluded, np.int64), list(removed), names
        self.filter_generation = Generation(self.device)
        self.mean_faces = float(models.face_count[self.object_model].mean()) if len(self.object_model) else 1.0
        self.solids = SolidArrays(models, states, solid) if np.any(solid) else None
        self.retired = False
        self._trees, self._trees_made = Trees(), (-1, 0, 0)
        self._slab_search = 0  # searches until slabs are made at the LODs as they stand, 0 where they need not be

    @property
    def lods(self) -> np.ndarray:
        """LOD of each object, int (n,); -1 before `set_lods`. Waits for the device while it chooses LODs."""
        self.catch_up()
        return self._lods

    def follow(self, followed):
        """Take it that `LevelStates` on the device points objects at states from now on."""
        self._followed = followed

    def follows(self, followed) -> bool:
        """Return whether what chooses LODs on the device is still this."""
        return self._followed is followed

    def catch_up(self):
        """Bring to the host where objects stand, if that is chosen on the device. Waits for it then."""
        if self._followed is None:
            return
        lods, states = self._followed.read()
        self._lods, self.objects.state = lods, states.astype(np.int32)
        for state, lod in zip(states.tolist(), lods.tolist()):
            self.states.slots[state].lod = lod

    def make_slabs(self):
        """Make slabs of nodes of few faces, for warps, unless there are any. Launches only."""
        self.models.make_slabs(self.trees)

    def fit_slabs(self):
        """Make slabs at the LOD of most objects of each model that are not at the finest one, once LODs have stood for
        some searches. Launches only."""
        if self._slab_search > 0 and len(self.models.pool.node_slab):
            self._slab_search -= 1
            if self._slab_search == 0:
                self._make_lod_slabs()

    def _make_lod_slabs(self):
        for model, lod_max in enumerate(self.models.lod_max):
            coarse = np.flatnonzero((self.object_model == model) & (self._lods < lod_max))
            if len(coarse):
                lod = int(np.bincount(self._lods[coarse]).argmax())
                state = int(self.objects.state[coarse[np.argmax(self._lods[coarse] == lod)]])
                slot = self.states.slots[state]
                if (slot.model, slot.lod) == (model, lod):  # not of an object that was removed
                    self.models.make_lod_slabs(self.trees, model, state, lod)

    @property
    def object_count(self) -> int:
        """How many objects there are."""
        return len(self.object_model)

    def has_solid(self, pairs=None) -> bool:
        """Return whether any object is a solid, of pairs (p, 2) any that they name where there are some."""
        if self.solids is None:
            return False
        return pairs is None or len(pairs) == 0 or bool(self.solids.is_solid[pairs].any())

    @property
    def trees(self) -> Trees:
        """`Trees` for kernels, of the arrays that are in use; a copy of their addresses, kept until they change."""
        models, states, objects = self.models.pool, self.states.pool, self.objects.pool
        made = self.states.generation.number, id(objects.state), id(models.node_slab)
        if made != self._trees_made:
            self._trees = trees = Trees()
            trees.models, trees.states, trees.objects = models, states, objects
            self._trees_made = made
        return self._trees

    def with_own_states(self, follows_poses: bool = False) -> Batch:
        """Return a batch of the same models and objects, posed alike now or always, that has no tree state yet."""
        placed = self.objects.pool
        bits = self.objects.collision_bits.numpy()
        objects = ObjectArrays(placed.world.numpy(), placed.is_static.numpy(), self.device, bits)
        if follows_poses:
            objects.pool.rotation, objects.pool.position = placed.rotation, placed.position
        else:
            wp.copy(objects.pool.rotation, placed.rotation)
            wp.copy(objects.pool.position, placed.position)
        states = StateArrays(self.models, self.device)
        solid = () if self.solids is None else self.solids.is_solid
        return Batch(self.models, states, objects, self.object_model, self.excluded, solid, self.removed, self.names)

    def set_lods(self, lods) -> LodUpdate:
        """Bring every object to an LOD, int (n,) within its model's range: wholly, or not at all."""
        self._lead()
        with self.states.change():
            stats = self._bring(lods)
            if not np.array_equal(self._lods, lods):
                self._slab_search = SLAB_SEARCH
            self._lods = np.array(lods)
        self._fit_solids()
        # The base mesh has a few faces, and each operation adds about as many as any other.
        share = (self._lods + 1) / (self.models.lod_max[self.object_model] + 1)
        self.mean_faces = float((self.models.face_count[self.object_model] * share).mean())
        return stats

    def replace_states(self, wanted: list, serving) -> np.ndarray:
        """Make a state for each wanted (model, LOD), serve each object from one of them, int (n,), and free all others.

        Wholly, or not at all; returns their ids, int32.
        """
        self._lead()
        with self.states.change():
            ids = np.array(self.states.reserve([model for model, _ in wanted]), np.int32)
            moves = [(state, lod, -1) for state, (_, lod) in zip(ids.tolist(), wanted, strict=True)]
            self._move(moves, ids[serving])
            self.states.free_others(ids)
            self._lods = np.array([lod for _, lod in wanted], np.int64)[serving]
        self._fit_solids()
        return ids

    def _bring(self, lods) -> LodUpdate:
        """Bring every object to an LOD, and share states; those that no object uses are freed."""
        keys, inverse = np.unique((self.object_model.astype(np.int64) << 32) + lods, return_inverse=True)
        wanted = [(key >> 32, key & (2**32 - 1)) for key in keys.tolist()]
        used = set(np.unique(self.objects.state[self.objects.state >= 0]).tolist())
        moves, chosen = choose_states(self.states, set(wanted), used)
        update = self._move(moves, np.array([chosen[key] for key in wanted], np.int32)[inverse.ravel()])
        for state in used - set(chosen.values()):
            self.states.free.setdefault(self.states.slots[state].model, []).append(state)
        return update

    def _move(self, moves, serving) -> LodUpdate:
        """Move states as `LodUpdate` does, and point objects at those that serve them, int (n,).

        All that it needs is allocated before the first state in use changes (`StateArrays.change`).
        """
        update = LodUpdate(self.models, self.states, moves)
        moved = not np.array_equal(serving, self.objects.state)
        staged = self.objects.stage_states(serving, self.states) if moved else None
        update.launch()
        if moved:
            self.objects.set_states(serving, staged)
        return update

    def _fit_solids(self):
        if self.solids is None:
            return
        try:
            self.solids.fit()
        except RuntimeError:  # the LODs have changed all the same: the next launch tries again, and raises
            self.solids.forget()

    def tear(self):
        """Say that an interruption has left tree states that no LOD explains."""
        self.states.generation.suspend()
        self.states.torn = True

    def _lead(self):
        """Choose LODs on the host again."""
        if self._followed is not None:
            self.catch_up()
            self._followed = None
            self.states.free_others(self.objects.state)

    def mend(self):
        """Make tree states anew that an interrupted change of LODs has left torn."""
        if not self.states.torn:
            return
        check_device(self.device, "making tree states anew")
        self._lead()
        self.states.reset()
        if self.solids is not None:
            self.solids.forget()
        self.objects.state = np.full(self.object_count, -1, np.int32)
        self._bring(self.lods)
        self._fit_solids()
        self.states.generation.resume()
        self.states.torn = False

    def retire(self):
        """Refuse operators from now on: the scene has other objects."""
        self.states.generation.advance()
        self.objects.generation.advance()
        self.retired = True

    def check(self, user: str):
        """Raise RuntimeError where the batch is no longer that of its scene; name its user, such as "query"."""
        if self.retired:
            raise RuntimeError(
                f"objects were added to the scene, removed or changed since this {user} was made; make a new one"
            )
        self.mend()

    def exclude(self, keys):
        """Leave these pairs out of every later broad phase, and no others."""
        self.filter_generation.advance()
        self.excluded = keys

    def check_pairs(self, pairs) -> np.ndarray:
        """Return object pairs as int32 (p, 2), see `check_pairs`."""
        return check_pairs(pairs, self.object_count, self.removed)


def scene_or_batch(scene):
    """Return a `Scene` or `Batch`; raise TypeError for anything else."""
    if not isinstance(scene, Batch) and not callable(getattr(type(scene), "batch", None)):
        raise TypeError(f"scene: a Scene or Batch is expected, not a {type(scene).__name__}")
    return scene


def check_pairs(pairs, object_count: int, removed=(), owner="the scene", kind="objects") -> np.ndarray:
    """Return object pairs as int32 (p, 2).

    Raises ValueError for a wrong shape, an index that is no object or was removed, an object paired with itself.
    """
    pairs = to_numpy(pairs, "pairs")
    if pairs.shape in ((0,), (0, 2)):
        return np.empty((0, 2), np.int32)
    if pairs.ndim != 2 or pairs.shape[1] != 2 or pairs.dtype.kind not in "iu":
        raise ValueError(f"pairs: shape {pairs.shape} and type {pairs.dtype}, not whole numbers of shape (p, 2)")
    # Of the same bits without a sign, a negative number is greater than any index.
    if pairs.astype(np.int64).view(np.uint64).max() >= object_count:
        bad = np.flatnonzero(((pairs < 0) | (pairs >= object_count)).any(1))
        raise ValueError(f"pairs: pair {bad[0]} is {tuple(pairs[bad[0]].tolist())}, {owner} has {object_count} {kind}")
    same = pairs[:, 0] == pairs[:, 1]
    if same.any():
        first = int(same.argmax())
        raise ValueError(f"pairs: pair {first} pairs object {pairs[first, 0]} with itself")
    if removed:
        gone = np.isin(pairs, removed)
        if gone.any():
            raise ValueError(f"pairs: pair {gone.any(1).argmax()} names object {pairs[gone][0]}, which was removed")
    return pairs.astype(np.int32, order="C")


def exclusion_keys(pairs: np.ndarray) -> np.ndarray:
    """Return sorted unique keys i * 2^32 + j, i < j, of pairs (p, 2) in either order, int64."""
    pairs = np.sort(np.asarray(pairs, np.int64).reshape(-1, 2), axis=1)
    return np.unique((pairs[:, 0] << 32) + pairs[:, 1])
