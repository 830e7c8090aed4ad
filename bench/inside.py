"""What the benchmarks take from packages of the library beyond its root and `testing`; no other file does."""

import numpy as np

from warp_abtree.app import draw_controllers, load_scene
from warp_abtree.jobs import SweepJob, ThisProcess, run_shards
from warp_abtree.kernels.arithmetic.predicates import EXACT, FILTER, FLOAT32, UNCERTAIN
from warp_abtree.kernels.triangle.float32_filter import FLOAT32_UNIT, float32_filter_triangles
from warp_abtree.kernels.triangle.float64_filter import decide_triangles
from warp_abtree.lod.timing import WorkClock
from warp_abtree.model.mesh import load_mesh
from warp_abtree.model.tree import active_build
from warp_abtree.simulate.budget_report import budget_report, step_response
from warp_abtree.simulate.frame import FrameRow
from warp_abtree.state.lod_update import full_refit_fraction

__all__ = [
    "EXACT",
    "FILTER",
    "FLOAT32",
    "FLOAT32_UNIT",
    "UNCERTAIN",
    "FrameRow",
    "SweepJob",
    "ThisProcess",
    "WorkClock",
    "active_build",
    "budget_report",
    "decide_triangles",
    "draw_controllers",
    "float32_filter_triangles",
    "full_refit_fraction",
    "load_mesh",
    "load_scene",
    "read_bits",
    "run_shards",
    "state_lods",
    "step_response",
    "upload_lods",
]


def read_bits(scene) -> list:
    """Return boxes, statuses and corners bit by bit, one row a state, in the order of model and LOD. Waits."""
    states = scene.batch().states
    order = np.lexsort(([slot.lod for slot in states.slots], [slot.model for slot in states.slots]))
    pool, node_end = states.pool, states.node_total
    arrays = [pool.node_box[: 2 * node_end], pool.node_status[:node_end], pool.face_corner[: states.face_total]]
    return [array.numpy().view(np.int32).reshape(len(states.slots), -1)[order] for array in arrays]


def state_lods(scene) -> list:
    """Return the LOD of every state."""
    return [slot.lod for slot in scene.batch().states.slots]


def upload_lods(scene):
    """Write the host's LODs of the states to the device, after repeated launches."""
    scene.batch().states.upload_slots()
