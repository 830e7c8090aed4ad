"""Models, tree states and objects as flat device arrays."""

from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.kernels.base.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.base.nodes import clear_node_kernel
from warp_abtree.kernels.base.poses import SLAB_DEPTH
from warp_abtree.kernels.search.make_slabs import make_slab_kernel
from warp_abtree.state.generation import Generation

# Columns of `StatePool` that mirror the host's slots.
SLOT_COLUMNS = ("model", "lod", "node_start", "face_start")
SLOTS_LEAST = 16  # states that the pool has room for at first


def _upload(values, dtype, device):
    return wp.array(values, dtype=dtype, device=device)


class ModelArrays(DeviceMemory):
    """Static arrays of several models, concatenated on one device.

    Attributes:
        pool: `ModelPool` for kernels.
        device: As given.
        vertex_start, face_start, split_start, node_count, face_count, depth: NumPy, one entry a model.
        split_bounds: split_start of each model, offset into the pool's split_face.
        size: Longest side of each model's box [model units].
    """

    def __init__(self, models, device):
        def starts(lengths):
            return np.concatenate([[0], np.cumsum(lengths)])

        forests = [model.progressive for model in models]
        self.vertex_start = starts([len(f.vertex_parent) for f in forests])
        self.face_start = starts([f.face_count for f in forests])
        self.split_start = starts([len(f.split_face) for f in forests])
        self.node_start = starts([model.tree.node_count for model in models])
        # Vertices are looked up by four times their index in 32 bits.
        for what, total, power in (("vertices", self.vertex_start[-1], 30), ("face slices", self.split_start[-1], 31)):
            if total >= 2**power:
                raise ValueError(f"the models of one scene hold {total} {what}, more than 2^{power}")
        self.face_count = np.array([f.face_count for f in forests], np.int64)
        self.node_count = np.array([model.tree.node_count for model in models], np.int64)
        self.depth = np.array([model.tree.depth for model in models], np.int64)
        self.lod_max = np.array([f.lod_max for f in forests], np.int64)
        self._forests = forests
        self.size = np.array([np.ptp(f.vertex_pos[: f.vertex_count], axis=0).max() for f in forests])
        self.split_bounds = [
            f.split_start.astype(np.int64) + s for f, s in zip(forests, self.split_start[:-1], strict=True)
        ]

        def joined(parts, dtype):
            return _upload(np.ascontiguousarray(np.concatenate(parts)), dtype, device)

        parents = [
            np.where(f.vertex_parent < 0, -1, f.vertex_parent + s).astype(np.int32)
            for f, s in zip(forests, self.vertex_start[:-1], strict=True)
        ]
        corners = [(f.face_vertex + s).astype(np.int32) for f, s in zip(forests, self.vertex_start[:-1], strict=True)]
        pool = ModelPool()
        pool.vertex_parent = joined(parents, wp.int32)
        pool.vertex_pos = joined([np.pad(f.vertex_pos, ((0, 0), (0, 1))) for f in forests], wp.vec4d)
        near = [np.pad(model.progressive.vertex_pos - model.centre, ((0, 0), (0, 1))) for model in models]
        pool.vertex_near = joined([x.astype(np.float32) for x in near], wp.vec4)
        pool.face_vertex = joined(corners, wp.vec3i)
        pool.face_split = joined([f.face_split for f in forests], wp.int32)
        pool.split_face = joined([f.split_face for f in forests], wp.int32)
        pool.leaf_node = joined([model.tree.leaf_node for model in models], wp.int32)
        pool.node_face = joined([model.tree.node_face for model in models], wp.int32)
        pool.face_start = _upload(self.face_start[:-1].astype(np.int32), wp.int32, device)
        pool.face_count = _upload(self.face_count.astype(np.int32), wp.int32, device)
        pool.depth = _upload(self.depth.astype(np.int32), wp.int32, device)
        pool.node_start = _upload(self.node_start[:-1].astype(np.int32), wp.int32, device)
        finest = [s + f.vertex_count for f, s in zip(forests, self.vertex_start[:-1], strict=True)]
        pool.finest_limit = _upload(np.array(finest, np.int32), wp.int32, device)
        pool.lod_max = _upload(self.lod_max.astype(np.int32), wp.int32, device)
        pool.centre = _upload(np.array([model.centre for model in models]), wp.vec3d, device)
        pool.node_slab = wp.empty(0, dtype=wp.vec4, device=device)
        pool.slab_gain = wp.zeros(len(models), dtype=wp.vec2i, device=device)
        self.pool, self.device = pool, device

    @property
    def lod_error(self) -> list:
        """Certified errors of each model, as `ProgressiveMesh` has them."""
        return [f.lod_error for f in self._forests]

    def make_slabs(self):
        """Make slabs of nodes of few faces, for warps, unless there are any. Launches only."""
        if len(self.pool.node_slab):
            return
        slabs = wp.empty(int(self.node_start[-1]), dtype=wp.vec4, device=self.device)
        for model, depth in enumerate(self.depth):
            first = 1 << max(0, int(depth) - int(SLAB_DEPTH))
            inputs = [model, first, self.pool, slabs, self.pool.slab_gain]
            wp.launch(make_slab_kernel, int(self.node_count[model]) - first, inputs, device=self.device)
        self.pool.node_slab = slabs


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

    def _grow(self):
        """Count a replacement of arrays."""
        self.growths += 1
        self.generation.advance()

    def _allocate_nodes(self, count):
        old, kept = self.pool, self.node_total
        mark = wp.zeros(count // 32 + 1, dtype=wp.uint32, device=self.device)
        box = wp.empty(2 * count, dtype=wp.vec4, device=self.device)
        if kept:
            wp.copy(box, old.node_box, count=2 * kept)
        self._grow()
        self.pool.node_mark, self.pool.node_box = mark, box
        wp.launch(clear_node_kernel, count - kept, [kept, self.pool], device=self.device)
        self.node_room = count

    def _allocate_faces(self, count):
        old, kept = self.pool, self.face_total
        array = wp.full(count, wp.vec4i(-1, -1, -1, -1), dtype=wp.vec4i, device=self.device)
        if kept:
            wp.copy(array, old.face_corner, count=kept)
        self._grow()
        self.pool.face_corner = array
        self.face_room = count

    def _allocate_slots(self, count):
        made = {name: wp.zeros(count, dtype=wp.int32, device=self.device) for name in SLOT_COLUMNS}
        kept = len(self.slots)
        for name, array in made.items():
            if kept:
                wp.copy(array, getattr(self.pool, name), count=kept)
        self._grow()
        for name, array in made.items():
            setattr(self.pool, name, array)
        self.slot_room = count

    def reserve(self, wanted_models):
        """Take one state for each entry of a list of models and return their ids; contents are whatever stood there.

        Raises:
            ValueError: The pool would pass 2^30 nodes.
        """
        fresh = []
        ids = []
        spare = {model: list(ids) for model, ids in self.free.items()}
        for model in wanted_models:
            if spare.get(model):
                ids.append(spare[model].pop())
            else:
                ids.append(len(self.slots) + len(fresh))
                fresh.append(model)
        nodes = self.node_total + sum(int(self.models.node_count[m]) for m in fresh)
        faces = self.face_total + sum(int(self.models.face_count[m]) for m in fresh)
        if nodes >= 2**30:
            raise ValueError(f"the tree states of the scene would hold {nodes} nodes, more than 2^30; use fewer LODs")
        if nodes > self.node_room:
            self._allocate_nodes(max(nodes, min(2 * self.node_room, 2**30 - 1)))
        if faces > self.face_room:
            self._allocate_faces(max(faces, min(2 * self.face_room, 2**31 - 1)))
        if len(self.slots) + len(fresh) > self.slot_room:
            self._allocate_slots(max(len(self.slots) + len(fresh), 2 * self.slot_room))
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
        self.pool = ObjectPool()
        self.pool.state = wp.full(count, -1, dtype=wp.int32, device=device)
        self.pool.world = _upload(np.asarray(worlds, np.int32), wp.int32, device)
        self.pool.is_static = _upload(np.asarray(statics, np.int32), wp.int32, device)
        self.pool.rotation = wp.zeros(count, dtype=wp.mat33d, device=device)
        self.pool.position = wp.zeros(count, dtype=wp.vec3d, device=device)
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
