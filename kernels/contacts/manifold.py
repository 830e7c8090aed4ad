"""Candidate points of contacts: depths behind faces along the normals of their loops, or of the faces."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, pose_point
from warp_abtree.kernels.contacts.contact import Contacts, have_crossed
from warp_abtree.kernels.triangle.corners import load_corners
from warp_abtree.kernels.triangle.segment import measure_length, unit_vector

wp.set_module_options(native.options())

POINTS = wp.constant(8)
"""Points that stand for a pair, unless told otherwise."""

# A face seen at a smaller cosine along a direction says nothing about depth in that direction.
FACING = wp.constant(wp.float64(0.1))
# A face's own normal serves in place of the loop's within 60 degrees of it.
LIKENESS = wp.constant(wp.float64(0.5))
# By which part of a face's size its column is wider, so that walls that stand on its rim are inside.
COLUMN_SLACK = wp.constant(wp.float64(2.0**-36))
CLIPPED_CORNERS = wp.constant(8)
# Depths of candidates that there are not: the middle of the contact serves where all are so, or not even that.
NO_DEPTH, NO_POINT = wp.constant(wp.float64(-wp.inf)), wp.constant(wp.float64(wp.nan))


@wp.struct
class Curves:
    """Contact curves of all pairs, world frame; unit normals from the pair's first object to its second."""

    parent: wp.array(dtype=wp.int32)  # union-find forest of contacts, shape [contact]
    loop: wp.array(dtype=wp.int32)  # first contact of its loop, shape [contact]
    loop_normal: wp.array(dtype=wp.vec3d)  # at the first contact of each loop, shape [contact]
    point: wp.array2d(dtype=wp.vec3d)  # the deepest candidate and one far from it [world units], shape [contact, 2]
    depth: wp.array2d(dtype=wp.float64)  # [world units], or NO_DEPTH or NO_POINT, shape [contact, 2]
    normal: wp.array(dtype=wp.vec3d)  # of both candidates, shape [contact]
    listed: wp.array(dtype=wp.int32)  # contacts of each pair that have candidates, shape [contact]
    nearest: wp.array2d(dtype=wp.float64)  # squared distance from points chosen, shape [contact, 2]
    seen: wp.array(dtype=wp.int32)  # from how many of them, shape [contact]


@wp.struct
class Rows:
    """Contacts of all pairs in two orders."""

    start: wp.array(dtype=wp.int32)  # where those of each pair start, shape [pair + 1]
    faces: wp.array(dtype=wp.vec3i)  # pair and faces, in the order of the first object's faces, shape [contact]
    order: wp.array(dtype=wp.int32)  # contacts by their keys, shape [contact]
    key: wp.array(dtype=wp.int64)  # `contact_key` of each in that order, or its loop, shape [contact]


@wp.struct
class Manifolds:
    """Points that stand for each pair, world frame."""

    count: wp.array(dtype=wp.int32)  # points of it, shape [pair]
    point: wp.array2d(dtype=wp.vec3d)  # [world units], shape [pair, points]
    normal: wp.array2d(dtype=wp.vec3d)  # unit, from the pair's first object to its second, shape [pair, points]
    depth: wp.array2d(dtype=wp.float64)  # [world units] along the normal, negative if apart, shape [pair, points]


@wp.func
def clip_column(
    corner: wp.array(dtype=wp.vec3d), face: wp.int32, cut: wp.int32, n: wp.vec3d, polygon: wp.array(dtype=wp.vec3d)
):
    """Clip the triangle at cut to the column of the triangle at face along n; return the number of polygon corners."""
    zero = wp.float64(0.0)
    clipped = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    count = wp.int32(3)
    for k in range(3):
        polygon[k] = corner[cut + k]
    for k in range(3):
        u = corner[face + k]
        edge = corner[face + (k + 1) % 3] - u
        across = corner[face + (k + 2) % 3] - u
        inward = unit_vector(wp.cross(edge, n))
        if wp.dot(inward, across) < zero:
            inward = -inward
        slack = COLUMN_SLACK * (measure_length(edge) + measure_length(across))
        kept = wp.int32(0)
        i = wp.int32(0)
        while i < count:
            p = polygon[i]
            q = polygon[(i + 1) % count]
            at_p = wp.dot(inward, p - u) + slack
            at_q = wp.dot(inward, q - u) + slack
            if at_p >= zero:
                clipped[kept] = p
                kept += 1
            if (at_p < zero) != (at_q < zero):
                clipped[kept] = p + (q - p) * (at_p / (at_p - at_q))
                kept += 1
            i += 1
        count = kept
        i = wp.int32(0)
        while i < count:
            polygon[i] = clipped[i]
            i += 1
    return count


