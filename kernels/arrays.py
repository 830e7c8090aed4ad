"""Flat device arrays of all models, tree states and objects, as the structs that kernels receive.

Ids that cross structs are global: a vertex id indexes `vertex_pos`, a state id `StatePool`, an object id
`ObjectPool`. Node ids are heap indices inside one tree (the root is 1), face ids are the face's index in its own
model.
"""

import warp as wp

from warp_abtree.kernels import native

INACTIVE = wp.constant(0)
ACTIVE = wp.constant(1)
DEFORMED = wp.constant(2)
"""Status of a node (Liu et al. 2006, section 3.2.1). Deformed lasts from ACTIVE-MARK to ACTIVE-WALK only."""

LEVEL_MAX = wp.constant(31)
"""Levels that a tree of at most 2^30 leaves can have."""

LAST_KEY = wp.constant(wp.int64(2**63 - 1))
"""Sorts behind all keys."""


@wp.struct
class ModelPool:
    """Static data of every model, concatenated.

    Per vertex of the forest: vertex_parent (global id, -1 at a root), vertex_pos [model units] (x, y, z, 0),
    vertex_near, the same about the model's centre in float32.
    Per face: face_vertex (global ids), face_split, leaf_node (the indexed list). Per node: node_face (-1 inside).
    Per model: starts into these, counts, centre [model units].
    """

    vertex_parent: wp.array(dtype=wp.int32)
    vertex_pos: wp.array(dtype=wp.vec4d)
    vertex_near: wp.array(dtype=wp.vec4)
    face_vertex: wp.array(dtype=wp.vec3i)
    face_split: wp.array(dtype=wp.int32)
    split_face: wp.array(dtype=wp.int32)
    leaf_node: wp.array(dtype=wp.int32)
    node_face: wp.array(dtype=wp.int32)
    face_start: wp.array(dtype=wp.int32)
    face_count: wp.array(dtype=wp.int32)
    node_start: wp.array(dtype=wp.int32)
    finest_limit: wp.array(dtype=wp.int32)
    lod_max: wp.array(dtype=wp.int32)
    centre: wp.array(dtype=wp.vec3d)


@wp.func_native(native.body("numbers.cuh", "load_vertex"))
def load_vertex(vertices: wp.array(dtype=wp.vec4d), i: wp.int32) -> wp.vec3d:
    """Return a position of `ModelPool.vertex_pos`, which nothing writes during a kernel."""
    ...


@wp.struct
class StatePool:
    """Everything that a level of detail decides: one entry a model at a LOD.

    Per node: node_status, and node_box, two entries of 16 bytes for a record (`nodes.Node`). Per face:
    face_corner, the active ancestors (global vertex ids) of the three corners, -1 where the face is inactive.
    """

    model: wp.array(dtype=wp.int32)
    lod: wp.array(dtype=wp.int32)
    node_start: wp.array(dtype=wp.int32)
    face_start: wp.array(dtype=wp.int32)
    node_status: wp.array(dtype=wp.int32)
    node_box: wp.array(dtype=wp.vec4)
    face_corner: wp.array(dtype=wp.vec4i)


@wp.struct
class ObjectPool:
    """Posed objects: x_world = rotation x_model + position [world units]."""

    state: wp.array(dtype=wp.int32)
    world: wp.array(dtype=wp.int32)
    is_static: wp.array(dtype=wp.int32)
    rotation: wp.array(dtype=wp.mat33d)
    position: wp.array(dtype=wp.vec3d)
