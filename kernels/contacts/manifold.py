"""Candidate points of contacts: depths behind faces along the normals of their loops, or of the faces."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, pose_point
from warp_abtree.kernels.contacts.contact import Contacts, have_crossed
from warp_abtree.kernels.triangle.corners import load_corners
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options(native.options())

POINTS = wp.constant(8)
"""Points that stand for a pair, unless told otherwise."""

# A face seen at a smaller cosine along a direction says nothing about depth in that direction.
FACING = wp.constant(wp.float64(0.1))
# A face's own normal serves in place of the loop's within 60 degrees of it.
LIKENESS = wp.constant(wp.float64(0.5))
# By which part of a face's size its column is wider, so that walls that stand on its rim are inside.
COLUMN_SLACK = wp.constant(wp.float64(2.0**-36))
CLIPPED_CORNERS = wp.constant(8)
# Candidates of a contact: a triangle within the column of another has so many corners at most.
COLUMN_CORNERS = wp.constant(6)
# Depths of candidates that there are not: the middle of the contact serves where all are so, or not even that.
NO_DEPTH, NO_POINT = wp.constant(wp.float64(-wp.inf)), wp.constant(wp.float64(wp.nan))


@wp.struct
class Curves:
    """Contact curves of all pairs, world frame; unit normals from the pair's first object to its second."""

    parent: wp.array(dtype=wp.int32)  # union-find forest of contacts, shape [contact]
    loop: wp.array(dtype=wp.int32)  # first contact of its loop, shape [contact]
    loop_normal: wp.array(dtype=wp.vec3d)  # at the first contact of each loop, shape [contact]
    point: wp.array2d(dtype=wp.vec3d)  # candidate points [world units], shape [contact, COLUMN_CORNERS]
    depth: wp.array2d(dtype=wp.float64)  # [world units], or NO_DEPTH or NO_POINT, shape [contact, COLUMN_CORNERS]
    normal: wp.array(dtype=wp.vec3d)  # of its candidates, shape [contact]
    wrench: wp.array(dtype=wp.vec4)  # see `candidates`, shape [2 * COLUMN_CORNERS * contact]


@wp.struct
class Rows:
    """Contacts of all pairs in two orders."""

    start: wp.array(dtype=wp.int32)  # where those of each pair start, shape [pair + 1]
    faces: wp.array(dtype=wp.vec3i)  # pair and faces, in the order of the first object's faces, shape [contact]
    order: wp.array(dtype=wp.int32)  # contacts by their keys, shape [contact]
    key: wp.array(dtype=wp.int64)  # `contact_key` of each in that order, or its loop, shape [contact]


@wp.struct
class Manifolds:
    """Points that stand for each pair, world frame."""

    count: wp.array(dtype=wp.int32)  # points of it, shape [pair]
    point: wp.array2d(dtype=wp.vec3d)  # [world units], shape [pair, points]
    normal: wp.array2d(dtype=wp.vec3d)  # unit, from the pair's first object to its second, shape [pair, points]
    depth: wp.array2d(dtype=wp.float64)  # [world units] along the normal, negative if apart, shape [pair, points]


@wp.func
def clip_column(
    corner: wp.array(dtype=wp.vec3d), face: wp.int32, cut: wp.int32, n: wp.vec3d, polygon: wp.array(dtype=wp.vec3d)
):
    """Clip the triangle at cut to the column of the triangle at face along n; return the number of polygon corners."""
    zero = wp.float64(0.0)
    clipped = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    count = wp.int32(3)
    for k in range(3):
        polygon[k] = corner[cut + k]
    for k in range(3):
        u = corner[face + k]
        edge = corner[face + (k + 1) % 3] - u
        across = corner[face + (k + 2) % 3] - u
        inward = unit_vector(wp.cross(edge, n))
        if wp.dot(inward, across) < zero:
            inward = -inward
        slack = COLUMN_SLACK * (measure_length(edge) + measure_length(across))
        kept = wp.int32(0)
        i = wp.int32(0)
        while i < count:
            p = polygon[i]
            q = polygon[(i + 1) % count]
            at_p = wp.dot(inward, p - u) + slack
            at_q = wp.dot(inward, q - u) + slack
            if at_p >= zero:
                clipped[kept] = p
                kept += 1
            if (at_p < zero) != (at_q < zero):
                clipped[kept] = p + (q - p) * (at_p / (at_p - at_q))
                kept += 1
            i += 1
        count = kept
        i = wp.int32(0)
        while i < count:
            polygon[i] = clipped[i]
            i += 1
    return count


@wp.struct
class Column:
    """The column of one face along a normal, with what lies of the other within it."""

    normal: wp.vec3d  # unit, from the pair's first object to its second
    depth: wp.float64  # how deep the deepest corner is behind the face, or NO_DEPTH
    count: wp.int32  # corners of the polygon


