"""Contact points found at LODs, moved to the original surfaces.

Each goes to the middle between the points of both original surfaces that are nearest to it. Its depth is how far these
two overlap along its normal, which stays that of the LODs. Both points are the nearest of all faces, up to rounding.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import HALF, PairBatch, PairPose, pair_pose, pose_point
from warp_abtree.kernels.contacts.manifold import Manifolds
from warp_abtree.kernels.contacts.slots import WitnessRows
from warp_abtree.kernels.distance.frame import SearchScale, make_scale
from warp_abtree.kernels.inside.nearest_face import make_solid, nearest_face, point_features, point_weights
from warp_abtree.kernels.inside.parity import load_posed_face
from warp_abtree.kernels.intersect.face_pairs import NEAR_BIT

wp.set_module_options(native.options("distance/point_boxes.cuh"))


@wp.kernel
def pose_original_kernel(fine: Trees, batch: PairBatch, poses_out: wp.array(dtype=PairPose)):
    """Compute the pose of B's original in A's frame once a pair, A the smaller index.

    Args:
        fine: The objects at their finest LODs.
    """
    p = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    poses_out[p] = pair_pose(True, fine, a, b, wp.float64(0.0))


@wp.func
def nearest_point(
    fine: Trees, pose: PairPose, scaling: SearchScale, of_b: bool, state: wp.int32, x: wp.vec3d, hint: wp.int32
):
    """Return the point of the surface of A or B that is nearest to a point, all in A's frame."""
    _, face = nearest_face(fine, pose, make_solid(fine, pose, scaling, of_b, state), x, hint, wp.float64(0.0))
    a, b, c = load_posed_face(fine, pose, of_b, face)
    near, _ = point_features(a, b, c, x)
    u = point_weights(near)
    return (u[0] * a + u[1] * b) + u[2] * c


@wp.func
def is_finest(trees: Trees, state: wp.int32):
    """Return whether a tree state is that of the original mesh."""
    return trees.states.lod[state] == trees.models.lod_max[trees.states.model[state]]


@wp.kernel(cuda_max_registers=128)
def project_point_kernel(
    trees: Trees,
    fine: Trees,
    batch: PairBatch,
    poses: wp.array(dtype=PairPose),
    faces: wp.array(dtype=wp.vec3i),
    rows: WitnessRows,
    manifolds_inout: Manifolds,
):
    """Move one contact point a thread to the original surfaces.

    By branch and bound over the tree of either, from the face that the LODs have there. What stands at the finest LODs
    stays as it is.

    Args:
        fine, poses: As for `pose_original_kernel`.
        faces: Of crossing contacts, as of `ContactQuery`.
    """
    p, k = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]) or k >= manifolds_inout.count[p]:
        return
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    if is_finest(trees, trees.objects.state[a]) and is_finest(trees, trees.objects.state[b]):
        return
    item = rows.item[manifolds_inout.witness[p, k]]
    if item[0] < NEAR_BIT:
        item = faces[item[1]]
    swapped, pose = batch.poses[p].swapped, poses[p]
    rotation, position = trees.objects.rotation[a], trees.objects.position[a]
    back, scaling = wp.transpose(rotation), make_scale(fine, pose, a, b)
    x = back * (manifolds_inout.point[p, k] - position)
    on_a = nearest_point(fine, pose, scaling, False, fine.objects.state[a], x, item[1 + swapped])
    on_b = nearest_point(fine, pose, scaling, True, fine.objects.state[b], x, item[2 - swapped])
    sense = wp.where(swapped != 0, wp.float64(-1.0), wp.float64(1.0))
    manifolds_inout.point[p, k] = pose_point(rotation, position, HALF * (on_a + on_b))
    manifolds_inout.depth[p, k] = sense * wp.dot(on_a - on_b, back * manifolds_inout.normal[p, k])


@wp.kernel
def drop_apart_kernel(batch: PairBatch, gap: wp.array(dtype=wp.float64), manifolds_inout: Manifolds):
    """Drop the points of one pair a thread that are no nearer than its gap.

    Args:
        gap: Of each pair [world units], or [0] for none: points that are apart go.
    """
    p = wp.tid()
    if p >= wp.min(batch.count[0], batch.pairs.shape[0]):
        return
    found, shell = wp.int32(0), wp.float64(0.0)
    if gap.shape[0] > 0:
        shell = gap[p]
    for k in range(manifolds_inout.count[p]):
        depth = manifolds_inout.depth[p, k]
        if depth > -shell or depth == wp.float64(0.0):
            manifolds_inout.point[p, found] = manifolds_inout.point[p, k]
            manifolds_inout.normal[p, found] = manifolds_inout.normal[p, k]
            manifolds_inout.depth[p, found] = depth
            found += 1
    manifolds_inout.count[p] = found
