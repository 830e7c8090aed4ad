"""Refinement and ACTIVE-UPDATE of a tree state by one block: marks in shared memory, any number of states in one launch.

Leaves the same bits and counts as the level lists of `mark`, `refine` and `refit`, which serve larger trees.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, StatePool
from warp_abtree.kernels.update.refine import refine_face
from warp_abtree.kernels.update.refit import block_sync, refit_inner, refit_leaf
from warp_abtree.kernels.update.work_lists import WHOLE, UpdateLists

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK_DEPTH = native.constant("BLOCK_DEPTH")  # of the deepest tree that a block updates
MARK_WORDS = native.constant("MARK_WORDS")
# Marks follow two words that count faces changed and nodes marked: a bit a node, then a bit a face.
MARK_START = wp.constant(native.constant("MARK_START"))
CHANGED, MARKED = wp.constant(0), wp.constant(1)

marks_code = functools.partial(native.body, "block_marks.cuh")


@wp.func_native(marks_code("block_marks"))
def block_marks(scratch: wp.array(dtype=wp.uint32)) -> wp.uint64:
    """Return where this block's marks lie: an address in shared memory on CUDA, on the CPU that of `scratch`."""


@wp.func_native(marks_code("read_word"))
def read_word(marks: wp.uint64, i: wp.int32) -> wp.uint32: ...


@wp.func_native(marks_code("clear_word"))
def clear_word(marks: wp.uint64, i: wp.int32): ...


@wp.func_native(marks_code("add_to_word"))
def add_to_word(marks: wp.uint64, i: wp.int32, amount: wp.int32): ...


@wp.func_native(marks_code("mark_bit"))
def mark_bit(marks: wp.uint64, bit: wp.int32) -> bool:
    """Set a bit, and return whether it was not set."""


@wp.struct
class BlockThread:
    """A thread of the block that updates a state."""

    thread: wp.int32  # its place in the block
    threads: wp.int32  # of the block, a power of two
    state: wp.int32  # that the block updates
    depth: wp.int32  # of its tree
    face_start: wp.int32  # of its model
    marks: wp.uint64  # of the block


@wp.func
def clear_marks(own: BlockThread, face_count: wp.int32):
    bits = MARK_START + wp.max(1 << own.depth, 32) + face_count
    word = own.thread
    while word < (bits + 31) / 32:
        clear_word(own.marks, word)
        word += own.threads


@wp.func
def refine_slice(own: BlockThread, models: ModelPool, plan: UpdateLists, states: StatePool, update: wp.int32):
    """Refine each face of a slice and refit its leaf, and mark the leaf's ancestors as far as no walk has marked them.

    Source: Liu et al. 2006, section 3.2.2, ACTIVE-MARK.
    """
    slice = plan.block_slice[update]
    face_mark = MARK_START + wp.max(1 << own.depth, 32)
    changed = wp.int32(0)
    marked = wp.int32(0)
    entry = own.thread
    while entry < slice[1]:
        face = models.split_face[slice[0] + entry]
        # A slice may list a face twice.
        if mark_bit(own.marks, face_mark + face):
            corner = refine_face(models, states, own.state, face)
            states.face_corner[states.face_start[own.state] + face] = corner
            node = models.leaf_node[own.face_start + face]
            refit_leaf(models, states, own.state, node, face, corner)
            changed += 1
            marked += 1
            node = node >> 1
            while node > 0:
                if not mark_bit(own.marks, MARK_START + node):
                    break
                marked += 1
                node = node >> 1
        entry += own.threads
    if changed > 0:
        add_to_word(own.marks, CHANGED, changed)
        add_to_word(own.marks, MARKED, marked)


@wp.func
def refit_marked(own: BlockThread, states: StatePool, level: wp.int32):
    """Refit the marked nodes of a level, as many of them in a row for each thread as share them out."""
    span = wp.max((1 << level) / own.threads, 1)
    node = (1 << level) + own.thread * span
    end = wp.min(node + span, 2 << level)
    while node < end:
        bits = read_word(own.marks, (MARK_START + node) / 32) >> wp.uint32(node & 31)
        if span < 32:
            bits = bits & ((wp.uint32(1) << wp.uint32(span)) - wp.uint32(1))
        while bits != wp.uint32(0):
            lowest = bits & (~bits + wp.uint32(1))
            refit_inner(states, own.state, node + wp.int32(wp.bit_count(lowest - wp.uint32(1))))
            bits = bits ^ lowest
        node += 32


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
        add_to_word(own.marks, CHANGED, changed)


@wp.func
def refit_whole(own: BlockThread, models: ModelPool, states: StatePool, level: wp.int32):
    """Refit every inner node of a level."""
    node = (1 << level) + own.thread
    while node < 2 << level:
        # All leaves lie on the two deepest levels.
        inner = level < own.depth - 1
        if not inner:
            inner = models.node_face[models.node_start[states.model[own.state]] + node] < 0
        if inner:
            refit_inner(states, own.state, node)
        node += own.threads


@wp.kernel(cuda_max_registers=64)
def update_state_kernel(
    blocks: wp.int32,
    threads: wp.int32,
    models: ModelPool,
    scratch: wp.array(dtype=wp.uint32),
    states_inout: StatePool,
    plan_inout: UpdateLists,
):
    """Bring one state after another to its LOD, a block each: faces and leaves first, then level by level.

    Invariant: children of a level are final when it begins, since a barrier stands between levels.
    Source: Liu et al. 2006, section 3.2.2, ACTIVE-UPDATE; Algorithms 1 to 3.
    """
    block, thread = wp.tid()
    own = BlockThread()
    own.thread = thread
    own.threads = threads
    own.marks = block_marks(scratch)
    update = wp.int32(block)
    while update < plan_inout.block_count[0]:
        own.state = plan_inout.block_state[update]
        model = states_inout.model[own.state]
        own.face_start = models.face_start[model]
        own.depth = models.depth[model]
        face_count = models.face_count[model]
        whole = plan_inout.block_slice[update][1] == WHOLE
        block_sync()
        clear_marks(own, face_count)
        block_sync()
        if whole:
            refine_whole(own, models, states_inout, face_count)
        else:
            refine_slice(own, models, plan_inout, states_inout, update)
        level = own.depth - 1
        while level >= 0:
            block_sync()
            if whole:
                refit_whole(own, models, states_inout, level)
            else:
                refit_marked(own, states_inout, level)
            level -= 1
        block_sync()
        if thread == 0:
            plan_inout.changed_count[own.state] = wp.int32(read_word(own.marks, CHANGED))
            marked = wp.int32(read_word(own.marks, MARKED))
            plan_inout.marked_count[own.state] = wp.where(whole, 2 * face_count - 1, marked)
        update += blocks
