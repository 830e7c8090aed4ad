"""Slabs of nodes on the CPU: how far the faces below a node reach along their mean normal, both ways.

A box has corners that no face has. Along the direction in which two surfaces are nearest, faces that look that way
reach no farther than their slab, so a node's box and slab together bound it closely (`nearest/boxes.h`). A slab is
made of a state at a LOD once so many pairs have asked for it that it pays.

A slab is two entries of 16 bytes a node, as `nodes.Node` has:

    127        96 95         64 63         32 31          0
    [    low     |  normal z   |  normal y   |  normal x   ]
    [     -      |   radius    | area of sum |    high     ]
"""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.traversal.boxes import round_down, round_up
from warp_abtree.kernels.traversal.nodes import Node, load_node

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Pairs that ask for the slabs of a state before they are made: it takes about as long as so many searches save.
USES_MIN = wp.constant(16)


@wp.struct
class Slabs:
    """Slabs of all states, and what they were made of."""

    record: wp.array(dtype=wp.vec4)  # two entries a node of the pool, shape [2 node]
    made: wp.array(dtype=wp.vec4i)  # (LOD, model, where its nodes begin, pairs that have asked), shape [state]
    states: wp.array(dtype=wp.vec2i)  # those of its objects, shape [pair]


@wp.struct
class Slab:
    """What lies below a node: low <= normal . x <= high, x about the model's centre."""

    normal: wp.vec3  # unit, or 0
    low: wp.float32  # least
    high: wp.float32  # greatest
    weight: wp.float32  # length of the sum of the faces' normals, each as long as twice its area
    radius: wp.float32  # of a ball about the middle of the node's box that holds the faces


@wp.func
def load_slab(slabs: Slabs, at: wp.int32):
    first, second = slabs.record[2 * at], slabs.record[2 * at + 1]
    slab = Slab()
    slab.normal = wp.vec3(first[0], first[1], first[2])
    slab.low = first[3]
    slab.high = second[0]
    slab.weight = second[1]
    slab.radius = second[2]
    return slab


@wp.func
def store_slab(slabs: Slabs, at: wp.int32, slab: Slab):
    n = slab.normal
    slabs.record[2 * at] = wp.vec4(n[0], n[1], n[2], slab.low)
    slabs.record[2 * at + 1] = wp.vec4(slab.high, slab.weight, slab.radius, 0.0)


@wp.func
def set_normal(slab: Slab, sum: wp.vec3d):
    """Return a slab along a sum of normals, its extent open."""
    length = wp.length(sum)
    made = Slab()
    made.low = slab.low
    made.high = slab.high
    made.weight = wp.float32(length)
    if length > wp.float64(0.0) and length < wp.float64(wp.inf):
        made.normal = wp.vec3(sum / length)
    return made


@wp.func
def middle_of(node: Node):
    """Return the middle of a node's box."""
    return wp.float64(0.5) * (wp.vec3d(node.lower) + wp.vec3d(node.upper))


@wp.func
def face_slab(models: ModelPool, states: StatePool, node: Node, at: wp.int32):
    """Return the slab of one active face."""
    c = states.face_corner[at]
    p = models.vertex_near[c[0]]
    q = models.vertex_near[c[1]]
    r = models.vertex_near[c[2]]
    a = wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))
    b = wp.vec3d(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]))
    d = wp.vec3d(wp.float64(r[0]), wp.float64(r[1]), wp.float64(r[2]))
    slab = set_normal(Slab(), wp.cross(b - a, d - a))
    n = wp.vec3d(slab.normal)
    slab.low = round_down(wp.min(wp.min(wp.dot(n, a), wp.dot(n, b)), wp.dot(n, d)))
    slab.high = round_up(wp.max(wp.max(wp.dot(n, a), wp.dot(n, b)), wp.dot(n, d)))
    m = middle_of(node)
    slab.radius = round_up(wp.max(wp.max(wp.length(a - m), wp.length(b - m)), wp.length(d - m)))
    return slab


