"""Contact loops of an object pair, joined by union-find, and their normals.

A loop is a set of contacts that faces link: two contacts of a pair that share a face of either object are of one loop,
unless the other faces are of two walls that face each other, as of a slot that the face spans.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import LAST_KEY, Trees
from warp_abtree.kernels.base.lanes import count_lanes, first_lane, warp_lane, warp_size
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.base.sums import add_in_order, six_numbers
from warp_abtree.kernels.contacts.contact import Contacts, count_contacts, pair_direction
from warp_abtree.kernels.contacts.manifold import Curves
from warp_abtree.kernels.triangle.distance import largest_coordinate
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options(native.options("base/lanes.cuh", "base/sums.cuh", "io/sort_by_pair.h"))

# Areas of a loop, relative to its length squared, that have no direction worth the name.
LEAST_LOOP_AREA = wp.constant(wp.float64(2.0**-20))
# Lengths of a loop, relative to its coordinates, of which rounding tells the area.
LEAST_LOOP_LENGTH = wp.constant(wp.float64(2.0**-42))


@wp.func
def find_root(parent: wp.array(dtype=wp.int32), i: wp.int32):
    """Return the root of a union-find set, with path halving: concurrent unions make long paths."""
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
    """Union of two sets; the root of a set is its least member, whatever the order of unions."""
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
    """Return whether two contacts of a face belong to opposite walls, which push it in opposite directions.

    Args:
        normal: Outward normals of the walls, `Contacts.normal_a` or `normal_b`.
    """
    zero = wp.float64(0.0)
    between = (contacts.p0[j] + contacts.p1[j]) - (contacts.p0[i] + contacts.p1[i])
    opposed = wp.dot(normal[i], normal[j]) < zero
    return opposed and wp.dot(between, normal[i]) > zero and wp.dot(between, normal[j]) < zero


@wp.kernel
def begin_loop_kernel(width: wp.int32, contacts: Contacts, curves_out: Curves):
    """Make each contact a loop of its own, with a key that brings contacts of one face of B together.

    Args:
        width: Bits that a face takes in a key, below its pair.
    """
    i = wp.tid()
    curves_out.order[i] = i
    curves_out.key[i] = LAST_KEY
    if i < count_contacts(contacts):
        curves_out.parent[i] = i
        curves_out.key[i] = (wp.int64(contacts.face[i][0]) << wp.int64(width)) | wp.int64(contacts.face[i][2])


@native.func_native(cpu=True)
def sort_span(first: wp.int32, last: wp.int32, key: wp.array(dtype=wp.int64), order: wp.array(dtype=wp.int32)):
    """Sort a span of keys that differ in their low 31 bits alone, equal ones as they are, and numbers with them."""


@wp.kernel
def sort_loop_kernel(contacts: Contacts, curves_inout: Curves):
    """Sort the contacts of one object pair by their keys, one thread after the other, CPU only."""
    p, start = wp.tid(), contacts.start
    if start[p] < start[p + 1]:
        sort_span(start[p], start[p + 1], curves_inout.key, curves_inout.order)


@wp.kernel
def link_loop_kernel(contacts: Contacts, curves_inout: Curves):
    """Unite each contact with the next of its face that is not across a gap, for faces of either object."""
    i, last, faces = wp.tid(), count_contacts(contacts), contacts.face
    order, key = curves_inout.order, curves_inout.key
    if i + 1 >= last:
        return
    j = i + 1
    while j < last and faces[j][0] == faces[i][0] and faces[j][1] == faces[i][1]:
        if not are_across(contacts, contacts.normal_b, i, j):
            unite_roots(curves_inout.parent, i, j)
            j = last
        j += 1
    k = order[i]
    j = i + 1
    while j < last and key[j] == key[i]:
        if not are_across(contacts, contacts.normal_a, k, order[j]):
            unite_roots(curves_inout.parent, k, order[j])
            j = last
        j += 1


@wp.kernel
def name_loop_kernel(contacts: Contacts, curves_inout: Curves):
    """Name the loop of each contact by its first, as the key that brings loops together."""
    i = wp.tid()
    curves_inout.order[i] = i
    curves_inout.key[i] = LAST_KEY
    if i < count_contacts(contacts):
        root = find_root(curves_inout.parent, i)
        curves_inout.loop[i] = root
        curves_inout.key[i] = wp.int64(root)


@wp.struct
class LoopSums:
    """Sums over the contacts of a loop, about its first point."""

    total: wp.float64  # length of those that are not coplanar
    gap: wp.vec3d  # from end to end of the same
    middle: wp.vec3d  # their middles times their lengths
    area: wp.vec3d  # vector area of the cone over them
    mean: wp.vec3d  # normals of all times their lengths
    plain: wp.vec3d  # normals of all


@wp.func
def six_of(x: wp.vec3d, y: wp.vec3d):
    return six_numbers(x[0], x[1], x[2], y[0], y[1], y[2])


@wp.func
def sum_loop(
    first: wp.int32, last: wp.int32, contacts: Contacts, order: wp.array(dtype=wp.int32), loop: wp.array(dtype=wp.int32)
):
    """Sum the contacts of a loop in their order, by all lanes of a warp; the loop is that of contact order[first]."""
    zero, half = wp.float64(0.0), wp.float64(0.5)
    root = order[first]
    origin = contacts.p0[root]
    normals, ends, areas = six_numbers(), six_numbers(), six_numbers()
    at, count = wp.int32(first), warp_size()
    while count == warp_size():
        k = at + warp_lane()
        i = order[wp.min(k, last - 1)]
        belongs = k < last
        if belongs:
            belongs = loop[i] == root
        along = contacts.p1[i] - contacts.p0[i]
        length = measure_length(along)
        mean, plain = length * contacts.normal[i], contacts.normal[i]
        middle = (length * half) * ((contacts.p0[i] - origin) + (contacts.p1[i] - origin))
        area = half * wp.cross(contacts.p0[i] - origin, along)
        if contacts.coplanar[i] != 0:
            length, along, middle, area = zero, wp.vec3d(), wp.vec3d(), wp.vec3d()
        count = count_lanes(belongs)
        normals = add_in_order(normals, six_of(mean, plain), count)
        ends = add_in_order(ends, six_of(along, middle), count)
        areas = add_in_order(areas, six_numbers(area[0], area[1], area[2], length, zero, zero), count)
        at += count
    sums = LoopSums()
    sums.mean = wp.vec3d(normals[0], normals[1], normals[2])
    sums.plain = wp.vec3d(normals[3], normals[4], normals[5])
    sums.gap = wp.vec3d(ends[0], ends[1], ends[2])
    sums.middle = wp.vec3d(ends[3], ends[4], ends[5])
    sums.area = wp.vec3d(areas[0], areas[1], areas[2])
    sums.total = areas[3]
    return sums


@wp.kernel
def average_loop_kernel(trees: Trees, batch: PairBatch, contacts: Contacts, curves_inout: Curves):
    """Find the normals of loops, by the warp of their first contact: the direction of the area within the curve.

    Moving an object by dx changes the volume that closed surfaces share by the vector area of the curve times dx, so
    this is the direction that frees them soonest. An open or empty curve, or one too short for its coordinates, takes
    the mean of its contacts' normals.
    """
    k, last, order, faces = wp.tid(), count_contacts(contacts), curves_inout.order, contacts.face
    begins = k < last
    if begins:
        begins = curves_inout.loop[order[k]] == order[k]
    lane = first_lane(begins)
    while lane < warp_size():
        first = k - warp_lane() + lane
        sums = sum_loop(first, last, contacts, order, curves_inout.loop)
        n = sums.area
        if sums.total > wp.float64(0.0):
            # About the mean point, since for an open curve the area depends on where it is measured from.
            about = wp.cross(sums.middle / sums.total, sums.gap)
            n = (sums.area - wp.float64(0.5) * about) / (sums.total * sums.total)
        root = order[first]
        far = wp.float64(1.0) / batch.poses[faces[root][0]].scale + largest_coordinate(contacts.p0[root])
        has_area = wp.where(measure_length(n) > LEAST_LOOP_AREA and sums.total > LEAST_LOOP_LENGTH * far, 1, 0)
        if has_area == 0:
            n = sums.mean
            if measure_length(sums.mean) <= LEAST_LOOP_AREA * sums.total:
                n = sums.plain
            if measure_length(sums.plain) <= LEAST_LOOP_AREA:
                p = faces[root][0]
                n = pair_direction(trees, batch.pairs[p][0], batch.pairs[p][1])
        begins = begins and warp_lane() != lane
        if warp_lane() == 0:
            curves_inout.loop_normal[root] = unit_vector(n)
            curves_inout.has_area[root] = has_area
        lane = first_lane(begins)
