"""One summary an object pair of its sorted contacts, in sums of a fixed shape.

A chunk is CHUNK contacts of one pair, the pair's last one shorter. One warp a chunk sums its contacts in their order
(on the CPU a thread), then one thread a pair its chunks in theirs, so that no bit depends on the device or on the order
in which threads run. With a gap contacts of faces that are apart count nothing.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool, load_vertex
from warp_abtree.kernels.contact.contact import (
    SHORTEST_NORMAL,
    Contacts,
    contact_objects,
    have_crossed,
    pair_direction,
)
from warp_abtree.kernels.poses import PairPose, pose_point
from warp_abtree.kernels.traversal.nodes import load_node
from warp_abtree.kernels.traversal.warp_stack import add_in_order, six_numbers, warp_lane, warp_max, warp_size
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

CHUNK = wp.constant(32)
# Squared sine of the angle between two planes, under which their line runs away too fast to tell how fast.
LEAST_SINE_SQUARED = wp.constant(wp.float64(2.0**-40))


@wp.struct
class PairContacts:
    """One entry an object pair, world frame."""

    point: wp.array(dtype=wp.vec3d)  # mean point [world units]
    normal: wp.array(dtype=wp.vec3d)  # unit mean normal
    travel: wp.array(dtype=wp.float64)  # [world units]


@wp.struct
class ChunkSums:
    """Sums over each chunk, and what a pair's chunks need of each other."""

    span: wp.array(dtype=wp.vec3i)  # (pair, first contact, end), shape [chunk]
    length: wp.array(dtype=wp.float64)  # sum of lengths, shape [chunk]
    point: wp.array(dtype=wp.vec3d)  # weighted, from the pair's first end, shape [chunk]
    normal: wp.array(dtype=wp.vec3d)  # weighted, shape [chunk]
    area: wp.array(dtype=wp.float64)  # that the contact curve encloses, shape [chunk]
    change: wp.array(dtype=wp.float64)  # how fast the area changes, shape [chunk]
    front: wp.array(dtype=wp.float64)  # how far the first object's faces reach along the normal, shape [chunk]
    back: wp.array(dtype=wp.float64)  # how far the second's reach against it, shape [chunk]
    crossed: wp.array(dtype=wp.float64)  # contacts whose faces intersect, shape [chunk]; [0] without a gap
    total: wp.array(dtype=wp.float64)  # length of all contacts, or 0, shape [pair]
    number: wp.array(dtype=wp.float64)  # of contacts whose faces intersect, shape [pair]; [0] without a gap
    middle: wp.array(dtype=wp.vec3d)  # mean point from the first end, shape [pair]


