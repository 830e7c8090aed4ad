"""Contacts on the CPU: 8 face pairs of an object pair at a time, in vector instructions, and their sums."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.contacts.contact import Contacts, Deferred, contact_objects
from warp_abtree.kernels.contacts.summary import PairContacts, mean_normal, write_no_contacts
from warp_abtree.kernels.contacts.travel import choose_travel, reach_contacts

wp.set_module_options(native.options("base/lanes.cuh", "contacts/contact_sums.h", "contacts/contacts.h"))


@native.func_native(cpu=True)
def simd_contacts(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    rotation: wp.mat33d,
    position: wp.vec3d,
    proven: bool,
    span: wp.vec3i,
    faces: wp.array(dtype=wp.vec3i),
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


@native.func_native(cpu=True)
def simd_sum_lengths(contacts: Contacts, ends: wp.vec2i, total: wp.ref[wp.float64], number: wp.ref[wp.float64]):
    """Find the length of an object pair's contacts, and how many are of faces that intersect, as `sum_lengths`."""


@native.func_native(cpu=True)
def simd_sum_means(
    contacts: Contacts,
    ends: wp.vec2i,
    total: wp.float64,
    number: wp.float64,
    middle: wp.ref[wp.vec3d],
    normal: wp.ref[wp.vec3d],
):
    """Find the mean point of a pair's contacts, from the first end, and the mean of normals, as `sum_means`."""


@native.func_native(cpu=True)
def simd_sum_areas(
    contacts: Contacts,
    ends: wp.vec2i,
    middle: wp.vec3d,
    normal: wp.vec3d,
    area: wp.ref[wp.float64],
    change: wp.ref[wp.float64],
):
    """Find the area within a pair's contact curve and its change, as `sum_chunks`."""


@wp.kernel
def find_pair_contacts_kernel(
    trees: Trees,
    batch: PairBatch,
    proven: bool,
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    deferred_inout: Deferred,
    contacts_out: Contacts,
):
    """Compute the contacts of one object pair, or defer them; one thread after the other, CPU only."""
    p = wp.tid()
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    if start[p] < start[p + 1]:
        deferred_inout.total[0] = simd_contacts(
            trees.models,
            trees.states,
            batch.poses[p],
            trees.objects.rotation[a],
            trees.objects.position[a],
            proven,
            wp.vec3i(start[p], start[p + 1], deferred_inout.total[0]),
            faces,
            deferred_inout.place,
            contacts_out,
        )


@wp.kernel
def sum_pair_kernel(
    trees: Trees,
    batch: PairBatch,
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    pair_contacts_out: PairContacts,
):
    """Sum the contacts of one object pair a thread, as the kernels of `summary` do; CPU only."""
    p = wp.tid()
    ends = wp.vec2i(start[p], start[p + 1])
    total, number = wp.float64(0.0), wp.float64(0.0)
    simd_sum_lengths(contacts, ends, total, number)
    if number == wp.float64(0.0):
        write_no_contacts(p, pair_contacts_out)
        return
    middle, normal = wp.vec3d(), wp.vec3d()
    simd_sum_means(contacts, ends, total, number, middle, normal)
    n = mean_normal(trees, batch.pairs[p], normal)
    area, change = wp.float64(0.0), wp.float64(0.0)
    simd_sum_areas(contacts, ends, middle, n, area, change)
    origin = contacts.p0[ends[0]]
    front, back = wp.float64(0.0), wp.float64(0.0)
    if area == wp.float64(0.0):
        own = contact_objects(batch, p)
        span = wp.vec3i(p, ends[0], ends[1])
        front, back = reach_contacts(trees, own, batch.poses[p], span, faces, contacts, n, origin)
    pair_contacts_out.normal[p] = n
    pair_contacts_out.point[p] = origin + middle
    pair_contacts_out.travel[p] = choose_travel(trees, batch.pairs[p], n, origin, area, change, front - back)
