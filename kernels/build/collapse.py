"""Edge collapse by quadric error, strictly greedy: one serial kernel on the CPU, resumable after any merge.

Source: Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.build import heap as queue
from warp_abtree.kernels.build import vertex_forest as forest
from warp_abtree.kernels.build.quadric import Quadric, quadric_error, quadric_minimum, quadric_moved, quadric_plane

wp.set_module_options(native.options("build/fetch_edges.h") | {"fuse_fp": True})

RUNNING = wp.constant(0)
FINISHED = wp.constant(1)
HEAP_FULL = wp.constant(2)

# Entries of `counter`, kept between launches.
HEAP_SIZE = wp.constant(0)
MERGE_COUNT = wp.constant(1)
LIVE_FACE_COUNT = wp.constant(2)
STATUS = wp.constant(3)

# Stages of a heap entry, which only rise: an edge is popped at most three times.
FRESH = wp.constant(0)
PENALISED = wp.constant(1)  # the merge flips a face or makes a vertex of too many faces
LAST = wp.constant(2)  # the merge removes a connected component

MAX_VALENCE = wp.constant(24)
MIN_COS = wp.constant(wp.float64(0.2))
MAX_REACH = wp.constant(wp.float64(4.0))  # optimum at most so many edge lengths from the midpoint
POINT_WEIGHT = wp.constant(wp.float64(1.0e-9))
LINE_SHARE = wp.constant(wp.float64(1.0e-6))  # orders merges of faces without area by edge length
POSTPONED_KEY = wp.constant(wp.float64(1.0e100))


@wp.struct
class Surface:
    """The nodes of the vertex forest during the collapse."""

    pos: wp.array(dtype=wp.vec3d)  # [node_capacity], normalised
    quadric: wp.array(dtype=Quadric)  # [node_capacity]
    parent: wp.array(dtype=int)  # [node_capacity], -1: active
    stamp: wp.array(dtype=int)  # [node_capacity], last node that met this one as a neighbour


@native.func_native(cpu=True)
def fetch_edges(surface: Surface, rings: forest.Rings, heap: queue.Heap, size: wp.int32):
    """Prefetch what the next merges will read into the caches of this core."""


@wp.func
def edge_quadric(surface: Surface, a: int, b: int):
    """Return the sum of two nodes' quadrics relative to the midpoint of their edge."""
    h = (surface.pos[b] - surface.pos[a]) * wp.float64(0.5)
    return quadric_moved(surface.quadric[a], h) + quadric_moved(surface.quadric[b], -h)


@wp.func
def place_edge(surface: Surface, a: int, b: int, q: Quadric):
    """Return where the merged node goes, to the minimum of the quadric, else midpoint or end, and the error there."""
    pa = surface.pos[a]
    pb = surface.pos[b]
    h = (pb - pa) * wp.float64(0.5)
    y = quadric_minimum(q, wp.length(h) * wp.float64(2.0) * MAX_REACH)
    if wp.isfinite(y[0]):
        return pa + h + y, quadric_error(q, y)
    pos = pa + h
    cost = q[9]
    cost_a = quadric_error(q, -h)
    cost_b = quadric_error(q, h)
    if cost_a < cost:
        pos = pa
        cost = cost_a
    if cost_b < cost:
        pos = pb
        cost = cost_b
    return pos, wp.max(cost, wp.float64(0.0))


@wp.func
def component_extent(surface: Surface, rings: forest.Rings, a: int, b: int):
    """Return the longest squared edge of a connected component whose faces all have both a and b."""
    size = wp.length_sq(surface.pos[b] - surface.pos[a])
    k = rings.head[a]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            third = forest.third_corner(f, a, b, rings.corner_node)
            if third >= 0:
                size = wp.max(size, wp.length_sq(surface.pos[third] - surface.pos[a]))
                size = wp.max(size, wp.length_sq(surface.pos[third] - surface.pos[b]))
        k = rings.next[k]
    return size


@wp.func
def ring_flips(surface: Surface, rings: forest.Rings, node: int, other: int, target: wp.vec3d):
    """Tell whether moving `node` to the target turns a surviving face by more than arccos(MIN_COS)."""
    k = rings.head[node]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            if forest.third_corner(f, node, other, rings.corner_node) < 0:
                p = surface.pos[rings.corner_node[3 * f + (k + 1) % 3]]
                q = surface.pos[rings.corner_node[3 * f + (k + 2) % 3]]
                before = wp.cross(p - surface.pos[node], q - surface.pos[node])
                after = wp.cross(p - target, q - target)
                size = wp.length(before)
                if size > wp.float64(0.0):
                    if wp.dot(before, after) <= MIN_COS * size * wp.length(after):
                        return True
        k = rings.next[k]
    return False


