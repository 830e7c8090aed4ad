"""Candidate points of faces that are apart: where their own normals say how far, or where two surfaces are nearest.

Speculative points must not stop what merely slides past: two faces of a floor meet ahead of a box, and the edge between
them is nearer to the side of the box than anything else of the second face. And a face behind another one may be
inside, or beyond a thin wall. In either case points count only where no other face of either object is nearer there.
"""

import warp as wp

from warp_abtree.kernels.arrays import ModelPool, ObjectPool, StatePool
from warp_abtree.kernels.contact.contact import Contacts, have_crossed, load_corners
from warp_abtree.kernels.contact.manifold import NO_DEPTH, NO_POINT, Curves, measure_column, write_candidates
from warp_abtree.kernels.poses import PairPose
from warp_abtree.kernels.triangle.segment import nearest_on_triangle

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# A face's normal serves where the other face looks against it within 60 degrees.
FACING = wp.constant(wp.float64(0.5))
# Part of the distance that the gap along a face's normal differs by, where that is the direction of the distance.
ALIKE = wp.constant(wp.float64(2.0**-10))
# Part of a squared distance under which another face is nearer.
NEARER = wp.constant(wp.float64(0.998))


@wp.struct
class Rows:
    """Contacts of all pairs in two orders."""

    start: wp.array(dtype=wp.int32)  # where those of each pair start, shape [pair + 1]
    faces: wp.array(dtype=wp.vec3i)  # pair and faces, in the order of the first object's faces, shape [contact]
    order: wp.array(dtype=wp.int32)  # contacts in the order of the second object's faces, shape [contact]
    key: wp.array(dtype=wp.int64)  # pair and face of each in that order, shape [contact]


@wp.struct
class NearRow:
    """A contact of faces that are apart, in A's frame and the order of the pair."""

    first: wp.vec3d  # nearest point of the first object's face [scaled]
    second: wp.vec3d  # of the second's
    square: wp.float64  # of their distance, under which another face is nearer
    swapped: wp.int32  # 1 where the pair names B first


@wp.func
def make_row(pose: PairPose, back: wp.mat33d, position: wp.vec3d, p0: wp.vec3d, p1: wp.vec3d):
    row = NearRow()
    row.first = back * (p0 - position) * pose.scale
    row.second = back * (p1 - position) * pose.scale
    row.square = NEARER * wp.dot(row.second - row.first, row.second - row.first)
    row.swapped = pose.swapped
    return row


@wp.func
def is_nearer(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    row: NearRow,
    faces: wp.vec3i,
    of_first: bool,
    corner: wp.array(dtype=wp.vec3d),
):
    """Return whether the first object's face of another contact is nearer to `second`, or the second's to `first`."""
    load_corners(models, states, pose, faces[1 + row.swapped], faces[2 - row.swapped], corner)
    base = wp.where(of_first, 3 * row.swapped, 3 - 3 * row.swapped)
    point = wp.where(of_first, row.second, row.first)
    v = nearest_on_triangle(pose.scale, base, corner, point) - point
    return wp.dot(v, v) < row.square


@wp.func
def are_surfaces_nearest(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    row: NearRow,
    i: wp.int32,
    rows: Rows,
    corner: wp.array(dtype=wp.vec3d),
):
    """Return whether no face in contact with either face of contact i is nearer to its points than they are."""
    own = rows.faces[i]
    count = rows.start[rows.start.shape[0] - 1]
    j = i - 1
    while j >= 0 and rows.faces[j][0] == own[0] and rows.faces[j][1] == own[1]:
        if is_nearer(models, states, pose, row, rows.faces[j], False, corner):
            return False
        j -= 1
    j = i + 1
    while j < count and rows.faces[j][0] == own[0] and rows.faces[j][1] == own[1]:
        if is_nearer(models, states, pose, row, rows.faces[j], False, corner):
            return False
        j += 1
    wanted = (wp.int64(own[0]) << wp.int64(31)) | wp.int64(own[2])
    j = wp.lower_bound(rows.key, 0, count, wanted)
    while j < count and rows.key[j] == wanted:
        if is_nearer(models, states, pose, row, rows.faces[rows.order[j]], True, corner):
            return False
        j += 1
    return True


@wp.kernel
def find_near_candidate_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    gap: wp.array(dtype=wp.float64),
    rows: Rows,
    contacts: Contacts,
    curves_inout: Curves,
):
    """Find the normal and two candidate points of one contact of faces that are apart a thread.

    Along the normal of either face, whichever leaves the wider gap, if that is the distance; else the nearest points,
    where both faces look at one another. A face that lies behind the other one's plane is inside, as deep as it is far.

    Args:
        gap: Under which face pairs are near [world units], shape [pair].
    """
    i = wp.tid()
    if i >= rows.start[rows.start.shape[0] - 1] or have_crossed(contacts, i):
        return
    own = rows.faces[i]
    p = own[0]
    pose = pair_poses[p]
    a = wp.min(pairs[p][0], pairs[p][1])
    rotation, position = objects.rotation[a], objects.position[a]
    back = wp.transpose(rotation)
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(models, states, pose, own[1 + pose.swapped], own[2 - pose.swapped], corner)
    normal_a, normal_b = back * contacts.normal_a[i], back * contacts.normal_b[i]
    first = 3 * pose.swapped
    n = back * contacts.normal[i]
    depth, other = NO_DEPTH, NO_DEPTH
    point, second = wp.vec3d(), wp.vec3d()
    if -wp.dot(normal_a, normal_b) >= FACING:
        depth, point, other, second = measure_column(corner, normal_a, normal_a, normal_b, first, -gap[p])
        d, x, e, y = measure_column(corner, -normal_b, normal_a, normal_b, first, -gap[p])
        if d > NO_DEPTH and (depth == NO_DEPTH or d < depth):
            n, depth, point, other, second = -normal_b, d, x, e, y
        elif depth > NO_DEPTH:
            n = normal_a
    row = make_row(pose, back, position, contacts.p0[i], contacts.p1[i])
    nearest = bool(True)
    if not (wp.abs(wp.abs(depth) - contacts.separation[i]) <= ALIKE * contacts.separation[i]):
        n = back * contacts.normal[i]
        depth, other = -contacts.separation[i], NO_POINT
        point = (row.first + row.second) * (wp.float64(0.5) / pose.scale)
        nearest = wp.dot(n, normal_a) > wp.float64(0.0) and wp.dot(n, normal_b) < wp.float64(0.0)
    if nearest and (depth > wp.float64(0.0) or other != other):
        nearest = are_surfaces_nearest(models, states, pose, row, i, rows, corner)
    if not nearest:
        depth, other = NO_POINT, NO_POINT
    write_candidates(i, rotation, position, n, wp.vec2d(depth, other), point, second, contacts, curves_inout)
