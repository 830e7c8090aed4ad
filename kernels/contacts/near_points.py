"""Candidate points of faces that are apart: gaps along face normals that face each other, else nearest points.

Speculative points must not stop what merely slides past: two faces of a floor meet ahead of a box, and the edge between
them is nearer to the side of the box than anything else of the second face. And a face behind another one may be
inside, or beyond a thin wall. In either case points count only where no other face of either object is nearer there
(`inside.nearest_contacts`).
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.counters import take_slots
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.column import COLUMN_CORNERS, FacePair, load_pair
from warp_abtree.kernels.contacts.contact import Contacts, PairObjects, contact_objects
from warp_abtree.kernels.contacts.manifold import NO_POINT, Witnesses
from warp_abtree.kernels.contacts.separation import write_near_contact
from warp_abtree.kernels.contacts.slots import WitnessRows, tree_size
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, PAIR_MASK, Hits

wp.set_module_options(
    native.options("base/counters.cuh", "contacts/candidates.cuh", "exact/double_word.cuh", "triangle/gap.cuh")
)

# A face's normal serves where the other face looks against it within 60 degrees.
OPPOSED_LEAST = wp.constant(wp.float64(0.5))
# Cosine under which normals differ by more than rounding, and the gap along one from the distance by a part.
ALONG = wp.constant(wp.float64(0.998))

# Distance and depth, at unit size, under which faces touch.
NO_DISTANCE = wp.constant(wp.float64(2.0**-30))
# Cosine between the direction of a distance and a face's normal from which on the face does not look away from it; one
# that is closer to the plane of one face of an edge is far from that of the other.
LEAST_AHEAD = wp.constant(wp.float64(2.0**-10))


@native.func_native()
def touching_faces(objects: ObjectPool, pair: FacePair, scale: wp.float64) -> wp.int32:
    """Return 1 where the second face lies in front of the first one, plus 2 where the first lies in front of it."""


@native.func_native()
def find_along_edges(
    objects: ObjectPool, pair: FacePair, way: wp.vec3d, separation: wp.float64, w: wp.int32, witnesses: Witnesses
) -> bool:
    """Write the ends of what two edges share as candidates, where they are parallel; return whether they are.

    Args:
        way: Direction of the distance.
    """


@wp.func
def which_touches(w: wp.int32, trees: Trees, own: PairObjects, pose: PairPose, pair: FacePair, near: Contacts):
    """Return which face of a contact touches the other one, which lies in front of it: 1, the first, 2, or 0.

    That of the larger object where both do, as edges beside one another; neither in one plane, or where they are apart.
    """
    touching = wp.int32(0)
    if near.separation[w] * pose.scale < NO_DISTANCE:
        touching = touching_faces(trees.objects, pair, pose.scale)
        if touching == 3:
            size_a, size_b = tree_size(trees, trees.objects.state[own.a]), tree_size(trees, trees.objects.state[own.b])
            touching = wp.where((size_a >= size_b) == (pose.swapped == 0), 1, 2)
            if -wp.dot(near.normal_a[w], near.normal_b[w]) >= ALONG:
                touching = wp.int32(0)
    return touching


@wp.func
def write_nearest_points(
    w: wp.int32,
    objects: ObjectPool,
    pair: FacePair,
    pose: PairPose,
    touching: wp.int32,
    contacts: Contacts,
    witnesses: Witnesses,
):
    """Write the middle of the nearest points of a contact as its candidate, where both faces look at one another.

    Of parallel edges, both ends of what they share. The normal is the direction of the distance; where faces touch,
    that of the face that has the other in front. Returns whether both look at one another.

    Args:
        touching: As `which_touches`.
    """
    rotation, position = objects.rotation[pair.object], objects.position[pair.object]
    back = wp.transpose(rotation)
    n = wp.vec3d(contacts.normal[w])
    if touching == 1 and wp.dot(n, contacts.normal_a[w]) < ALONG:
        n = contacts.normal_a[w]
    if touching == 2 and -wp.dot(n, contacts.normal_b[w]) < ALONG:
        n = -contacts.normal_b[w]
    ahead = wp.dot(n, contacts.normal_a[w]) > LEAST_AHEAD and wp.dot(n, contacts.normal_b[w]) < -LEAST_AHEAD
    shared = bool(False)
    witnesses.normal[w] = n
    if ahead:
        shared = find_along_edges(objects, pair, n, contacts.separation[w], w, witnesses)
    if not shared:
        for k in range(COLUMN_CORNERS):
            witnesses.depth[w, k] = NO_POINT
    if ahead and not shared:
        first = back * (contacts.p0[w] - position) * pose.scale
        middle = (first + back * (contacts.p1[w] - position) * pose.scale) * (wp.float64(0.5) / pose.scale)
        witnesses.depth[w, 0] = -contacts.separation[w]
        witnesses.point[w, 0] = pose_point(rotation, position, middle)
    return ahead


@native.func_native()
def find_facing(
    objects: ObjectPool,
    pair: FacePair,
    gap: wp.float64,
    separation: wp.float64,
    side: wp.int32,
    w: wp.int32,
    witnesses: Witnesses,
) -> wp.int32:
    """Write the corners of the column of faces that look at one another as candidates; return 0 if they don't serve.

    Along the normal of either face, whichever leaves the wider gap, if that is the distance. A face that lies behind
    the other one's plane is inside, as deep as it is far; then 2 is returned, else 1.

    Args:
        side: 1 or 2 for the normal of the first face or of the second alone: that of a face that an edge or a corner
            of the other one stands over, or touches.
    """


@wp.kernel(cuda_max_registers=168)
def find_near_witness_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    hits: Hits,
    rows: WitnessRows,
    contacts_out: Contacts,
    witnesses_out: Witnesses,
):
    """Find the contact of one witness of faces that are apart a thread, its normal and its candidate points.

    Where both faces look at one another and the distance may be along the normal of either, corners of columns. Where
    an edge or a corner of one stands over the other, or on it, along the normal of that, corners of its column. Else
    the nearest points, where neither face looks away from the other. A gap along a normal is that of two points of
    faces, which are convex: points farther apart than the nearest by a fraction e at most are so in a direction whose
    cosine with that of the distance is at least 1 / (1 + e).

    Args:
        gap: Under which face pairs are near [world units], shape [pair]; those that are not have no candidates.
    """
    w = wp.tid()
    if w >= wp.min(hits.witness_total[0], rows.item.shape[0]):
        return
    item = rows.item[w]
    if item[0] < NEAR_BIT:
        return
    p = item[0] & PAIR_MASK
    pose = batch.poses[p]
    own = contact_objects(batch, p)
    write_near_contact(w, trees, own, pose, item, contacts_out)
    n, normal_a, normal_b = contacts_out.normal[w], contacts_out.normal_a[w], contacts_out.normal_b[w]
    # Of what touches rounding may tell the direction.
    served, nearest_only, touch = wp.int32(0), bool(False), contacts_out.separation[w] * pose.scale < NO_DISTANCE
    pair = load_pair(trees, pose, own.a, item, normal_a, normal_b)
    touching = which_touches(w, trees, own, pose, pair, contacts_out)
    if contacts_out.separation[w] >= gap[p]:
        for k in range(COLUMN_CORNERS):
            witnesses_out.depth[w, k] = NO_POINT
        served = wp.int32(1)
    else:
        opposed, separation = -wp.dot(normal_a, normal_b), contacts_out.separation[w]
        ahead_a, ahead_b = wp.dot(n, normal_a), -wp.dot(n, normal_b)
        facing = opposed >= OPPOSED_LEAST and (wp.max(wp.abs(ahead_a), wp.abs(ahead_b)) >= ALONG or touch)
        side = wp.int32(touching)
        if not touch and (ahead_a >= ALONG) != (ahead_b >= ALONG):
            side = wp.where(ahead_a >= ALONG, 1, 2)
        k, last = wp.where(facing, 0, 1), wp.where(side != 0 and opposed > LEAST_AHEAD, 1, 0)
        while k <= last and served == 0:
            served = find_facing(
                trees.objects, pair, gap[p], separation, wp.where(k == 0, touching, side), w, witnesses_out
            )
            nearest_only = served == 2 or (served == 1 and k == 1 and not touch)
            k += 1
    if served == 0:
        nearest_only = write_nearest_points(w, trees.objects, pair, pose, touching, contacts_out, witnesses_out)
    if nearest_only:
        witnesses_out.nearest_only[take_slots(witnesses_out.nearest_total, 1)] = w
