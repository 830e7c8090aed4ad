"""Candidate points of contacts: depths behind faces along the normals of their loops, or of the faces."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.contact import Contacts
from warp_abtree.kernels.contacts.slots import Slots, WitnessRows, offer_point, scattered_place
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_face_pair
from warp_abtree.kernels.triangle.distance import largest_coordinate

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
# Candidates of a contact: a triangle within the column of another has so many corners at most.
COLUMN_CORNERS = wp.constant(6)
# Places where there may be one: ends of three edges, and three piercing edges of the column.
POSSIBLE_CORNERS = wp.constant(9)
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


@wp.struct
class FacePair:
    """Corners of the faces of a pair's first and second object, A's frame."""

    a0: wp.vec3d
    a1: wp.vec3d
    a2: wp.vec3d
    b0: wp.vec3d
    b1: wp.vec3d
    b2: wp.vec3d


@wp.func
def load_pair(trees: Trees, pose: PairPose, faces: wp.vec3i):
    """Return the faces of a contact, of which `faces` names the pair, and those of the first and the second object."""
    a = load_corner_ids(trees.states, pose.corner_a + faces[1 + pose.swapped])
    b = load_corner_ids(trees.states, pose.corner_b + faces[2 - pose.swapped])
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    pair, back = FacePair(), pose.swapped != 0
    pair.a0 = wp.where(back, b0, a0)
    pair.a1 = wp.where(back, b1, a1)
    pair.a2 = wp.where(back, b2, a2)
    pair.b0 = wp.where(back, a0, b0)
    pair.b1 = wp.where(back, a1, b1)
    pair.b2 = wp.where(back, a2, b2)
    return pair


@wp.func
def column_slack(pair: FacePair):
    """Return what depths in a column err by at most: a part of the size of both faces."""
    size = wp.max(largest_coordinate(pair.a1 - pair.a0), largest_coordinate(pair.a2 - pair.a0))
    size = wp.max(size, wp.max(largest_coordinate(pair.b0 - pair.a0), largest_coordinate(pair.b1 - pair.a0)))
    return COLUMN_ROUNDING * wp.max(size, largest_coordinate(pair.b2 - pair.a0))


@wp.struct
class Column:
    """The column of one face along a normal, and the face that it cuts.

    The corners of what lies of that within it are the ends of its edges, clipped, and where the column's edges pierce
    it: nine at most, each of them once.
    """

    normal: wp.vec3d  # unit, from the pair's first object to its second
    depth: wp.float64  # how deep the deepest corner is behind the face, or NO_DEPTH
    plane: wp.vec3d  # the face's normal over its cosine with the column's
    u0: wp.vec3d  # corners of the face
    u1: wp.vec3d  # the second
    u2: wp.vec3d  # the third
    v0: wp.vec3d  # corners of the other one
    v1: wp.vec3d  # the second
    v2: wp.vec3d  # the third
    side0: wp.vec3d  # normals of the column's sides, inwards, of any length
    side1: wp.vec3d  # the second
    side2: wp.vec3d  # the third
    slack: wp.vec3d  # by which each side is wider, times that length


@wp.func
def sum_sizes(v: wp.vec3d):
    return (wp.abs(v[0]) + wp.abs(v[1])) + wp.abs(v[2])


@wp.func
def make_side(n: wp.vec3d, u: wp.vec3d, v: wp.vec3d, w: wp.vec3d):
    """Return the inward normal of the side of a column over the edge from u to v, w the third corner, and its slack."""
    edge, across = v - u, w - u
    inward = wp.cross(edge, n)
    if wp.dot(inward, across) < wp.float64(0.0):
        inward = -inward
    return inward, COLUMN_SLACK * (sum_sizes(edge) + sum_sizes(across)) * sum_sizes(inward)


@wp.func
def height_over(side: wp.vec3d, u: wp.vec3d, slack: wp.float64, p: wp.vec3d):
    return wp.dot(side, p - u) + slack


@wp.func
def clip_range(range: wp.vec2d, at_p: wp.float64, at_q: wp.float64):
    """Return the part of a range of an edge's parameter where a linear function is not negative; [2, 1] for none."""
    zero = wp.float64(0.0)
    if at_p < zero and at_q < zero:
        return wp.vec2d(wp.float64(2.0), wp.float64(1.0))
    if at_p < zero:
        range[0] = wp.max(range[0], at_p / (at_p - at_q))
    if at_q < zero:
        range[1] = wp.min(range[1], at_p / (at_p - at_q))
    return range


