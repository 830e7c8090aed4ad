"""One summary an object pair of its sorted contacts, in sums of a fixed shape.

A chunk is CHUNK contacts of one pair, the pair's last one shorter. One warp a chunk sums its contacts in their order;
what it needs of the whole pair it sums itself, of the pair's chunks in theirs, so that no bit depends on the device or
on the order in which threads run. With a gap contacts of faces that are apart count nothing. The CPU sums a pair after
the other (`sum_pair_kernel`).
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees, no_vector
from warp_abtree.kernels.base.lanes import warp_lane, warp_size
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.base.sums import add_in_order, six_numbers
from warp_abtree.kernels.contacts.contact import (
    SHORTEST_NORMAL,
    Contacts,
    have_crossed,
    pair_direction,
)
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options(native.options("base/lanes.cuh", "base/sums.cuh", "contacts/contact_sums.h"))

# Contacts of one object pair that are summed together, in places that its first contact tells.
CHUNK = native.constant("CHUNK")


@wp.func
def first_chunk(p: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return the place of a pair's first chunk: each pair before has at most one chunk more than whole ones fit."""
    return start[p] // CHUNK + p


@wp.func
def chunk_span(p: wp.int32, c: wp.int32, start: wp.array(dtype=wp.int32)):
    """Return (pair, first contact, end) of a chunk from its pair's first on; behind its last, the end is the first."""
    first = start[p] + (c - first_chunk(p, start)) * CHUNK
    return wp.vec3i(p, first, wp.max(first, wp.min(first + CHUNK, start[p + 1])))


@wp.kernel
def locate_chunk_kernel(start: wp.array(dtype=wp.int32), span_out: wp.array(dtype=wp.vec3i)):
    """Locate one chunk a thread: find its pair."""
    c = wp.tid()
    low = wp.int32(0)
    high = start.shape[0] - 1
    while high - low > 1:  # the pair is one of low .. high - 1
        middle = (low + high) // 2
        if first_chunk(middle, start) <= c:
            low = middle
        else:
            high = middle
    span_out[c] = chunk_span(low, c, start)


@wp.struct
class PairContacts:
    """One entry an object pair, world frame."""

    point: wp.array(dtype=wp.vec3d)  # mean point [world units]
    normal: wp.array(dtype=wp.vec3d)  # unit mean normal


@wp.struct
class ChunkSums:
    """Sums over each chunk."""

    span: wp.array(dtype=wp.vec3i)  # (pair, first contact, end), shape [chunk]; nothing behind the last pair's
    lengths: wp.array(dtype=six_numbers)  # length, and number of contacts whose faces intersect; shape [chunk]
    means: wp.array(dtype=six_numbers)  # weighted points, from the pair's first end, and normals; shape [chunk]


@wp.func
def sum_chunks(p: wp.int32, start: wp.array(dtype=wp.int32), numbers: wp.array(dtype=six_numbers)):
    """Return the sums over the chunks of a pair, by all lanes of a warp."""
    all = six_numbers()
    c = first_chunk(p, start)
    end = c + (start[p + 1] - start[p] + CHUNK - 1) // CHUNK
    while c < end:
        k = wp.min(c + warp_lane(), end - 1)
        all = add_in_order(all, numbers[k], wp.min(end - c, warp_size()))
        c += warp_size()
    return all


@wp.kernel
def sum_length_kernel(contacts: Contacts, sums_inout: ChunkSums):
    """Sum the lengths of the contacts of one chunk a warp."""
    c, start = wp.tid() / warp_size(), contacts.start
    if c >= first_chunk(start.shape[0] - 1, start):
        return
    span = sums_inout.span[c]
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
        sums_inout.lengths[c] = sums


@wp.kernel
def sum_mean_kernel(contacts: Contacts, sums_inout: ChunkSums):
    """Sum one chunk's points, from the first end of its pair, and normals, weighted by their part of the pair's length.

    Where all lengths vanish all weights are the same.
    """
    c, start = wp.tid() / warp_size(), contacts.start
    if c >= first_chunk(start.shape[0] - 1, start):
        return
    span = sums_inout.span[c]
    if span[1] >= span[2]:
        return
    p = span[0]
    origin = contacts.p0[start[p]]
    half = wp.float64(0.5)
    lengths = sum_chunks(p, start, sums_inout.lengths)
    total, number = lengths[0], lengths[1]
    sums = six_numbers()
    first = wp.int32(span[1])
    while first < span[2]:
        k = wp.min(first + warp_lane(), span[2] - 1)
        count = wp.min(span[2] - first, warp_size())
        weight = wp.float64(1.0) / number
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
        sums_inout.means[c] = sums


@wp.func
def mean_normal(trees: Trees, pair: wp.vec2i, sum: wp.vec3d):
    """Return the unit normal of a sum of weighted normals; where it is short, the direction between the models."""
    n = sum
    if measure_length(n) <= SHORTEST_NORMAL:
        n = pair_direction(trees, pair[0], pair[1])
    return unit_vector(n)


@wp.kernel
def average_contacts_kernel(
    trees: Trees,
    batch: PairBatch,
    contacts: Contacts,
    sums: ChunkSums,
    pair_contacts_out: PairContacts,
):
    """Find the mean point and normal of one object pair a warp."""
    p, start = wp.tid() / warp_size(), contacts.start
    lengths = sum_chunks(p, start, sums.lengths)
    if lengths[1] == wp.float64(0.0):
        if warp_lane() == 0:
            pair_contacts_out.normal[p] = no_vector()
            pair_contacts_out.point[p] = no_vector()
        return
    means = sum_chunks(p, start, sums.means)
    if warp_lane() == 0:
        pair_contacts_out.normal[p] = mean_normal(trees, batch.pairs[p], wp.vec3d(means[3], means[4], means[5]))
        pair_contacts_out.point[p] = contacts.p0[start[p]] + wp.vec3d(means[0], means[1], means[2])


@native.func_native(cpu=True)
def simd_sum_lengths(contacts: Contacts, ends: wp.vec2i, total: wp.ref[wp.float64], number: wp.ref[wp.float64]):
    """Find the length of an object pair's contacts, and how many are of faces that intersect, as `sum_chunks`."""


@native.func_native(cpu=True)
def simd_sum_means(
    contacts: Contacts,
    ends: wp.vec2i,
    total: wp.float64,
    number: wp.float64,
    middle: wp.ref[wp.vec3d],
    normal: wp.ref[wp.vec3d],
):
    """Find the mean point of a pair's contacts, from the first end, and the mean of normals, as `sum_chunks`."""


@wp.kernel
def sum_pair_kernel(trees: Trees, batch: PairBatch, contacts: Contacts, pair_contacts_out: PairContacts):
    """Sum the contacts of one object pair a thread, as the kernels above do; CPU only."""
    p = wp.tid()
    ends = wp.vec2i(contacts.start[p], contacts.start[p + 1])
    total, number = wp.float64(0.0), wp.float64(0.0)
    simd_sum_lengths(contacts, ends, total, number)
    if number == wp.float64(0.0):
        pair_contacts_out.normal[p] = no_vector()
        pair_contacts_out.point[p] = no_vector()
        return
    middle, normal = wp.vec3d(), wp.vec3d()
    simd_sum_means(contacts, ends, total, number, middle, normal)
    pair_contacts_out.normal[p] = mean_normal(trees, batch.pairs[p], normal)
    pair_contacts_out.point[p] = contacts.p0[ends[0]] + middle
