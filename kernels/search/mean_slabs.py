"""Slabs of nodes along the mean normal of the faces below, for bounds of distances.

A box has corners that no face has. Along the direction in which two surfaces are nearest, faces that look that way
reach no farther than their slab, so a node's box and slab together bound it closely (`slab_bound`, on the CPU
`distance/boxes.h`). The slabs of a state at a LOD are made once so many pairs have been searched without that it pays:
on the CPU by the thread that counts, on CUDA by blocks that share its subtrees.

A slab is two entries of 16 bytes a node, as `nodes.Node` has:

    127        96 95         64 63         32 31          0
    [    low     |  normal z   |  normal y   |  normal x   ]
    [     -      |   radius    | area of sum |    high     ]
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import StatePool, Trees
from warp_abtree.kernels.base.boxes import round_down, round_up
from warp_abtree.kernels.base.lanes import block_sync
from warp_abtree.kernels.base.nodes import Node, load_node, store_entry

MODULE_OPTIONS = native.options("base/lanes.cuh", "search/slabs.cuh")
wp.set_module_options(MODULE_OPTIONS)

# Pairs that are searched without slabs of a state before these are made: it takes about as long as so many save.
USES_MIN = wp.constant(16)
SLAB_THREADS = 256  # of a block that makes slabs
SUBTREE_LEVELS = wp.constant(10)  # of those that blocks share


@wp.struct
class Slabs:
    """Slabs of all tree states, and the LODs that they were made at."""

    record: wp.array(dtype=wp.vec4)  # two entries a node of the pool, shape [2 node]
    made: wp.array(dtype=wp.vec3i)  # (LOD, model, where its nodes begin) of what they are of, shape [state]
    uses: wp.array(dtype=wp.int32)  # pairs searched since, without, shape [state]
    due: wp.array(dtype=wp.int32)  # states whose slabs are to be made in this launch, shape [state]
    due_count: wp.array(dtype=wp.int32)  # how many, shape [1]
    ended: wp.array(dtype=wp.int32)  # subtrees of a state that blocks have ended, shape [state]
    states: wp.array(dtype=wp.vec2i)  # those of its objects, shape [pair]


@wp.struct
class MeanSlab:
    """Slab of the faces below a node: low <= normal . x <= high, x about the model's centre."""

    normal: wp.vec3  # unit, or 0
    low: wp.float32  # least
    high: wp.float32  # greatest
    weight: wp.float32  # length of the sum of the faces' normals, each as long as twice its area
    radius: wp.float32  # of a ball about the middle of the node's box that holds the faces


@native.func_native()
def is_last_block(ended: wp.array(dtype=wp.int32), i: wp.int32, amount: wp.int32, whole: wp.int32) -> bool:
    """Add to the work ended; return whether this block is the last, which then sees what the others have written."""


@native.func_native()
def load_written(values: wp.array(dtype=wp.vec4), i: wp.int64) -> wp.vec4:
    """Return an entry that another block may have written."""


@wp.func
def load_mean_slab(slabs: Slabs, at: wp.int32):
    i = wp.int64(2) * wp.int64(at)
    first, second = load_written(slabs.record, i), load_written(slabs.record, i + wp.int64(1))
    slab = MeanSlab()
    slab.normal = wp.vec3(first[0], first[1], first[2])
    slab.low = first[3]
    slab.high = second[0]
    slab.weight = second[1]
    slab.radius = second[2]
    return slab


@wp.func
def store_mean_slab(slabs: Slabs, at: wp.int32, slab: MeanSlab):
    n = slab.normal
    i = wp.int64(2) * wp.int64(at)
    store_entry(slabs.record, i, wp.vec4(n[0], n[1], n[2], slab.low))
    store_entry(slabs.record, i + wp.int64(1), wp.vec4(slab.high, slab.weight, slab.radius, 0.0))


@wp.func
def set_normal(slab: MeanSlab, sum: wp.vec3d):
    """Return a slab along a sum of normals, its extent open."""
    length = wp.length(sum)
    made = MeanSlab()
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
def face_slab(trees: Trees, node: Node, at: wp.int32):
    """Return the slab of one active face."""
    c = trees.states.face_corner[at]
    p = trees.models.vertex_near[c[0]]
    q = trees.models.vertex_near[c[1]]
    r = trees.models.vertex_near[c[2]]
    a = wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))
    b = wp.vec3d(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]))
    d = wp.vec3d(wp.float64(r[0]), wp.float64(r[1]), wp.float64(r[2]))
    slab = set_normal(MeanSlab(), wp.cross(b - a, d - a))
    n = wp.vec3d(slab.normal)
    slab.low = round_down(wp.min(wp.min(wp.dot(n, a), wp.dot(n, b)), wp.dot(n, d)))
    slab.high = round_up(wp.max(wp.max(wp.dot(n, a), wp.dot(n, b)), wp.dot(n, d)))
    m = middle_of(node)
    slab.radius = round_up(wp.max(wp.max(wp.length(a - m), wp.length(b - m)), wp.length(d - m)))
    return slab


