"""Candidate points of contacts: depths behind faces along the normals of their loops, or of the faces."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.contact import Contacts
from warp_abtree.kernels.contacts.slots import Slots, WitnessRows, offer_point
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits
from warp_abtree.kernels.triangle.corners import load_corners
from warp_abtree.kernels.triangle.distance import largest_coordinate
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options(native.options("contacts/slots.cuh"))

POINTS = wp.constant(8)
"""Points that stand for a pair, unless told otherwise."""

# A face seen at a smaller cosine along a direction says nothing about depth in that direction.
FACING = wp.constant(wp.float64(0.1))
# A face's own normal serves in place of the loop's within 60 degrees of it.
LIKENESS = wp.constant(wp.float64(0.5))
# By which part of a face's size its column is wider, so that walls that stand on its rim are inside.
COLUMN_SLACK = wp.constant(wp.float64(2.0**-36))
# Part of the size of faces that depths in a column err by.
COLUMN_ROUNDING = wp.constant(wp.float64(2.0**-46))
CLIPPED_CORNERS = wp.constant(8)
# Candidates of a contact: a triangle within the column of another has so many corners at most.
COLUMN_CORNERS = wp.constant(6)
# Depths of candidates that there are not: the middle of the contact serves where all are so, or not even that.
NO_DEPTH, NO_POINT = wp.constant(wp.float64(-wp.inf)), wp.constant(wp.float64(wp.nan))
NO_DEPTH_SEPARATION = wp.constant(wp.float32(2.0**60))  # more than any, in offers to slots


@wp.struct
class Curves:
    """Contact curves of all pairs, world frame; unit normals from the pair's first object to its second."""

    parent: wp.array(dtype=wp.int32)  # union-find forest of contacts, shape [contact]
    loop: wp.array(dtype=wp.int32)  # first contact of its loop, shape [contact]
    loop_normal: wp.array(dtype=wp.vec3d)  # at the first contact of each loop, shape [contact]
    has_area: wp.array(dtype=wp.int32)  # there, 1 where the normal is that of an area, else 0, shape [contact]


@wp.struct
class Witnesses:
    """Candidate points of all pairs, of the contacts that slots keep, world frame."""

    normal: wp.array(dtype=wp.vec3d)  # unit, from the pair's first object to its second, shape [witness]
    point: wp.array2d(dtype=wp.vec3d)  # [world units], shape [witness, COLUMN_CORNERS]
    depth: wp.array2d(dtype=wp.float64)  # [world units], NO_DEPTH or NO_POINT, shape [witness, COLUMN_CORNERS]
    nearest_only: wp.array(dtype=wp.int32)  # whether another face may be nearer, 0 or 1, shape [witness]
    wrench: wp.array(dtype=wp.vec4)  # see `candidates`, shape [2 * COLUMN_CORNERS * witness]


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


@wp.func
def column_slack(corner: wp.array(dtype=wp.vec3d)):
    """Return what depths in a column err by at most: a part of the size of both faces."""
    size = wp.float64(0.0)
    for k in range(5):
        size = wp.max(size, largest_coordinate(corner[k + 1] - corner[0]))
    return COLUMN_ROUNDING * size


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
    w: wp.int32,
    rotation: wp.mat33d,
    position: wp.vec3d,
    column: Column,
    least: wp.float64,
    point: wp.array(dtype=wp.vec3d),
    depth: wp.array(dtype=wp.float64),
    witnesses: Witnesses,
):
    """Write the candidates of a witness, posed to the world: the corners of a column that are deep enough."""
    witnesses.normal[w] = rotation * column.normal
    for k in range(COLUMN_CORNERS):
        witnesses.depth[w, k] = NO_POINT
        if k < column.count and column.depth > NO_DEPTH:
            if depth[k] >= least:
                witnesses.depth[w, k] = depth[k]
                witnesses.point[w, k] = pose_point(rotation, position, point[k])


@wp.func
def write_middle(w: wp.int32, i: wp.int32, n: wp.vec3d, contacts: Contacts, witnesses: Witnesses):
    """Write the middle and an end of contact i as candidates, which have no depth."""
    witnesses.normal[w] = n
    for k in range(COLUMN_CORNERS):
        witnesses.depth[w, k] = wp.where(k < 2, NO_DEPTH, NO_POINT)
    witnesses.point[w, 0] = wp.float64(0.5) * (contacts.p0[i] + contacts.p1[i])
    witnesses.point[w, 1] = contacts.p1[i]


@wp.func
def lies_in_front(n: wp.vec3d, face: wp.int32, corner: wp.array(dtype=wp.vec3d), slack: wp.float64):
    """Return whether a face lies in front of the plane of that at corners face .. face + 2, whose normal is n."""
    least = wp.float64(wp.inf)
    for k in range(3):
        least = wp.min(least, wp.dot(n, corner[3 - face + k] - corner[face]))
    return least >= -slack and wp.dot(n, n) > wp.float64(0.0)


@wp.struct
class Crossing:
    """A contact of faces that cross, to find its candidates."""

    i: wp.int32  # its place among contacts
    a: wp.int32  # object A of its pair
    faces: wp.vec3i  # pair, face of its first object, face of its second
    least: wp.float64  # depth from which on there are candidates: 0, or minus the gap where faces look at one another


@wp.func
def load_crossing(i: wp.int32, batch: PairBatch, gap: wp.array(dtype=wp.float64), faces: wp.vec3i, contacts: Contacts):
    """Return a contact.

    Args:
        gap: Of each pair [world units], or [0] for none.
    """
    crossing = Crossing()
    crossing.i = i
    crossing.faces = faces
    crossing.a = wp.min(batch.pairs[faces[0]][0], batch.pairs[faces[0]][1])
    if gap.shape[0] > 0 and -wp.dot(contacts.normal_a[i], contacts.normal_b[i]) >= LIKENESS:
        crossing.least = -gap[faces[0]]
    return crossing


