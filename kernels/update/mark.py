"""ACTIVE-MARK: bottom-up marking of every node that an LOD change touches, one path walk a face."""

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, StatePool
from warp_abtree.kernels.update.work_lists import UpdateLists, find_update, item_count, list_length

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def mark_path(leaf: wp.int32, state: wp.int32, states: StatePool, plan: UpdateLists):
    """Mark a leaf and its ancestors as far as no earlier walk has marked them; return how many there were."""
    node_start = states.node_start[state]
    node = leaf
    depth = wp.int32(0)
    while leaf >> depth > 1:
        depth += 1
    marked = wp.int32(0)
    while node > 0:
        at = node_start + node
        bit = wp.uint32(1) << wp.uint32(at & 31)
        if (wp.atomic_or(states.node_mark, at >> 5, bit) & bit) != wp.uint32(0):
            break
        slot = wp.atomic_add(plan.level_count, depth, 1)
        plan.level_node[plan.level_start[depth] + slot] = wp.vec2i(state, node)
        marked += 1
        node = node >> 1
        depth -= 1
    return marked


@wp.kernel
def mark_path_kernel(step: wp.int32, models: ModelPool, states_inout: StatePool, plan_inout: UpdateLists):
    """Walk from the leaf of each affected face to the root and mark what no earlier walk has marked.

    Whoever marks a node first appends (state, node) to the worklist of its level: O(k (log n - log k + 2)) a batch.
    Source: Liu et al. 2006, section 3.2.2 and Algorithm 2. As printed it returns from the whole operation at the
        first removed leaf with an inactive sibling and leaves one with an active sibling untouched; its text says
        what is meant: a node is inactive iff no active primitive lies under it, and boxes are smallest. So removed,
        deformed and inserted leaves are all marked here, and ACTIVE-WALK decides the status.
    """
    updates = list_length(plan_inout.partial_total)
    entries = item_count(plan_inout.partial_total)
    entry = wp.tid()
    while entry < entries:
        u, i = find_update(plan_inout.entry_end, updates, entry)
        state = plan_inout.partial_state[u]
        face = models.split_face[plan_inout.slice_start[u] + i]
        leaf = models.leaf_node[models.face_start[states_inout.model[state]] + face]
        marked = mark_path(leaf, state, states_inout, plan_inout)
        if marked > 0:
            # Only the first walk from a leaf gets past it.
            wp.atomic_add(plan_inout.changed_count, state, 1)
            wp.atomic_add(plan_inout.marked_count, state, marked)
        entry += step
