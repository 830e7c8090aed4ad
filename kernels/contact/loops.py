"""Contact loops of an object pair, and their normals.

A loop is a set of contacts that faces link: two contacts of a pair that share a face of either object are of one loop,
unless the other faces are of two walls that face each other, as of a slot that the face spans. Faces that are apart,
nearer than a gap, are of no loop.
"""

import warp as wp

from warp_abtree.kernels.arrays import LAST_KEY, ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.contact.contact import Contacts, have_crossed, pair_direction
from warp_abtree.kernels.contact.manifold import Curves
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Areas of a loop, relative to its length squared, that have no direction worth the name.
LEAST_LOOP_AREA = wp.constant(wp.float64(2.0**-20))


@wp.func
def find_root(parent: wp.array(dtype=wp.int32), i: wp.int32):
    """Return the root of a set, and halve the way to it: threads that link neighbours at once make long ways."""
    root = i
    up = parent[root]
    while up != root:
        top = parent[up]
        if top != up:
            # Nothing but such a step changes the entry of a member, so that it stays one towards the root.
            parent[root] = top
        root = up
        up = top
    return root


@wp.func
def unite_roots(parent: wp.array(dtype=wp.int32), i: wp.int32, j: wp.int32):
    """Unite two sets; the root of a set is its least member, whatever the order of unions."""
    a = find_root(parent, i)
    b = find_root(parent, j)
    while a != b:
        high = wp.max(a, b)
        low = wp.min(a, b)
        old = wp.atomic_cas(parent, high, high, low)
        if old == high:
            a = low
            b = low
        else:
            # Another thread was first; what it wrote is less than high, so that this ends.
            a = find_root(parent, old)
            b = find_root(parent, low)


@wp.func
def are_across(contacts: Contacts, normal: wp.array(dtype=wp.vec3d), i: wp.int32, j: wp.int32):
    """Return whether two contacts of a face are of two walls that face each other, which push it either way.

    Args:
        normal: Outward normals of the walls, `Contacts.normal_a` or `normal_b`.
    """
    zero = wp.float64(0.0)
    between = (contacts.p0[j] + contacts.p1[j]) - (contacts.p0[i] + contacts.p1[i])
    opposed = wp.dot(normal[i], normal[j]) < zero
    return opposed and wp.dot(between, normal[i]) > zero and wp.dot(between, normal[j]) < zero


@wp.func
def pair_key(pair: wp.int32, face: wp.int32):
    """Return the key that sorts contacts by their pairs, and those by faces of B."""
    return (wp.int64(pair) << wp.int64(31)) | wp.int64(face)


@wp.kernel
def begin_loop_kernel(
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    curves_out: Curves,
    order_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
    listed_total_out: wp.array(dtype=wp.int32),
):
    """Make each contact a loop of its own, with a key that brings contacts of one face of B together; list none yet."""
    i = wp.tid()
    if i == 0:
        listed_total_out[0] = 0
    order_out[i] = i
    key_out[i] = LAST_KEY
    if i < start[start.shape[0] - 1]:
        curves_out.parent[i] = i
        key_out[i] = pair_key(faces[i][0], faces[i][2])


@wp.kernel
def link_loop_kernel(
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    order: wp.array(dtype=wp.int32),
    key: wp.array(dtype=wp.int64),
    curves_inout: Curves,
):
    """Unite each contact with the next of its face that is not across a gap, for faces of either object."""
    i = wp.tid()
    last = start[start.shape[0] - 1]
    if i + 1 >= last:
        return
    if have_crossed(contacts, i):
        j = i + 1
        while j < last and faces[j][0] == faces[i][0] and faces[j][1] == faces[i][1]:
            if have_crossed(contacts, j) and not are_across(contacts, contacts.normal_b, i, j):
                unite_roots(curves_inout.parent, i, j)
                j = last
            j += 1
    k = order[i]
    if have_crossed(contacts, k):
        j = i + 1
        while j < last and key[j] == key[i]:
            if have_crossed(contacts, order[j]) and not are_across(contacts, contacts.normal_a, k, order[j]):
                unite_roots(curves_inout.parent, k, order[j])
                j = last
            j += 1


@wp.kernel
def name_loop_kernel(
    start: wp.array(dtype=wp.int32),
    contacts: Contacts,
    curves_inout: Curves,
    order_out: wp.array(dtype=wp.int32),
    key_out: wp.array(dtype=wp.int64),
):
    """Name the loop of each contact by its first, as the key that brings loops together."""
    i = wp.tid()
    order_out[i] = i
    key_out[i] = LAST_KEY
    if i < start[start.shape[0] - 1]:
        root = find_root(curves_inout.parent, i)
        curves_inout.loop[i] = root
        if have_crossed(contacts, i):
            key_out[i] = wp.int64(root)


@wp.kernel
def average_loop_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    order: wp.array(dtype=wp.int32),
    curves_inout: Curves,
):
    """Find the normal of one loop, by the thread of its first contact: the direction of the area within the curve.

    Moving an object by dx changes the volume that closed surfaces share by the vector area of the curve times dx, so
    this is the direction that frees them soonest. An open or empty curve takes the mean of its contacts' normals.
    """
    k = wp.tid()
    last = start[start.shape[0] - 1]
    if k >= last or curves_inout.loop[order[k]] != order[k] or not have_crossed(contacts, order[k]):
        return
    root = order[k]
    origin = contacts.p0[root]
    total = wp.float64(0.0)
    half = wp.float64(0.5)
    middle = wp.vec3d()
    gap = wp.vec3d()
    mean = wp.vec3d()
    plain = wp.vec3d()
    area = wp.vec3d()
    i = root
    while i >= 0:
        along = contacts.p1[i] - contacts.p0[i]
        length = measure_length(along)
        mean += length * contacts.normal[i]
        plain += contacts.normal[i]
        if contacts.coplanar[i] == 0:
            total += length
            gap += along
            middle += (length * half) * ((contacts.p0[i] - origin) + (contacts.p1[i] - origin))
            area += half * wp.cross(contacts.p0[i] - origin, along)
        k += 1
        i = wp.int32(-1)
        if k < last and curves_inout.loop[order[k]] == root:
            i = order[k]
    n = area
    if total > wp.float64(0.0):
        # About the mean point, since for an open curve the area depends on where it is measured from.
        n = (area - half * wp.cross(middle / total, gap)) / (total * total)
    if measure_length(n) <= LEAST_LOOP_AREA:
        n = mean
        if measure_length(mean) <= LEAST_LOOP_AREA * total:
            n = plain
        if measure_length(plain) <= LEAST_LOOP_AREA:
            p = faces[root][0]
            n = pair_direction(models, states, objects, pairs[p][0], pairs[p][1])
    curves_inout.loop_normal[root] = unit_vector(n)
