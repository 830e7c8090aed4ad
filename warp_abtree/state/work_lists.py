"""Worklists of an LOD update, and ACTIVE-UPDATE, which works through them.

Source: Liu, Georganas and Roth 2006, section 3.2.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.checks.device_memory import DeviceMemory
from warp_abtree.checks.regime import current_regime
from warp_abtree.kernels.base.arrays import LEVEL_MAX
from warp_abtree.kernels.update import block_update, mark, refine, refit
from warp_abtree.kernels.update.work_lists import UpdateLists

# Nodes of a level that one block refits, at most: a launch costs about as much.
TOP_ROOM = 1024
# On a GPU: faces of a slice, or of a tree, that a block updates where there are fewer states than multiprocessors; with
# more states, as many times more. Threads of a block: of many states with trees of at most SMALL_DEPTH, and with
# shallow ones. And blocks of a launch, at most.
BLOCK_SLICE, BLOCK_FACES = 1024, 8192
SMALL_DEPTH = 10
SMALL_THREADS, SHALLOW_THREADS = 64, 256
BLOCKS_MOST = 8192
# Fraction of the longest slice of a partial update that level lists take.
LISTED_FRACTION = 0.1
# Threads that a GPU runs at a time, of each multiprocessor: more take turns over what they work off.
THREADS_AT_ONCE = 2048


def launch_items(kernel, items: int, inputs: list, device):
    """Launch a kernel over at most so many items; how many there are, it reads on the device.

    The kernel takes (step) before its inputs: thread `tid` works on the items tid, tid + step, and so on.
    """
    if items:
        step = min(items, THREADS_AT_ONCE * device.sm_count) if device.is_cuda else 1
        wp.launch(kernel, dim=step, inputs=[step, *inputs], device=device)


def update_kernels(face_counts, device) -> list:
    """Return the kernels, with block sizes, that bring states of models of so many faces to their first LODs."""
    most = 2 ** int(block_update.BLOCK_DEPTH) if device.is_cpu else BLOCK_FACES
    by_blocks = [current_regime().block_updates and count <= most for count in face_counts]
    kernels: list = [(block_update.state_update(False), block_update.BLOCK_THREADS)] if any(by_blocks) else []
    if not all(by_blocks):
        kernels += [(refit.refit_top_kernel, refit.TOP_THREADS)]
        kernels += [(kernel, 256) for kernel in (refit.refit_level_kernel, refine.refine_all_kernel)]
    return kernels


def block_limits(models, state_count: int, device):
    """Return the longest slice that a block takes of each model, 0 where none, and whether it refits them whole.

    At most `state_count` states are updated at once.
    """
    fits = (models.depth <= block_update.BLOCK_DEPTH) & current_regime().block_updates
    if not device.is_cuda:
        return np.where(fits, models.split_start[-1], 0), fits
    times = max(1.0, state_count / device.sm_count)
    return np.where(fits, int(times * BLOCK_SLICE), 0), fits & (models.face_count <= times * BLOCK_FACES)


def partial_limit(models, block_max, device):
    """Return the longest slice of each model that a partial update takes; negative where all are refitted whole.

    On a GPU level lists with little on each level take as long as with much, so few faces are worth it.
    """
    most = full_refit_fraction(device) * models.face_count
    listed = LISTED_FRACTION * most if device.is_cuda else most
    return np.floor(np.maximum(np.minimum(block_max, most), listed)).astype(np.int64)


def full_refit_fraction(device) -> float:
    """Return the fraction of its faces past which a state is refitted whole."""
    return current_regime().full_refit["cuda" if device.is_cuda else "cpu"]


@dataclass
class WorkLists(DeviceMemory):
    """What the kernels of an update of many tree states work through, and the most that there can be of it.

    Attributes:
        plan: `UpdateLists` for kernels.
        block_room: States that a block updates each, at most.
        depth: Of the deepest tree.
        entry_room, face_room: Faces in the slices of partial updates, and of states under full update, at most.
        level_room: Nodes to refit on each level, the root's first, at most; as many entries as there are levels.
    """

    plan: UpdateLists
    block_room: int
    depth: int
    entry_room: int
    face_room: int
    level_room: list
    device: wp.Device

    def __post_init__(self):
        # Marks lie in shared memory on CUDA.
        words = 1 if self.device.is_cuda else int(block_update.MARK_WORDS)
        self._scratch = wp.empty(words, dtype=wp.uint32, device=self.device)

    def update(self, models, states):
        """Refine meshes and update trees of `ModelPool` and `StatePool`, by blocks and by lists. Launches only."""
        if self.block_room:
            self.launch_blocks(block_update.state_update, self.block_room, [models, self._scratch, states, self.plan])
        refine_meshes(models, states, self)
        active_update(models, states, self)

    def launch_blocks(self, update, count: int, inputs: list):
        """Launch the kernel that `update` makes, a block for each of so many states, or fewer that take turns."""
        blocks, threads, shallow = 1, 1, False
        if self.device.is_cuda:
            shallow = self.depth <= block_update.SHALLOW_DEPTH and self.block_room > self.device.sm_count
            few_faces = SMALL_THREADS if self.depth <= SMALL_DEPTH else SHALLOW_THREADS
            blocks, threads = min(count, BLOCKS_MOST), few_faces if shallow else block_update.BLOCK_THREADS
        inputs = [blocks, threads, *inputs]
        wp.launch(update(shallow), (blocks, threads), inputs, block_dim=threads, device=self.device)


def make_level_lists(plan: UpdateLists, marked_room: list, device):
    """Make the worklists of an update, each of its own length."""
    room = np.zeros(int(LEVEL_MAX), np.int64)
    room[: len(marked_room)] = marked_room
    starts = np.cumsum(room) - room
    plan.level_start = wp.array(starts.astype(np.int32), dtype=wp.int32, device=device)
    plan.level_count = wp.zeros(int(LEVEL_MAX), dtype=wp.int32, device=device)
    plan.level_node = wp.empty(int(room.sum()), dtype=wp.vec2i, device=device)


def refine_meshes(models, states, work: WorkLists):
    """Set the active ancestors of every face corner that changes, of `ModelPool` and `StatePool`. Launches only."""
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
    if any(work.level_room[:top]):
        threads = refit.TOP_THREADS if work.device.is_cuda else 1
        inputs = [threads, top, models, work.plan, states]
        wp.launch(refit.refit_top_kernel, threads, inputs, block_dim=threads, device=work.device)


def active_update(models, states, work: WorkLists):
    """Bring boxes, status and skip links to the corners that refinement has set (ACTIVE-UPDATE).

    Leaves the very same bits as a rebuild of all boxes at that LOD. Launches only, two and one for each level that has
    much to refit.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-UPDATE; Algorithm 1.
    """
    active_mark(models, states, work)
    active_walk(models, states, work)
