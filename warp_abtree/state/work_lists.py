"""Worklists of an LOD update, and ACTIVE-UPDATE, which works through them.

Source: Liu, Georganas and Roth 2006, section 3.2.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.kernels.arrays import LEVEL_MAX
from warp_abtree.kernels.update import mark, refine, refit
from warp_abtree.kernels.update.work_lists import UpdateLists

# Nodes of a level that one block refits, at most: a launch costs about as much. And the threads of that block.
TOP_ROOM = 1024
TOP_THREADS = 512
# Threads that a GPU runs at a time, of each multiprocessor: more take turns over what they work off.
THREADS_AT_ONCE = 2048


def launch_items(kernel, items: int, inputs: list, device):
    """Launch a kernel over at most so many items; how many there are, it reads on the device.

    The kernel takes (step) before its inputs: thread `tid` works on the items tid, tid + step, and so on.
    """
    if items:
        step = min(items, THREADS_AT_ONCE * device.sm_count) if device.is_cuda else 1
        wp.launch(kernel, dim=step, inputs=[step, *inputs], device=device)


@dataclass
class WorkLists:
    """What the kernels of an update of many tree states work through, and the most that there can be of it.

    Attributes:
        plan: `UpdateLists` for kernels.
        entry_room, face_room: Faces in the slices of partial updates, and of states under full update, at most.
        level_room: Nodes to refit on each level, the root's first, at most; as many entries as there are levels.
    """

    plan: UpdateLists
    entry_room: int
    face_room: int
    level_room: list
    device: wp.Device


def make_level_lists(plan: UpdateLists, marked_room: list, device):
    """Make the worklists of an update, each of its own length."""
    room = np.zeros(int(LEVEL_MAX), np.int64)
    room[: len(marked_room)] = marked_room
    starts = np.cumsum(room) - room
    plan.level_start = wp.array(starts.astype(np.int32), dtype=wp.int32, device=device)
    plan.level_count = wp.zeros(int(LEVEL_MAX), dtype=wp.int32, device=device)
    plan.level_node = wp.empty(int(room.sum()), dtype=wp.vec2i, device=device)


def refine_meshes(models, states, work: WorkLists):
    """Set the active ancestors of every face corner that changes. Launches only.

    Args:
        models, states: `ModelPool` and `StatePool` of one device.
    """
    launch_items(refine.refine_slice_kernel, work.entry_room, [models, work.plan, states], work.device)
    launch_items(refine.refine_all_kernel, work.face_room, [models, states, work.plan], work.device)


def active_mark(models, states, work: WorkLists):
    """Mark the leaves of every affected face and their ancestors deformed, each node once (ACTIVE-MARK)."""
    launch_items(mark.mark_path_kernel, work.entry_room, [models, states, work.plan], work.device)


def active_walk(models, states, work: WorkLists):
    """Refit what is marked, and every node of states under full update, deepest level first (ACTIVE-WALK).

    One launch a level, and one for all those from the root on that have little to refit.
    """
    top = next((level for level, room in enumerate(work.level_room) if room > TOP_ROOM), len(work.level_room))
    for level in reversed(range(top, len(work.level_room))):
        launch_items(refit.refit_level_kernel, work.level_room[level], [level, models, work.plan, states], work.device)
    if top:
        threads = TOP_THREADS if work.device.is_cuda else 1
        inputs = [threads, top, models, work.plan, states]
        wp.launch(refit.refit_top_kernel, threads, inputs, block_dim=threads, device=work.device)


def active_update(models, states, work: WorkLists):
    """Bring boxes, status and skip links to the corners that refinement has set (ACTIVE-UPDATE).

    Leaves the very same bits as a rebuild of all boxes at that LOD. Launches only, two and one for each level that has
    much to refit; no host synchronisation.

    Args:
        models, states: `ModelPool` and `StatePool` of one device.
        work: What to update; its worklists and counters are written.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-UPDATE; Algorithm 1.
    """
    active_mark(models, states, work)
    active_walk(models, states, work)
