"""Candidate points of contacts: depths behind faces along the normals of their loops, or of the faces."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.contacts.column import (
    COLUMN_CORNERS,
    FACING,
    NO_DEPTH,
    POSSIBLE_CORNERS,
    Column,
    FacePair,
    column_corner,
    column_slack,
    load_pair,
    make_column,
    measure_column,
)
from warp_abtree.kernels.contacts.contact import Contacts
from warp_abtree.kernels.contacts.slots import Slots, WitnessRows, find_bin, no_scores, offer_scores, rate_point
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT, Hits

wp.set_module_options(native.options("contacts/slots.cuh"))

POINTS = wp.constant(8)
"""Points that stand for a pair, unless told otherwise."""

# Distance and depth, at unit size, under which faces touch.
NO_DISTANCE = wp.constant(wp.float64(2.0**-30))
# Cosine under which normals differ by more than rounding.
ALONG = wp.constant(wp.float64(0.998))
# A face's own normal serves in place of the loop's within 60 degrees of it.
LIKENESS = wp.constant(wp.float64(0.5))
# Depth of candidates that there are not; where all of a pair have NO_DEPTH the middles of its contacts serve.
NO_POINT = wp.constant(wp.float64(wp.nan))
NO_DEPTH_SEPARATION = wp.constant(wp.float32(2.0**60))  # more than any, in offers to slots


@wp.struct
class Curves:
    """Contact curves of all pairs, world frame; unit normals from the pair's first object to its second."""

    parent: wp.array(dtype=wp.int32)  # union-find forest of contacts, shape [contact]
    loop: wp.array(dtype=wp.int32)  # first contact of its loop, shape [contact]
    loop_normal: wp.array(dtype=wp.vec3d)  # at the first contact of each loop, shape [contact]
    has_area: wp.array(dtype=wp.int32)  # there, 1 where the normal is that of an area, else 0, shape [contact]


@wp.struct
class Witnesses:
    """Candidate points of all pairs, of the contacts that slots keep, world frame."""

    normal: wp.array(dtype=wp.vec3d)  # unit, from the pair's first object to its second, shape [witness]
    point: wp.array2d(dtype=wp.vec3d)  # [world units], shape [witness, COLUMN_CORNERS]
    depth: wp.array2d(dtype=wp.float64)  # [world units], NO_DEPTH or NO_POINT, shape [witness, COLUMN_CORNERS]
    nearest_only: wp.array(dtype=wp.int32)  # whether another face may be nearer, 0 or 1, shape [witness]
    wrench: wp.array(dtype=wp.vec4)  # see `points`, shape [2 * COLUMN_CORNERS * witness]


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


@wp.func
def write_candidates(
    w: wp.int32,
    rotation: wp.mat33d,
    position: wp.vec3d,
    column: Column,
    least: wp.float64,
    slack: wp.float64,
    witnesses: Witnesses,
):
    """Write the candidates of a witness, posed to the world: the corners of a column that are deep enough.

    Args:
        least: Depth of the least deep one; one that lacks no more than `slack` counts as so deep.
    """
    witnesses.normal[w] = rotation * column.normal
    place, k = wp.int32(0), wp.int32(0)
    while k < POSSIBLE_CORNERS:
        point, depth, exists = column_corner(column, k)
        if exists and depth >= least - slack and place < COLUMN_CORNERS:
            witnesses.depth[w, place] = wp.max(depth, least)
            witnesses.point[w, place] = pose_point(rotation, position, point)
            place += 1
        k += 1
    while place < COLUMN_CORNERS:
        witnesses.depth[w, place] = NO_POINT
        place += 1


@wp.func
def write_middle(w: wp.int32, i: wp.int32, n: wp.vec3d, contacts: Contacts, witnesses: Witnesses):
    """Write the middle and an end of contact i as candidates, which have no depth."""
    witnesses.normal[w] = n
    for k in range(COLUMN_CORNERS):
        witnesses.depth[w, k] = wp.where(k < 2, NO_DEPTH, NO_POINT)
    witnesses.point[w, 0] = wp.float64(0.5) * (contacts.p0[i] + contacts.p1[i])
    witnesses.point[w, 1] = contacts.p1[i]