@wp.func
def commit_merge(surface: Surface, rings: forest.Rings, a: int, b: int, c: int, q: Quadric, pos: wp.vec3d):
    """Make node c at `pos` of nodes a and b."""
    mid = surface.pos[a] + (surface.pos[b] - surface.pos[a]) * wp.float64(0.5)
    surface.pos[c] = pos
    surface.quadric[c] = quadric_moved(q, pos - mid)
    surface.parent[a] = c
    surface.parent[b] = c
    tail = forest.absorb_ring(rings, a, a, b, c, -1)
    tail = forest.absorb_ring(rings, b, a, b, c, tail)


@wp.func
def push_ring(surface: Surface, rings: forest.Rings, heap: queue.Heap, size: int, c: int):
    """Push the edges of the new node c, each once; return the heap's new size."""
    k = rings.head[c]
    while k >= 0:
        f = k // 3
        for turn in range(1, 3):
            n = rings.corner_node[3 * f + (k + turn) % 3]
            if surface.stamp[n] != c:
                surface.stamp[n] = c
                _, cost = place_edge(surface, n, c, edge_quadric(surface, n, c))
                size = queue.heap_push(heap, size, cost, queue.pack_pair(n, c, FRESH))
        k = rings.next[k]
    return size


@wp.kernel
def weigh_faces_kernel(
    face_count: int,
    face_vertex: wp.array2d(dtype=int),
    boundary: wp.array2d(dtype=wp.int8),
    surface_inout: Surface,
):
    """Add every face's planes to the quadrics of its corners (serial, dim=1).

    `boundary` is 1 where edge k to k+1 of the face has no other face, shape [face_count, 3].
    """
    for f in range(face_count):
        corner = forest.face_corners(face_vertex, f)
        if forest.are_distinct(corner):
            px = surface_inout.pos[corner[0]]
            py = surface_inout.pos[corner[1]]
            pz = surface_inout.pos[corner[2]]
            n = wp.cross(py - px, pz - px)
            area = wp.length(n) * wp.float64(0.5)
            n = wp.normalize(n)
            longest = wp.max(wp.length_sq(py - px), wp.max(wp.length_sq(pz - py), wp.length_sq(px - pz)))
            q = quadric_plane(n, area / wp.float64(3.0))
            point = POINT_WEIGHT * (area + LINE_SHARE * longest) / wp.float64(3.0)
            q[0] = q[0] + point
            q[3] = q[3] + point
            q[5] = q[5] + point
            for k in range(3):
                a = face_vertex[f, k]
                b = face_vertex[f, (k + 1) % 3]
                surface_inout.quadric[a] = surface_inout.quadric[a] + q
                if boundary[f, k] != wp.int8(0):
                    e = surface_inout.pos[b] - surface_inout.pos[a]
                    side = quadric_plane(wp.normalize(wp.cross(n, e)), wp.length_sq(e))
                    surface_inout.quadric[a] = surface_inout.quadric[a] + side
                    surface_inout.quadric[b] = surface_inout.quadric[b] + side


@wp.kernel
def price_edges_kernel(
    edge_count: int,
    edge_pair: wp.array(dtype=wp.int64),
    surface: Surface,
    key_out: wp.array(dtype=wp.float64),
):
    """Price every edge of the original mesh, packed, of stage FRESH (serial, dim=1)."""
    for i in range(edge_count):
        a = queue.pair_first(edge_pair[i])
        b = queue.pair_second(edge_pair[i])
        _, cost = place_edge(surface, a, b, edge_quadric(surface, a, b))
        key_out[i] = cost


@wp.kernel
def compact_heap_kernel(surface: Surface, heap_inout: queue.Heap, counter_inout: wp.array(dtype=int)):
    """Drop the stale entries and order the rest as a heap (serial, dim=1)."""
    size = counter_inout[HEAP_SIZE]
    kept = int(0)
    for i in range(size):
        pair = heap_inout.pair[i]
        if surface.parent[queue.pair_first(pair)] < 0 and surface.parent[queue.pair_second(pair)] < 0:
            heap_inout.key[kept] = heap_inout.key[i]
            heap_inout.pair[kept] = pair
            kept += 1
    i = (kept - 2) // 4
    while kept > 1 and i >= 0:
        queue.sift_down(heap_inout, kept, i, heap_inout.key[i], heap_inout.pair[i])
        i -= 1
    counter_inout[HEAP_SIZE] = kept


