"""Separation of two faces: their distance, or by separating axes how deep they are in one another.

The separation of two triangles is the widest gap that a direction leaves between them, the greatest of
min n.b - max n.a over unit vectors n. Where they do not intersect it is their distance; where they do, it is minus the
shortest motion that parts them, and the direction is a normal of either face or across an edge of each.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.counters import reserve_slot
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.contact import (
    Contacts,
    Deferred,
    PairObjects,
    contact_objects,
    have_crossed,
    pair_direction,
)
from warp_abtree.kernels.exact.double_word import BOUND_DOUBLE, double_orient2d
from warp_abtree.kernels.exact.predicates import BOUND_2D, drop_axis
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, PAIR_MASK
from warp_abtree.kernels.triangle.corners import load_corners, load_triangles
from warp_abtree.kernels.triangle.distance import Triangles, divide, scale_triangles
from warp_abtree.kernels.triangle.segment import RELATIVE_ERROR, round_area, unit_vector
from warp_abtree.kernels.triangle.triangle_pair import (
    between_features,
    cross_exactly,
    feature_weights,
    nearest_features,
)

wp.set_module_options(native.options("base/counters.cuh", "exact/double_word.cuh"))

# Separations are no smaller in magnitude, so that their sign says which faces intersect, as float32 too.
LEAST_SEPARATION = wp.constant(wp.float64(2.0**-126))
# Nearest points that are closer, squared and in the size of the faces, do not tell a direction: the widest gap does.
CLOSEST = wp.constant(wp.float64(2.0**-60))


@wp.func
def signed_area_nearly(a: wp.vec2d, b: wp.vec2d, c: wp.vec2d):
    """Return det(a - c, b - c) with a relative error of at most RELATIVE_ERROR, 0 where it is lost in 2^-100."""
    area = round_area(a, b, c)
    value, size = area[0], area[1]
    if BOUND_2D * size > RELATIVE_ERROR * wp.abs(value):
        double = double_orient2d(a, b, c)
        value = wp.where(wp.abs(double[0]) <= BOUND_DOUBLE * size, wp.float64(0.0), double[0])
    return value


@wp.func
def plain_normal(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the unit normal of a face by winding, zero where it has no area."""
    x = signed_area_nearly(drop_axis(a, 0), drop_axis(b, 0), drop_axis(c, 0))
    y = signed_area_nearly(drop_axis(a, 1), drop_axis(b, 1), drop_axis(c, 1))
    z = signed_area_nearly(drop_axis(a, 2), drop_axis(b, 2), drop_axis(c, 2))
    return unit_vector(wp.vec3d(x, y, z))


@wp.struct
class Gap:
    """Widest gap yet between two triangles, a square that keeps its sign, over the square of a direction's length."""

    square: wp.float64  # below 0 / 0 there is none
    length: wp.float64  # squared
    direction: wp.vec3d  # from A to B


@wp.func
def offer_gap(best: wp.ref[Gap], n: wp.vec3d, low: wp.float64, high: wp.float64):
    """Offer the gap along n, of which B lies from low to high if A is at 0."""
    gap, length = wp.max(-high, low), wp.dot(n, n)
    square = gap * wp.abs(gap)
    if square * best.length > best.square * length:
        best.square = square
        best.length = length
        best.direction = wp.where(low >= -high, n, -n)


@wp.func
def offer_face(best: wp.ref[Gap], n: wp.vec3d, x: wp.vec3d, y: wp.vec3d, z: wp.vec3d):
    """Offer the gap along n, across a face of A; x, y, z are the other's corners relative to a corner of it."""
    p, q, r = wp.dot(n, x), wp.dot(n, y), wp.dot(n, z)
    offer_gap(best, n, wp.min(p, wp.min(q, r)), wp.max(p, wp.max(q, r)))


@wp.func
def offer_edge_gap(best: wp.ref[Gap], n: wp.vec3d, a: wp.float64, b: wp.float64, r: wp.vec3d):
    """Offer the gap along a vector n across an edge of each face.

    Args:
        a, b: How far the corners opposite of the edges lie along n from them.
        r: From the first edge's start to the second's.
    """
    zero = wp.float64(0.0)
    z = wp.dot(n, r)
    # A lies from 0 to a, B from z to z + b.
    low = z + wp.min(b, zero) - wp.max(a, zero)
    high = z + wp.max(b, zero) - wp.min(a, zero)
    offer_gap(best, n, low, high)


@wp.func
def widest_gap(t: Triangles):
    """Return the widest gap that a direction leaves between two triangles: a face's normal, or one across two edges.

    Of triangles that intersect the motion that parts them is never too short but for a few roundings, and too long by
    at most 2^-26 of the size where edges are nearly parallel, as the direction across them errs then.
    """
    best = Gap()
    best.square = wp.float64(-1.0)
    e0, e1, e2 = t.a1, t.a2 - t.a1, -t.a2
    f0, f1, f2 = t.b1 - t.b0, t.b2 - t.b1, t.b0 - t.b2
    normal_a, normal_b = cross_exactly(t.a1, t.a2), cross_exactly(f0, -f2)
    offer_face(best, normal_a, t.b0, t.b1, t.b2)
    # Seen from B, A lies on the other side.
    offer_face(best, -normal_b, t.b0, t.b0 - t.a1, t.b0 - t.a2)
    # Along e x f, of an edge e of A, the corner opposite of e lies by -f . normal_a; that of f by e . normal_b.
    a0, a1, a2 = -wp.dot(f0, normal_a), -wp.dot(f1, normal_a), -wp.dot(f2, normal_a)
    b0, b1, b2 = wp.dot(e0, normal_b), wp.dot(e1, normal_b), wp.dot(e2, normal_b)
    offer_edge_gap(best, wp.cross(e0, f0), a0, b0, t.b0)
    offer_edge_gap(best, wp.cross(e0, f1), a1, b0, t.b1)
    offer_edge_gap(best, wp.cross(e0, f2), a2, b0, t.b2)
    offer_edge_gap(best, wp.cross(e1, f0), a0, b1, t.b0 - t.a1)
    offer_edge_gap(best, wp.cross(e1, f1), a1, b1, t.b1 - t.a1)
    offer_edge_gap(best, wp.cross(e1, f2), a2, b1, t.b2 - t.a1)
    offer_edge_gap(best, wp.cross(e2, f0), a0, b2, t.b0 - t.a2)
    offer_edge_gap(best, wp.cross(e2, f1), a1, b2, t.b1 - t.a2)
    offer_edge_gap(best, wp.cross(e2, f2), a2, b2, t.b2 - t.a2)
    return best