@wp.func
def clip_edge(column: Column, p: wp.vec3d, q: wp.vec3d):
    """Return between which parameters an edge from p to q lies within a column, the first more where it does not."""
    range = wp.vec2d(wp.float64(0.0), wp.float64(1.0))
    s = column.slack
    range = clip_range(
        range, height_over(column.side0, column.u0, s[0], p), height_over(column.side0, column.u0, s[0], q)
    )
    range = clip_range(
        range, height_over(column.side1, column.u1, s[1], p), height_over(column.side1, column.u1, s[1], q)
    )
    return clip_range(
        range, height_over(column.side2, column.u2, s[2], p), height_over(column.side2, column.u2, s[2], q)
    )


@wp.func
def pierce_cut(column: Column, u: wp.vec3d):
    """Return where the edge of a column at a corner of its face pierces the other face, and whether it does."""
    zero = wp.float64(0.0)
    m = wp.cross(column.v1 - column.v0, column.v2 - column.v0)
    along = wp.dot(column.normal, m)
    if along == zero:
        return u, False
    p = u + column.normal * (wp.dot(column.v0 - u, m) / along)
    inside = wp.dot(wp.cross(column.v1 - column.v0, p - column.v0), m) > zero
    inside = inside and wp.dot(wp.cross(column.v2 - column.v1, p - column.v1), m) > zero
    return p, inside and wp.dot(wp.cross(column.v0 - column.v2, p - column.v2), m) > zero


@wp.func
def edge_of(column: Column, i: wp.int32):
    """Return edge i of what a column cuts, from corner to corner, and between which parameters it lies within."""
    p = wp.where(i == 0, column.v0, wp.where(i == 1, column.v1, column.v2))
    q = wp.where(i == 0, column.v1, wp.where(i == 1, column.v2, column.v0))
    return p, q, clip_edge(column, p, q)


@wp.func
def ends_before(range: wp.vec2d):
    """Return whether an edge leaves a column before its end, which is where the next one starts."""
    return range[1] < wp.float64(1.0) and range[0] < range[1]


@wp.func
def depth_of(column: Column, point: wp.vec3d):
    return wp.dot(column.u0 - point, column.plane)


@wp.func
def corner_of(column: Column, k: wp.int32):
    """Return the k-th corner of what a column cuts, its depth, and whether there is one, k = 0 .. 8."""
    point, exists = wp.vec3d(), False
    if k < 6:
        p, q, range = edge_of(column, k / 2)
        exists = range[0] <= range[1] and (k % 2 == 0 or ends_before(range))
        t = range[k % 2]
        point = p
        if t > wp.float64(0.0):
            point = p + (q - p) * t
    else:
        point, exists = pierce_cut(column, wp.where(k == 6, column.u0, wp.where(k == 7, column.u1, column.u2)))
    return point, depth_of(column, point), exists


@wp.func
def raise_depth(depth: wp.float64, least: wp.float64, exists: bool, of_corner: wp.float64):
    return wp.where(exists and of_corner >= least, wp.max(depth, of_corner), depth)


