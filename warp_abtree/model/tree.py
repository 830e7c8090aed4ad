"""The AB-Tree: its static topology, and the update that an LOD change asks for.

Source: Liu, Georganas and Roth 2006, section 3.2.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_abtree.kernels.arrays import LEVEL_MAX
from warp_abtree.kernels.update import mark, refit
from warp_abtree.kernels.update.work_lists import WorkLists

FACE_COUNT_MAX = 2**30
# Nodes of a level that one block refits, at most: a launch costs about as much. And the threads of that block.
TOP_ROOM = 1024
TOP_THREADS = 512


@dataclass(frozen=True)
class Tree:
    """Static topology of an AB-Tree over n faces.

    Attributes:
        leaf_node: Heap index of each face's leaf, the paper's indexed list, int32 (n,).
        node_face: Face of each leaf node, -1 elsewhere, int32 (2^(depth+1),); the root is 1.
        depth: ceil(log2 n).
    """

    leaf_node: np.ndarray
    node_face: np.ndarray
    depth: int

    @classmethod
    def from_leaves(cls, leaf_node: np.ndarray) -> "Tree":
        """Make the tree that an indexed list describes.

        Raises:
            ValueError: The list does not give every face a leaf of its own.
        """
        n = len(leaf_node)
        node_face = np.full(2 << find_depth(n), -1, np.int32)
        if not np.array_equal(np.sort(leaf_node), np.sort(leaf_nodes(n))):
            raise ValueError(f"the indexed list is not one leaf for each of {n} faces")
        node_face[leaf_node] = np.arange(n, dtype=np.int32)
        return cls(leaf_node, node_face, find_depth(n))

    @property
    def node_count(self) -> int:
        """Length of the node arrays: heap indices 0 .. 2^(depth+1)-1, 2n-1 of them in use."""
        return len(self.node_face)


def find_depth(n: int) -> int:
    """Return the depth of a tree of n leaves, ceil(log2 n)."""
    return (n - 1).bit_length()


def leaf_nodes(n: int) -> np.ndarray:
    """Return the heap index of each leaf position of a tree of n leaves, int32 (n,)."""
    depth = find_depth(n)
    bounds = (np.arange((1 << depth) + 1) * n) >> depth
    index = np.flatnonzero(np.diff(bounds))
    node = (1 << depth) + index
    if depth > 0:
        # Halves equal to within one put every leaf on one of the two deepest levels.
        above = (np.arange((1 << (depth - 1)) + 1) * n) >> (depth - 1)
        node = np.where(np.diff(above)[index >> 1] == 1, node >> 1, node)
    return node.astype(np.int32)


def _partition(order, left, begin, middle):
    """Move the marked entries of every segment before the others, keeping the order of each kind.

    Args:
        order: Face ids, segment after segment.
        left: Whether each face goes left, per face id.
        begin, middle: Where the segment of each position begins, and where its right half will.
    """
    goes_left = left[order]
    rank = np.cumsum(goes_left) - goes_left
    rank -= rank[begin]
    position = np.arange(len(order))
    out = np.empty_like(order)
    out[np.where(goes_left, begin + rank, middle + (position - begin) - rank)] = order
    return out


def _sort_leaves(lower, upper, depth):
    """Return the face at each leaf position: median splits, one level at a time, over three presorted orders."""
    n = len(lower)
    key = lower + upper
    orders = [np.argsort(key[:, axis], kind="stable") for axis in range(3)]
    left = np.zeros(n, bool)
    for d in range(depth):
        bounds = (np.arange((1 << d) + 1) * n) >> d
        middles = ((2 * np.arange(1 << d) + 1) * n) >> (d + 1)
        lengths = np.diff(bounds)
        extent = np.maximum.reduceat(upper[orders[0]], bounds[:-1]) - np.minimum.reduceat(lower[orders[0]], bounds[:-1])
        axis = np.repeat(np.argmax(extent, 1), lengths)
        begin = np.repeat(bounds[:-1], lengths)
        middle = np.repeat(middles, lengths)
        in_left = np.arange(n) < middle
        for k in range(3):
            here = axis == k
            left[orders[k][here]] = in_left[here]
        orders = [_partition(order, left, begin, middle) for order in orders]
    return orders[0]


def active_build(vertex_pos: np.ndarray, face_vertex: np.ndarray) -> Tree:
    """Build the balanced tree over all faces top-down (ACTIVE-BUILD).

    Each segment splits at its median along the longest axis of its box, in the order of the faces' box centres, ties
    by face index; halves are equal to within one. The node at depth d and index i holds leaf positions (i n) >> d ..
    ((i+1) n) >> d.

    Args:
        vertex_pos: Original vertices [model units], float64 (v, 3).
        face_vertex: Original faces, int32 (n, 3).

    Raises:
        ValueError: No face, or more than 2^30.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-BUILD.
    """
    n = len(face_vertex)
    if not 0 < n <= FACE_COUNT_MAX:
        raise ValueError(f"an AB-Tree needs 1 to 2^30 faces, not {n}")
    corners = vertex_pos[face_vertex]
    leaf_face = _sort_leaves(corners.min(1), corners.max(1), find_depth(n))
    leaf_node = np.empty(n, np.int32)
    leaf_node[leaf_face] = leaf_nodes(n)
    return Tree.from_leaves(leaf_node)


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
class UpdateWork:
    """An update of many tree states: what kernels work off, and the most that there can be of it.

    Attributes:
        plan: `WorkLists` for kernels.
        entry_room, face_room: Faces in the slices of partial updates, and of states under full update, at most.
        level_room: Nodes to refit on each level, the root's first, at most; as many entries as there are levels.
    """

    plan: WorkLists
    entry_room: int
    face_room: int
    level_room: list
    device: wp.Device


def make_level_lists(plan: WorkLists, marked_room: list, device):
    """Make the worklists of an update, each of its own length."""
    room = np.zeros(int(LEVEL_MAX), np.int64)
    room[: len(marked_room)] = marked_room
    starts = np.cumsum(room) - room
    plan.level_start = wp.array(starts.astype(np.int32), dtype=wp.int32, device=device)
    plan.level_count = wp.zeros(int(LEVEL_MAX), dtype=wp.int32, device=device)
    plan.level_node = wp.empty(int(room.sum()), dtype=wp.vec2i, device=device)


class UpdateBatch(UpdateWork):
    """An update that the host plans.

    Args:
        state, lod: State and target LOD of each update, int32 (u,).
        full: Whether the whole tree is refitted, bool (u,).
        slice_start, slice_length: Slice of each update in split_face; length 0 where it is full, int64 (u,).
        depth, face_count: Tree depth and faces of each update's model, int64 (u,).
        state_count: States of the pool; `plan.changed_count` and `plan.marked_count` have an entry for each.
    """

    def __init__(self, state, lod, full, slice_start, slice_length, depth, face_count, state_count, device):
        self.state, self.lod, self.full = state, lod, full
        self.slice_start, self.slice_length = slice_start, slice_length
        self.depth, self.face_count = depth, face_count
        partial = np.flatnonzero(~full)
        # Deepest first, so that the states that have a level are the first of the list.
        whole = np.flatnonzero(full)
        whole = whole[np.argsort(-depth[whole], kind="stable")]
        entry_end, face_end = np.cumsum(slice_length[partial]), np.cumsum(face_count[whole])
        entries = int(entry_end[-1]) if len(partial) else 0
        faces = int(face_end[-1]) if len(whole) else 0
        levels = range(int(depth.max()) + 1 if len(depth) else 0)
        whole_count = np.array([np.sum(depth[whole] >= level) for level in range(int(LEVEL_MAX))], np.int64)
        marked_room = [min(entries, int(np.sum(depth[partial] >= level)) << level) for level in levels]
        level_room = [room + (int(whole_count[level]) << level) for level, room in enumerate(marked_room)]
        plan = WorkLists()

        def upload(values, dtype=wp.int32):
            return wp.array(np.asarray(values, np.int64), dtype=dtype, device=device)

        plan.partial_total = upload([(len(partial) << 32) + entries], wp.int64)
        plan.partial_state = upload(state[partial])
        plan.slice_start = upload(slice_start[partial])
        plan.entry_end = upload(entry_end)
        plan.full_total = upload([(len(whole) << 32) + faces], wp.int64)
        plan.full_state = plan.whole_state = upload(state[whole])
        plan.face_end = upload(face_end)
        plan.whole_count = upload(whole_count)
        plan.whole_start = wp.zeros(int(LEVEL_MAX), dtype=wp.int32, device=device)
        plan.changed_count = wp.zeros(state_count, dtype=wp.int32, device=device)
        plan.marked_count = wp.zeros(state_count, dtype=wp.int32, device=device)
        make_level_lists(plan, marked_room, device)
        super().__init__(plan, entries, faces, level_room, device)


def active_mark(models, states, work: UpdateWork):
    """Mark the leaves of every affected face and their ancestors deformed, each node once (ACTIVE-MARK)."""
    launch_items(mark.mark_path_kernel, work.entry_room, [models, states, work.plan], work.device)


def active_walk(models, states, work: UpdateWork):
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


def active_update(models, states, work: UpdateWork):
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
