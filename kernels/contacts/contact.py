"""Contacts of intersecting face pairs in the world: by float64 where it is sure, else by exact signs."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, Trees
from warp_abtree.kernels.base.lanes import warp_lane, warp_size
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.exact.expansion import EXPANSION_LANES
from warp_abtree.kernels.intersect.uncertain_pairs import items_at_once
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_corners, load_face_pair
from warp_abtree.kernels.triangle.segment import (
    face_normal,
    find_normal,
    find_segment,
    intersect_faces,
    unit_vector,
)

wp.set_module_options(
    native.options(
        "base/lanes.cuh", "contacts/contacts.h", "exact/determinant.cuh", "exact/expansion.cuh", "triangle/segment.cuh"
    )
)

# Differences of unit normals, and means of them, that are shorter have no direction worth the name.
SHORTEST_NORMAL = wp.constant(wp.float64(2.0**-20))


@wp.struct
class Contacts:
    """One entry an intersecting face pair, its objects in the order in which the pair names them, world frame."""

    face: wp.array(dtype=wp.vec3i)  # (pair, face of its first object, face of its second), sorted; [0] of witnesses
    start: wp.array(dtype=wp.int32)  # where those of each pair start, at last where all end, shape [pair + 1]; or [0]
    p0: wp.array(dtype=wp.vec3d)  # first end [world units]
    p1: wp.array(dtype=wp.vec3d)  # second end [world units]
    normal_a: wp.array(dtype=wp.vec3d)  # unit normal of the first object's face
    normal_b: wp.array(dtype=wp.vec3d)  # unit normal of the second object's face
    normal: wp.array(dtype=wp.vec3d)  # unit normal of the contact, from the first object to the second
    coplanar: wp.array(dtype=wp.int32)  # 0 or 1
    separation: wp.array(dtype=wp.float64)  # [world units], negative where the faces intersect; [0] without a gap


@wp.func
def pair_direction(trees: Trees, a: wp.int32, b: wp.int32):
    """Return the unit vector between the centres of two models, world frame; x where they coincide."""
    centre_a = trees.models.centre[trees.states.model[trees.objects.state[a]]]
    centre_b = trees.models.centre[trees.states.model[trees.objects.state[b]]]
    from_a = pose_point(trees.objects.rotation[a], trees.objects.position[a], centre_a)
    v = unit_vector(pose_point(trees.objects.rotation[b], trees.objects.position[b], centre_b) - from_a)
    if wp.dot(v, v) == wp.float64(0.0):
        return wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    return v


@wp.struct
class PairObjects:
    """An object pair as its contacts need it."""

    a: wp.int32  # object with the smaller index
    b: wp.int32  # the other
    swapped: wp.int32  # 1 where the pair names b first


@wp.struct
class Deferred:
    """Contacts that are left for a launch of their own."""

    total: wp.array(dtype=wp.int32)  # how many, shape [1]
    place: wp.array(dtype=wp.int32)  # of each in `Contacts`, shape [capacity]


@wp.func
def contact_objects(batch: PairBatch, p: wp.int32):
    own = PairObjects()
    own.a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    own.b = wp.max(batch.pairs[p][0], batch.pairs[p][1])
    own.swapped = batch.poses[p].swapped
    return own


@wp.func
def count_contacts(contacts: Contacts):
    """Return how many contacts of all pairs there are."""
    return contacts.start[contacts.start.shape[0] - 1]


@wp.func
def have_crossed(contacts: Contacts, i: wp.int32):
    """Return whether a contact's faces intersect; with a gap they may be apart."""
    if contacts.separation.shape[0] == 0:
        return True
    return contacts.separation[i] < wp.float64(0.0)


@wp.func
def write_contact(
    trees: Trees,
    own: PairObjects,
    i: wp.int32,
    p0: wp.vec3d,
    p1: wp.vec3d,
    face_normal_a: wp.vec3d,
    face_normal_b: wp.vec3d,
    contacts: Contacts,
):
    """Pose a contact to the world, from points and normals in the frame of object a."""
    rotation = trees.objects.rotation[own.a]
    end0 = pose_point(rotation, trees.objects.position[own.a], p0)
    end1 = pose_point(rotation, trees.objects.position[own.a], p1)
    normal_a = unit_vector(rotation * face_normal_a)
    normal_b = unit_vector(rotation * face_normal_b)
    normal = normal_a - normal_b
    if wp.dot(normal, normal) <= SHORTEST_NORMAL * SHORTEST_NORMAL:
        normal = normal_a
    normal = unit_vector(normal)
    if wp.dot(normal, normal) == wp.float64(0.0):
        normal = pair_direction(trees, own.a, own.b)
    back = own.swapped != 0
    contacts.p0[i] = wp.where(back, end1, end0)
    contacts.p1[i] = wp.where(back, end0, end1)
    contacts.normal_a[i] = wp.where(back, normal_b, normal_a)
    contacts.normal_b[i] = wp.where(back, normal_a, normal_b)
    contacts.normal[i] = wp.where(back, -normal, normal)


