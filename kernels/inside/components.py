"""The components of tree states: one face of each, so that a point of it stands for all of it.

Faces that share a vertex are of one component. Components are those of a state's active faces, not of the original
mesh: a neck that is thinned to an edge without faces leaves two.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.lanes import warp_lane, warp_size, warp_sync
from warp_abtree.kernels.contacts.loops import find_root, unite_roots

wp.set_module_options(native.options("base/lanes.cuh"))

NO_FACE = wp.constant(2**31 - 1)


@wp.struct
class Solids:
    """Which objects are solids, and the components of all states."""

    is_solid: wp.array(dtype=wp.int32)  # 0 or 1, shape [object]
    shift: wp.array(dtype=wp.int32)  # a vertex's id and this is its place in `parent`, shape [state]
    made: wp.array(dtype=wp.vec3i)  # (LOD, model, where its nodes begin), shape [state]
    count: wp.array(dtype=wp.int32)  # components, shape [state]
    parent: wp.array(dtype=wp.int32)  # union-find forest of the vertices of each state, shape [place]
    lowest: wp.array(dtype=wp.int32)  # lowest face of a root's component, shape [place]
    face: wp.array(dtype=wp.int32)  # lowest face of each component from `first` on, in no order, shape [place]
    first: wp.array(dtype=wp.int32)  # where its places begin, -1 where there is no state, shape [state]


@wp.kernel(module="unique", module_options=native.options("base/lanes.cuh"))
def find_component_kernel(
    models: ModelPool,
    states: StatePool,
    launched: wp.array(dtype=wp.int32),
    solids_inout: Solids,
):
    """Find the components of a state that has changed, a warp a state; on the CPU a thread."""
    state = wp.tid() / warp_size()
    if launched[0] == STALE or solids_inout.first[state] < 0:
        return
    key = wp.vec3i(states.lod[state], states.model[state], states.node_start[state])
    if solids_inout.made[state] == key:
        return
    start = states.face_start[state]
    count = models.face_count[states.model[state]]
    shift = solids_inout.shift[state]
    i = warp_lane()
    while i < count:
        c = states.face_corner[start + i]
        if c[0] >= 0:
            for k in range(3):
                solids_inout.parent[c[k] + shift] = c[k] + shift
                solids_inout.lowest[c[k] + shift] = NO_FACE
        i += warp_size()
    if warp_lane() == 0:
        solids_inout.made[state] = wp.vec3i(-1, -1, -1)
        solids_inout.count[state] = 0
    warp_sync()
    i = warp_lane()
    while i < count:
        c = states.face_corner[start + i]
        if c[0] >= 0:
            unite_roots(solids_inout.parent, c[0] + shift, c[1] + shift)
            unite_roots(solids_inout.parent, c[0] + shift, c[2] + shift)
        i += warp_size()
    warp_sync()
    i = warp_lane()
    while i < count:
        c = states.face_corner[start + i]
        if c[0] >= 0:
            wp.atomic_min(solids_inout.lowest, find_root(solids_inout.parent, c[0] + shift), i)
        i += warp_size()
    warp_sync()
    i = warp_lane()
    while i < count:
        c = states.face_corner[start + i]
        if c[0] >= 0 and solids_inout.lowest[find_root(solids_inout.parent, c[0] + shift)] == i:
            slot = wp.atomic_add(solids_inout.count, state, 1)
            solids_inout.face[solids_inout.first[state] + slot] = i
        i += warp_size()
    warp_sync()
    if warp_lane() == 0:
        solids_inout.made[state] = key
