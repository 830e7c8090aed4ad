"""Containment: object pairs of which one holds a component of the other, though their surfaces do not cross.

Surfaces that do not meet leave each component of one wholly inside or wholly outside the other, so one corner of each
component decides.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees, load_vertex
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairBatch, PairPose, pose_point
from warp_abtree.kernels.distance.report import Distances, write_nearest
from warp_abtree.kernels.inside.components import NO_FACE, Solids
from warp_abtree.kernels.inside.parity import is_inside
from warp_abtree.kernels.intersect.face_pairs import Hits

wp.set_module_options(native.options("exact/determinant.cuh"))

# Of `Hits.any_hit` beside 1 for surfaces that meet: a component of A in B, and of B in A.
FIRST_INSIDE, SECOND_INSIDE = wp.constant(2), wp.constant(3)


@wp.func
def find_inside(trees: Trees, pose: PairPose, solids: Solids, state: wp.int32, of_b: bool, centre: wp.vec3d):
    """Return the lowest face that represents a component inside the solid A, or B, of the other's state; or NO_FACE."""
    lowest = wp.int32(NO_FACE)
    i = wp.int32(0)
    while i < solids.count[state]:
        face = solids.face[solids.first[state] + i]
        if face < lowest:
            corner = trees.states.face_corner[wp.where(of_b, pose.corner_a, pose.corner_b) + face]
            x = load_vertex(trees.models.vertex_pos, corner[0])
            if not of_b:
                x = pose_point(pose.rotation, pose.translation, x)
            if is_inside(trees, pose, of_b, centre, x):
                lowest = face
        i += 1
    return lowest


@wp.kernel(module="unique", module_options=native.options("exact/determinant.cuh"))
def find_contained_kernel(
    trees: Trees,
    batch: PairBatch,
    solids: Solids,
    hits_inout: Hits,
    near_hit_inout: wp.array(dtype=wp.int32),
    contained_out: wp.array(dtype=wp.int32),
):
    """Find contained components of the pairs whose surfaces do not meet, a thread a pair.

    Args:
        batch: Pairs that the traversal passed over, as their `within` says, are passed over here too.
        near_hit_inout: Whether each pair is near, shape [pair]; [0] where no distance was asked.
        contained_out: Face of the component that is inside, shape [pair].
    """
    p = wp.tid()
    if p >= batch.count[0] or p >= batch.pairs.shape[0] or batch.launched[0] == STALE:
        return
    if hits_inout.any_hit[p] != 0 or batch.poses[p].within < wp.float64(0.0):
        return
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    pose = batch.poses[p]
    centre = trees.models.centre[trees.states.model[trees.objects.state[a]]]
    face = NO_FACE
    if solids.is_solid[b] != 0:
        face = find_inside(trees, pose, solids, trees.objects.state[a], True, centre)
        if face != NO_FACE:
            hits_inout.any_hit[p] = FIRST_INSIDE
    if face == NO_FACE and solids.is_solid[a] != 0:
        face = find_inside(trees, pose, solids, trees.objects.state[b], False, centre)
        if face != NO_FACE:
            hits_inout.any_hit[p] = SECOND_INSIDE
    if face != NO_FACE:
        contained_out[p] = face
        if near_hit_inout.shape[0] > 0:
            near_hit_inout[p] = 1


@wp.kernel
def report_contained_kernel(
    trees: Trees, batch: PairBatch, hits: Hits, contained: wp.array(dtype=wp.int32), distances_out: Distances
):
    """Report a corner and its face of the contained component of pairs that intersect in this way, a thread a pair."""
    p = wp.tid()
    if p >= batch.count[0] or batch.launched[0] == STALE:
        return
    which = hits.any_hit[p]
    if which < FIRST_INSIDE:
        return
    of_b = which == SECOND_INSIDE
    owner = wp.where(of_b, wp.max(batch.pairs[p][0], batch.pairs[p][1]), wp.min(batch.pairs[p][0], batch.pairs[p][1]))
    face = contained[p]
    corner = trees.states.face_corner[trees.states.face_start[trees.objects.state[owner]] + face]
    x = load_vertex(trees.models.vertex_pos, corner[0])
    x = pose_point(trees.objects.rotation[owner], trees.objects.position[owner], x)
    face_a, face_b = wp.where(of_b, -1, face), wp.where(of_b, face, -1)
    write_nearest(p, batch.poses[p].swapped, face_a, face_b, x, x, distances_out)
