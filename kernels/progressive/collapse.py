"""Edge collapse by quadric error, strictly greedy: one serial kernel on the CPU, resumable after any merge.

Source: Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997.

A quadric is (A, b, c) with Q(y) = y.A y + 2 b.y + c, y relative to its own node's position: planes through the node
then need A alone, and no digits are lost to the distance from the origin.
A heap entry is a float64 key and the int64 pair (a << 32 | b << 2 | stage), a < b; its order (key, pair) is total, so
the sequence depends neither on the heap's layout nor on where a launch ends.
"""

import warp as wp

from warp_abtree.kernels.progressive.vertex_forest import (
    Rings,
    absorb_ring,
    breaks_link,
    count_dying,
    third_corner,
    third_vertices_live,
)

wp.set_module_options({"enable_backward": False})

Quadric = wp.types.vector(length=10, dtype=wp.float64)  # xx xy xz yy yz zz, b, c

RUNNING = wp.constant(0)
FINISHED = wp.constant(1)
HEAP_FULL = wp.constant(2)

# counter: what the kernels carry from launch to launch
HEAP_SIZE = wp.constant(0)
MERGE_COUNT = wp.constant(1)
LIVE_FACES = wp.constant(2)
STATUS = wp.constant(3)

# An entry passes from stage to stage upwards only, so it is popped at most four times.
FRESH = wp.constant(0)
PENALISED = wp.constant(1)
BLOCKED = wp.constant(2)
LAST = wp.constant(3)

MAX_VALENCE = wp.constant(24)
MIN_COS = wp.constant(wp.float64(0.2))
MAX_REACH = wp.constant(wp.float64(4.0))  # optimum at most so many edge lengths from the midpoint
MIN_PIVOT = wp.constant(wp.float64(1.0e-13))  # of the trace; the point quadric keeps honest pivots near 1e-9
POINT_WEIGHT = wp.constant(wp.float64(1.0e-9))
LINE_SHARE = wp.constant(wp.float64(1.0e-6))  # lets faces without area still order their merges by length
BLOCKED_KEY = wp.constant(wp.float64(1.0e50))
LAST_KEY = wp.constant(wp.float64(1.0e100))


@wp.struct
class Surface:
    """What the collapse knows of every node."""

    pos: wp.array(dtype=wp.vec3d)  # [node_capacity], normalised
    quadric: wp.array(dtype=Quadric)  # [node_capacity]
    parent: wp.array(dtype=int)  # [node_capacity], -1: active
    stamp: wp.array(dtype=int)  # [node_capacity], last node that met this one as a neighbour


@wp.struct
class Heap:
    """Binary order on a 4-ary heap, smallest first."""

    key: wp.array(dtype=wp.float64)  # [capacity]
    pair: wp.array(dtype=wp.int64)  # [capacity]


@wp.struct
class Placement:
    pos: wp.vec3d
    cost: wp.float64


@wp.func
def pack_pair(a: int, b: int, stage: int):
    low = wp.int64(wp.min(a, b))
    high = wp.int64(wp.max(a, b))
    return (low << wp.int64(32)) | (high << wp.int64(2)) | wp.int64(stage)


@wp.func
def pair_first(pair: wp.int64):
    return int(pair >> wp.int64(32))


@wp.func
def pair_second(pair: wp.int64):
    return int((pair >> wp.int64(2)) & wp.int64(0x3FFFFFFF))


@wp.func
def pair_stage(pair: wp.int64):
    return int(pair & wp.int64(3))


@wp.func
def heap_before(key_a: wp.float64, pair_a: wp.int64, key_b: wp.float64, pair_b: wp.int64):
    return key_a < key_b or (key_a == key_b and pair_a < pair_b)


@wp.func
def sift_down(heap: Heap, size: int, start: int, key: wp.float64, pair: wp.int64):
    """Put (key, pair) into the hole at `start`, whose subtrees are heaps."""
    hole = start
    child = 4 * hole + 1
    while child < size:
        best = child
        best_key = heap.key[child]
        best_pair = heap.pair[child]
        end = wp.min(child + 4, size)
        i = child + 1
        while i < end:
            if heap_before(heap.key[i], heap.pair[i], best_key, best_pair):
                best = i
                best_key = heap.key[i]
                best_pair = heap.pair[i]
            i += 1
        if heap_before(key, pair, best_key, best_pair):
            child = size
        else:
            heap.key[hole] = best_key
            heap.pair[hole] = best_pair
            hole = best
            child = 4 * hole + 1
    heap.key[hole] = key
    heap.pair[hole] = pair


