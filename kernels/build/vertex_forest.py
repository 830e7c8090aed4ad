"""Vertex forest: the rings of its nodes, and the merges that touch each face.

Ring of a node: a singly linked list of face corners, head[node] -> corner -> next[corner] -> ... -1.
Corner 3 f + k is corner k of face f. A face is dead iff corner_node[3 f] < 0; dead corners stay in the rings of
third vertices until these merge themselves, so every walk skips them.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rings:
    """The faces about every node, as lists of their corners."""

    head: wp.array(dtype=int)  # [node_capacity], first corner or -1
    degree: wp.array(dtype=int)  # [node_capacity], live faces
    next: wp.array(dtype=int)  # [3 face_count], next corner of the ring or -1
    corner_node: wp.array(dtype=int)  # [3 face_count], active node of each corner


@wp.func
def third_corner(f: int, a: int, b: int, corner_node: wp.array(dtype=int)):
    """Return the corner of face f that is neither node a nor node b, where f has a or b; -1 unless it has both."""
    x = corner_node[3 * f]
    y = corner_node[3 * f + 1]
    z = corner_node[3 * f + 2]
    if (x == a and y == b) or (x == b and y == a):
        return z
    if (y == a and z == b) or (y == b and z == a):
        return x
    if (x == a and z == b) or (x == b and z == a):
        return y
    return int(-1)


@wp.func
def absorb_ring(rings: Rings, node: int, a: int, b: int, c: int, tail: int):
    """Move the ring of `node` (a or b, merging into c) behind corner `tail` of c's ring; kill faces that have a and b.

    Returns the new tail, -1 while c's ring is empty. Degrees of third vertices fall with every death; c's is counted.
    """
    k = rings.head[node]
    while k >= 0:
        following = rings.next[k]
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            third = third_corner(f, a, b, rings.corner_node)
            if third >= 0:
                rings.degree[third] = rings.degree[third] - 1
                rings.corner_node[3 * f] = -1
            else:
                rings.corner_node[k] = c
                rings.degree[c] = rings.degree[c] + 1
                if tail < 0:
                    rings.head[c] = k
                else:
                    rings.next[tail] = k
                tail = k
        k = following
    if tail >= 0:
        rings.next[tail] = -1
    return tail


@wp.func
def count_dying(rings: Rings, a: int, b: int):
    """Count the live faces that have both a and b, on the shorter ring."""
    node = wp.where(rings.degree[a] <= rings.degree[b], a, b)
    count = int(0)
    k = rings.head[node]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            if third_corner(f, a, b, rings.corner_node) >= 0:
                count += 1
        k = rings.next[k]
    return count


@wp.func
def third_vertices_live(rings: Rings, a: int, b: int):
    """Tell whether a third corner of a face dying with (a, b) has another live face."""
    k = rings.head[a]
    while k >= 0:
        f = k // 3
        if rings.corner_node[3 * f] >= 0:
            third = third_corner(f, a, b, rings.corner_node)
            if third >= 0:
                other = rings.head[third]
                while other >= 0:
                    g = other // 3
                    if rings.corner_node[3 * g] >= 0:
                        if third_corner(g, a, b, rings.corner_node) < 0:
                            return True
                    other = rings.next[other]
        k = rings.next[k]
    return False


@wp.func
def face_corners(face_vertex: wp.array2d(dtype=int), f: int):
    return wp.vec3i(face_vertex[f, 0], face_vertex[f, 1], face_vertex[f, 2])


@wp.func
def are_distinct(corner: wp.vec3i):
    return corner[0] != corner[1] and corner[1] != corner[2] and corner[2] != corner[0]


@wp.kernel
def link_rings_kernel(face_count: int, face_vertex: wp.array2d(dtype=int), rings_inout: Rings):
    """Link the corners of every face with three distinct corners; mark the others dead (serial, dim=1).

    `head` must hold -1 and `degree` 0. Rings come out in ascending order of corners.
    """
    f = face_count - 1
    while f >= 0:
        if are_distinct(face_corners(face_vertex, f)):
            for k in range(3):
                v = face_vertex[f, k]
                rings_inout.corner_node[3 * f + k] = v
                rings_inout.next[3 * f + k] = rings_inout.head[v]
                rings_inout.head[v] = 3 * f + k
                rings_inout.degree[v] = rings_inout.degree[v] + 1
        else:
            rings_inout.corner_node[3 * f] = -1
        f -= 1


@wp.func
def next_merge(node: int, node_count: int, vertex_parent: wp.array(dtype=int)):
    """Return the parent of a node, or node_count at a root, so that roots come last."""
    return wp.where(vertex_parent[node] < 0, node_count, vertex_parent[node])


@wp.func
def climb_face(corner: wp.vec3i, node_count: int, vertex_parent: wp.array(dtype=int)):
    """Apply the next merge that touches a face.

    Returns the node that the merge makes (node_count if there is none), the corners after it, and whether the face
    still has three and more merges may come.
    """
    a = next_merge(corner[0], node_count, vertex_parent)
    b = next_merge(corner[1], node_count, vertex_parent)
    c = next_merge(corner[2], node_count, vertex_parent)
    node = wp.min(a, wp.min(b, c))
    after = wp.vec3i(
        wp.where(a == node, node, corner[0]), wp.where(b == node, node, corner[1]), wp.where(c == node, node, corner[2])
    )
    alive = node < node_count and int(a == node) + int(b == node) + int(c == node) < 2
    return node, after, alive


@wp.kernel
def find_events_kernel(
    vertex_count: int,
    node_count: int,
    face_vertex: wp.array2d(dtype=int),
    vertex_parent: wp.array(dtype=int),
    split_cursor_inout: wp.array(dtype=wp.int64),
    face_split_out: wp.array(dtype=int),
    split_face_out: wp.array(dtype=int),
):
    """Find the merge at which each face dies, and write it to the slices of all splits that touch it (serial, dim=1).

    The three corners climb in the order of the merges, so the first merge that two of them share is the lowest
    common ancestor at which the face dies; every merge passed on the way deforms the face.

    Args:
        split_cursor_inout: Start of every slice, which come out ascending, shape [m]; ends as the end of every slice.
        split_face_out: Slices; shape [0] only counts the faces of each.
    """
    for f in range(face_vertex.shape[0]):
        corner = face_corners(face_vertex, f)
        alive = are_distinct(corner)
        split = wp.where(alive, 0, node_count - vertex_count + 1)
        while alive:
            node, corner, alive = climb_face(corner, node_count, vertex_parent)
            if node < node_count:
                i = node_count - 1 - node
                if split_face_out.shape[0] > 0:
                    split_face_out[split_cursor_inout[i]] = f
                split_cursor_inout[i] = split_cursor_inout[i] + wp.int64(1)
                if not alive:
                    split = i + 1
        face_split_out[f] = split