@wp.func
def node_top(node: Node, slab: MeanSlab, n: wp.vec3d):
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
    first, second = load_mean_slab(slabs, at), load_mean_slab(slabs, at + 1)
    sum = wp.float64(first.weight) * wp.vec3d(first.normal) + wp.float64(second.weight) * wp.vec3d(second.normal)
    slab = set_normal(MeanSlab(), sum)
    n = wp.vec3d(slab.normal)
    a, b = load_node(states, at), load_node(states, at + 1)
    slab.high = round_up(wp.max(node_top(a, first, n), node_top(b, second, n)))
    slab.low = round_down(-wp.max(node_top(a, first, -n), node_top(b, second, -n)))
    m = middle_of(node)
    one = wp.length(middle_of(a) - m) + wp.float64(first.radius)
    other = wp.length(middle_of(b) - m) + wp.float64(second.radius)
    box = wp.length(wp.vec3d(node.upper) - m)
    slab.radius = round_up(wp.min(box, wp.max(one, other)))
    return slab


@wp.func
def make_slab(trees: Trees, slabs: Slabs, state: wp.int32, i: wp.int32):
    """Make the slab of node i of a state, if it is active; those of the nodes below are made."""
    start = trees.states.node_start[state]
    node = load_node(trees.states, start + i)
    if node.skip >= 0:
        if node.face >= 0:
            store_mean_slab(slabs, start + i, face_slab(trees, node, trees.states.face_start[state] + node.face))
        elif node.skip != i:
            store_mean_slab(slabs, start + i, load_mean_slab(slabs, start + node.skip))
        else:
            store_mean_slab(slabs, start + i, join_slabs(trees.states, slabs, node, start + 2 * i))


@wp.func
def key_of(states: StatePool, state: wp.int32):
    """Return the key of a state's slabs: its LOD, model and place."""
    return wp.vec3i(states.lod[state], states.model[state], states.node_start[state])


@wp.func
def is_made(states: StatePool, slabs: Slabs, state: wp.int32):
    """Return whether slabs of a state are those of its LOD; not of state -1."""
    return state >= 0 and state < slabs.made.shape[0] and slabs.made[state] == key_of(states, state)


@wp.func
def has_mean_slabs(states: StatePool, slabs: Slabs, p: wp.int32):
    """Return whether there are slabs of both objects of a pair."""
    own = slabs.states[p]
    return is_made(states, slabs, own[0]) and is_made(states, slabs, own[1])


@wp.func
def count_use(trees: Trees, slabs: Slabs, state: wp.int32):
    """Count a pair that is searched without slabs of a state; return whether they are to be made now."""
    end = trees.states.node_start[state] + (wp.int32(2) << trees.models.depth[trees.states.model[state]])
    # What a graph has no room for has none.
    if state >= slabs.made.shape[0] or 2 * end > slabs.record.shape[0] or is_made(trees.states, slabs, state):
        return False
    return slabs.uses[state] < USES_MIN and wp.atomic_add(slabs.uses, state, 1) == USES_MIN - 1


@wp.func
def count_uses(p: wp.int32, trees: Trees, pairs: wp.array(dtype=wp.vec2i), slabs: Slabs):
    """Count an object pair, and list its states whose slabs are to be made now."""
    own = wp.vec2i(trees.objects.state[pairs[p][0]], trees.objects.state[pairs[p][1]])
    slabs.states[p] = own
    for k in range(2):
        if count_use(trees, slabs, own[k]):
            slabs.due[wp.atomic_add(slabs.due_count, 0, 1)] = own[k]


@wp.func
def make_below(
    top: wp.int32, levels: wp.int32, thread: wp.int32, threads: wp.int32, trees: Trees, slabs: Slabs, state: wp.int32
):
    """Make the slabs of a node and of so many levels below it, children first, by the threads of a block."""
    level = levels
    while level >= 0:
        i = thread
        while i < wp.int32(1) << level:
            make_slab(trees, slabs, state, (top << level) + i)
            i += threads
        block_sync()
        level -= 1


@wp.func
def make_due(first: wp.int32, step: wp.int32, thread: wp.int32, threads: wp.int32, trees: Trees, slabs: Slabs):
    """Make the listed states' slabs: each block builds every `step`-th subtree, the last to finish the levels above.

    Subtrees are shared among blocks; the block that ends the last one of a state makes what is above.
    """
    for k in range(slabs.due_count[0]):
        state = slabs.due[k]
        depth = trees.models.depth[trees.states.model[state]]
        above = wp.max(0, depth - SUBTREE_LEVELS)
        made = wp.int32(0)
        i = (first + k) % step
        while i < wp.int32(1) << above:
            make_below((wp.int32(1) << above) + i, depth - above, thread, threads, trees, slabs, state)
            made += 1
            i += step
        if made > 0 and is_last_block(slabs.ended, state, made, wp.int32(1) << above):
            make_below(1, above - 1, thread, threads, trees, slabs, state)
            if thread == 0:
                slabs.made[state] = key_of(trees.states, state)
                slabs.uses[state] = 0
                slabs.ended[state] = 0


@wp.kernel(module="unique", module_options=MODULE_OPTIONS | {"block_dim": SLAB_THREADS})
def make_slabs_kernel(threads: wp.int32, blocks: wp.int32, trees: Trees, slabs_inout: Slabs):
    """Make the slabs that are due."""
    i = wp.tid()
    make_due(i / threads, blocks, i % threads, threads, trees, slabs_inout)