@wp.func
def first_chunk(p: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return the place of a pair's first chunk: each pair before has at most one chunk more than whole ones fit."""
    return start[p] // CHUNK + p


@wp.func
def end_chunk(p: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return the place after a pair's last chunk."""
    return first_chunk(p, start) + (start[p + 1] - start[p] + CHUNK - 1) // CHUNK


@wp.func
def locate_chunk(c: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return (pair, first contact, end) of a chunk; a place without one has its end at or before the first."""
    low = wp.int32(0)
    high = start.shape[0] - 1
    while high - low > 1:  # the pair is one of low .. high - 1
        middle = (low + high) // 2
        if first_chunk(middle, start) <= c:
            low = middle
        else:
            high = middle
    first = start[low] + (c - first_chunk(low, start)) * CHUNK
    return wp.vec3i(low, first, wp.min(first + CHUNK, start[low + 1]))


@wp.kernel
def sum_length_kernel(start: wp.array(dtype=wp.int32), contacts: Contacts, sums_out: ChunkSums):
    """Locate one chunk a warp and sum the lengths of its contacts."""
    c = wp.tid() / warp_size()
    span = locate_chunk(c, start)
    sums = six_numbers()
    length = six_numbers()
    first = wp.int32(span[1])
    while first < span[2]:
        k = wp.min(first + warp_lane(), span[2] - 1)
        count = wp.min(span[2] - first, warp_size())
        crossed = wp.where(have_crossed(contacts, k), wp.float64(1.0), wp.float64(0.0))
        length[0] = crossed * measure_length(contacts.p1[k] - contacts.p0[k])
        length[1] = crossed
        sums = add_in_order(sums, length, count)
        first += warp_size()
    if warp_lane() == 0:
        sums_out.span[c] = span
        sums_out.length[c] = sums[0]
        if sums_out.crossed.shape[0] > 0:
            sums_out.crossed[c] = sums[1]


@wp.kernel
def total_length_kernel(start: wp.array(dtype=wp.int32), sums_inout: ChunkSums):
    """Sum the lengths of one object pair's chunks a thread."""
    p = wp.tid()
    total = wp.float64(0.0)
    number = wp.float64(0.0)
    c = first_chunk(p, start)
    end = end_chunk(p, start)
    while c < end:
        total += sums_inout.length[c]
        if sums_inout.crossed.shape[0] > 0:
            number += sums_inout.crossed[c]
        c += 1
    sums_inout.total[p] = total
    if sums_inout.crossed.shape[0] > 0:
        sums_inout.number[p] = number


@wp.func
def count_crossed(p: wp.int32, start: wp.array(dtype=wp.int32), sums: ChunkSums):
    """Return how many contacts of a pair are of faces that intersect."""
    number = wp.float64(start[p + 1] - start[p])
    if sums.number.shape[0] > 0:
        number = sums.number[p]
    return number


@wp.kernel
def sum_mean_kernel(start: wp.array(dtype=wp.int32), contacts: Contacts, sums_inout: ChunkSums):
    """Sum one chunk's points, from the first end of its pair, and normals, weighted by their part of the pair's length.

    Where all lengths vanish all weights are the same.
    """
    c = wp.tid() / warp_size()
    span = sums_inout.span[c]
    if span[1] >= span[2]:
        return
    p = span[0]
    origin = contacts.p0[start[p]]
    half = wp.float64(0.5)
    total = sums_inout.total[p]
    sums = six_numbers()
    first = wp.int32(span[1])
    while first < span[2]:
        k = wp.min(first + warp_lane(), span[2] - 1)
        count = wp.min(span[2] - first, warp_size())
        weight = wp.float64(1.0) / count_crossed(p, start, sums_inout)
        if total != wp.float64(0.0):
            weight = measure_length(contacts.p1[k] - contacts.p0[k]) / total
        if not have_crossed(contacts, k):
            weight = wp.float64(0.0)
        middle = weight * (half * (contacts.p0[k] - origin) + half * (contacts.p1[k] - origin))
        normal = weight * contacts.normal[k]
        both = six_numbers(middle[0], middle[1], middle[2], normal[0], normal[1], normal[2])
        sums = add_in_order(sums, both, count)
        first += warp_size()
    if warp_lane() == 0:
        sums_inout.point[c] = wp.vec3d(sums[0], sums[1], sums[2])
        sums_inout.normal[c] = wp.vec3d(sums[3], sums[4], sums[5])


@wp.func_native(native.body("numbers.cuh", "no_vector"))
def no_vector() -> wp.vec3d:
    """Return three NaNs of the bits 0x7ff8000000000000 on every device."""


@wp.kernel
def average_contact_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    start: wp.array(dtype=wp.int32),
    sums_inout: ChunkSums,
    pair_contacts_out: PairContacts,
):
    """Sum one object pair's chunks a thread to its mean point and normal; NaN for a pair without contacts."""
    p = wp.tid()
    point = wp.vec3d()
    n = no_vector()
    c = first_chunk(p, start)
    end = end_chunk(p, start)
    if count_crossed(p, start, sums_inout) > wp.float64(0.0):
        n = wp.vec3d()
        while c < end:
            point += sums_inout.point[c]
            n += sums_inout.normal[c]
            c += 1
        if measure_length(n) <= SHORTEST_NORMAL:
            n = pair_direction(models, states, objects, pairs[p][0], pairs[p][1])
        n = unit_vector(n)
    sums_inout.middle[p] = point
    pair_contacts_out.normal[p] = n


@wp.func
def box_support(models: ModelPool, states: StatePool, objects: ObjectPool, i: wp.int32, n: wp.vec3d, origin: wp.vec3d):
    """Return how far the root box of a posed object reaches along n from a point, world frame."""
    state = objects.state[i]
    root = load_node(states, states.node_start[state] + 1)
    lower = wp.vec3d(root.lower)
    upper = wp.vec3d(root.upper)
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
    if square < LEAST_SINE_SQUARED:
        return wp.float64(0.0)
    y = wp.dot(n, normal_b) / square
    return y * wp.dot(normal_b - normal_a * cosine, wp.cross(segment, n))


@wp.kernel
def sum_loop_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    pair_contacts: PairContacts,
    sums_inout: ChunkSums,
):
    """Sum what the travel needs of one chunk a warp: area within the contact curve, its change, extents of faces."""
    c = wp.tid() / warp_size()
    span = sums_inout.span[c]
    if span[1] >= span[2]:
        return
    p = span[0]
    n = pair_contacts.normal[p]
    origin = contacts.p0[start[p]]
    own = contact_objects(pairs, pair_poses, p)
    front = -wp.float64(wp.inf)
    back = -wp.float64(wp.inf)
    sums = six_numbers()
    first = wp.int32(span[1])
    while first < span[2]:
        k = wp.min(first + warp_lane(), span[2] - 1)
        count = wp.min(span[2] - first, warp_size())
        a = states.face_corner[pair_poses[p].corner_a + faces[k][1 + own.swapped]]
        b = states.face_corner[pair_poses[p].corner_b + faces[k][2 - own.swapped]]
        for i in range(3):
            corner_a = load_vertex(models.vertex_pos, a[i])
            corner_b = pose_point(
                pair_poses[p].rotation, pair_poses[p].translation, load_vertex(models.vertex_pos, b[i])
            )
            reach_a = wp.dot(n, pose_point(objects.rotation[own.a], objects.position[own.a], corner_a) - origin)
            reach_b = wp.dot(n, pose_point(objects.rotation[own.a], objects.position[own.a], corner_b) - origin)
            # The normal goes from the object that the pair names first.
            if have_crossed(contacts, k):
                front = wp.max(front, wp.where(own.swapped == 0, reach_a, reach_b))
                back = wp.max(back, -wp.where(own.swapped == 0, reach_b, reach_a))
        # About the mean point, since for an open curve the area depends on where it is measured from.
        r = contacts.p0[k] - origin - sums_inout.middle[p]
        s = contacts.p1[k] - contacts.p0[k]
        parts = six_numbers()
        if contacts.coplanar[k] == 0 and have_crossed(contacts, k):
            parts[0] = wp.float64(0.5) * wp.dot(n, wp.cross(r, s))
            parts[1] = loop_change(s, contacts.normal_a[k], contacts.normal_b[k], n)
        sums = add_in_order(sums, parts, count)
        first += warp_size()
    front = warp_max(front)
    back = -warp_max(back)
    if warp_lane() == 0:
        sums_inout.area[c] = sums[0]
        sums_inout.change[c] = sums[1]
        sums_inout.front[c] = front
        sums_inout.back[c] = back


@wp.func
def sum_loop(p: wp.int32, start: wp.array(dtype=wp.int32), sums: ChunkSums):
    """Return area, change, and the overlap of the faces along the normal, of all chunks of a pair."""
    front = -wp.float64(wp.inf)
    back = wp.float64(wp.inf)
    area = wp.float64(0.0)
    change = wp.float64(0.0)
    c = first_chunk(p, start)
    end = end_chunk(p, start)
    while c < end:
        front = wp.max(front, sums.front[c])
        back = wp.min(back, sums.back[c])
        area += sums.area[c]
        change += sums.change[c]
        c += 1
    return area, change, front - back


@wp.kernel
def measure_travel_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    start: wp.array(dtype=wp.int32),
    contacts: Contacts,
    sums: ChunkSums,
    pair_contacts_inout: PairContacts,
):
    """Estimate the travel of one object pair a thread, and pose its mean point; docstring of warp_abtree/contact.py."""
    p = wp.tid()
    first = start[p]
    if count_crossed(p, start, sums) == wp.float64(0.0):
        pair_contacts_inout.point[p] = no_vector()
        pair_contacts_inout.travel[p] = wp.float64(0.0)
        return
    origin = contacts.p0[first]
    n = pair_contacts_inout.normal[p]
    area, change, overlap = sum_loop(p, start, sums)
    travel = box_support(models, states, objects, pairs[p][0], n, origin)
    travel += box_support(models, states, objects, pairs[p][1], -n, origin)
    if area == wp.float64(0.0):
        travel = wp.min(travel, overlap)
    elif area * change < wp.float64(0.0):
        travel = wp.min(travel, -area / change)
    pair_contacts_inout.point[p] = origin + sums.middle[p]
    pair_contacts_inout.travel[p] = wp.max(travel, wp.float64(0.0))