@wp.func
def deepest_corner(column: Column, least: wp.float64):
    """Return how deep the deepest corner is that is deep enough, NO_DEPTH where there is none."""
    depth, i = wp.float64(NO_DEPTH), wp.int32(0)
    while i < 3:
        p, q, range = edge_of(column, i)
        # Depth is linear along the edge.
        at_p, at_q = depth_of(column, p), depth_of(column, q)
        exists = range[0] <= range[1]
        depth = raise_depth(depth, least, exists, at_p + (at_q - at_p) * range[0])
        depth = raise_depth(depth, least, exists and ends_before(range), at_p + (at_q - at_p) * range[1])
        point, pierces = pierce_cut(column, wp.where(i == 0, column.u0, wp.where(i == 1, column.u1, column.u2)))
        depth = raise_depth(depth, least, pierces, depth_of(column, point))
        i += 1
    return depth


@wp.func
def measure_column(pair: FacePair, n: wp.vec3d, normal_a: wp.vec3d, normal_b: wp.vec3d, least: wp.float64):
    """Return the column of one face along n, of that which looks more along it, and how deep the other is within it.

    Args:
        least: Depth from which on corners count: 0, or minus the gap.
    """
    column = Column()
    column.normal = n
    column.depth = NO_DEPTH
    facing_a, facing_b = wp.dot(n, normal_a), -wp.dot(n, normal_b)
    other, facing = facing_b > facing_a, wp.max(facing_a, facing_b)
    if facing < FACING:
        return column
    column.plane = wp.where(other, normal_b, normal_a) / facing
    column.u0 = wp.where(other, pair.b0, pair.a0)
    column.u1 = wp.where(other, pair.b1, pair.a1)
    column.u2 = wp.where(other, pair.b2, pair.a2)
    column.v0 = wp.where(other, pair.a0, pair.b0)
    column.v1 = wp.where(other, pair.a1, pair.b1)
    column.v2 = wp.where(other, pair.a2, pair.b2)
    side0, s0 = make_side(n, column.u0, column.u1, column.u2)
    side1, s1 = make_side(n, column.u1, column.u2, column.u0)
    side2, s2 = make_side(n, column.u2, column.u0, column.u1)
    column.side0 = side0
    column.side1 = side1
    column.side2 = side2
    column.slack = wp.vec3d(s0, s1, s2)
    column.depth = deepest_corner(column, least)
    return column


@wp.func
def write_candidates(
    w: wp.int32,
    rotation: wp.mat33d,
    position: wp.vec3d,
    column: Column,
    least: wp.float64,
    witnesses: Witnesses,
):
    """Write the candidates of a witness, posed to the world: the corners of a column that are deep enough."""
    witnesses.normal[w] = rotation * column.normal
    place, k = wp.int32(0), wp.int32(0)
    while k < POSSIBLE_CORNERS:
        point, depth, exists = corner_of(column, k)
        if exists and depth >= least and place < COLUMN_CORNERS:
            witnesses.depth[w, place] = depth
            witnesses.point[w, place] = pose_point(rotation, position, point)
            place += 1
        k += 1
    while place < COLUMN_CORNERS:
        witnesses.depth[w, place] = NO_POINT
        place += 1


@wp.func
def write_middle(w: wp.int32, i: wp.int32, n: wp.vec3d, contacts: Contacts, witnesses: Witnesses):
    """Write the middle and an end of contact i as candidates, which have no depth."""
    witnesses.normal[w] = n
    for k in range(COLUMN_CORNERS):
        witnesses.depth[w, k] = wp.where(k < 2, NO_DEPTH, NO_POINT)
    witnesses.point[w, 0] = wp.float64(0.5) * (contacts.p0[i] + contacts.p1[i])
    witnesses.point[w, 1] = contacts.p1[i]


