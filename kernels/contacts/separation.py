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
    count_contacts,
    have_crossed,
    pair_direction,
)
from warp_abtree.kernels.exact.double_word import BOUND_DOUBLE, double_orient2d
from warp_abtree.kernels.exact.predicates import BOUND_2D, drop_axis
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, PAIR_MASK
from warp_abtree.kernels.triangle.corners import load_corners, load_triangles
from warp_abtree.kernels.triangle.distance import Triangles, scale_triangles
from warp_abtree.kernels.triangle.segment import RELATIVE_ERROR, round_area, unit_vector
from warp_abtree.kernels.triangle.triangle_pair import (
    between_features,
    feature_weights,
    nearest_features,
)

wp.set_module_options(native.options("base/counters.cuh", "exact/double_word.cuh", "triangle/gap.cuh"))

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


@native.func_native()
def find_depth(t: Triangles, direction: wp.ref[wp.vec3d]) -> wp.float64:
    """Find the direction from A to B, of any length, that leaves the widest gap; return the depth of triangles.

    The depth is the shortest motion that parts triangles which intersect [scaled]. It is never too short but for a few
    roundings, and too long by at most 2^-26 of the size where edges are nearly parallel.
    """


@wp.kernel
def mark_near_kernel(listed_inout: Deferred, contacts_inout: Contacts):
    """Take the marks of those that are apart from sorted face pairs, as signs of separations, and list these.

    The list goes from the end of its places on, since those that are deferred are listed from their start.
    """
    i = wp.tid()
    near = bool(False)
    if i < count_contacts(contacts_inout):
        row = contacts_inout.face[i]
        near = (row[0] & NEAR_BIT) != 0
        row[0] = row[0] & PAIR_MASK
        contacts_inout.face[i] = row
        contacts_inout.separation[i] = wp.where(near, LEAST_SEPARATION, -LEAST_SEPARATION)
    slot = reserve_slot(listed_inout.total, near)
    if near:
        listed_inout.place[listed_inout.place.shape[0] - 1 - slot] = i


@wp.kernel(cuda_max_registers=128)
def find_separation_kernel(trees: Trees, batch: PairBatch, contacts_inout: Contacts):
    """Compute the separation of one face pair that intersects a thread."""
    i = wp.tid()
    if i >= count_contacts(contacts_inout) or not have_crossed(contacts_inout, i):
        return
    row = contacts_inout.face[i]
    p = row[0]
    swapped = batch.poses[p].swapped
    t = load_triangles(trees, batch.poses[p], row[1 + swapped], row[2 - swapped])
    direction = wp.vec3d()
    contacts_inout.separation[i] = -wp.max(find_depth(t, direction) * t.size, LEAST_SEPARATION)


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
        direction = wp.vec3d()
        find_depth(t, direction)
        normal = unit_vector(rotation * direction)
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
            row = contacts_inout.face[i]
            own = contact_objects(batch, row[0])
            write_near_contact(i, trees, own, batch.poses[row[0]], row, contacts_inout)
        k += step
