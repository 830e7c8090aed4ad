"""Contacts of intersecting face pairs in the world, one thread a face pair."""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool, load_vertex
from warp_abtree.kernels.poses import PairPose, pose_point
from warp_abtree.kernels.triangle.segment import face_normal, intersect_faces, unit_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Differences of unit normals, and means of them, that are shorter have no direction worth the name.
SHORTEST_NORMAL = wp.constant(wp.float64(2.0**-20))


@wp.struct
class Contacts:
    """One entry an intersecting face pair, its objects in the order in which the pair names them, world frame."""

    p0: wp.array(dtype=wp.vec3d)  # first end [world units]
    p1: wp.array(dtype=wp.vec3d)  # second end [world units]
    normal_a: wp.array(dtype=wp.vec3d)  # unit normal of the first object's face
    normal_b: wp.array(dtype=wp.vec3d)  # unit normal of the second object's face
    normal: wp.array(dtype=wp.vec3d)  # unit normal of the contact, from the first object to the second
    coplanar: wp.array(dtype=wp.int32)  # 0 or 1


@wp.func
def pair_direction(models: ModelPool, states: StatePool, objects: ObjectPool, a: wp.int32, b: wp.int32):
    """Return the unit vector between the centres of two models, world frame; x where they coincide."""
    centre_a = models.centre[states.model[objects.state[a]]]
    centre_b = models.centre[states.model[objects.state[b]]]
    from_a = pose_point(objects.rotation[a], objects.position[a], centre_a)
    v = unit_vector(pose_point(objects.rotation[b], objects.position[b], centre_b) - from_a)
    if wp.dot(v, v) == wp.float64(0.0):
        return wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    return v


@wp.func
def load_corners(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    face_a: wp.int32,
    face_b: wp.int32,
    corner: wp.array(dtype=wp.vec3d),
):
    """Put the corners of a face of A and of one of B, both in A's frame, into places 0..2 and 3..5."""
    a = states.face_corner[pose.corner_a + face_a]
    b = states.face_corner[pose.corner_b + face_b]
    for k in range(3):
        corner[k] = load_vertex(models.vertex_pos, a[k])
        corner[3 + k] = pose_point(pose.rotation, pose.translation, load_vertex(models.vertex_pos, b[k]))


@wp.kernel
def find_contact_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    contacts_out: Contacts,
):
    """Compute the contact of one intersecting face pair a thread, in A's frame, and pose it to the world.

    Args:
        start: Where the face pairs of each object pair start, shape [pair + 1]; after the last pair, where all end.
    """
    i = wp.tid()
    if i >= start[start.shape[0] - 1]:
        return
    p = faces[i][0]
    swapped = pair_poses[p].swapped
    a = wp.min(pairs[p][0], pairs[p][1])
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(models, states, pair_poses[p], faces[i][1 + swapped], faces[i][2 - swapped], corner)
    p0, p1, coplanar = intersect_faces(pair_poses[p].scale, corner)
    rotation = objects.rotation[a]
    p0 = pose_point(rotation, objects.position[a], p0)
    p1 = pose_point(rotation, objects.position[a], p1)
    normal_a = unit_vector(rotation * face_normal(corner[0], corner[1], corner[2]))
    normal_b = unit_vector(rotation * face_normal(corner[3], corner[4], corner[5]))
    normal = normal_a - normal_b
    if wp.dot(normal, normal) <= SHORTEST_NORMAL * SHORTEST_NORMAL:
        normal = normal_a
    normal = unit_vector(normal)
    if wp.dot(normal, normal) == wp.float64(0.0):
        normal = pair_direction(models, states, objects, a, wp.max(pairs[p][0], pairs[p][1]))
    contacts_out.coplanar[i] = coplanar
    if swapped != 0:
        contacts_out.p0[i] = p1
        contacts_out.p1[i] = p0
        contacts_out.normal_a[i] = normal_b
        contacts_out.normal_b[i] = normal_a
        contacts_out.normal[i] = -normal
    else:
        contacts_out.p0[i] = p0
        contacts_out.p1[i] = p1
        contacts_out.normal_a[i] = normal_a
        contacts_out.normal_b[i] = normal_b
        contacts_out.normal[i] = normal