@wp.func
def measure_column(
    corner: wp.array(dtype=wp.vec3d),
    n: wp.vec3d,
    normal_a: wp.vec3d,
    normal_b: wp.vec3d,
    first: wp.int32,
    least: wp.float64,
    point: wp.array(dtype=wp.vec3d),
    depth: wp.array(dtype=wp.float64),
):
    """Find the part of one face within the column of the other along n: its corners, and their depths along n.

    Args:
        least: Depth from which on corners count: 0, or minus the gap.
        corner: Corners of the pair's first object at places first .. first + 2, of its second at the others.
    """
    column = Column()
    column.normal = n
    column.depth = NO_DEPTH
    facing_a = wp.dot(n, normal_a)
    facing_b = -wp.dot(n, normal_b)
    face = first
    cut = 3 - first
    plane = normal_a
    facing = facing_a
    if facing_b > facing_a:
        face = 3 - first
        cut = first
        plane = normal_b
        facing = facing_b
    if facing < FACING:
        return column
    column.count = clip_column(corner, face, cut, n, point)
    i = wp.int32(0)
    while i < column.count:
        depth[i] = wp.dot(corner[face] - point[i], plane) / facing
        if depth[i] >= least:
            column.depth = wp.max(column.depth, depth[i])
        i += 1
    return column


@wp.func
def write_candidates(
    i: wp.int32,
    rotation: wp.mat33d,
    position: wp.vec3d,
    column: Column,
    least: wp.float64,
    point: wp.array(dtype=wp.vec3d),
    depth: wp.array(dtype=wp.float64),
    curves: Curves,
):
    """Write the candidates of a contact, posed to the world: the corners of a column that are deep enough."""
    curves.normal[i] = rotation * column.normal
    for k in range(COLUMN_CORNERS):
        curves.depth[i, k] = NO_POINT
        if k < column.count and column.depth > NO_DEPTH:
            if depth[k] >= least:
                curves.depth[i, k] = depth[k]
                curves.point[i, k] = pose_point(rotation, position, point[k])


@wp.func
def write_middle(i: wp.int32, contacts: Contacts, curves: Curves):
    """Write the middle and an end of a contact as its candidates, which have no depth, with the loop's normal."""
    curves.normal[i] = curves.loop_normal[curves.loop[i]]
    for k in range(COLUMN_CORNERS):
        curves.depth[i, k] = wp.where(k < 2, NO_DEPTH, NO_POINT)
    curves.point[i, 0] = wp.float64(0.5) * (contacts.p0[i] + contacts.p1[i])
    curves.point[i, 1] = contacts.p1[i]


@wp.kernel
def find_candidate_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    rows: Rows,
    contacts: Contacts,
    curves_inout: Curves,
):
    """Find the normal and the candidate points of one contact a thread, of faces that intersect.

    Of the loop's normal and of those faces' normals that are like it, the one along which the faces overlap least; of
    both faces' normals where neither is like it and one looks the other way.

    Args:
        gap: How far outside points may be, of faces that look at one another [world units], shape [pair]; [0] for not
            at all.
        rows: In the order of loops, those of faces that intersect first.
    """
    if wp.tid() >= rows.start[rows.start.shape[0] - 1]:
        return
    i = rows.order[wp.tid()]
    if not have_crossed(contacts, i):
        return
    p = rows.faces[i][0]
    swapped = batch.poses[p].swapped
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, batch.poses[p], rows.faces[i][1 + swapped], rows.faces[i][2 - swapped], corner)
    rotation, position = trees.objects.rotation[a], trees.objects.position[a]
    back = wp.transpose(rotation)
    normal_a = back * contacts.normal_a[i]
    normal_b = back * contacts.normal_b[i]
    first = 3 * swapped
    zero = wp.float64(0.0)
    least = zero
    if gap.shape[0] > 0 and -wp.dot(normal_a, normal_b) >= LIKENESS:
        least = -gap[p]
    loop = back * curves_inout.loop_normal[curves_inout.loop[i]]
    point = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    depth = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.float64)
    best = measure_column(corner, loop, normal_a, normal_b, first, least, point, depth)
    written = bool(True)
    toward_a, toward_b = wp.dot(loop, normal_a), -wp.dot(loop, normal_b)
    toward = wp.max(toward_a, toward_b)
    # A loop that runs all round a part in another, as round a thread, has no one way out.
    contrary = FACING <= toward and toward <= LIKENESS and wp.min(toward_a, toward_b) < -FACING
    for k in range(2):
        m = wp.where(k == 0, normal_a, -normal_b)
        if contrary or wp.dot(m, loop) > LIKENESS:
            other = measure_column(corner, m, normal_a, normal_b, first, least, point, depth)
            written = other.depth >= zero and (best.depth < zero or other.depth <= best.depth)
            if written:
                best = other
    if best.depth == NO_DEPTH:
        write_middle(i, contacts, curves_inout)
        return
    if not written:
        best = measure_column(corner, best.normal, normal_a, normal_b, first, least, point, depth)
    write_candidates(i, rotation, position, best, least, point, depth, curves_inout)