@wp.func
def measure_crossing(
    crossing: Crossing,
    trees: Trees,
    pose: PairPose,
    contacts: Contacts,
    curves: Curves,
    point: wp.array(dtype=wp.vec3d),
    depth: wp.array(dtype=wp.float64),
):
    """Find the normal and the candidate points of a contact of faces that cross, in A's frame.

    Of the loop's normal and of those faces' normals that are like it, the one along which the faces overlap least; of
    both faces' normals where neither is like it and one looks the other way. Where faces merely touch, the normal of a
    face that has the other in front serves, if it is like the loop's or that has no area, as rounding may have made it;
    edges beside one another have none then.
    """
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, pose, crossing.faces[1 + pose.swapped], crossing.faces[2 - pose.swapped], corner)
    back = wp.transpose(trees.objects.rotation[crossing.a])
    normal_a = back * contacts.normal_a[crossing.i]
    normal_b = back * contacts.normal_b[crossing.i]
    first, least, slack = 3 * pose.swapped, crossing.least, column_slack(corner)
    loop = back * curves.loop_normal[curves.loop[crossing.i]]
    touches_a = lies_in_front(normal_a, first, corner, slack)
    touches_b = lies_in_front(normal_b, 3 - first, corner, slack)
    if curves.has_area[curves.loop[crossing.i]] != 0:
        touches_a = touches_a and wp.dot(loop, normal_a) > LIKENESS
        touches_b = touches_b and -wp.dot(loop, normal_b) > LIKENESS
    if touches_a and touches_b and -wp.dot(normal_a, normal_b) < LIKENESS:
        none = Column()
        none.normal = loop
        none.depth = NO_DEPTH
        return none
    if touches_a or touches_b:
        n = wp.where(touches_a, normal_a, -normal_b)
        return measure_column(corner, n, normal_a, normal_b, first, wp.min(least, -slack), point, depth)
    best = measure_column(corner, loop, normal_a, normal_b, first, least, point, depth)
    written = bool(True)
    toward_a, toward_b = wp.dot(loop, normal_a), -wp.dot(loop, normal_b)
    toward = wp.max(toward_a, toward_b)
    # A loop that runs all round a part in another, as round a thread, has no one way out.
    contrary = FACING <= toward and toward <= LIKENESS and wp.min(toward_a, toward_b) < -FACING
    for k in range(2):
        m = wp.where(k == 0, normal_a, -normal_b)
        if contrary or wp.dot(m, loop) > LIKENESS:
            other = measure_column(corner, m, normal_a, normal_b, first, wp.min(least, -slack), point, depth)
            written = other.depth >= -slack and (best.depth < -slack or other.depth <= best.depth + slack)
            if written:
                best = other
    if not written and best.depth > NO_DEPTH:
        best = measure_column(corner, best.normal, normal_a, normal_b, first, least, point, depth)
    return best


@wp.kernel
def offer_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    order: wp.array(dtype=wp.int32),
    contacts: Contacts,
    curves: Curves,
    hits: Hits,
    slots_inout: Slots,
):
    """Offer the candidates of one contact of faces that cross a thread to the slots of its pair.

    Args:
        gap: How far outside points may be, of faces that look at one another [world units], shape [pair]; [0] for not
            at all.
        start, faces, order: Contacts of pairs, as for `loops`, in the order of loops.
    """
    if wp.tid() >= start[start.shape[0] - 1]:
        return
    i = order[wp.tid()]
    crossing = load_crossing(i, batch, gap, faces[i], contacts)
    p = faces[i][0]
    pose = batch.poses[p]
    point = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    depth = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.float64)
    column = measure_crossing(crossing, trees, pose, contacts, curves, point, depth)
    sense = wp.where(pose.swapped != 0, wp.float64(-1.0), wp.float64(1.0))
    n = wp.vec3(sense * column.normal)
    weight, directions = slots_inout.measures[p][1], slots_inout.directions
    if column.depth == NO_DEPTH:
        # Behind whatever has a depth.
        offer_point(n, wp.vec3(), NO_DEPTH_SEPARATION, weight, directions, i, p, hits.apart, slots_inout.key)
        return
    centre = trees.models.centre[trees.states.model[trees.objects.state[crossing.a]]]
    for k in range(column.count):
        if depth[k] >= crossing.least:
            x, s = wp.vec3((point[k] - centre) * pose.scale), wp.float32(-depth[k] * pose.scale)
            offer_point(n, x, s, weight, directions, i, p, hits.apart, slots_inout.key)


@wp.kernel
def find_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    curves: Curves,
    hits: Hits,
    rows: WitnessRows,
    witnesses_out: Witnesses,
):
    """Find the normal and the candidate points of one witness of faces that cross a thread, or that there is none."""
    w = wp.tid()
    if w >= wp.min(hits.witness_total[0], rows.item.shape[0]):
        return
    item = rows.item[w]
    if item[0] < 0:
        for k in range(COLUMN_CORNERS):
            witnesses_out.depth[w, k] = NO_POINT
    if item[0] < 0 or item[0] >= NEAR_BIT:
        return
    crossing = load_crossing(item[1], batch, gap, faces[item[1]], contacts)
    point = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    depth = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.float64)
    column = measure_crossing(crossing, trees, batch.poses[item[0]], contacts, curves, point, depth)
    rotation, position = trees.objects.rotation[crossing.a], trees.objects.position[crossing.a]
    if column.depth == NO_DEPTH:
        write_middle(w, crossing.i, rotation * column.normal, contacts, witnesses_out)
    else:
        write_candidates(w, rotation, position, column, crossing.least, point, depth, witnesses_out)