@wp.kernel(cuda_max_registers=128)
def find_contact_kernel(
    trees: Trees,
    batch: PairBatch,
    proven: bool,
    deferred_inout: Deferred,
    contacts_out: Contacts,
):
    """Compute the contact of one intersecting face pair a thread, or defer it where float64 is not sure of it.

    Args:
        proven: Whether face pairs are known to intersect, by exact signs.
    """
    i = wp.tid()
    if i >= count_contacts(contacts_out) or not have_crossed(contacts_out, i):
        return
    row = contacts_out.face[i]
    p = row[0]
    own = contact_objects(batch, p)
    a = load_corner_ids(trees.states, batch.poses[p].corner_a + row[1 + own.swapped])
    b = load_corner_ids(trees.states, batch.poses[p].corner_b + row[2 - own.swapped])
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, batch.poses[p], a, b)
    normal_a, normal_b, p0, p1 = wp.vec3d(), wp.vec3d(), wp.vec3d(), wp.vec3d()
    sure_a, sure_b = find_normal(a0, a1, a2, normal_a), find_normal(b0, b1, b2, normal_b)
    sure = find_segment(proven, wp.matrix_from_rows(a0, a1, a2), wp.matrix_from_rows(b0, b1, b2), p0, p1)
    if sure and sure_a and sure_b:
        write_contact(trees, own, i, p0, p1, normal_a, normal_b, contacts_out)
        contacts_out.coplanar[i] = 0
    else:
        deferred_inout.place[wp.atomic_add(deferred_inout.total, 0, 1)] = i


@wp.kernel
def find_deferred_kernel(
    step: wp.int32,
    trees: Trees,
    batch: PairBatch,
    deferred: Deferred,
    contacts_out: Contacts,
):
    """Compute deferred contacts by exact signs: few at a time in each warp of so many threads."""
    at_once = wp.min(items_at_once(deferred.total[0], step), EXPANSION_LANES)
    k = at_once * (wp.tid() / warp_size()) + warp_lane()
    while warp_lane() < at_once and k < deferred.total[0]:
        i = deferred.place[k]
        row = contacts_out.face[i]
        p = row[0]
        own = contact_objects(batch, p)
        corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
        load_corners(trees, batch.poses[p], row[1 + own.swapped], row[2 - own.swapped], corner)
        p0, p1, coplanar = intersect_faces(batch.poses[p].scale, corner)
        normal_a = face_normal(corner[0], corner[1], corner[2])
        normal_b = face_normal(corner[3], corner[4], corner[5])
        write_contact(trees, own, i, p0, p1, normal_a, normal_b, contacts_out)
        contacts_out.coplanar[i] = coplanar
        k += at_once * (step / warp_size())


@native.func_native(cpu=True)
def simd_contacts(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    rotation: wp.mat33d,
    position: wp.vec3d,
    proven: bool,
    span: wp.vec3i,
    place: wp.array(dtype=wp.int32),
    contacts: Contacts,
) -> wp.int32:
    """Compute the contacts of an object pair's face pairs, as `find_contact_kernel`; list those that are uncertain.

    Args:
        rotation, position: Pose of object A.
        proven: Whether the face pairs are known to intersect.
        span: First face pair, the one behind the last, and how many entries the list has.

    Returns how many entries the list has then.
    """


@wp.kernel
def find_pair_contacts_kernel(
    trees: Trees,
    batch: PairBatch,
    proven: bool,
    deferred_inout: Deferred,
    contacts_out: Contacts,
):
    """Compute the contacts of one object pair, or defer them; one thread after the other, CPU only."""
    p = wp.tid()
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    start = contacts_out.start
    if start[p] < start[p + 1]:
        deferred_inout.total[0] = simd_contacts(
            trees.models,
            trees.states,
            batch.poses[p],
            trees.objects.rotation[a],
            trees.objects.position[a],
            proven,
            wp.vec3i(start[p], start[p + 1], deferred_inout.total[0]),
            deferred_inout.place,
            contacts_out,
        )