@wp.func
def heap_push(heap: Heap, size: int, key: wp.float64, pair: wp.int64):
    """Insert an entry at the end and lift it; return the new size."""
    hole = size
    moving = bool(True)
    while moving and hole > 0:
        up = (hole - 1) // 4
        if heap_before(key, pair, heap.key[up], heap.pair[up]):
            heap.key[hole] = heap.key[up]
            heap.pair[hole] = heap.pair[up]
            hole = up
        else:
            moving = bool(False)
    heap.key[hole] = key
    heap.pair[hole] = pair
    return size + 1


@wp.func
def heap_drop_top(heap: Heap, size: int):
    """Remove the smallest entry; return the new size."""
    last = size - 1
    if last > 0:
        sift_down(heap, last, 0, heap.key[last], heap.pair[last])
    return last


@wp.func
def quadric_apply(q: Quadric, y: wp.vec3d):
    """Return A y."""
    return wp.vec3d(
        q[0] * y[0] + q[1] * y[1] + q[2] * y[2],
        q[1] * y[0] + q[3] * y[1] + q[4] * y[2],
        q[2] * y[0] + q[4] * y[1] + q[5] * y[2],
    )


@wp.func
def quadric_moved(q: Quadric, d: wp.vec3d):
    """Return the same quadric relative to a point that lies d further."""
    ad = quadric_apply(q, d)
    r = q
    r[6] = q[6] + ad[0]
    r[7] = q[7] + ad[1]
    r[8] = q[8] + ad[2]
    r[9] = q[9] + wp.float64(2.0) * (q[6] * d[0] + q[7] * d[1] + q[8] * d[2]) + wp.dot(d, ad)
    return r


@wp.func
def quadric_error(q: Quadric, y: wp.vec3d):
    e = wp.dot(y, quadric_apply(q, y)) + wp.float64(2.0) * (q[6] * y[0] + q[7] * y[1] + q[8] * y[2]) + q[9]
    return wp.max(e, wp.float64(0.0))


@wp.func
def quadric_plane(n: wp.vec3d, weight: wp.float64):
    """Return the quadric of a plane through the node itself."""
    q = Quadric()
    q[0] = weight * n[0] * n[0]
    q[1] = weight * n[0] * n[1]
    q[2] = weight * n[0] * n[2]
    q[3] = weight * n[1] * n[1]
    q[4] = weight * n[1] * n[2]
    q[5] = weight * n[2] * n[2]
    return q


@wp.func
def quadric_minimum(q: Quadric, reach: wp.float64):
    """Return where q is least; (inf, inf, inf) if A is near singular or the place is beyond `reach`. LDL^T."""
    far = wp.vec3d(wp.float64(wp.inf), wp.float64(wp.inf), wp.float64(wp.inf))
    floor = MIN_PIVOT * (q[0] + q[3] + q[5])
    if not (q[0] > floor):
        return far
    l1 = q[1] / q[0]
    l2 = q[2] / q[0]
    d1 = q[3] - l1 * q[1]
    if not (d1 > floor):
        return far
    u = q[4] - l1 * q[2]
    l3 = u / d1
    d2 = q[5] - l2 * q[2] - l3 * u
    if not (d2 > floor):
        return far
    s0 = -q[6]
    s1 = -q[7] - l1 * s0
    s2 = -q[8] - l2 * s0 - l3 * s1
    z = s2 / d2
    y = s1 / d1 - l3 * z
    x = s0 / q[0] - l1 * y - l2 * z
    if x * x + y * y + z * z <= reach * reach:
        return wp.vec3d(x, y, z)
    return far


@wp.func
def edge_quadric(surface: Surface, a: int, b: int):
    """Return the sum of two nodes' quadrics relative to the midpoint of their edge."""
    h = (surface.pos[b] - surface.pos[a]) * wp.float64(0.5)
    return quadric_moved(surface.quadric[a], h) + quadric_moved(surface.quadric[b], -h)