@wp.func
def lies_in_front(n: wp.vec3d, u: wp.vec3d, v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d, slack: wp.float64):
    """Return whether a face lies in front of the plane through u whose normal is n."""
    least = wp.min(wp.dot(n, v0 - u), wp.min(wp.dot(n, v1 - u), wp.dot(n, v2 - u)))
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
def measure_crossing(crossing: Crossing, trees: Trees, pose: PairPose, contacts: Contacts, curves: Curves):
    """Return the column of a contact of faces that cross, in A's frame.

    Of the loop's normal and of those faces' normals that are like it, the one along which the faces overlap least; of
    both faces' normals where neither is like it and one looks the other way. Where faces merely touch, the normal of a
    face that has the other in front serves, if it is like the loop's or that has no area, as rounding may have made it;
    edges beside one another have none then.
    """
    pair = load_pair(trees, pose, crossing.faces)
    back = wp.transpose(trees.objects.rotation[crossing.a])
    normal_a = back * contacts.normal_a[crossing.i]
    normal_b = back * contacts.normal_b[crossing.i]
    least, slack = crossing.least, column_slack(pair)
    loop = back * curves.loop_normal[curves.loop[crossing.i]]
    touches_a = lies_in_front(normal_a, pair.a0, pair.b0, pair.b1, pair.b2, slack)
    touches_b = lies_in_front(normal_b, pair.b0, pair.a0, pair.a1, pair.a2, slack)
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
        return measure_column(pair, n, normal_a, normal_b, wp.min(least, -slack))
    best = measure_column(pair, loop, normal_a, normal_b, least)
    toward_a, toward_b = wp.dot(loop, normal_a), -wp.dot(loop, normal_b)
    toward = wp.max(toward_a, toward_b)
    # A loop that runs all round a part in another, as round a thread, has no one way out.
    contrary = FACING <= toward and toward <= LIKENESS and wp.min(toward_a, toward_b) < -FACING
    k = wp.int32(0)
    while k < 2:
        m = wp.where(k == 0, normal_a, -normal_b)
        if contrary or wp.dot(m, loop) > LIKENESS:
            other = measure_column(pair, m, normal_a, normal_b, wp.min(least, -slack))
            if other.depth >= -slack and (best.depth < -slack or other.depth <= best.depth + slack):
                best = other
        k += 1
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
    slots_inout: Slots,
):
    """Offer the candidates of one contact of faces that cross a thread to the slots of its pair.

    Args:
        gap: How far outside points may be, of faces that look at one another [world units], shape [pair]; [0] for not
            at all.
        start, faces, order: Contacts of pairs, as for `loops`, in the order of loops.
    """
    count = start[start.shape[0] - 1]
    at = scattered_place(wp.tid(), count)
    if at >= count:
        return
    i = order[at]
    crossing = load_crossing(i, batch, gap, faces[i], contacts)
    p = faces[i][0]
    pose = batch.poses[p]
    column = measure_crossing(crossing, trees, pose, contacts, curves)
    sense = wp.where(pose.swapped != 0, wp.float64(-1.0), wp.float64(1.0))
    n = wp.vec3(sense * column.normal)
    weight, directions = slots_inout.measures[p][1], slots_inout.directions
    if column.depth == NO_DEPTH:
        # Behind whatever has a depth.
        offer_point(n, wp.vec3(), NO_DEPTH_SEPARATION, weight, directions, i, p, slots_inout.key)
        return
    centre = trees.models.centre[trees.states.model[trees.objects.state[crossing.a]]]
    k = wp.int32(0)
    while k < POSSIBLE_CORNERS:
        point, depth, exists = corner_of(column, k)
        if exists and depth >= crossing.least:
            x, s = wp.vec3((point - centre) * pose.scale), wp.float32(-depth * pose.scale)
            offer_point(n, x, s, weight, directions, i, p, slots_inout.key)
        k += 1


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
    column = measure_crossing(crossing, trees, batch.poses[item[0]], contacts, curves)
    rotation, position = trees.objects.rotation[crossing.a], trees.objects.position[crossing.a]
    if column.depth == NO_DEPTH:
        write_middle(w, crossing.i, rotation * column.normal, contacts, witnesses_out)
    else:
        write_candidates(w, rotation, position, column, crossing.least, witnesses_out)
