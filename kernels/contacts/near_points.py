"""Candidate points of faces that are apart: gaps along face normals that face each other, else nearest points.

Speculative points must not stop what merely slides past: two faces of a floor meet ahead of a box, and the edge between
them is nearer to the side of the box than anything else of the second face. And a face behind another one may be
inside, or beyond a thin wall. In either case points count only where no other face of either object is nearer there.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, Trees, load_vertex
from warp_abtree.kernels.base.counters import reserve_slot
from warp_abtree.kernels.base.lanes import next_place, warp_any, warp_size
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.contact import Contacts, Deferred, have_crossed
from warp_abtree.kernels.contacts.loops import contact_key
from warp_abtree.kernels.contacts.manifold import NO_DEPTH, NO_POINT, Curves, Rows, measure_column, write_candidates
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_corners
from warp_abtree.kernels.triangle.segment import nearest_on_triangle

wp.set_module_options(native.options("base/counters.cuh", "base/lanes.cuh"))

# A face's normal serves where the other face looks against it within 60 degrees.
OPPOSED_LEAST = wp.constant(wp.float64(0.5))
# Part of the distance that the gap along a face's normal differs by, where that is the direction of the distance.
ALIKE = wp.constant(wp.float64(2.0**-10))
# Cosine between a face's normal and the direction of the distance under which the gap differs by more than `ALIKE`.
ALONG = wp.constant(wp.float64(0.998))
# Part of a squared distance under which another face is nearer.
NEARER = wp.constant(wp.float64(0.998))
# In place of the loop of a contact whose candidates count only if no other face is nearer.
NEAREST_ONLY = wp.constant(wp.int32(-1))
CONTACTS_A_WARP = wp.constant(wp.int32(256))


@wp.struct
class NearRow:
    """A contact of faces that are apart, in A's frame and the order of the pair."""

    first: wp.vec3d  # nearest point of the first object's face [scaled]
    second: wp.vec3d  # of the second's
    square: wp.float64  # of their distance, under which another face is nearer
    swapped: wp.int32  # 1 where the pair names B first


@wp.func
def make_row(pose: PairPose, back: wp.mat33d, position: wp.vec3d, p0: wp.vec3d, p1: wp.vec3d):
    row = NearRow()
    row.first = back * (p0 - position) * pose.scale
    row.second = back * (p1 - position) * pose.scale
    row.square = NEARER * wp.dot(row.second - row.first, row.second - row.first)
    row.swapped = pose.swapped
    return row


@wp.func
def is_nearer(trees: Trees, pose: PairPose, row: NearRow, face: wp.int32, of_first: bool):
    """Return whether another face of the first object is nearer to `second`, or one of the second's to `first`."""
    point = wp.where(of_first, row.second, row.first)
    of_b = of_first == (row.swapped != 0)
    ids = load_corner_ids(trees.states, wp.where(of_b, pose.corner_b, pose.corner_a) + face)
    a, b = load_vertex(trees.models.vertex_pos, ids[0]), load_vertex(trees.models.vertex_pos, ids[1])
    c = load_vertex(trees.models.vertex_pos, ids[2])
    if of_b:
        a = pose_point(pose.rotation, pose.translation, a)
        b = pose_point(pose.rotation, pose.translation, b)
        c = pose_point(pose.rotation, pose.translation, c)
    v = nearest_on_triangle(a * pose.scale, b * pose.scale, c * pose.scale, point) - point
    return wp.dot(v, v) < row.square


@wp.func
def next_neighbour(i: wp.int32, turn: wp.ref[wp.int32], j: wp.ref[wp.int32], rows: Rows, contacts: Contacts):
    """Return the next contact, at place j, that has a face of contact i and less separation, -1 for no more.

    Those of the first object's face come before i, turn 0, and after it, 1, those of the second's at last, 2. No other
    has a face nearer to the points of i: none of it is nearer than its separation.
    """
    own = rows.faces[i]
    p = own[0]
    while turn < 3:
        other = wp.int32(-1)
        j += wp.where(turn == 0, -1, 1)
        if turn == 2:
            if j < rows.start[p + 1] and rows.key[j] == contact_key(p, own[2]):
                other = rows.order[j]
        elif j >= rows.start[p] and j < rows.start[p + 1] and rows.faces[j][1] == own[1]:
            other = j
        if other < 0:
            j = i
            if turn == 1:
                j = wp.lower_bound(rows.key, rows.start[p], rows.start[p + 1], contact_key(p, own[2])) - 1
            turn += 1
        elif contacts.separation[other] < contacts.separation[i]:
            return other
    return -1


@wp.func
def is_nearest_only(contacts: Contacts, curves: Curves, i: wp.int32, end: wp.int32):
    """Return whether contact i has candidates that count only where its faces are nearest."""
    if i >= end:
        return False
    return not have_crossed(contacts, i) and curves.loop[i] == NEAREST_ONLY


