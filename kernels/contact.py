"""Contacts of intersecting face pairs in the world, and their sums over object pairs.

One thread a face pair, then one thread an object pair over its sorted face pairs: nothing depends on the order in which
threads run.
"""

import warp as wp

from warp_abtree.kernels.pools import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.pose import PairPose, pose_point
from warp_abtree.kernels.segment import face_normal, intersect_faces, measure_length, unit_vector
from warp_abtree.kernels.traverse import PairTrees, locate_pair

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Differences of unit normals, and means of them, that are shorter have no direction worth the name.
SHORTEST_NORMAL = wp.constant(wp.float64(2.0**-20))
# Squared sine of the angle between two planes, under which their line runs away too fast to tell how fast.
FLATTEST = wp.constant(wp.float64(2.0**-40))


@wp.struct
class Contacts:
    """One entry an intersecting face pair: ends [world units, world frame] and unit normals, first and second object
    in the order in which the pair names them; coplanar 0 or 1."""

    p0: wp.array(dtype=wp.vec3d)
    p1: wp.array(dtype=wp.vec3d)
    normal_a: wp.array(dtype=wp.vec3d)
    normal_b: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3d)
    coplanar: wp.array(dtype=wp.int32)


@wp.struct
class PairContacts:
    """One entry an object pair: mean point [world units, world frame], unit mean normal, depth [world units]."""

    point: wp.array(dtype=wp.vec3d)
    normal: wp.array(dtype=wp.vec3d)
    depth: wp.array(dtype=wp.float64)


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
    trees: PairTrees,
    pose: PairPose,
    face_a: wp.int32,
    face_b: wp.int32,
    corner: wp.array(dtype=wp.vec3d),
):
    """Put the corners of a face of A and of one of B, both in A's frame, into places 0..2 and 3..5."""
    a = states.face_corner[trees.corner_a + face_a]
    b = states.face_corner[trees.corner_b + face_b]
    for k in range(3):
        corner[k] = models.vertex_pos[a[k]]
        corner[3 + k] = pose_point(pose.rotation, pose.translation, models.vertex_pos[b[k]])


@wp.kernel
def find_contact_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    faces: wp.array(dtype=wp.vec3i),
    contacts_out: Contacts,
):
    """Compute the contact of one intersecting face pair a thread, in A's frame, and pose it to the world."""
    i = wp.tid()
    p = faces[i][0]
    swapped, trees = locate_pair(models, states, objects, pairs[p])
    a = wp.min(pairs[p][0], pairs[p][1])
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(models, states, trees, pair_poses[p], faces[i][1 + swapped], faces[i][2 - swapped], corner)
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


@wp.func
def box_support(models: ModelPool, states: StatePool, objects: ObjectPool, i: wp.int32, n: wp.vec3d, origin: wp.vec3d):
    """Return how far the root box of a posed object reaches along n from a point, world frame."""
    state = objects.state[i]
    root = states.node_start[state] + 1
    lower = wp.vec3d(states.node_lower[root])
    upper = wp.vec3d(states.node_upper[root])
    centre = pose_point(objects.rotation[i], objects.position[i], models.centre[states.model[state]])
    m = wp.transpose(objects.rotation[i]) * n
    reach = wp.dot(n, centre - origin)
    for k in range(3):
        reach += wp.max(m[k] * lower[k], m[k] * upper[k])
    return reach


@wp.func
def loop_change(segment: wp.vec3d, normal_a: wp.vec3d, normal_b: wp.vec3d, n: wp.vec3d):
    """Return how fast the area within a contact curve changes, a segment's part, as B moves along n at unit speed.

    The line of the two planes moves at v = x normal_a + y normal_b with v . normal_a = 0, v . normal_b = n . normal_b.
    """
    cosine = wp.dot(normal_a, normal_b)
    square = wp.float64(1.0) - cosine * cosine
    if square < FLATTEST:
        return wp.float64(0.0)
    y = wp.dot(n, normal_b) / square
    return y * wp.dot(normal_b - normal_a * cosine, wp.cross(segment, n))


@wp.func
def mean_contact(first: wp.int32, end: wp.int32, contacts: Contacts):
    """Return mean point from the first end, and summed normal, of a range of contacts: both weighted by length.

    Where all lengths vanish all weights are 1. The normal's sum is divided by that of the weights.
    """
    origin = contacts.p0[first]
    half = wp.float64(0.5)
    total = wp.float64(0.0)
    k = first
    while k < end:
        total += measure_length(contacts.p1[k] - contacts.p0[k])
        k += 1
    points = total == wp.float64(0.0)
    if points:
        total = wp.float64(end - first)
    point = wp.vec3d()
    normal = wp.vec3d()
    k = first
    while k < end:
        weight = wp.float64(1.0)
        if not points:
            weight = measure_length(contacts.p1[k] - contacts.p0[k]) / total
        else:
            weight = weight / total
        point += weight * (half * (contacts.p0[k] - origin) + half * (contacts.p1[k] - origin))
        normal += weight * contacts.normal[k]
        k += 1
    return point, normal


@wp.kernel
def reduce_contact_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    faces: wp.array(dtype=wp.vec3i),
    pair_start: wp.array(dtype=wp.int32),
    contacts: Contacts,
    pair_contacts_out: PairContacts,
):
    """Sum the contacts of one object pair a thread, in their order; docstring of warp_abtree/contact.py."""
    p = wp.tid()
    first = pair_start[p]
    end = pair_start[p + 1]
    if first == end:
        return
    origin = contacts.p0[first]
    point, n = mean_contact(first, end, contacts)
    if measure_length(n) <= SHORTEST_NORMAL:
        n = pair_direction(models, states, objects, pairs[p][0], pairs[p][1])
    n = unit_vector(n)
    swapped, trees = locate_pair(models, states, objects, pairs[p])
    a = wp.min(pairs[p][0], pairs[p][1])
    front = -wp.float64(wp.inf)
    back = wp.float64(wp.inf)
    area = wp.float64(0.0)
    change = wp.float64(0.0)
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    k = first
    while k < end:
        load_corners(models, states, trees, pair_poses[p], faces[k][1 + swapped], faces[k][2 - swapped], corner)
        i = wp.int32(0)
        while i < 6:
            at = wp.dot(n, pose_point(objects.rotation[a], objects.position[a], corner[i]) - origin)
            # Places 0..2 are the lower object's, which a swapped pair names second.
            if (i < 3) == (swapped == 0):
                front = wp.max(front, at)
            else:
                back = wp.min(back, at)
            i += 1
        # About the mean point, since for an open curve the area depends on where it is measured from.
        r = contacts.p0[k] - origin - point
        s = contacts.p1[k] - contacts.p0[k]
        if contacts.coplanar[k] == 0:
            area += wp.float64(0.5) * wp.dot(n, wp.cross(r, s))
            change += loop_change(s, contacts.normal_a[k], contacts.normal_b[k], n)
        k += 1
    depth = box_support(models, states, objects, pairs[p][0], n, origin)
    depth += box_support(models, states, objects, pairs[p][1], -n, origin)
    if area == wp.float64(0.0):
        depth = wp.min(depth, front - back)
    elif area * change < wp.float64(0.0):
        depth = wp.min(depth, -area / change)
    pair_contacts_out.point[p] = origin + point
    pair_contacts_out.normal[p] = n
    pair_contacts_out.depth[p] = wp.max(depth, wp.float64(0.0))