@wp.func
def top_of(node: Node, slab: Slab, n: wp.vec3d):
    """Return an upper bound of n . x below a node, by its box and slab."""
    m = wp.vec3d(slab.normal)
    along = wp.dot(n, m)
    rest = n - along * m
    top = wp.where(along > wp.float64(0.0), along * wp.float64(slab.high), along * wp.float64(slab.low))
    plain = wp.float64(0.0)
    for i in range(3):
        low, high = wp.float64(node.lower[i]), wp.float64(node.upper[i])
        top += wp.where(rest[i] > wp.float64(0.0), rest[i] * high, rest[i] * low)
        plain += wp.where(n[i] > wp.float64(0.0), n[i] * high, n[i] * low)
    return wp.min(top, plain)


@wp.func
def join_slabs(states: StatePool, slabs: Slabs, node: Node, at: wp.int32):
    """Return the slab of a node whose children are two siblings of the pool."""
    first, second = load_slab(slabs, at), load_slab(slabs, at + 1)
    sum = wp.float64(first.weight) * wp.vec3d(first.normal) + wp.float64(second.weight) * wp.vec3d(second.normal)
    slab = set_normal(Slab(), sum)
    n = wp.vec3d(slab.normal)
    a, b = load_node(states, at), load_node(states, at + 1)
    slab.high = round_up(wp.max(top_of(a, first, n), top_of(b, second, n)))
    slab.low = round_down(-wp.max(top_of(a, first, -n), top_of(b, second, -n)))
    m = middle_of(node)
    one = wp.length(middle_of(a) - m) + wp.float64(first.radius)
    other = wp.length(middle_of(b) - m) + wp.float64(second.radius)
    box = wp.length(wp.vec3d(node.upper) - m)
    slab.radius = round_up(wp.min(box, wp.max(one, other)))
    return slab


@wp.func
def make_slabs(models: ModelPool, states: StatePool, slabs: Slabs, state: wp.int32):
    """Make the slabs of all active nodes of a state, children first."""
    start = states.node_start[state]
    i = wp.int32(2) << models.depth[states.model[state]]
    while i > 1:
        i -= 1
        node = load_node(states, start + i)
        if node.skip >= 0:
            if node.face >= 0:
                store_slab(slabs, start + i, face_slab(models, states, node, states.face_start[state] + node.face))
            elif node.skip != i:
                store_slab(slabs, start + i, load_slab(slabs, start + node.skip))
            else:
                store_slab(slabs, start + i, join_slabs(states, slabs, node, start + 2 * i))


@wp.func
def has_slabs(slabs: Slabs, p: wp.int32):
    """Return whether there are slabs of both objects of a pair."""
    own = slabs.states[p]
    if wp.max(own[0], own[1]) >= slabs.made.shape[0]:
        return False
    return slabs.made[own[0]][3] >= USES_MIN and slabs.made[own[1]][3] >= USES_MIN


@wp.func
def ask_slabs(models: ModelPool, states: StatePool, slabs: Slabs, state: wp.int32):
    """Count a pair that asks for the slabs of a state, and make them if they pay and there is room."""
    end = states.node_start[state] + (wp.int32(2) << models.depth[states.model[state]])
    if state >= slabs.made.shape[0] or 2 * end > slabs.record.shape[0]:
        return
    key = wp.vec3i(states.lod[state], states.model[state], states.node_start[state])
    made = slabs.made[state]
    uses = wp.where(made[0] == key[0] and made[1] == key[1] and made[2] == key[2], made[3], 0)
    if uses < USES_MIN:
        uses += 1
        if uses == USES_MIN:
            make_slabs(models, states, slabs, state)
        slabs.made[state] = wp.vec4i(key[0], key[1], key[2], uses)


@wp.func
def refresh_slabs(
    p: wp.int32,
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    slabs: Slabs,
):
    """Count what an object pair asks for, and make the slabs that pay; one pair after the other, CPU only."""
    own = wp.vec2i(objects.state[pairs[p][0]], objects.state[pairs[p][1]])
    slabs.states[p] = own
    ask_slabs(models, states, slabs, own[0])
    ask_slabs(models, states, slabs, own[1])