@wp.func
def place_edge(surface: Surface, a: int, b: int, q: Quadric):
    """Choose where the edge (a, b) goes: the quadric's minimum, else the best of midpoint and ends."""
    pa = surface.pos[a]
    pb = surface.pos[b]
    h = (pb - pa) * wp.float64(0.5)
    mid = pa + h
    place = Placement()
    y = quadric_minimum(q, wp.length(h) * wp.float64(2.0) * MAX_REACH)
    if wp.isfinite(y[0]):
        place.pos = mid + y
        place.cost = quadric_error(q, y)
        return place
    place.pos = mid
    place.cost = q[9]
    cost_a = quadric_error(q, -h)
    cost_b = quadric_error(q, h)
    if cost_a < place.cost:
        place.pos = pa
        place.cost = cost_a
    if cost_b < place.cost:
        place.pos = pb
        place.cost = cost_b
    place.cost = wp.max(place.cost, wp.float64(0.0))
    return place


@wp.func
def piece_extent(surface: Surface, rings: Rings, a: int, b: int):
    """Return the longest squared edge of the faces at a: the size of a piece whose faces all have a and b."""
    size = wp.length_sq(surface.pos[b] - surface.pos[a])
    k = rings.head[a]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            third = third_corner(f, a, b, rings.corner_node)
            if third >= 0:
                size = wp.max(size, wp.length_sq(surface.pos[third] - surface.pos[a]))
                size = wp.max(size, wp.length_sq(surface.pos[third] - surface.pos[b]))
        k = rings.next[k]
    return size


@wp.func
def ring_flips(surface: Surface, rings: Rings, node: int, other: int, target: wp.vec3d):
    """Tell whether moving `node` to the target turns a surviving face by more than arccos(MIN_COS)."""
    k = rings.head[node]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            if third_corner(f, node, other, rings.corner_node) < 0:
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
def commit_merge(surface: Surface, rings: Rings, a: int, b: int, c: int, q: Quadric, pos: wp.vec3d):
    """Make node c at `pos` of nodes a and b."""
    mid = surface.pos[a] + (surface.pos[b] - surface.pos[a]) * wp.float64(0.5)
    surface.pos[c] = pos
    surface.quadric[c] = quadric_moved(q, pos - mid)
    surface.parent[a] = c
    surface.parent[b] = c
    tail = absorb_ring(rings, a, a, b, c, -1)
    tail = absorb_ring(rings, b, a, b, c, tail)


@wp.func
def push_ring(surface: Surface, rings: Rings, heap: Heap, size: int, c: int):
    """Push the edges of the new node c, each once; return the heap's new size."""
    k = rings.head[c]
    while k >= 0:
        f = k // 3
        for turn in range(1, 3):
            n = rings.corner_node[3 * f + (k + turn) % 3]
            if surface.stamp[n] != c:
                surface.stamp[n] = c
                place = place_edge(surface, n, c, edge_quadric(surface, n, c))
                size = heap_push(heap, size, place.cost, pack_pair(n, c, FRESH))
        k = rings.next[k]
    return size


@wp.kernel
def weigh_faces_kernel(
    face_count: int,
    face_vertex: wp.array2d(dtype=int),
    boundary: wp.array2d(dtype=wp.int8),
    # In and out:
    surface_inout: Surface,
):
    """Add every face's planes to the quadrics of its corners (serial, dim=1).

    Args:
        boundary: 1 where edge k to k+1 of the face has no other face, shape [face_count, 3].
    """
    for f in range(face_count):
        x = face_vertex[f, 0]
        y = face_vertex[f, 1]
        z = face_vertex[f, 2]
        if x != y and y != z and z != x:
            px = surface_inout.pos[x]
            py = surface_inout.pos[y]
            pz = surface_inout.pos[z]
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
    # Out:
    key_out: wp.array(dtype=wp.float64),
):
    """Price every edge of the original mesh (serial, dim=1).

    Args:
        edge_pair: Packed edges, stage FRESH, shape [edge_count].
    """
    for i in range(edge_count):
        a = pair_first(edge_pair[i])
        b = pair_second(edge_pair[i])
        place = place_edge(surface, a, b, edge_quadric(surface, a, b))
        key_out[i] = place.cost


