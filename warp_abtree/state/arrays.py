"""Models, tree states and objects as flat device arrays."""

from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.upload import struct_of
from warp_abtree.kernels.base.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.base.nodes import clear_node_kernel
from warp_abtree.kernels.base.poses import SLAB_DEPTH
from warp_abtree.kernels.search.make_slabs import make_slab_kernel
from warp_abtree.state.generation import Generation

# Columns of `StatePool` that mirror the host's slots.
SLOT_COLUMNS = ("model", "lod", "node_start", "face_start")
SLOTS_LEAST = 16  # states that the pool has room for at first
NO_CORNERS = wp.vec4i(-1, -1, -1, -1)  # of a face that is not active

# Levels of nodes that have slabs at coarse LODs beyond those at the finest: one thread measures all faces of a node.
MORE_LEVELS = 3


class ModelArrays(DeviceMemory):
    """Static arrays of several models, concatenated on one device.

    Attributes:
        pool: `ModelPool` for kernels.
        vertex_start, face_start, split_start, node_count, face_count, depth: NumPy, one entry a model.
        split_bounds: split_start of each model, offset into the pool's split_face.
        size: Longest side of each model's box [model units].
    """

    def __init__(self, models, device):
        forests, trees = [model.progressive for model in models], [model.tree for model in models]
        pairs = zip(forests, trees, strict=True)
        lengths = [(len(f.vertex_parent), f.face_count, len(f.split_face), tree.node_count) for f, tree in pairs]
        starts = np.concatenate([np.zeros((1, 4), np.int64), np.cumsum(lengths, axis=0)]).T
        self.vertex_start, self.face_start, self.split_start, self.node_start = starts
        # Vertices are looked up by four times their index in 32 bits.
        for what, total, power in (("vertices", self.vertex_start[-1], 30), ("face slices", self.split_start[-1], 31)):
            if total >= 2**power:
                raise ValueError(f"the models of one scene hold {total} {what}, more than 2^{power}")
        self.face_count, self.node_count = np.diff(self.face_start), np.diff(self.node_start)
        self.depth = np.array([tree.depth for tree in trees], np.int64)
        self.lod_max = np.array([f.lod_max for f in forests], np.int64)
        self._forests, self._slab_lods = forests, np.full(len(models), -1)  # the LOD beside the finest that has slabs
        self.size = np.array([np.ptp(f.vertex_pos[: f.vertex_count], axis=0).max() for f in forests])
        self.split_bounds = [f.split_start.astype(np.int64) + s for f, s in zip(forests, self.split_start)]
        first = self.vertex_start[:-1]
        parents = [np.where(f.vertex_parent < 0, -1, f.vertex_parent + s) for f, s in zip(forests, first)]
        centres = np.array([model.centre for model in models])

        def joined(parts):
            return np.concatenate(list(parts))

        def padded(points):
            return np.pad(points, ((0, 0), (0, 1)))

        self.device = device
        self.pool = struct_of(
            ModelPool,
            device,
            vertex_parent=joined(parents),
            vertex_pos=joined(padded(f.vertex_pos) for f in forests),
            vertex_near=joined(padded(f.vertex_pos - c).astype(np.float32) for f, c in zip(forests, centres)),
            face_vertex=joined(f.face_vertex + s for f, s in zip(forests, first)),
            face_split=joined(f.face_split for f in forests),
            split_face=joined(f.split_face for f in forests),
            leaf_node=joined(tree.leaf_node for tree in trees),
            node_face=joined(tree.node_face for tree in trees),
            node_slab=np.empty((0, 4)),
            slab_gain=np.zeros((2 * len(models), 2)),
            slab_first=np.tile(1 << np.maximum(0, self.depth - int(SLAB_DEPTH)), 2),
            slab_lod=self._slab_lods,
            face_start=self.face_start[:-1],
            face_count=self.face_count,
            depth=self.depth,
            node_start=self.node_start[:-1],
            finest_limit=first + [f.vertex_count for f in forests],
            lod_max=self.lod_max,
            centre=centres,
        )

    @property
    def lod_error(self) -> list:
        """Certified errors of each model, as `ProgressiveMesh` has them."""
        return [f.lod_error for f in self._forests]

    def make_slabs(self, trees):
        """Make slabs of nodes of few faces at the finest LODs, for warps, unless there are any. Launches only."""
        if len(self.pool.node_slab):
            return
        slabs = wp.empty(2 * int(self.node_start[-1]), dtype=wp.vec4, device=self.device)
        for model in range(len(self.depth)):
            self._make_slabs(trees, model, -1, slabs)
        self.pool.node_slab = slabs

    def make_lod_slabs(self, trees, model: int, state: int, lod: int):
        """Make slabs of a model's nodes as they are in a tree state, at a LOD, in the place of those of another LOD.
        Launches only."""
        if self._slab_lods[model] != lod:
            active = max(1, int(self._forests[model].active_count(lod)))
            self._make_slabs(trees, model, state, self.pool.node_slab, int(self.face_count[model]) // active)
            self._slab_lods[model] = lod

    def _make_slabs(self, trees, model, state, slabs, coarser=1):
        """Make slabs of nodes of some 8 faces at most, at an LOD with so many times fewer than the finest one has."""
        pool, at = self.pool, model + (len(self.depth) if state >= 0 else 0)
        levels = int(SLAB_DEPTH) + min(MORE_LEVELS, coarser.bit_length() - 1)
        first = 1 << max(0, int(self.depth[model]) - levels)
        start = int(self.node_start[model]) + (int(self.node_start[-1]) if state >= 0 else 0)
        pool.slab_gain[at : at + 1].zero_()
        pool.slab_first[at : at + 1].fill_(first)
        inputs = [model, state, first, trees, start, at, slabs, pool.slab_gain, pool.slab_lod]
        wp.launch(make_slab_kernel, int(self.node_count[model]) - first, inputs, device=self.device)


@dataclass
class Slot:
    """One tree state: where it lies, and what stands there."""

    model: int
    lod: int
    node_start: int
    face_start: int


class StateArrays(DeviceMemory):
    """A pool of tree states that grows; a freed state is taken again by the same model.

    Attributes:
        pool: `StatePool` for kernels, longer than what is in use. Growing replaces its arrays, which captured graphs
            cannot follow.
        generation: Of the arrays of the pool; retired where the scene makes others.
        growths: How often it has grown.
        slots: Host side of each state.
        free: Ids of states that no object uses, by model.
        torn: Whether a change of LODs was interrupted: states hold what no LOD explains until `reset`.
    """

    def __init__(self, models: ModelArrays, device):
        self.models = models
        self.device = device
        self.generation = Generation(device)
        self.slots: list[Slot] = []
        self.free: dict[int, list[int]] = {}
        self.torn = self._touched = False
        self.growths = 0
        self.node_total = 0
        self.face_total = 0
        self._uploaded = 0
        self.pool = StatePool()
        self._allocate_nodes(0)
        self._allocate_faces(0)
        self._allocate_slots(SLOTS_LEAST)

    def _grow(self, kept: int, **made):
        """Replace arrays of the pool, which keep so many entries, and count that."""
        for name, array in made.items() if kept else ():
            wp.copy(array, getattr(self.pool, name), count=kept)
        self.growths += 1
        self.generation.advance()
        for name, array in made.items():
            setattr(self.pool, name, array)

    def _allocate_nodes(self, count):
        kept, mark = self.node_total, wp.zeros(count // 32 + 1, dtype=wp.uint32, device=self.device)
        self._grow(2 * kept, node_box=wp.empty(2 * count, dtype=wp.vec4, device=self.device))
        self.pool.node_mark = mark
        wp.launch(clear_node_kernel, count - kept, [kept, self.pool], device=self.device)
        self.node_room = count

    def _allocate_faces(self, count):
        self._grow(self.face_total, face_corner=wp.full(count, NO_CORNERS, dtype=wp.vec4i, device=self.device))
        self.face_room = count

    def _allocate_slots(self, count):
        made = {name: wp.zeros(count, dtype=wp.int32, device=self.device) for name in SLOT_COLUMNS}
        self._grow(len(self.slots), **made)
        self.slot_room = count

    def reserve(self, wanted_models):
        """Take one state for each entry of a list of models and return their ids; contents are whatever stood there.

        Raises ValueError where the pool would pass 2^30 nodes.
        """
        fresh: list[int] = []
        ids = []
        spare = {model: list(ids) for model, ids in self.free.items()}
        for model in wanted_models:
            if spare.get(model):
                ids.append(spare[model].pop())
            else:
                ids.append(len(self.slots) + len(fresh))
                fresh.append(model)
        nodes = self.node_total + int(self.models.node_count[fresh].sum())
        faces = self.face_total + int(self.models.face_count[fresh].sum())
        if nodes >= 2**30:
            raise ValueError(f"the tree states of the scene would hold {nodes} nodes, more than 2^30; use fewer LODs")
        slots = len(self.slots) + len(fresh)
        if nodes > self.node_room:
            self._allocate_nodes(max(nodes, min(2 * self.node_room, 2**30 - 1)))
        if faces > self.face_room:
            self._allocate_faces(max(faces, min(2 * self.face_room, 2**31 - 1)))
        if slots > self.slot_room:
            self._allocate_slots(max(slots, 2 * self.slot_room))
        self.free = spare
        for model in fresh:
            self.slots.append(Slot(model, -1, self.node_total, self.face_total))
            self.node_total += int(self.models.node_count[model])
            self.face_total += int(self.models.face_count[model])
        return ids

    def free_others(self, used):
        """Let all states be taken again but those of some ids."""
        self.free = {}
        for state in sorted(set(range(len(self.slots))) - set(np.asarray(used).tolist())):
            self.free.setdefault(self.slots[state].model, []).append(state)

    def read_nodes(self, slot, count):
        """Return lower and upper bounds, float32 (count, 3), and skip ids of a slot's nodes. Waits for the device."""
        box = self.pool.node_box[2 * slot.node_start : 2 * (slot.node_start + count)].numpy().reshape(count, 2, 4)
        return box[:, 0, :3], box[:, 1, :3], np.ascontiguousarray(box[:, 0, 3]).view(np.int32)

    def upload_slots(self):
        """Bring model, LOD and starts of all states to the device, in place; of states known there the LOD alone."""
        for name in SLOT_COLUMNS if len(self.slots) > self._uploaded else ("lod",):
            values = np.array([getattr(slot, name) for slot in self.slots], np.int32)
            source = wp.array(values, dtype=wp.int32, device="cpu", copy=False)
            wp.copy(getattr(self.pool, name), source, count=len(values))
        self._uploaded = len(self.slots)

    def touch(self):
        """Say that from here on states in use change: what fails now leaves them torn."""
        self._touched = True

    @contextmanager
    def change(self):
        """Change LODs wholly or not at all.

        What fails before `touch`, as for lack of memory, leaves every state as it was; room that the pool has gained
        stays. What fails after it, an interruption among them, leaves the states torn, for `reset`.
        """
        lods = [slot.lod for slot in self.slots]
        held = {name: getattr(self, name) for name in ("node_total", "face_total")}
        held["free"] = {model: list(ids) for model, ids in self.free.items()}
        self.torn, self._touched = True, False
        try:
            yield
        except BaseException:
            self.generation.suspend()
            if not self._touched:
                del self.slots[len(lods) :]
                for slot, lod in zip(self.slots, lods, strict=True):
                    slot.lod = lod
                for name, value in held.items():
                    setattr(self, name, value)
                self.generation.resume()
                self.torn = False
            raise
        self.torn = False

    def reset(self):
        """Forget all states; the pool keeps its room."""
        self.slots, self.free, self._uploaded = [], {}, 0
        self.node_total = self.face_total = 0
        self.pool.node_mark.zero_()
        wp.launch(clear_node_kernel, self.node_room, [0, self.pool], device=self.device)


class ObjectArrays(DeviceMemory):
    """Posed objects of a scene on one device.

    Attributes:
        pool: `ObjectPool` for kernels.
        state: State of each object, NumPy int32 (n,), the host's copy of pool.state.
        generation: Of the arrays; retired where the scene makes others.
        collision_bits: Collision group and mask of each object, device vec2ui; empty where they keep no pair apart.
    """

    def __init__(self, worlds, statics, device, collision_bits=()):
        count = len(worlds)
        self.device = device
        self.state = np.full(count, -1, np.int32)
        placed = {"rotation": np.zeros((count, 3, 3)), "position": np.zeros((count, 3))}
        self.pool = struct_of(ObjectPool, device, state=self.state, world=worlds, is_static=statics, **placed)
        bits = np.asarray(collision_bits, np.uint32).reshape(-1, 2)
        self.collision_bits = wp.array(bits, dtype=wp.vec2ui, device=device)
        self.generation = Generation(device)
        self._pointed = 0

    def stage_states(self, state, states: StateArrays):
        """Return what `set_states` needs to point objects at states of a pool that has grown; None where it has not.

        A graph that was captured before reads the array that it knows: its tree states are none of the new ones.
        """
        if states.growths == self._pointed:
            return None
        return wp.array(state, dtype=wp.int32, device=self.device), states

    def set_states(self, state, staged=None):
        """Point every object at a state, int32 (n,)."""
        if staged is None:
            self.pool.state.assign(np.asarray(state, np.int32))
        else:
            # What has failed since the pool has grown may have launched on the array that stood here.
            array, states = staged
            states.generation.advance()
            self.pool.state, self._pointed = array, states.growths
        self.state = np.asarray(state, np.int32)