@wp.func
def measure_column(
    corner: wp.array(dtype=wp.vec3d),
    n: wp.vec3d,
    normal_a: wp.vec3d,
    normal_b: wp.vec3d,
    first: wp.int32,
    least: wp.float64,
):
    """Return the depth of one face behind the other along n, its point, and a second such point far away, or NO_DEPTH.

    Args:
        least: Depth from which on there are points: 0, or minus the gap.
        corner: Corners of the pair's first object at places first .. first + 2, of its second at the others.
    """
    none = NO_DEPTH
    facing_a = wp.dot(n, normal_a)
    facing_b = -wp.dot(n, normal_b)
    face = first
    cut = 3 - first
    plane = normal_a
    facing = facing_a
    if facing_b > facing_a:
        face = 3 - first
        cut = first
        plane = normal_b
        facing = facing_b
    origin = wp.vec3d()
    if facing < FACING:
        return none, origin, none, origin
    polygon = wp.zeros(shape=(CLIPPED_CORNERS,), dtype=wp.vec3d)
    count = clip_column(corner, face, cut, n, polygon)
    deepest = none
    point = origin
    i = wp.int32(0)
    while i < count:
        depth = wp.dot(corner[face] - polygon[i], plane) / facing
        if depth > deepest and depth >= least:
            deepest = depth
            point = polygon[i]
        i += 1
    other = none
    second = point
    most = wp.float64(0.0)
    i = wp.int32(0)
    while i < count:
        depth = wp.dot(corner[face] - polygon[i], plane) / facing
        away = wp.dot(polygon[i] - point, polygon[i] - point)
        if away > most and depth - least >= wp.float64(0.5) * (deepest - least):
            most = away
            other = depth
            second = polygon[i]
        i += 1
    return deepest, point, other, second


@wp.func
def write_candidates(
    i: wp.int32,
    rotation: wp.mat33d,
    position: wp.vec3d,
    n: wp.vec3d,
    depths: wp.vec2d,
    point: wp.vec3d,
    second: wp.vec3d,
    contacts: Contacts,
    curves: Curves,
):
    """Write both candidates of a contact, posed to the world; where there is none its middle and an end."""
    curves.depth[i, 0] = depths[0]
    curves.depth[i, 1] = depths[1]
    curves.normal[i] = rotation * n
    curves.point[i, 0] = pose_point(rotation, position, point)
    curves.point[i, 1] = pose_point(rotation, position, second)
    if depths[0] == NO_DEPTH:
        curves.point[i, 1] = contacts.p1[i]
        curves.point[i, 0] = wp.float64(0.5) * (contacts.p0[i] + contacts.p1[i])


@wp.kernel
def find_candidate_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    rows: Rows,
    contacts: Contacts,
    curves_inout: Curves,
):
    """Find the normal and two candidate points of one contact a thread, of faces that intersect.

    Of the loop's normal and of those faces' normals that are like it, the one along which the faces overlap least; of
    both faces' normals where neither is like it and one looks the other way.

    Args:
        gap: How far outside the second point may be, of faces that look at one another [world units], shape [pair]; [0]
            for not at all.
        rows: In the order of loops, those of faces that intersect first.
    """
    if wp.tid() >= rows.start[rows.start.shape[0] - 1]:
        return
    i = rows.order[wp.tid()]
    if not have_crossed(contacts, i):
        return
    p = rows.faces[i][0]
    swapped = batch.poses[p].swapped
    a = wp.min(batch.pairs[p][0], batch.pairs[p][1])
    corner = wp.zeros(shape=(6,), dtype=wp.vec3d)
    load_corners(trees, batch.poses[p], rows.faces[i][1 + swapped], rows.faces[i][2 - swapped], corner)
    rotation, position = trees.objects.rotation[a], trees.objects.position[a]
    back = wp.transpose(rotation)
    normal_a = back * contacts.normal_a[i]
    normal_b = back * contacts.normal_b[i]
    first = 3 * swapped
    zero = wp.float64(0.0)
    least = zero
    if gap.shape[0] > 0 and -wp.dot(normal_a, normal_b) >= LIKENESS:
        least = -gap[p]
    n = back * curves_inout.loop_normal[curves_inout.loop[i]]
    loop = n
    depth, point, other, second = measure_column(corner, n, normal_a, normal_b, first, least)
    toward_a, toward_b = wp.dot(loop, normal_a), -wp.dot(loop, normal_b)
    toward = wp.max(toward_a, toward_b)
    # A loop that runs all round a part in another, as round a thread, has no one way out.
    contrary = FACING <= toward and toward <= LIKENESS and wp.min(toward_a, toward_b) < -FACING
    for k in range(2):
        m = wp.where(k == 0, normal_a, -normal_b)
        if contrary or wp.dot(m, loop) > LIKENESS:
            d, x, e, y = measure_column(corner, m, normal_a, normal_b, first, least)
            if d >= zero and (depth < zero or d <= depth):
                n = m
                depth = d
                point = x
                other = e
                second = y
    write_candidates(i, rotation, position, n, wp.vec2d(depth, other), point, second, contacts, curves_inout)
