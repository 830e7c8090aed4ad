"""Candidate points of faces that are apart: gaps along face normals that face each other, else nearest points.

Speculative points must not stop what merely slides past: two faces of a floor meet ahead of a box, and the edge between
them is nearer to the side of the box than anything else of the second face. And a face behind another one may be
inside, or beyond a thin wall. In either case points count only where no other face of either object is nearer there
(`inside.nearest_contacts`).
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.counters import reserve_slot
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.contact import Contacts, Deferred, have_crossed
from warp_abtree.kernels.contacts.manifold import (
    CLIPPED_CORNERS,
    COLUMN_CORNERS,
    NO_DEPTH,
    NO_POINT,
    Curves,
    Rows,
    measure_column,
    write_candidates,
)
from warp_abtree.kernels.triangle.corners import load_corners
from warp_abtree.kernels.triangle.distance import largest_coordinate

wp.set_module_options(native.options("base/counters.cuh"))

# A face's normal serves where the other face looks against it within 60 degrees.
OPPOSED_LEAST = wp.constant(wp.float64(0.5))
# Part of the distance that the gap along a face's normal differs by, where that is the direction of the distance.
ALIKE = wp.constant(wp.float64(2.0**-10))
# Cosine between a face's normal and the direction of the distance under which the gap differs by more than `ALIKE`.
ALONG = wp.constant(wp.float64(0.998))
# In place of the loop of a contact whose candidates count only if no other face is nearer.
NEAREST_ONLY = wp.constant(wp.int32(-1))
# Part of the size of faces that a gap along a normal errs by.
COLUMN_ROUNDING = wp.constant(wp.float64(2.0**-46))


@wp.func
def write_nearest_points(
    i: wp.int32, objects: ObjectPool, a: wp.int32, pose: PairPose, contacts: Contacts, curves: Curves
):
    """Write the middle of the nearest points of a contact as its candidate, where both faces look at one another.

    Args:
        a: Object in whose frame the pose is.
    """
    rotation, position = objects.rotation[a], objects.position[a]
    back = wp.transpose(rotation)
    n = contacts.normal[i]
    ahead = wp.dot(n, contacts.normal_a[i]) > wp.float64(0.0) and wp.dot(n, contacts.normal_b[i]) < wp.float64(0.0)
    for k in range(COLUMN_CORNERS):
        curves.depth[i, k] = NO_POINT
    curves.normal[i] = n
    curves.loop[i] = i
    if ahead:
        curves.loop[i] = NEAREST_ONLY
        first = back * (contacts.p0[i] - position) * pose.scale
        middle = (first + back * (contacts.p1[i] - position) * pose.scale) * (wp.float64(0.5) / pose.scale)
        curves.depth[i, 0] = -contacts.separation[i]
        curves.point[i, 0] = pose_point(rotation, position, middle)


@wp.kernel
def find_near_candidate_kernel(
    objects: ObjectPool, batch: PairBatch, rows: Rows, contacts: Contacts, facing_inout: Deferred, curves_inout: Curves
):
    """Find the candidate of one contact of faces that are apart a thread: their nearest points; or list it.

    Where both faces look at one another and the distance may be along the normal of either, it is listed. A gap along
    a normal is that of two points of faces, which are convex: points farther apart than the nearest by a fraction e at
    most are so in a direction whose cosine with that of the distance is at least 1 / (1 + e).
    """
    i = wp.tid()
    listed = bool(False)
    apart = i < rows.start[rows.start.shape[0] - 1]
    if apart:
        apart = not have_crossed(contacts, i)
    if apart:
        n, normal_a, normal_b = contacts.normal[i], contacts.normal_a[i], contacts.normal_b[i]
        along = wp.max(wp.abs(wp.dot(n, normal_a)), wp.abs(wp.dot(n, normal_b)))
        listed = -wp.dot(normal_a, normal_b) >= OPPOSED_LEAST and along >= ALONG
        if not listed:
            p = rows.faces[i][0]
            a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
            write_nearest_points(i, objects, a, batch.poses[p], contacts, curves_inout)
    slot = reserve_slot(facing_inout.total, listed)
    if listed:
        facing_inout.place[slot] = i


@wp.func
def faces_size(corner: wp.array(dtype=wp.vec3d)):
    """Return the largest coordinate, in magnitude, of the differences of two faces' corners from the first."""
    size = wp.float64(0.0)
    for k in range(5):
        size = wp.max(size, largest_coordinate(corner[k + 1] - corner[0]))
    return size


@wp.kernel
def find_facing_candidate_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    rows: Rows,
    contacts: Contacts,
    facing: Deferred,
    curves_inout: Curves,
):
    """Find the normal and the candidate points of one listed contact of faces that are apart a thread.

    Along the normal of either face, whichever leaves the wider gap, if that is the distance; else the nearest points,
    where both faces look at one another. A face that lies behind the other one's plane is inside, as deep as it is far.

    Args:
        gap: Under which face pairs are near [world units], shape [pair].
    """
    k = wp.tid()
    if k >= facing.total[0]:
        return
    i = facing.place[k]
    own = rows.faces[i]
    p = own[0]
    pose = batch.poses[p]
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    rotation = trees.objects.rotation[a]
    back = wp.transpose(rotation)
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, pose, own[1 + pose.swapped], own[2 - pose.swapped], corner)
    point = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    depth = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.float64)
    normal_a, normal_b = back * contacts.normal_a[i], back * contacts.normal_b[i]
    first, least, separation = 3 * pose.swapped, -gap[p], contacts.separation[i]
    slack = wp.max(ALIKE * separation, COLUMN_ROUNDING * faces_size(corner))
    best = measure_column(corner, -normal_b, normal_a, normal_b, first, least, point, depth)
    # A gap wider than the distance stays so whatever the other normal says.
    if best.depth == NO_DEPTH or -best.depth - separation <= slack:
        other = measure_column(corner, normal_a, normal_a, normal_b, first, least, point, depth)
        if best.depth > NO_DEPTH and (other.depth == NO_DEPTH or best.depth < other.depth):
            best = measure_column(corner, -normal_b, normal_a, normal_b, first, least, point, depth)
        else:
            best = other
    if wp.abs(wp.abs(best.depth) - separation) <= slack:
        curves_inout.loop[i] = wp.where(best.depth > slack, NEAREST_ONLY, i)
        write_candidates(i, rotation, trees.objects.position[a], best, least, point, depth, curves_inout)
    else:
        write_nearest_points(i, trees.objects, a, pose, contacts, curves_inout)
