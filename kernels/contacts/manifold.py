"""Candidate points of contacts: depths behind faces along the normals of their loops, or of the faces."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.contacts.column import COLUMN_CORNERS, NO_DEPTH, FacePair, load_pair
from warp_abtree.kernels.contacts.contact import Contacts, count_contacts
from warp_abtree.kernels.contacts.slots import Slots, WitnessRows, gap_of
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits

wp.set_module_options(native.options("contacts/candidates.cuh", "contacts/crossing_list.h"))

POINTS = wp.constant(8)
"""Points that stand for a pair, unless told otherwise."""

# Depth of candidates that there are not; where all of a pair have NO_DEPTH the middles of its contacts serve.
NO_POINT = wp.constant(wp.float64(wp.nan))


@wp.struct
class Curves:
    """Contact curves of all pairs, world frame; unit normals from the pair's first object to its second."""

    parent: wp.array(dtype=wp.int32)  # union-find forest of contacts, shape [contact]
    loop: wp.array(dtype=wp.int32)  # first contact of its loop, shape [contact]
    loop_normal: wp.array(dtype=wp.vec3d)  # at the first contact of each loop, shape [contact]
    has_area: wp.array(dtype=wp.int32)  # there, 1 where the normal is that of an area, else 0, shape [contact]
    order: wp.array(dtype=wp.int32)  # contacts in the order of their keys, then scratch, shape [2 contact]
    key: wp.array(dtype=wp.int64)  # of a face of B, later of a loop, then scratch, shape [2 contact]


@wp.struct
class Witnesses:
    """Candidate points of all pairs, of the contacts that slots keep, world frame."""

    normal: wp.array(dtype=wp.vec3d)  # unit, from the pair's first object to its second, shape [witness]
    point: wp.array2d(dtype=wp.vec3d)  # [world units], shape [witness, COLUMN_CORNERS]
    depth: wp.array2d(dtype=wp.float64)  # [world units], NO_DEPTH or NO_POINT, shape [witness, COLUMN_CORNERS]
    nearest_only: wp.array(dtype=wp.int32)  # those whose points another face may be nearer to, in any order, [witness]
    nearest_total: wp.array(dtype=wp.int32)  # how many these are, shape [1]
    wrench: wp.array(dtype=wp.vec4)  # see `points`, shape [2 * COLUMN_CORNERS * witness]
    chosen: wp.array2d(dtype=wp.int32)  # wrenches of the points of a pair, shape [pair, points]
    place: wp.array2d(dtype=wp.vec3d)  # where these are [world units], shape [pair, points]


@wp.struct
class Manifolds:
    """Points that stand for each pair, world frame."""

    count: wp.array(dtype=wp.int32)  # points of it, shape [pair]
    point: wp.array2d(dtype=wp.vec3d)  # [world units], shape [pair, points]
    normal: wp.array2d(dtype=wp.vec3d)  # unit, from the pair's first object to its second, shape [pair, points]
    depth: wp.array2d(dtype=wp.float64)  # [world units] along the normal, negative if apart, shape [pair, points]
    before: wp.array2d(dtype=wp.int32)  # place a launch before, -1 if new, shape [pair, points],
    # or [0, 0] where nothing is kept between launches
    witness: wp.array2d(dtype=wp.int32)  # that each is a candidate of, shape [pair, points], or [0, 0] where not kept


@native.func_native()
def offer_crossing(
    trees: Trees,
    pose: PairPose,
    pair: FacePair,
    loop: wp.vec3d,
    has_area: bool,
    gap: wp.float64,
    place: wp.int32,
    p: wp.int32,
    slots: Slots,
):
    """Offer the candidates of a contact of faces that cross to the slots of its object pair p.

    Args:
        loop, has_area: Normal of its loop, and whether it is that of an area.
        gap: How far outside points may be, of faces that look at one another [world units], 0 for not at all.
        place: Of the contact.
    """


