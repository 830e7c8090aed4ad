"""Worklists of an update of many tree states, made by the host, or by a kernel inside a captured graph.

Every count stands in device memory, so that a launch need not know it: threads take items first + step tid until there
are none left.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import LEVEL_MAX, ModelPool, StatePool

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# One atomic takes an update's place in a list and its items' places after those of the updates before it.
LIST_SHIFT = wp.constant(wp.int64(32))
ITEM_MASK = wp.constant(wp.int64(2**32 - 1))

# LOD of a state whose last update was interrupted.
UNKNOWN = wp.constant(-1)
# Length that stands for all faces in the place of a slice.
WHOLE = wp.constant(-1)


@wp.struct
class UpdateLists:
    """States under update: partial, refitted where a slice of faces touches them, and full, refitted whole.

    A block updates a state by itself (`block_update`), or all threads work through lists, level by level. A total holds
    two counts in one word, so that one atomic takes an update's place and its items' places:

        63           32 31            0
        [   updates    |    items     ]    items: entries of all slices, or faces
    """

    block_count: wp.array(dtype=wp.int32)  # states that a block updates each, shape [1]
    block_state: wp.array(dtype=wp.int32)  # shape [block's update]
    block_start: wp.array(dtype=wp.int32)  # where its slice begins in split_face, shape [block's update]
    block_length: wp.array(dtype=wp.int32)  # of its slice, or WHOLE, shape [block's update]
    partial_total: wp.array(dtype=wp.int64)  # updates and entries of all slices, shape [1]
    partial_state: wp.array(dtype=wp.int32)  # shape [partial update]
    slice_start: wp.array(dtype=wp.int32)  # into split_face, shape [partial update]
    entry_end: wp.array(dtype=wp.int32)  # running total of slice lengths, shape [partial update]
    full_total: wp.array(dtype=wp.int64)  # updates and faces, shape [1]
    full_state: wp.array(dtype=wp.int32)  # shape [full update]
    face_end: wp.array(dtype=wp.int32)  # running total of faces, shape [full update]
    whole_count: wp.array(dtype=wp.int32)  # full updates whose trees have the level, shape [level]
    whole_start: wp.array(dtype=wp.int32)  # where they begin in whole_state, shape [level]
    whole_state: wp.array(dtype=wp.int32)  # states of full updates, level by level
    level_count: wp.array(dtype=wp.int32)  # marked nodes, shape [level]
    level_start: wp.array(dtype=wp.int32)  # where they begin in level_node, shape [level]
    level_node: wp.array(dtype=wp.vec2i)  # (state, node), level by level
    changed_count: wp.array(dtype=wp.int32)  # faces that change, shape [state]
    marked_count: wp.array(dtype=wp.int32)  # nodes refitted, shape [state]
    takes_any: wp.array(dtype=wp.int32)  # 1 where no LOD wanted on the device is a fault, shape [state]


@wp.struct
class SplitTable:
    """Slices of each model's faces by vertex split, and the longest that each kind of update takes."""

    bound: wp.array(dtype=wp.int32)  # split_start of every model, as places in the pool's split_face
    bound_start: wp.array(dtype=wp.int32)  # where a model's begin in `bound`, shape [model]
    partial_max: wp.array(dtype=wp.int32)  # longest slice that a partial update takes, shape [model]
    block_max: wp.array(dtype=wp.int32)  # longest slice that a block takes, shape [model]
    block_whole: wp.array(dtype=wp.int32)  # whether a block refits it whole, 0 or 1, shape [model]


@wp.func
def list_length(total: wp.array(dtype=wp.int64)):
    return wp.int32(total[0] >> LIST_SHIFT)


@wp.func
def item_count(total: wp.array(dtype=wp.int64)):
    return wp.int32(total[0] & ITEM_MASK)


@wp.func
def find_update(item_end: wp.array(dtype=wp.int32), update_count: wp.int32, item: wp.int32):
    """Return the update that an item belongs to, and which of its items it is."""
    u = wp.lower_bound(item_end, 0, update_count, item + 1)
    begin = wp.int32(0)
    if u > 0:
        begin = item_end[u - 1]
    return u, item - begin