@wp.func
def lies_in_front(n: wp.vec3d, u: wp.vec3d, v0: wp.vec3d, v1: wp.vec3d, v2: wp.vec3d, slack: wp.float64):
    """Return whether a face lies in front of the plane through u whose normal is n."""
    least = wp.min(wp.dot(n, v0 - u), wp.min(wp.dot(n, v1 - u), wp.dot(n, v2 - u)))
    return least >= -slack and wp.dot(n, n) > wp.float64(0.0)


@wp.func
def touching_faces(pair: FacePair, normal_a: wp.vec3d, normal_b: wp.vec3d, slack: wp.float64):
    """Return whether the second face of a pair lies in front of the first one, and the first in front of the second."""
    touches_a = lies_in_front(normal_a, pair.a0, pair.b0, pair.b1, pair.b2, slack)
    return touches_a, lies_in_front(normal_b, pair.b0, pair.a0, pair.a1, pair.a2, slack)


@wp.struct
class Crossing:
    """A contact of faces that cross, to find its candidates."""

    i: wp.int32  # its place among contacts
    a: wp.int32  # object A of its pair
    faces: wp.vec3i  # pair, face of its first object, face of its second
    least: wp.float64  # depth from which on there are candidates: 0, or minus the gap where faces look at one another


@wp.func
def load_crossing(i: wp.int32, batch: PairBatch, gap: wp.array(dtype=wp.float64), faces: wp.vec3i, contacts: Contacts):
    """Return a contact.

    Args:
        gap: Of each pair [world units], or [0] for none.
    """
    crossing = Crossing()
    crossing.i = i
    crossing.faces = faces
    crossing.a = wp.min(batch.pairs[faces[0]][0], batch.pairs[faces[0]][1])
    if gap.shape[0] > 0 and -wp.dot(contacts.normal_a[i], contacts.normal_b[i]) >= LIKENESS:
        crossing.least = -gap[faces[0]]
    return crossing


@wp.func
def measure_crossing(crossing: Crossing, trees: Trees, pose: PairPose, contacts: Contacts, curves: Curves):
    """Return the column of a contact of faces that cross, in A's frame, and what its corners' depths may lack.

    Of the loop's normal and of those faces' normals that are like it, the one along which the faces overlap least; of
    both faces' normals where neither is like it and one looks the other way. Where faces merely touch, the normal of a
    face that has the other in front serves, if it is like the loop's or that has no area, as rounding may have made it;
    edges beside one another have none then. Where faces are hardly in one another, a face's normal that rounding alone
    makes as good as the loop's serves only if the other face lies in front.
    """
    pair = load_pair(trees, pose, crossing.faces)
    back = wp.transpose(trees.objects.rotation[crossing.a])
    normal_a = back * contacts.normal_a[crossing.i]
    normal_b = back * contacts.normal_b[crossing.i]
    least, slack, shallow = crossing.least, column_slack(pair), NO_DISTANCE / pose.scale
    loop = back * curves.loop_normal[curves.loop[crossing.i]]
    touches_a, touches_b = touching_faces(pair, normal_a, normal_b, slack)
    has_area, opposed = curves.has_area[curves.loop[crossing.i]] != 0, -wp.dot(normal_a, normal_b) >= LIKENESS
    if has_area or not opposed:
        like = wp.where(has_area, LIKENESS, FACING)
        touches_a = touches_a and wp.dot(loop, normal_a) > like
        touches_b = touches_b and -wp.dot(loop, normal_b) > like
    if touches_a and touches_b and not opposed:
        none = Column()
        none.normal = loop
        none.depth = NO_DEPTH
        return none, wp.float64(0.0)
    # Of columns only normals and depths are kept: a second one beside the first would not fit into registers.
    best_n, best_depth = wp.vec3d(loop), -wp.float64(wp.inf)
    toward_a, toward_b = wp.dot(loop, normal_a), -wp.dot(loop, normal_b)
    toward = wp.max(toward_a, toward_b)
    # A loop that runs all round a part in another, as round a thread, has no one way out.
    contrary = FACING <= toward and toward <= LIKENESS and wp.min(toward_a, toward_b) < -FACING
    touches = touches_a or touches_b
    first_a = touches_a and not (touches_b and toward_a < ALONG * toward_b)
    k = wp.int32(0)
    while k < wp.where(touches, 1, 3):
        n = wp.where(k == 1 or (k == 0 and first_a), normal_a, -normal_b)
        if k == 0 and not touches:
            n = loop
        if k == 0 or contrary or wp.dot(n, loop) > LIKENESS:
            tight, more = k > 0 or touches, wp.float64(slack)
            depth = measure_column(pair, n, normal_a, normal_b, wp.where(tight, wp.min(least, -slack), least)).depth
            if k > 0 and best_depth < shallow:
                # Rounding does not tell a face that the other one cuts from one that it touches.
                in_front_a, in_front_b = touching_faces(pair, normal_a, normal_b, shallow)
                if not wp.where(k == 1, in_front_a, in_front_b):
                    more = -slack
            if k == 0 or (depth >= -slack and (best_depth < -slack or depth <= best_depth + more)):
                best_n = n
                best_depth = depth
        k += 1
    best, _ = make_column(pair, best_n, normal_a, normal_b)
    best.depth = best_depth
    return best, wp.where(touches and least == wp.float64(0.0), slack, wp.float64(0.0))