@native.func_native()
def find_crossing(
    objects: ObjectPool,
    pair: FacePair,
    loop: wp.vec3d,
    has_area: bool,
    gap: wp.float64,
    scale: wp.float64,
    w: wp.int32,
    witnesses: Witnesses,
) -> bool:
    """Write the normal and the candidates of witness w, as for `offer_crossing`; return whether they have a depth."""


@wp.func
def load_crossing(i: wp.int32, trees: Trees, batch: PairBatch, contacts: Contacts):
    """Return the faces of contact i."""
    faces = contacts.face[i]
    a = wp.min(batch.pairs[faces[0]][0], batch.pairs[faces[0]][1])
    return load_pair(trees, batch.poses[faces[0]], a, faces, contacts.normal_a[i], contacts.normal_b[i])


@wp.kernel(cuda_max_registers=128)
def offer_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    contacts: Contacts,
    curves: Curves,
    slots_inout: Slots,
):
    """Offer the candidates of one contact of faces that cross a thread to the slots of its pair.

    Args:
        gap: Of pairs, as for `offer_crossing`, shape [pair]; [0] for none.
        curves: Contacts in the order of loops.
    """
    if wp.tid() >= count_contacts(contacts):
        return
    i = curves.order[wp.tid()]
    p, root = contacts.face[i][0], curves.loop[i]
    pair, has_area = load_crossing(i, trees, batch, contacts), curves.has_area[root] != 0
    loop, shell = curves.loop_normal[root], gap_of(gap, p)
    offer_crossing(trees, batch.poses[p], pair, loop, has_area, shell, i, p, slots_inout)
    slots_inout.used[p] = 1


@native.func_native(cpu=True)
def simd_offer_crossing(
    trees: Trees,
    pose: PairPose,
    a: wp.int32,
    gap: wp.float64,
    pair: wp.int32,
    span: wp.vec2i,
    contacts: Contacts,
    curves: Curves,
    slots: Slots,
):
    """Offer the contacts of an object pair, as `offer_crossing_kernel`, 8 at a time.

    Args:
        a: Object A.
        span: First contact, and the one behind the last.
    """


@wp.kernel
def offer_pair_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    contacts: Contacts,
    curves: Curves,
    slots_inout: Slots,
):
    """Offer the contacts of one object pair, as `offer_crossing_kernel`; one thread after the other, CPU only."""
    p, start = wp.tid(), contacts.start
    if start[p] < start[p + 1]:
        a, span = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.vec2i(start[p], start[p + 1])
        shell = gap_of(gap, p)
        simd_offer_crossing(trees, batch.poses[p], a, shell, p, span, contacts, curves, slots_inout)
        slots_inout.used[p] = 1


@wp.kernel(cuda_max_registers=216)
def find_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    contacts: Contacts,
    curves: Curves,
    hits: Hits,
    rows: WitnessRows,
    witnesses_out: Witnesses,
):
    """Find the normal and the candidate points of one witness of faces that cross a thread, or that there is none.

    No witness of faces that are apart is listed yet.
    """
    w = wp.tid()
    if w == 0:
        witnesses_out.nearest_total[0] = 0
    if w >= wp.min(hits.witness_total[0], rows.item.shape[0]):
        return
    item = rows.item[w]
    if item[0] < 0:
        for k in range(COLUMN_CORNERS):
            witnesses_out.depth[w, k] = NO_POINT
    if item[0] < 0 or item[0] >= NEAR_BIT:
        return
    i, root = item[1], curves.loop[item[1]]
    pair, has_area = load_crossing(i, trees, batch, contacts), curves.has_area[root] != 0
    loop, shell = curves.loop_normal[root], gap_of(gap, item[0])
    if not find_crossing(trees.objects, pair, loop, has_area, shell, batch.poses[item[0]].scale, w, witnesses_out):
        # The middle and an end are candidates then, which have no depth.
        for k in range(COLUMN_CORNERS):
            witnesses_out.depth[w, k] = wp.where(k < 2, NO_DEPTH, NO_POINT)
        witnesses_out.point[w, 0] = wp.float64(0.5) * (contacts.p0[i] + contacts.p1[i])
        witnesses_out.point[w, 1] = contacts.p1[i]