@wp.kernel
def compact_heap_kernel(
    surface: Surface,
    # In and out:
    heap_inout: Heap,
    counter_inout: wp.array(dtype=int),
):
    """Drop the stale entries and order the rest as a heap (serial, dim=1)."""
    size = counter_inout[HEAP_SIZE]
    kept = int(0)
    for i in range(size):
        pair = heap_inout.pair[i]
        if surface.parent[pair_first(pair)] < 0 and surface.parent[pair_second(pair)] < 0:
            heap_inout.key[kept] = heap_inout.key[i]
            heap_inout.pair[kept] = pair
            kept += 1
    i = (kept - 2) // 4
    while kept > 1 and i >= 0:
        sift_down(heap_inout, kept, i, heap_inout.key[i], heap_inout.pair[i])
        i -= 1
    counter_inout[HEAP_SIZE] = kept


@wp.func
def postponed_stage(
    surface: Surface, rings: Rings, link_condition: int, a: int, b: int, stage: int, dying: int, pos: wp.vec3d
):
    """Return the stage that the edge must wait for; its own stage if it may go now."""
    rest = rings.degree[a] + rings.degree[b] - 2 * dying
    if stage < LAST and rest == 0:
        if not third_vertices_live(rings, a, b):
            return LAST
    if stage < BLOCKED and link_condition != 0:
        if breaks_link(rings, a, b):
            return BLOCKED
    if stage < PENALISED:
        if rest > MAX_VALENCE:
            return PENALISED
        if ring_flips(surface, rings, a, b, pos) or ring_flips(surface, rings, b, a, pos):
            return PENALISED
    return stage


@wp.func
def postponed_key(surface: Surface, rings: Rings, a: int, b: int, stage: int, q: Quadric, cost: wp.float64):
    """Return the key of a postponed edge: soft penalty, after all ordinary merges, or last of all by size."""
    if stage == LAST:
        return LAST_KEY * (wp.float64(1.0) + piece_extent(surface, rings, a, b))
    if stage == BLOCKED:
        return BLOCKED_KEY * (wp.float64(1.0) + cost)
    # three times the trace is the area of the original faces that the two nodes stand for
    return cost + wp.length_sq(surface.pos[b] - surface.pos[a]) * wp.float64(3.0) * (q[0] + q[3] + q[5])


@wp.kernel
def collapse_edges_kernel(
    vertex_count: int,
    base_faces: int,
    merge_budget: int,
    heap_capacity: int,
    link_condition: int,
    # In and out:
    surface_inout: Surface,
    rings_inout: Rings,
    heap_inout: Heap,
    counter_inout: wp.array(dtype=int),
):
    """Merge the cheapest edge, again and again (serial, dim=1); stop for one of the reasons in counter[STATUS].

    Invariants: an edge has one entry in the heap at most; an entry is stale iff one of its nodes has a parent; two
    active nodes once joined by a face stay joined, as only a merge of one of them kills their faces.
    """
    size = counter_inout[HEAP_SIZE]
    merges = counter_inout[MERGE_COUNT]
    live = counter_inout[LIVE_FACES]
    end = merges + merge_budget
    status = int(RUNNING)
    while status == RUNNING and merges < end:
        if live <= base_faces or size == 0:
            status = int(FINISHED)
        else:
            pair = heap_inout.pair[0]
            a = pair_first(pair)
            b = pair_second(pair)
            if surface_inout.parent[a] >= 0 or surface_inout.parent[b] >= 0:
                size = heap_drop_top(heap_inout, size)
            elif size + 2 * (rings_inout.degree[a] + rings_inout.degree[b]) > heap_capacity:
                status = int(HEAP_FULL)
            else:
                size = heap_drop_top(heap_inout, size)
                dying = count_dying(rings_inout, a, b)
                # the last faces of the model stay
                if dying < live:
                    q = edge_quadric(surface_inout, a, b)
                    place = place_edge(surface_inout, a, b, q)
                    old = pair_stage(pair)
                    stage = postponed_stage(surface_inout, rings_inout, link_condition, a, b, old, dying, place.pos)
                    if stage != old:
                        key = postponed_key(surface_inout, rings_inout, a, b, stage, q, place.cost)
                        size = heap_push(heap_inout, size, key, pack_pair(a, b, stage))
                    else:
                        c = vertex_count + merges
                        commit_merge(surface_inout, rings_inout, a, b, c, q, place.pos)
                        size = push_ring(surface_inout, rings_inout, heap_inout, size, c)
                        merges += 1
                        live -= dying
    counter_inout[HEAP_SIZE] = size
    counter_inout[MERGE_COUNT] = merges
    counter_inout[LIVE_FACES] = live
    counter_inout[STATUS] = status