@wp.kernel
def clear_plan_kernel(plan_out: UpdateLists):
    """Empty every list and counter, a thread a state, and LEVEL_MAX threads at least."""
    i = wp.tid()
    if i == 0:
        plan_out.block_count[0] = 0
        plan_out.partial_total[0] = wp.int64(0)
        plan_out.full_total[0] = wp.int64(0)
    if i < LEVEL_MAX:
        plan_out.whole_count[i] = 0
        plan_out.level_count[i] = 0
    if i < plan_out.changed_count.shape[0]:
        plan_out.changed_count[i] = 0
        plan_out.marked_count[i] = 0


@wp.func
def list_block(plan: UpdateLists, state: wp.int32, begin: wp.int32, length: wp.int32):
    u = wp.atomic_add(plan.block_count, 0, 1)
    plan.block_state[u] = state
    plan.block_start[u] = begin
    plan.block_length[u] = length


@wp.func
def list_partial(plan: UpdateLists, state: wp.int32, begin: wp.int32, length: wp.int32):
    before = wp.atomic_add(plan.partial_total, 0, (wp.int64(1) << LIST_SHIFT) + wp.int64(length))
    u = wp.int32(before >> LIST_SHIFT)
    plan.partial_state[u] = state
    plan.slice_start[u] = begin
    plan.entry_end[u] = wp.int32(before & ITEM_MASK) + length


@wp.func
def list_full(plan: UpdateLists, state: wp.int32, face_count: wp.int32, depth: wp.int32):
    before = wp.atomic_add(plan.full_total, 0, (wp.int64(1) << LIST_SHIFT) + wp.int64(face_count))
    u = wp.int32(before >> LIST_SHIFT)
    plan.full_state[u] = state
    plan.face_end[u] = wp.int32(before & ITEM_MASK) + face_count
    for level in range(depth + 1):
        slot = wp.atomic_add(plan.whole_count, level, 1)
        plan.whole_state[plan.whole_start[level] + slot] = state
    plan.marked_count[state] = 2 * face_count - 1


@wp.func
def note_fault(faults: wp.array(dtype=wp.int32), i: wp.int32):
    """Count a request that cannot be met, and keep the lowest index that had one."""
    wp.atomic_add(faults, 0, 1)
    wp.atomic_min(faults, 1, i)


@wp.func
def find_slice(splits: SplitTable, model: wp.int32, old: wp.int32, lod: wp.int32):
    """Return where the faces between two LODs begin and how many there are, or WHOLE in the place of too many."""
    slice = wp.vec2i(0, WHOLE)
    if old != UNKNOWN:
        at = splits.bound_start[model]
        begin = splits.bound[at + wp.min(lod, old)]
        length = splits.bound[at + wp.max(lod, old)] - begin
        if length <= splits.partial_max[model]:
            slice = wp.vec2i(begin, length)
    return slice


@wp.kernel
def plan_update_kernel(
    models: ModelPool,
    splits: SplitTable,
    wanted: wp.array(dtype=wp.int32),
    states_inout: StatePool,
    plan_inout: UpdateLists,
    faults_inout: wp.array(dtype=wp.int32),
):
    """Compare each state's LOD with the wanted one and list the states that move; the faces between are one slice.

    Args:
        wanted: LOD of each state; one out of range is a fault and brought to the nearer end.
        faults_inout: As `note_fault`, by state.
    """
    s = wp.tid()
    model = states_inout.model[s]
    lod = wp.clamp(wanted[s], 0, models.lod_max[model])
    if lod != wanted[s] and plan_inout.takes_any[s] == 0:
        note_fault(faults_inout, s)
    old = states_inout.lod[s]
    if lod == old:
        return
    states_inout.lod[s] = lod
    slice = find_slice(splits, model, old, lod)
    begin, length = slice[0], slice[1]
    if length == WHOLE:
        if splits.block_whole[model] != 0:
            list_block(plan_inout, s, begin, length)
        else:
            list_full(plan_inout, s, models.face_count[model], models.depth[model])
    elif length <= splits.block_max[model]:
        list_block(plan_inout, s, begin, length)
    else:
        list_partial(plan_inout, s, begin, length)
