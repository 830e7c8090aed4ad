"""Node records: a box and where its subtree goes on, in 32 bytes that a thread loads at once."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool

wp.set_module_options(native.options())

SPAN_MIN = wp.constant(wp.float32(2.0**-126))


@wp.struct
class Node:
    """A box [model units, about the model's centre] and what the node stands for; two entries of 16 bytes a record:

    127        96 95         64 63         32 31          0
    [    skip    |   lower z   |   lower y   |  lower x   ]
    [    face    |   upper z   |   upper y   |  upper x   ]
    """

    lower: wp.vec3  # least corner
    upper: wp.vec3  # greatest corner
    skip: wp.int32  # this node if a leaf or of two active children, else what its active child stands for; -1 for none
    # Face number if `skip` is a leaf, else negative: the float32 bits of minus the box's extents' sum, never of 0.
    face: wp.int32


@native.func_native()
def load_constant(values: wp.array(dtype=wp.vec4), i: wp.int64) -> wp.vec4: ...


@native.func_native()
def load_entry(values: wp.array(dtype=wp.vec4), i: wp.int64) -> wp.vec4: ...


@native.func_native()
def store_entry(values: wp.array(dtype=wp.vec4), i: wp.int64, value: wp.vec4): ...


@wp.func
def unpack_node(low: wp.vec4, high: wp.vec4):
    node = Node()
    node.lower = wp.vec3(low[0], low[1], low[2])
    node.upper = wp.vec3(high[0], high[1], high[2])
    node.skip = wp.cast(low[3], wp.int32)
    node.face = wp.cast(high[3], wp.int32)
    return node


@wp.func
def load_node(states: StatePool, at: wp.int32):
    """Return the record of a node in the pool."""
    i = wp.int64(2) * wp.int64(at)
    return unpack_node(load_entry(states.node_box, i), load_entry(states.node_box, i + wp.int64(1)))


@wp.func
def load_constant_node(states: StatePool, at: wp.int32):
    """Return the record of a node that nothing writes during this kernel: two loads of 16 bytes."""
    i = wp.int64(2) * wp.int64(at)
    return unpack_node(load_constant(states.node_box, i), load_constant(states.node_box, i + wp.int64(1)))


@wp.func
def store_node(states: StatePool, at: wp.int32, node: Node):
    i = wp.int64(2) * wp.int64(at)
    lower = node.lower
    upper = node.upper
    face = node.face
    if face < 0:
        extent = ((upper[0] - lower[0]) + (upper[1] - lower[1])) + (upper[2] - lower[2])
        face = wp.cast(-wp.max(extent, SPAN_MIN), wp.int32)
    store_entry(states.node_box, i, wp.vec4(lower[0], lower[1], lower[2], wp.cast(node.skip, wp.float32)))
    store_entry(states.node_box, i + wp.int64(1), wp.vec4(upper[0], upper[1], upper[2], wp.cast(face, wp.float32)))


@wp.func
def empty_node():
    """Return a box that changes no union, over nothing active."""
    node = Node()
    node.lower = wp.vec3(wp.inf, wp.inf, wp.inf)
    node.upper = wp.vec3(-wp.inf, -wp.inf, -wp.inf)
    node.skip = -1
    node.face = -1
    return node


@wp.kernel
def clear_node_kernel(start: wp.int32, states_inout: StatePool):
    store_node(states_inout, start + wp.tid(), empty_node())