@wp.func
def postponed_stage(surface: Surface, rings: forest.Rings, a: int, b: int, stage: int, dying: int, pos: wp.vec3d):
    """Return the stage at which the edge may merge; its own stage if that is now."""
    rest = rings.degree[a] + rings.degree[b] - 2 * dying
    if stage < LAST and rest == 0:
        if not forest.third_vertices_live(rings, a, b):
            return LAST
    if stage < PENALISED:
        if rest > MAX_VALENCE:
            return PENALISED
        if ring_flips(surface, rings, a, b, pos) or ring_flips(surface, rings, b, a, pos):
            return PENALISED
    return stage


@wp.func
def postponed_key(surface: Surface, rings: forest.Rings, a: int, b: int, stage: int, q: Quadric, cost: wp.float64):
    """Return the key of a postponed edge: a soft penalty, or after all other merges, smallest component first."""
    if stage == LAST:
        return POSTPONED_KEY * (wp.float64(1.0) + component_extent(surface, rings, a, b))
    # three times the trace is the area of the original faces merged into the two nodes
    return cost + wp.length_sq(surface.pos[b] - surface.pos[a]) * wp.float64(3.0) * (q[0] + q[3] + q[5])


@wp.kernel
def collapse_edges_kernel(
    vertex_count: int,
    base_faces: int,
    merge_budget: int,
    heap_capacity: int,
    surface_inout: Surface,
    rings_inout: forest.Rings,
    heap_inout: queue.Heap,
    counter_inout: wp.array(dtype=int),
    merge_pair_out: wp.array(dtype=wp.vec2i),
):
    """Merge the cheapest edge repeatedly (serial, dim=1); counter[STATUS] says why the launch ended.

    Invariants: an edge has one entry in the heap at most; an entry is stale iff one of its nodes has a parent; two
    active nodes once joined by a face stay joined, as only a merge of one of them kills their faces. `merge_pair_out`
    gets the two nodes of each merge, the lower one first.
    """
    size = counter_inout[HEAP_SIZE]
    merges = counter_inout[MERGE_COUNT]
    live = counter_inout[LIVE_FACE_COUNT]
    end = merges + merge_budget
    status = int(RUNNING)
    while status == RUNNING and merges < end:
        if live <= base_faces or size == 0:
            status = int(FINISHED)
        else:
            pair = heap_inout.pair[0]
            a = queue.pair_first(pair)
            b = queue.pair_second(pair)
            if surface_inout.parent[a] >= 0 or surface_inout.parent[b] >= 0:
                size = queue.heap_drop_top(heap_inout, size)
            elif size + 2 * (rings_inout.degree[a] + rings_inout.degree[b]) > heap_capacity:
                status = int(HEAP_FULL)
            else:
                size = queue.heap_drop_top(heap_inout, size)
                fetch_edges(surface_inout, rings_inout, heap_inout, size)
                dying = forest.count_dying(rings_inout, a, b)
                # never merge away the last faces of the model
                if dying < live:
                    q = edge_quadric(surface_inout, a, b)
                    pos, cost = place_edge(surface_inout, a, b, q)
                    old = queue.pair_stage(pair)
                    stage = postponed_stage(surface_inout, rings_inout, a, b, old, dying, pos)
                    if stage != old:
                        key = postponed_key(surface_inout, rings_inout, a, b, stage, q, cost)
                        size = queue.heap_push(heap_inout, size, key, queue.pack_pair(a, b, stage))
                    else:
                        c = vertex_count + merges
                        commit_merge(surface_inout, rings_inout, a, b, c, q, pos)
                        merge_pair_out[merges] = wp.vec2i(a, b)
                        size = push_ring(surface_inout, rings_inout, heap_inout, size, c)
                        merges += 1
                        live -= dying
    counter_inout[HEAP_SIZE] = size
    counter_inout[MERGE_COUNT] = merges
    counter_inout[LIVE_FACE_COUNT] = live
    counter_inout[STATUS] = status
