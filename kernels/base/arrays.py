"""Flat device arrays of all models, tree states and objects, as the structs that kernels receive.

Ids that cross structs are global: a vertex id indexes `vertex_pos`, a state id `StatePool`, an object id
`ObjectPool`. Node ids are heap indices inside one tree (the root is 1), face ids are the face's index in its own
model.
"""

import warp as wp

from warp_abtree.kernels import native

LEVEL_MAX = wp.constant(31)
"""Levels that a tree of at most 2^30 leaves can have."""

LAST_KEY = wp.constant(wp.int64(2**63 - 1))
"""Sorts behind all keys."""

NONE_REFUSED = wp.constant(2**31 - 1)
"""In place of the index of the first row that is refused."""


@wp.struct
class ModelPool:
    """Static data of every model, concatenated: per vertex of the forest, per face, per node, per model."""

    vertex_parent: wp.array(dtype=wp.int32)  # global id, -1 at a root, shape [vertex]
    vertex_pos: wp.array(dtype=wp.vec4d)  # x, y, z, 0 [model units], shape [vertex]
    vertex_near: wp.array(dtype=wp.vec4)  # the same about the model's centre, shape [vertex]
    face_vertex: wp.array(dtype=wp.vec3i)  # global ids of the original corners, shape [face]
    face_split: wp.array(dtype=wp.int32)  # least LOD at which the face is active, shape [face]
    split_face: wp.array(dtype=wp.int32)  # faces that each vertex split inserts or deforms, slice by slice
    leaf_node: wp.array(dtype=wp.int32)  # node of each face, the indexed list of the paper, shape [face]
    node_face: wp.array(dtype=wp.int32)  # face of a leaf, -1 at an inner node, -1 without a node, shape [node]
    node_slab: wp.array(dtype=wp.vec4)  # `slab_overlap.NodeSlab` of nodes of few faces, shape [2 node], or [0]: at the
    # finest LOD, and behind these at one other LOD of each model
    slab_gain: wp.array(dtype=wp.vec2i)  # sum of `make_slabs.gain_of`, and its terms, shape [2 model]
    slab_first: wp.array(dtype=wp.int32)  # first node that has a slab, shape [2 model]
    slab_lod: wp.array(dtype=wp.int32)  # the other LOD that has slabs, -1 for none, shape [model]
    face_start: wp.array(dtype=wp.int32)  # where its faces begin, shape [model]
    face_count: wp.array(dtype=wp.int32)  # shape [model]
    depth: wp.array(dtype=wp.int32)  # of its tree, shape [model]
    node_start: wp.array(dtype=wp.int32)  # where its nodes begin, shape [model]
    finest_limit: wp.array(dtype=wp.int32)  # ids of vertices below it are original ones, shape [model]
    lod_max: wp.array(dtype=wp.int32)  # vertex splits of the finest LOD, shape [model]
    centre: wp.array(dtype=wp.vec3d)  # of the box of its vertices [model units], shape [model]


@native.func_native()
def load_vertex(vertices: wp.array(dtype=wp.vec4d), i: wp.int32) -> wp.vec3d:
    """Return a position of `ModelPool.vertex_pos`, which nothing writes during a kernel."""


@wp.struct
class StatePool:
    """Everything that a level of detail decides: one entry a model at a LOD."""

    model: wp.array(dtype=wp.int32)  # shape [state]
    lod: wp.array(dtype=wp.int32)  # vertex splits applied, shape [state]
    node_start: wp.array(dtype=wp.int32)  # where its nodes begin, shape [state]
    face_start: wp.array(dtype=wp.int32)  # where its faces begin, shape [state]
    node_mark: wp.array(dtype=wp.uint32)  # a bit a node: deformed, from ACTIVE-MARK to ACTIVE-WALK, shape [node / 32]
    node_box: wp.array(dtype=wp.vec4)  # records of `nodes.Node`, two entries of 16 bytes each, shape [2 node]
    face_corner: wp.array(dtype=wp.vec4i)  # active ancestors of its corners, -1 where inactive, shape [face]


# In the place of whether an object is static: a place without one, of which nothing that is given is read.
NO_OBJECT = wp.constant(2)


@wp.struct
class ObjectPool:
    """Posed objects: x_world = rotation x_model + position."""

    state: wp.array(dtype=wp.int32)  # tree state, shape [object]
    world: wp.array(dtype=wp.int32)  # -1 is every world, shape [object]
    is_static: wp.array(dtype=wp.int32)  # 0, 1 or NO_OBJECT, shape [object]
    rotation: wp.array(dtype=wp.mat33d)  # shape [object]
    position: wp.array(dtype=wp.vec3d)  # [world units], shape [object]


@wp.struct
class Trees:
    """The AB-Trees that a kernel reads: models, their tree states, and the objects that stand at these."""

    models: ModelPool  # static
    states: StatePool  # one a model at a LOD
    objects: ObjectPool  # posed


@wp.func
def pair_key(pair: wp.vec2i):
    """Return first object * 2^32 + second object, which sorts pairs by their objects."""
    return (wp.int64(pair[0]) << wp.int64(32)) | wp.int64(pair[1])


@native.func_native()
def no_vector() -> wp.vec3d:
    """Return three NaNs of the bits 0x7ff8000000000000 on every device."""
