"""Refinement and ACTIVE-UPDATE of a tree state by one block, marks in shared memory: many states in one launch.

Leaves the same bits and counts as the level lists of `mark`, `refine` and `refit`, which serve larger trees.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool
from warp_abtree.kernels.base.lanes import block_sync
from warp_abtree.kernels.base.nodes import Node, load_node, store_node
from warp_abtree.kernels.update.refine import refine_face
from warp_abtree.kernels.update.refit import refit_inner, refit_leaf, unite_nodes
from warp_abtree.kernels.update.work_lists import WHOLE, SplitTable, UpdateLists, find_slice, note_fault

BLOCK_THREADS = 1024  # of a block, where there are few states or deep trees
MODULE_OPTIONS = native.options("base/lanes.cuh", "update/block_marks.cuh")
wp.set_module_options(MODULE_OPTIONS)

BLOCK_DEPTH = native.constant("BLOCK_DEPTH")  # of the deepest tree that a block updates
SHALLOW_DEPTH = native.constant("SHALLOW_DEPTH")
MARK_WORDS = native.constant("MARK_WORDS")
# Marks follow two words that count faces changed and nodes marked: a bit a node, deformed; then another a node, set
# while two deformed children are to come.
MARK_START = wp.constant(native.constant("MARK_START"))
CHANGED_COUNT, MARKED_COUNT = wp.constant(0), wp.constant(1)


@native.func_native()
def block_marks(scratch: wp.array(dtype=wp.uint32)) -> wp.uint64:
    """Return the address of this block's marks: in shared memory on CUDA, on the CPU that of `scratch`."""


@native.func_native()
def shallow_marks(scratch: wp.array(dtype=wp.uint32)) -> wp.uint64:
    """Return the same for trees of SHALLOW_DEPTH at most."""


@native.func_native()
def read_word(marks: wp.uint64, i: wp.int32) -> wp.uint32: ...


@native.func_native()
def clear_word(marks: wp.uint64, i: wp.int32): ...


@native.func_native()
def add_to_word(marks: wp.uint64, i: wp.int32, amount: wp.int32): ...


@native.func_native()
def mark_bit(marks: wp.uint64, bit: wp.int32) -> bool:
    """Set a bit, and return whether it was not set."""


@native.func_native()
def unmark_bit(marks: wp.uint64, bit: wp.int32) -> bool:
    """Clear a bit, and return whether it was set; the thread that finds it clear sees what the other has written."""


@native.func_native()
def fetch_entry(values: wp.array(dtype=wp.vec4), i: wp.int64):
    """Prefetch an entry."""


@native.func_native()
def fetch_corner(values: wp.array(dtype=wp.vec4i), i: wp.int32): ...


@wp.struct
class BlockThread:
    """A thread of the block that updates a state."""

    thread: wp.int32  # its place in the block
    threads: wp.int32  # of the block, a power of two
    state: wp.int32  # that the block updates
    depth: wp.int32  # of its tree
    face_start: wp.int32  # of its model
    marks: wp.uint64  # of the block
    twice_start: wp.int32  # where the second bits of nodes begin


@wp.func
def clear_marks(own: BlockThread, counters_only: bool):
    word = own.thread
    bits = wp.where(counters_only, MARK_START, own.twice_start + (1 << own.depth))
    while word <= (bits - 1) / 32:
        clear_word(own.marks, word)
        word += own.threads


@wp.func
def mark_ancestors(own: BlockThread, states: StatePool, leaf: wp.int32):
    """Mark the ancestors of a leaf as far as no walk has marked them; return how many.

    A node that two walks reach waits for both. Boxes of siblings, which refitting unites, are brought near meanwhile.
    Source: Liu et al. 2006, section 3.2.2, ACTIVE-MARK.
    """
    node = leaf
    marked = wp.int32(0)
    while node > 1:
        fetch_entry(states.node_box, wp.int64(2) * wp.int64(states.node_start[own.state] + (node ^ 1)))
        node = node >> 1
        if not mark_bit(own.marks, MARK_START + node):
            mark_bit(own.marks, own.twice_start + node)
            break
        marked += 1
    return marked


