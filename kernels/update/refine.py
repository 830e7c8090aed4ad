"""Mesh refinement: the active ancestors of face corners at a level of detail."""

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, StatePool
from warp_abtree.kernels.update.work_lists import UpdateLists, find_update, item_count, list_length

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def find_ancestor(vertex_parent: wp.array(dtype=wp.int32), vertex: wp.int32, limit: wp.int32):
    """Return the highest ancestor of a vertex below an id: node n_v + j stands once merge j is applied."""
    x = vertex
    y = vertex_parent[x]
    while y >= 0 and y < limit:
        x = y
        y = vertex_parent[x]
    return x


@wp.func
def refine_face(models: ModelPool, states: StatePool, state: wp.int32, face: wp.int32):
    """Return the corners of a face at the LOD of its state; (-1, -1, -1) where it is inactive."""
    model = states.model[state]
    at = models.face_start[model] + face
    corner = wp.vec4i(-1, -1, -1, -1)
    lod = states.lod[state]
    if lod >= models.face_split[at]:
        limit = models.finest_limit[model] + models.lod_max[model] - lod
        origin = models.face_vertex[at]
        # Coarsening starts from the corners it finds: they are ancestors of the original ones and below the limit.
        old = states.face_corner[states.face_start[state] + face]
        for i in range(3):
            v = origin[i]
            if old[i] >= 0 and old[i] < limit:
                v = old[i]
            corner[i] = find_ancestor(models.vertex_parent, v, limit)
    return corner


@wp.kernel
def refine_slice_kernel(step: wp.int32, models: ModelPool, plan: UpdateLists, states_inout: StatePool):
    """Refine every face that the slices of partial updates list.

    A slice may list a face twice; both threads write the same corners, whichever old ones they read.
    """
    updates = list_length(plan.partial_total)
    entries = item_count(plan.partial_total)
    entry = wp.tid()
    while entry < entries:
        u, i = find_update(plan.entry_end, updates, entry)
        state = plan.partial_state[u]
        face = models.split_face[plan.slice_start[u] + i]
        at = states_inout.face_start[state] + face
        states_inout.face_corner[at] = refine_face(models, states_inout, state, face)
        entry += step


@wp.kernel
def refine_all_kernel(step: wp.int32, models: ModelPool, states_inout: StatePool, plan_inout: UpdateLists):
    """Refine every face of the states under full update and count those that change."""
    updates = list_length(plan_inout.full_total)
    faces = item_count(plan_inout.full_total)
    item = wp.tid()
    while item < faces:
        u, face = find_update(plan_inout.face_end, updates, item)
        state = plan_inout.full_state[u]
        at = states_inout.face_start[state] + face
        old = states_inout.face_corner[at]
        new = refine_face(models, states_inout, state, face)
        if new[0] != old[0] or new[1] != old[1] or new[2] != old[2]:
            states_inout.face_corner[at] = new
            wp.atomic_add(plan_inout.changed_count, state, 1)
        item += step