@wp.kernel(cuda_max_registers=128)
def offer_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    start: wp.array(dtype=wp.int32),
    faces: wp.array(dtype=wp.vec3i),
    order: wp.array(dtype=wp.int32),
    contacts: Contacts,
    curves: Curves,
    slots_inout: Slots,
):
    """Offer the candidates of one contact of faces that cross a thread to the slots of its pair.

    Args:
        gap: How far outside points may be, of faces that look at one another [world units], shape [pair]; [0] for not
            at all.
        start, faces, order: Contacts of pairs, as for `loops`, in the order of loops.
    """
    if wp.tid() >= start[start.shape[0] - 1]:
        return
    i = order[wp.tid()]
    crossing = load_crossing(i, batch, gap, faces[i], contacts)
    p = faces[i][0]
    pose = batch.poses[p]
    column, slack = measure_crossing(crossing, trees, pose, contacts, curves)
    sense = wp.where(pose.swapped != 0, wp.float64(-1.0), wp.float64(1.0))
    weight, directions = slots_inout.weight[p], slots_inout.directions
    bin, scores = find_bin(wp.vec3(sense * column.normal), directions), no_scores()
    centre = trees.models.centre[trees.states.model[trees.objects.state[crossing.a]]]
    if column.depth == NO_DEPTH:
        # Behind whatever has a depth.
        rate_point(wp.vec3(), NO_DEPTH_SEPARATION, weight, bin, directions, scores)
    k = wp.int32(0)
    while k < POSSIBLE_CORNERS and column.depth > NO_DEPTH:
        point, depth, exists = column_corner(column, k)
        if exists and depth >= crossing.least - slack:
            x, s = wp.vec3((point - centre) * pose.scale), wp.float32(-depth * pose.scale)
            rate_point(x, s, weight, bin, directions, scores)
        k += 1
    offer_scores(scores, bin, i, p, slots_inout.key)


@wp.kernel
def find_crossing_kernel(
    trees: Trees,
    batch: PairBatch,
    gap: wp.array(dtype=wp.float64),
    faces: wp.array(dtype=wp.vec3i),
    contacts: Contacts,
    curves: Curves,
    hits: Hits,
    rows: WitnessRows,
    witnesses_out: Witnesses,
):
    """Find the normal and the candidate points of one witness of faces that cross a thread, or that there is none."""
    w = wp.tid()
    if w >= wp.min(hits.witness_total[0], rows.item.shape[0]):
        return
    item = rows.item[w]
    if item[0] < 0:
        for k in range(COLUMN_CORNERS):
            witnesses_out.depth[w, k] = NO_POINT
    if item[0] < 0 or item[0] >= NEAR_BIT:
        return
    crossing = load_crossing(item[1], batch, gap, faces[item[1]], contacts)
    column, slack = measure_crossing(crossing, trees, batch.poses[item[0]], contacts, curves)
    rotation, position = trees.objects.rotation[crossing.a], trees.objects.position[crossing.a]
    if column.depth == NO_DEPTH:
        write_middle(w, crossing.i, rotation * column.normal, contacts, witnesses_out)
    else:
        write_candidates(w, rotation, position, column, crossing.least, slack, witnesses_out)