@wp.func
def mark_slice(own: BlockThread, models: ModelPool, states: StatePool, slice: wp.vec2i):
    """Mark the leaf of each face of a slice and the nodes above, and count both."""
    changed = wp.int32(0)
    marked = wp.int32(0)
    entry = own.thread
    while entry < slice[1]:
        face = models.split_face[slice[0] + entry]
        leaf = models.leaf_node[own.face_start + face]
        # A slice may list a face twice.
        if mark_bit(own.marks, MARK_START + leaf):
            fetch_corner(states.face_corner, states.face_start[own.state] + face)
            marked += 1 + mark_ancestors(own, states, leaf)
            changed += 1
        entry += own.threads
    if changed > 0:
        add_to_word(own.marks, CHANGED_COUNT, changed)
        add_to_word(own.marks, MARKED_COUNT, marked)


@wp.func
def refit_ancestors(own: BlockThread, states: StatePool, leaf: wp.int32, record: Node):
    """Last-arriver refit of a leaf's ancestors: the second thread to reach a node continues upwards.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-REFIT.
    """
    start = states.node_start[own.state]
    node = leaf
    box = record
    while node > 1:
        if unmark_bit(own.marks, own.twice_start + (node >> 1)):
            break
        other = load_node(states, start + (node ^ 1))
        node = node >> 1
        box = unite_nodes(node, box, other)
        store_node(states, start + node, box)


@wp.func
def refit_slice(own: BlockThread, models: ModelPool, states: StatePool, slice: wp.vec2i):
    """Refine each face of a slice, once, and refit its leaf and the ancestors."""
    entry = own.thread
    while entry < slice[1]:
        face = models.split_face[slice[0] + entry]
        leaf = models.leaf_node[own.face_start + face]
        if unmark_bit(own.marks, MARK_START + leaf):
            corner = refine_face(models, states, own.state, face)
            states.face_corner[states.face_start[own.state] + face] = corner
            record = refit_leaf(models, states, own.state, leaf, face, corner)
            refit_ancestors(own, states, leaf, record)
        entry += own.threads


@wp.func
def refine_whole(own: BlockThread, models: ModelPool, states: StatePool, face_count: wp.int32):
    """Refine every face and refit its leaf."""
    changed = wp.int32(0)
    face = own.thread
    while face < face_count:
        at = states.face_start[own.state] + face
        old = states.face_corner[at]
        new = refine_face(models, states, own.state, face)
        if new[0] != old[0] or new[1] != old[1] or new[2] != old[2]:
            states.face_corner[at] = new
            changed += 1
        refit_leaf(models, states, own.state, models.leaf_node[own.face_start + face], face, new)
        face += own.threads
    if changed > 0:
        add_to_word(own.marks, CHANGED_COUNT, changed)


@wp.func
def refit_subtree(own: BlockThread, models: ModelPool, states: StatePool, height: wp.int32):
    """Refit the inner nodes of a thread's subtree, as high as that, each right after its children."""
    node_start = models.node_start[states.model[own.state]]
    done = wp.int32(0)
    while height > 0 and done < 1 << height:
        # All leaves lie on the two deepest levels.
        done += 2
        node = ((1 << own.depth) + (own.thread << height) + done - 2) >> 1
        if models.node_face[node_start + node] < 0:
            refit_inner(states, own.state, node)
        ready = done >> 1
        while (ready & 1) == 0:
            node = node >> 1
            ready = ready >> 1
            refit_inner(states, own.state, node)


@wp.func
def update_whole(own: BlockThread, models: ModelPool, states: StatePool):
    """Refine every face and refit every node: leaves, then a subtree a thread, then level by level.

    Invariant: children of a level are final when it begins, since a barrier stands between levels.
    """
    refine_whole(own, models, states, models.face_count[states.model[own.state]])
    block_sync()
    top = wp.int32(0)
    while top < own.depth and 1 << top < own.threads:
        top += 1
    if own.thread < 1 << top:
        refit_subtree(own, models, states, own.depth - top)
    while top > 0:
        block_sync()
        top -= 1
        node = (1 << top) + own.thread
        if node < 2 << top and models.node_face[models.node_start[states.model[own.state]] + node] < 0:
            refit_inner(states, own.state, node)


