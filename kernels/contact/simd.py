"""Contacts on the CPU: 8 face pairs of an object pair at a time, in vector instructions, and their sums."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.contact.contact import Contacts, Deferred
from warp_abtree.kernels.poses import PairPose

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func_native(native.body("simd/contacts.h", "simd_contacts"))
def simd_contacts(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    rotation: wp.mat33d,
    position: wp.vec3d,
    proven: bool,
    ends: wp.vec2i,
    faces: wp.array(dtype=wp.vec3i),
    waiting: wp.int32,
    place: wp.array(dtype=wp.int32),
    contacts: Contacts,
) -> wp.int32:
    """Compute the contacts of an object pair's face pairs, as `find_contact`, and list those that it is not sure of.

    Args:
        rotation, position: Pose of object A.
        proven: Whether the face pairs are known to intersect.
        ends: First face pair, and the one behind the last.
        waiting: Entries of the list.

    Returns how many entries the list has then.
    """


@wp.kernel
def find_pair_contacts_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    proven: bool,
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    deferred_inout: Deferred,
    contacts_out: Contacts,
):
    """Compute the contacts of one object pair, or defer them; one thread after the other, CPU only."""
    p = wp.tid()
    a = wp.min(pairs[p][0], pairs[p][1])
    if start[p] < start[p + 1]:
        deferred_inout.total[0] = simd_contacts(
            models,
            states,
            pair_poses[p],
            objects.rotation[a],
            objects.position[a],
            proven,
            wp.vec2i(start[p], start[p + 1]),
            faces,
            deferred_inout.total[0],
            deferred_inout.place,
            contacts_out,
        )
