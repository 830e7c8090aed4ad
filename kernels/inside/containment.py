"""Containment: object pairs of which one holds a component of the other, though their surfaces do not cross.

Surfaces that do not meet leave each component of one wholly inside or wholly outside the other, so one corner of each
component decides.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, ObjectPool, StatePool, load_vertex
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairPose, pose_point
from warp_abtree.kernels.distance.report import Distances, write_nearest
from warp_abtree.kernels.inside.components import NO_FACE, Solids
from warp_abtree.kernels.inside.parity import is_inside
from warp_abtree.kernels.intersect.face_pairs import Hits

wp.set_module_options(native.options("exact/determinant.cuh"))

# Of `Hits.any_hit` beside 1 for surfaces that meet: a component of A in B, and of B in A.
FIRST_INSIDE, SECOND_INSIDE = wp.constant(2), wp.constant(3)


@wp.func
def probe_of(models: ModelPool, states: StatePool, pose: PairPose, of_b: bool, face: wp.int32):
    """Return the first corner of a face of A, or of B, in A's frame."""
    c = states.face_corner[wp.where(of_b, pose.corner_b, pose.corner_a) + face]
    x = load_vertex(models.vertex_pos, c[0])
    if of_b:
        x = pose_point(pose.rotation, pose.translation, x)
    return x


@wp.func
def find_inside(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    solids: Solids,
    state: wp.int32,
    of_b: bool,
    centre: wp.vec3d,
):
    """Return the lowest face that represents a component inside the solid A, or B, of the other's state; or NO_FACE."""
    lowest = wp.int32(NO_FACE)
    i = wp.int32(0)
    while i < solids.count[state]:
        face = solids.face[solids.first[state] + i]
        if face < lowest and is_inside(
            models, states, pose, of_b, centre, probe_of(models, states, pose, not of_b, face)
        ):
            lowest = face
        i += 1
    return lowest


@wp.kernel(module="unique", module_options=native.options("exact/determinant.cuh"))
def find_contained_kernel(
    # static
    models: ModelPool,
    states: StatePool,
    # state
    objects: ObjectPool,
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    solids: Solids,
    launched: wp.array(dtype=wp.int32),
    # out
    hits_inout: Hits,
    near_hit_inout: wp.array(dtype=wp.int32),
    contained_out: wp.array(dtype=wp.int32),
):
    """Find contained components of the pairs whose surfaces do not meet, a thread a pair.

    Args:
        near_hit_inout: Whether each pair is near, shape [pair]; [0] where no distance was asked.
        contained_out: Face of the component that is inside, shape [pair].
    """
    p = wp.tid()
    if p >= pair_count[0] or p >= pairs.shape[0] or launched[0] == STALE:
        return
    if hits_inout.any_hit[p] != 0:
        return
    a, b = wp.min(pairs[p][0], pairs[p][1]), wp.max(pairs[p][0], pairs[p][1])
    pose = pair_poses[p]
    centre = models.centre[states.model[objects.state[a]]]
    face = NO_FACE
    if solids.is_solid[b] != 0:
        face = find_inside(models, states, pose, solids, objects.state[a], True, centre)
        if face != NO_FACE:
            hits_inout.any_hit[p] = FIRST_INSIDE
    if face == NO_FACE and solids.is_solid[a] != 0:
        face = find_inside(models, states, pose, solids, objects.state[b], False, centre)
        if face != NO_FACE:
            hits_inout.any_hit[p] = SECOND_INSIDE
    if face != NO_FACE:
        contained_out[p] = face
        if near_hit_inout.shape[0] > 0:
            near_hit_inout[p] = 1


@wp.kernel
def report_contained_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    launched: wp.array(dtype=wp.int32),
    hits: Hits,
    contained: wp.array(dtype=wp.int32),
    distances_out: Distances,
):
    """Report a corner and its face of the contained component of pairs that intersect in this way, a thread a pair."""
    p = wp.tid()
    if p >= pair_count[0] or launched[0] == STALE:
        return
    which = hits.any_hit[p]
    if which < FIRST_INSIDE:
        return
    of_b = which == SECOND_INSIDE
    owner = wp.where(of_b, wp.max(pairs[p][0], pairs[p][1]), wp.min(pairs[p][0], pairs[p][1]))
    face = contained[p]
    corner = states.face_corner[states.face_start[objects.state[owner]] + face]
    x = load_vertex(models.vertex_pos, corner[0])
    x = pose_point(objects.rotation[owner], objects.position[owner], x)
    face_a, face_b = wp.where(of_b, -1, face), wp.where(of_b, face, -1)
    write_nearest(p, pair_poses[p].swapped, face_a, face_b, x, x, distances_out)