@wp.func
def update_state(own: BlockThread, models: ModelPool, states: StatePool, slice: wp.vec2i, plan: UpdateLists):
    """Bring a state to its LOD, by a slice of faces or WHOLE; for all threads of a block.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-UPDATE; Algorithms 1 to 3.
    """
    block_sync()
    clear_marks(own, slice[1] == WHOLE)
    block_sync()
    if slice[1] == WHOLE:
        update_whole(own, models, states)
    else:
        mark_slice(own, models, states, slice)
        block_sync()
        refit_slice(own, models, states, slice)
    block_sync()
    if own.thread == 0:
        whole = 2 * models.face_count[states.model[own.state]] - 1
        marked = wp.int32(read_word(own.marks, MARKED_COUNT))
        plan.changed_count[own.state] = wp.int32(read_word(own.marks, CHANGED_COUNT))
        plan.marked_count[own.state] = wp.where(slice[1] == WHOLE, whole, marked)


@wp.func
def make_thread(
    thread: wp.int32, threads: wp.int32, state: wp.int32, models: ModelPool, states: StatePool, marks: wp.uint64
):
    own = BlockThread()
    own.thread = thread
    own.threads = threads
    own.state = state
    own.marks = marks
    own.face_start = models.face_start[states.model[state]]
    own.depth = models.depth[states.model[state]]
    own.twice_start = MARK_START + (2 << own.depth)
    return own


@functools.cache
def state_update(shallow: bool):
    """Return the kernel that brings listed states to their LODs, of trees of SHALLOW_DEPTH or BLOCK_DEPTH at most."""
    find_marks = shallow_marks if shallow else block_marks

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS | {"block_dim": BLOCK_THREADS}, cuda_max_registers=64)
    def update_state_kernel(
        blocks: wp.int32,
        threads: wp.int32,
        models: ModelPool,
        scratch: wp.array(dtype=wp.uint32),
        states_inout: StatePool,
        plan_inout: UpdateLists,
    ):
        """Bring one listed state after another to its LOD, a block each."""
        block, thread = wp.tid()
        update = wp.int32(block)
        while update < plan_inout.block_count[0]:
            state = plan_inout.block_state[update]
            own = make_thread(thread, threads, state, models, states_inout, find_marks(scratch))
            slice = wp.vec2i(plan_inout.block_start[update], plan_inout.block_length[update])
            update_state(own, models, states_inout, slice, plan_inout)
            update += blocks

    return update_state_kernel


@functools.cache
def wanted_update(shallow: bool):
    """Return the kernel that brings states to LODs wanted, of trees of SHALLOW_DEPTH or BLOCK_DEPTH at most."""
    find_marks = shallow_marks if shallow else block_marks

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS | {"block_dim": BLOCK_THREADS}, cuda_max_registers=64)
    def update_wanted_kernel(
        blocks: wp.int32,
        threads: wp.int32,
        models: ModelPool,
        scratch: wp.array(dtype=wp.uint32),
        splits: SplitTable,
        wanted: wp.array(dtype=wp.int32),
        states_inout: StatePool,
        faults_inout: wp.array(dtype=wp.int32),
        plan_out: UpdateLists,
    ):
        """Bring one state after another to its LOD, a block each, where a block takes all of them.

        Args:
            wanted, faults_inout: As for `plan_update_kernel`.
            plan_out: Its counts of each state; nothing is listed.
        """
        block, thread = wp.tid()
        state = wp.int32(block)
        while state < wanted.shape[0]:
            own = make_thread(thread, threads, state, models, states_inout, find_marks(scratch))
            model = states_inout.model[state]
            old = states_inout.lod[state]
            lod = wp.clamp(wanted[state], 0, models.lod_max[model])
            # All threads have read the LOD before one writes it.
            block_sync()
            if thread == 0:
                states_inout.lod[state] = lod
                plan_out.changed_count[state] = 0
                plan_out.marked_count[state] = 0
                if lod != wanted[state] and plan_out.takes_any[state] == 0:
                    note_fault(faults_inout, state)
            if lod != old:
                update_state(own, models, states_inout, find_slice(splits, model, old, lod), plan_out)
            state += blocks

    return update_wanted_kernel