@wp.func
def crossing_depth(t: Triangles):
    """Return the shortest motion that parts two triangles which intersect [scaled], see `widest_gap`."""
    best = widest_gap(t)
    # Along one line there is no such direction, and any across it parts them.
    return wp.sqrt(wp.max(divide(-best.square, best.length), wp.float64(0.0)))


@wp.kernel
def mark_near_kernel(
    start: wp.array(dtype=wp.int32),
    faces_inout: wp.array(dtype=wp.vec3i),
    listed_inout: Deferred,
    contacts_out: Contacts,
):
    """Take the marks of those that are apart from sorted face pairs, as signs of separations, and list these.

    The list goes from the end of its places on, since those that are deferred are listed from their start.
    """
    i = wp.tid()
    near = bool(False)
    if i < start[start.shape[0] - 1]:
        row = faces_inout[i]
        near = (row[0] & NEAR_BIT) != 0
        row[0] = row[0] & PAIR_MASK
        faces_inout[i] = row
        contacts_out.separation[i] = wp.where(near, LEAST_SEPARATION, -LEAST_SEPARATION)
    slot = reserve_slot(listed_inout.total, near)
    if near:
        listed_inout.place[listed_inout.place.shape[0] - 1 - slot] = i


@wp.kernel(cuda_max_registers=128)
def find_separation_kernel(
    trees: Trees,
    batch: PairBatch,
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    contacts_inout: Contacts,
):
    """Compute the separation of one face pair that intersects a thread."""
    i = wp.tid()
    if i >= start[start.shape[0] - 1] or not have_crossed(contacts_inout, i):
        return
    row = faces[i]
    p = row[0]
    swapped = batch.poses[p].swapped
    t = load_triangles(trees, batch.poses[p], row[1 + swapped], row[2 - swapped])
    contacts_inout.separation[i] = -wp.max(crossing_depth(t) * t.size, LEAST_SEPARATION)


@wp.func
def write_near_contact(i: wp.int32, trees: Trees, own: PairObjects, pose: PairPose, row: wp.vec3i, contacts: Contacts):
    """Compute the contact of two faces that are apart."""
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, pose, row[1 + own.swapped], row[2 - own.swapped], corner)
    t = scale_triangles(corner[0], corner[1], corner[2], corner[3], corner[4], corner[5])
    near = nearest_features(t)
    contacts.separation[i] = wp.max(wp.sqrt(near.square) * t.size, LEAST_SEPARATION)
    contacts.coplanar[i] = 0
    u, v = feature_weights(near)
    point_a = u[0] * corner[0] + u[1] * corner[1] + u[2] * corner[2]
    point_b = v[0] * corner[3] + v[1] * corner[4] + v[2] * corner[5]
    rotation, position = trees.objects.rotation[own.a], trees.objects.position[own.a]
    end_a, end_b = pose_point(rotation, position, point_a), pose_point(rotation, position, point_b)
    normal_a = unit_vector(rotation * plain_normal(corner[0], corner[1], corner[2]))
    normal_b = unit_vector(rotation * plain_normal(corner[3], corner[4], corner[5]))
    normal = unit_vector(rotation * between_features(t, near))
    if near.square <= CLOSEST:
        normal = unit_vector(rotation * widest_gap(t).direction)
        if wp.dot(normal, normal) == wp.float64(0.0):
            normal = pair_direction(trees, own.a, own.b)
    back = own.swapped != 0
    contacts.p0[i] = wp.where(back, end_b, end_a)
    contacts.p1[i] = wp.where(back, end_a, end_b)
    contacts.normal_a[i] = wp.where(back, normal_b, normal_a)
    contacts.normal_b[i] = wp.where(back, normal_a, normal_b)
    contacts.normal[i] = wp.where(back, -normal, normal)


@wp.kernel(cuda_max_registers=128)
def find_near_contact_kernel(
    step: wp.int32,
    trees: Trees,
    batch: PairBatch,
    faces: wp.array(dtype=wp.vec3i),
    listed: Deferred,
    uncertain_only: bool,
    contacts_inout: Contacts,
):
    """Compute the contacts of faces that are apart, which are listed, in a grid-stride loop.

    Args:
        uncertain_only: Whether `simd_contacts` has done all but those that are uncertain there, which keep their mark.
    """
    k = wp.tid()
    while k < listed.total[0]:
        i = listed.place[listed.place.shape[0] - 1 - k]
        if not uncertain_only or contacts_inout.separation[i] == LEAST_SEPARATION:
            p = faces[i][0]
            own = contact_objects(batch, p)
            write_near_contact(i, trees, own, batch.poses[p], faces[i], contacts_inout)
        k += step
