"""What the benchmarks take from the library beyond the public names of its root; no other file of bench does."""

import contextlib
import math

import numpy as np
import warp as wp

from warp_abtree.app.pictures.plot import draw_controllers as draw_controllers
from warp_abtree.app.toml.scene_file import load_scene as load_scene
from warp_abtree.jobs.shards import SweepJob as SweepJob
from warp_abtree.jobs.shards import ThisProcess as ThisProcess
from warp_abtree.jobs.shards import run_shards as run_shards
from warp_abtree.kernels.arithmetic.predicates import EXACT as EXACT
from warp_abtree.kernels.arithmetic.predicates import FILTER as FILTER
from warp_abtree.kernels.arithmetic.predicates import FLOAT32 as FLOAT32
from warp_abtree.kernels.arithmetic.predicates import FLOAT64 as FLOAT64
from warp_abtree.kernels.triangle.float64_filter import decide_triangles as decide_triangles
from warp_abtree.lod.timing import WorkClock as WorkClock
from warp_abtree.model.mesh import load_mesh as load_mesh
from warp_abtree.model.tree import active_build as active_build
from warp_abtree.simulate.frame import FrameRow as FrameRow
from warp_abtree.state import update

REFITS = {"update": math.inf, "full": -1.0}  # fraction of the faces past which a state is refitted whole


def full_fraction(device) -> float:
    """Return the fraction of a state's faces past which the library refits its whole tree."""
    return update.full_share(device)


@contextlib.contextmanager
def forced_refit(kind):
    """Force partial ("update") or full ("full") refits; None leaves the choice to the library."""
    kept = update.FULL_SHARE
    update.FULL_SHARE = kept if kind is None else dict.fromkeys(kept, REFITS[kind])
    try:
        yield
    finally:
        update.FULL_SHARE = kept


class RecordedUpdate:
    """A change of LODs that was made once and whose launches can be repeated.

    Attributes:
        stats: What `set_lods` returned.
        entries: Faces in the slices between the LODs, repeats included.
    """

    def __init__(self, scene, lods, kind=None):
        batches, active_update = [], update.active_update

        def record(models, states, batch):
            batches.append(batch)
            active_update(models, states, batch)

        update.active_update = record
        try:
            with forced_refit(kind):
                self.stats = scene.set_lods(lods)
        finally:
            update.active_update = active_update
        (self._batch,) = batches
        self._models, self._states, _ = scene.arrays()
        self._targets = wp.clone(self._states.pool.lod)  # the next update writes in place
        self.entries = int(self._batch.slice_length.sum())

    def _clear(self):
        for name in ("changed_count", "marked_count", "level_count"):
            getattr(self._batch.plan, name).zero_()

    def launch(self):
        """Refine the meshes, mark and refit; the states must be at the LODs that the change began with."""
        self._clear()
        self._states.pool.lod = self._targets
        update.refine_meshes(self._models, self._states, self._batch)
        update.active_update(self._models.pool, self._states.pool, self._batch)

    def launch_refit(self):
        """Mark and refit alone, at the LODs that the change leads to."""
        self._clear()
        update.active_update(self._models.pool, self._states.pool, self._batch)


def read_bits(scene) -> list:
    """Return boxes, statuses and corners bit by bit, one row a state, in the order of model and LOD. Waits."""
    _, states, _ = scene.arrays()
    order = np.lexsort(([slot.lod for slot in states.slots], [slot.model for slot in states.slots]))
    pool, node_end = states.pool, states.node_total
    arrays = [pool.node_box[: 2 * node_end], pool.node_status[:node_end], pool.face_corner[: states.face_total]]
    return [array.numpy().view(np.int32).reshape(len(states.slots), -1)[order] for array in arrays]


def state_lods(scene) -> list:
    """Return the LOD of every state."""
    return [slot.lod for slot in scene.arrays()[1].slots]


def upload_lods(scene):
    """Write the host's LODs of the states to the device, after repeated launches."""
    scene.arrays()[1].upload_slots()
