"""Mesh refinement: the active ancestors of face corners at a level of detail."""

import warp as wp

from warp_abtree.kernels.pools import ModelPool, StatePool

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
    corner = wp.vec3i(-1, -1, -1)
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
def refine_slice_kernel(
    entry_count: wp.int32,
    models: ModelPool,
    entry_end: wp.array(dtype=wp.int32),
    update_state: wp.array(dtype=wp.int32),
    update_slice: wp.array(dtype=wp.int32),
    states_inout: StatePool,
):
    """Refine every face that the slices of partial updates list.

    A slice may list a face twice; both threads write the same corners, whichever old ones they read.

    Args:
        entry_end: Running total of slice lengths, shape [update_count].
        update_state: State of each update, shape [update_count].
        update_slice: Where its slice begins in split_face, shape [update_count].
    """
    tid = wp.tid()
    if tid >= entry_count:
        return
    u = wp.lower_bound(entry_end, tid + 1)
    begin = wp.int32(0)
    if u > 0:
        begin = entry_end[u - 1]
    state = update_state[u]
    face = models.split_face[update_slice[u] + tid - begin]
    states_inout.face_corner[states_inout.face_start[state] + face] = refine_face(models, states_inout, state, face)


@wp.kernel
def refine_all_kernel(
    models: ModelPool,
    face_end: wp.array(dtype=wp.int32),
    update_state: wp.array(dtype=wp.int32),
    update_id: wp.array(dtype=wp.int32),
    states_inout: StatePool,
    changed_count_out: wp.array(dtype=wp.int32),
):
    """Refine every face of the states under full update and count those that change.

    Args:
        face_end: Running total of face counts, shape [update_count].
        update_state: State of each update, shape [update_count].
        update_id: Where each update counts, shape [update_count].
    """
    tid = wp.tid()
    u = wp.lower_bound(face_end, tid + 1)
    begin = wp.int32(0)
    if u > 0:
        begin = face_end[u - 1]
    state = update_state[u]
    face = tid - begin
    at = states_inout.face_start[state] + face
    old = states_inout.face_corner[at]
    new = refine_face(models, states_inout, state, face)
    if new[0] != old[0] or new[1] != old[1] or new[2] != old[2]:
        states_inout.face_corner[at] = new
        wp.atomic_add(changed_count_out, update_id[u], 1)
