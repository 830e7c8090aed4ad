"""ACTIVE-WALK and ACTIVE-REFIT, level by level: boxes and skip links of marked nodes."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, load_vertex
from warp_abtree.kernels.base.boxes import round_down_vec, round_up_vec
from warp_abtree.kernels.base.lanes import block_sync
from warp_abtree.kernels.base.nodes import Node, empty_node, load_node, store_node
from warp_abtree.kernels.update.work_lists import UpdateLists, find_update

TOP_THREADS = 512  # of the block that refits the levels next to the root
MODULE_OPTIONS = native.options("base/lanes.cuh")
wp.set_module_options(MODULE_OPTIONS)


@wp.func
def refit_leaf(models: ModelPool, states: StatePool, state: wp.int32, node: wp.int32, face: wp.int32, corner: wp.vec4i):
    """Box one face about the model's centre, or empty the leaf of an inactive face; return its record."""
    leaf = empty_node()
    if corner[0] >= 0:
        centre = models.centre[states.model[state]]
        a = load_vertex(models.vertex_pos, corner[0]) - centre
        b = load_vertex(models.vertex_pos, corner[1]) - centre
        c = load_vertex(models.vertex_pos, corner[2]) - centre
        leaf.lower = round_down_vec(wp.min(a, wp.min(b, c)))
        leaf.upper = round_up_vec(wp.max(a, wp.max(b, c)))
        leaf.skip = node
        leaf.face = face
    store_node(states, states.node_start[state] + node, leaf)
    return leaf


@wp.func
def unite_nodes(node: wp.int32, left: Node, right: Node):
    """Return the record of a node with these children, in either order.

    It stands for the one child that is active, if the other is not.
    """
    # An empty box is (+inf, -inf), so the union needs no case for an inactive child.
    whole = Node()
    whole.lower = wp.min(left.lower, right.lower)
    whole.upper = wp.max(left.upper, right.upper)
    whole.skip = node
    whole.face = -1
    if left.skip < 0:
        whole.skip = right.skip
        whole.face = right.face
    elif right.skip < 0:
        whole.skip = left.skip
        whole.face = left.face
    return whole


@wp.func
def refit_inner(states: StatePool, state: wp.int32, node: wp.int32):
    """Unite the children of a node; both are final."""
    first = states.node_start[state] + 2 * node
    whole = unite_nodes(node, load_node(states, first), load_node(states, first + 1))
    store_node(states, states.node_start[state] + node, whole)


@wp.func
def refit_node(models: ModelPool, states: StatePool, state: wp.int32, node: wp.int32):
    face = models.node_face[models.node_start[states.model[state]] + node]
    if face >= 0:
        corner = states.face_corner[states.face_start[state] + face]
        refit_leaf(models, states, state, node, face, corner)
    else:
        refit_inner(states, state, node)


@wp.func
def refit_level(
    first: wp.int32, step: wp.int32, level: wp.int32, models: ModelPool, plan: UpdateLists, states: StatePool
):
    """Refit every `step`-th of a level's nodes: those marked, and all of the states under full update.

    Invariant: children of this level are final, since levels go deepest first.
    Source: Liu et al. 2006, section 3.2.2, ACTIVE-REFIT; Algorithm 3.
    """
    marked = plan.level_count[level]
    items = marked + (plan.whole_count[level] << level)
    item = wp.int32(first)
    while item < items:
        if item < marked:
            listed = plan.level_node[plan.level_start[level] + item]
            at = states.node_start[listed[0]] + listed[1]
            wp.atomic_and(states.node_mark, at >> 5, ~(wp.uint32(1) << wp.uint32(at & 31)))
            refit_node(models, states, listed[0], listed[1])
        else:
            whole = item - marked
            state = plan.whole_state[plan.whole_start[level] + (whole >> level)]
            node = (1 << level) + (whole & ((1 << level) - 1))
            # A heap index without a node lies under a leaf of the level above.
            up = models.node_start[states.model[state]] + (node >> 1)
            if level == 0 or models.node_face[up] < 0:
                refit_node(models, states, state, node)
        item += step


@wp.kernel
def refit_level_kernel(step: wp.int32, level: wp.int32, models: ModelPool, plan: UpdateLists, states_inout: StatePool):
    """Refit the nodes of one level that an update lists."""
    refit_level(wp.tid(), step, level, models, plan, states_inout)


# A module of its own: its blocks are larger, and a module is compiled for every size of blocks that it is launched in.
@wp.kernel(module="unique", module_options=MODULE_OPTIONS | {"block_dim": TOP_THREADS})
def refit_top_kernel(step: wp.int32, levels: wp.int32, models: ModelPool, plan: UpdateLists, states_inout: StatePool):
    """Refit the listed nodes of so many levels from the root on, deepest first: one block for all of them."""
    level = levels - 1
    while level >= 0:
        refit_level(wp.tid(), step, level, models, plan, states_inout)
        block_sync()
        level -= 1


@wp.kernel
def copy_node_kernel(
    node_end: wp.array(dtype=wp.int32),
    source_state: wp.array(dtype=wp.int32),
    target_state: wp.array(dtype=wp.int32),
    states_inout: StatePool,
):
    """Copy the nodes of whole states, given the running total of their counts."""
    u, i = find_update(node_end, node_end.shape[0], wp.tid())
    source, target = states_inout.node_start[source_state[u]] + i, states_inout.node_start[target_state[u]] + i
    store_node(states_inout, target, load_node(states_inout, source))


@wp.kernel
def copy_face_kernel(
    face_end: wp.array(dtype=wp.int32),
    source_state: wp.array(dtype=wp.int32),
    target_state: wp.array(dtype=wp.int32),
    states_inout: StatePool,
):
    """Copy the face corners of whole states, given the running total of their counts."""
    u, i = find_update(face_end, face_end.shape[0], wp.tid())
    source, target = states_inout.face_start[source_state[u]] + i, states_inout.face_start[target_state[u]] + i
    states_inout.face_corner[target] = states_inout.face_corner[source]