@wp.kernel
def keep_nearest_kernel(trees: Trees, batch: PairBatch, rows: Rows, contacts: Contacts, curves_inout: Curves):
    """Drop the candidates of contacts of which a neighbour has a face nearer to their points than theirs are.

    A warp has `CONTACTS_A_WARP` contacts. A lane takes the next of them when it is done with one, so that none waits
    for the lane whose faces have most neighbours.
    """
    queue = wp.tid() / warp_size() * CONTACTS_A_WARP
    end = wp.min(queue + CONTACTS_A_WARP, rows.start[rows.start.shape[0] - 1])
    i, turn, j, p = wp.int32(-1), wp.int32(0), wp.int32(0), wp.int32(0)
    row = NearRow()
    while queue < end or warp_any(i >= 0):
        next = next_place(queue, i < 0)
        if i < 0 and is_nearest_only(contacts, curves_inout, next, end):
            i = wp.int32(next)
            turn, j, p = wp.int32(0), wp.int32(i), rows.faces[i][0]
            a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
            back = wp.transpose(trees.objects.rotation[a])
            row = make_row(batch.poses[p], back, trees.objects.position[a], contacts.p0[i], contacts.p1[i])
        if i >= 0:
            other = next_neighbour(i, turn, j, rows, contacts)
            if other < 0:
                i = wp.int32(-1)
            else:
                face = rows.faces[other][wp.where(turn == 2, 1, 2)]
                if is_nearer(trees, batch.poses[p], row, face, turn == 2):
                    curves_inout.depth[i, 0] = NO_POINT
                    curves_inout.depth[i, 1] = NO_POINT
                    i = wp.int32(-1)


@wp.func
def write_near_candidates(
    i: wp.int32,
    objects: ObjectPool,
    a: wp.int32,
    scale: wp.float64,
    n: wp.vec3d,
    depths: wp.vec2d,
    point: wp.vec3d,
    second: wp.vec3d,
    contacts: Contacts,
    curves: Curves,
):
    """Write a contact's candidates along n, the first `depths[0]` deep; its nearest points if n does not separate.

    Args:
        a: Object in whose frame n and the points are.
    """
    rotation, position = objects.rotation[a], objects.position[a]
    back = wp.transpose(rotation)
    nearest, loop = bool(True), i
    separation = contacts.separation[i]
    if not (wp.abs(wp.abs(depths[0]) - separation) <= ALIKE * separation):
        n = back * contacts.normal[i]
        depths = wp.vec2d(-separation, NO_POINT)
        first = back * (contacts.p0[i] - position) * scale
        point = (first + back * (contacts.p1[i] - position) * scale) * (wp.float64(0.5) / scale)
        ahead_a, ahead_b = wp.dot(n, back * contacts.normal_a[i]), wp.dot(n, back * contacts.normal_b[i])
        nearest = ahead_a > wp.float64(0.0) and ahead_b < wp.float64(0.0)
    if nearest and (depths[0] > wp.float64(0.0) or depths[1] != depths[1]):
        loop = NEAREST_ONLY
    if not nearest:
        depths = wp.vec2d(NO_POINT, NO_POINT)
    curves.loop[i] = loop
    write_candidates(i, rotation, position, n, depths, point, second, contacts, curves)


@wp.kernel
def find_near_candidate_kernel(
    objects: ObjectPool, batch: PairBatch, rows: Rows, contacts: Contacts, facing_inout: Deferred, curves_inout: Curves
):
    """Find the candidate of one contact of faces that are apart a thread: their nearest points; or list it.

    Where both faces look at one another and the distance may be along the normal of either, it is listed. A gap along
    a normal is that of two points of faces, which are convex: points farther apart than the nearest by a fraction e at
    most are so in a direction whose cosine with that of the distance is at least 1 / (1 + e).
    """
    i = wp.tid()
    listed = bool(False)
    apart = i < rows.start[rows.start.shape[0] - 1]
    if apart:
        apart = not have_crossed(contacts, i)
    if apart:
        n, normal_a, normal_b = contacts.normal[i], contacts.normal_a[i], contacts.normal_b[i]
        along = wp.max(wp.abs(wp.dot(n, normal_a)), wp.abs(wp.dot(n, normal_b)))
        listed = -wp.dot(normal_a, normal_b) >= OPPOSED_LEAST and along >= ALONG
        if not listed:
            p = rows.faces[i][0]
            a, zero = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.vec3d()
            none = wp.vec2d(NO_DEPTH, NO_DEPTH)
            scale = batch.poses[p].scale
            write_near_candidates(i, objects, a, scale, zero, none, zero, zero, contacts, curves_inout)
    slot = reserve_slot(facing_inout.total, listed)
    if listed:
        facing_inout.place[slot] = i


@wp.kernel
def find_facing_candidate_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    rows: Rows,
    contacts: Contacts,
    facing: Deferred,
    curves_inout: Curves,
):
    """Find the normal and two candidate points of one listed contact of faces that are apart a thread.

    Along the normal of either face, whichever leaves the wider gap, if that is the distance; else the nearest points,
    where both faces look at one another. A face that lies behind the other one's plane is inside, as deep as it is far.

    Args:
        gap: Under which face pairs are near [world units], shape [pair].
    """
    k = wp.tid()
    if k >= facing.total[0]:
        return
    i = facing.place[k]
    own = rows.faces[i]
    p = own[0]
    pose = batch.poses[p]
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    back = wp.transpose(trees.objects.rotation[a])
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, pose, own[1 + pose.swapped], own[2 - pose.swapped], corner)
    normal_a, normal_b = back * contacts.normal_a[i], back * contacts.normal_b[i]
    first = 3 * pose.swapped
    n = normal_a
    depth, point, other, second = measure_column(corner, normal_a, normal_a, normal_b, first, -gap[p])
    # A gap wider than the distance stays so whatever the other normal says.
    if depth == NO_DEPTH or -depth - contacts.separation[i] <= ALIKE * contacts.separation[i]:
        d, x, e, y = measure_column(corner, -normal_b, normal_a, normal_b, first, -gap[p])
        if d > NO_DEPTH and (depth == NO_DEPTH or d < depth):
            n, depth, point, other, second = -normal_b, d, x, e, y
    depths = wp.vec2d(depth, other)
    write_near_candidates(i, trees.objects, a, pose.scale, n, depths, point, second, contacts, curves_inout)
