"""ACTIVE-MARK: bottom-up marking of every node that an LOD change touches, one path walk a face."""

import warp as wp

from warp_abtree.kernels.pools import DEFORMED, ModelPool, StatePool

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def find_depth(node: wp.int32):
    """Return the depth of a heap index: the position of its highest bit."""
    x = node
    depth = wp.int32(0)
    while x > 1:
        x = x >> 1
        depth += 1
    return depth


@wp.kernel
def mark_path_kernel(
    entry_count: wp.int32,
    models: ModelPool,
    entry_end: wp.array(dtype=wp.int32),
    update_state: wp.array(dtype=wp.int32),
    update_slice: wp.array(dtype=wp.int32),
    update_id: wp.array(dtype=wp.int32),
    level_start: wp.array(dtype=wp.int32),
    states_inout: StatePool,
    level_count_inout: wp.array(dtype=wp.int32),
    level_node_out: wp.array(dtype=wp.vec2i),
    changed_count_out: wp.array(dtype=wp.int32),
    marked_count_out: wp.array(dtype=wp.int32),
):
    """Walk from the leaf of each affected face to the root and mark what no earlier walk has marked.

    Whoever marks a node first appends (state, node) to the worklist of its level, so a batch costs O(k (log n - log k
    + 2)).

    Args:
        entry_end, update_state, update_slice: Slices of the updates, as in `refine_slice_kernel`.
        update_id: Where each update counts, shape [update_count].
        level_start: Where the worklist of each level begins, shape [LEVEL_MAX].
    Source: Liu et al. 2006, section 3.2.2 and Algorithm 2. As printed it returns from the whole operation at the
        first removed leaf with an inactive sibling and leaves one with an active sibling untouched; its text says
        what is meant: a node is inactive iff no active primitive lies under it, and boxes are smallest. So removed,
        deformed and inserted leaves are all marked here, and ACTIVE-WALK decides the status.
    """
    tid = wp.tid()
    if tid >= entry_count:
        return
    u = wp.lower_bound(entry_end, tid + 1)
    begin = wp.int32(0)
    if u > 0:
        begin = entry_end[u - 1]
    state = update_state[u]
    model = states_inout.model[state]
    node_start = states_inout.node_start[state]
    node = models.leaf_node[models.face_start[model] + models.split_face[update_slice[u] + tid - begin]]
    depth = find_depth(node)
    marked = wp.int32(0)
    while node > 0:
        if wp.atomic_exch(states_inout.node_status, node_start + node, DEFORMED) == DEFORMED:
            break
        slot = wp.atomic_add(level_count_inout, depth, 1)
        level_node_out[level_start[depth] + slot] = wp.vec2i(state, node)
        marked += 1
        node = node >> 1
        depth -= 1
    if marked > 0:
        # Only the first walk from a leaf gets past it.
        wp.atomic_add(changed_count_out, update_id[u], 1)
        wp.atomic_add(marked_count_out, update_id[u], marked)
