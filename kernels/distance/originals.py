"""What distances at coarse LODs prove of the original meshes: a lower bound, and a pair of original faces above it.

Every point of an original lies within its certified error of the surface at a LOD, e_A and e_B in model units, so the
originals are no nearer than the surfaces at the LODs less both, each as much longer in the world as its rotation
lengthens: `Frame.stretch`. Nothing is needed of how far the surfaces at the LODs lie from the originals. Any two
original faces are no nearer than the originals, wherever they are; those that stand near the witnesses are measured.
Vertices of an original may lie beyond the boxes that a `Frame` was made of, though by its error at most, by which
`stretch` counts what it misses of the sizes.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import ModelPool, ObjectPool, StatePool, load_vertex
from warp_abtree.kernels.base.nodes import load_node
from warp_abtree.kernels.base.poses import PairPose, pose_point
from warp_abtree.kernels.distance.frame import make_frame
from warp_abtree.kernels.distance.report import LEAST_DISTANCE, Distances, write_nearest
from warp_abtree.kernels.triangle.distance import corners_type
from warp_abtree.kernels.triangle.triangle_pair import feature_weights, nearest_features, scale_triangles

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

# Faces that are looked at in one go around a witness.
LOOKED_AT = wp.constant(64)
# Of a sum of errors, times a stretch, taken off a distance.
SUM_ROUNDING = wp.constant(wp.float64(1.0 + 2.0**-40))


@wp.func
def original_corners(models: ModelPool, model: wp.int32, face: wp.int32):
    """Return the corners (rows) of a face where it lies in the original."""
    c = models.face_vertex[models.face_start[model] + face]
    return wp.matrix_from_rows(
        load_vertex(models.vertex_pos, c[0]),
        load_vertex(models.vertex_pos, c[1]),
        load_vertex(models.vertex_pos, c[2]),
    )


@wp.func
def pose_corners(pose: PairPose, m: corners_type):
    """Return corners (rows) of B in A's frame, as x' of docs/exactness.md."""
    return wp.matrix_from_rows(
        pose_point(pose.rotation, pose.translation, m[0]),
        pose_point(pose.rotation, pose.translation, m[1]),
        pose_point(pose.rotation, pose.translation, m[2]),
    )


@wp.func
def face_at(models: ModelPool, model: wp.int32, slot: wp.int32):
    """Return the face of a slot of the deepest level, or of the leaf above it; -1 where there is none."""
    start = models.node_start[model]
    face = models.node_face[start + slot]
    if face < 0 and slot > 1:
        face = models.node_face[start + (slot >> 1)]
    if face >= 0 and models.face_split[models.face_start[model] + face] > models.lod_max[model]:
        return -1
    return face


@wp.func
def nearest_original(models: ModelPool, states: StatePool, state: wp.int32, face: wp.int32, target: wp.vec3d):
    """Return an original face near a point, of those that stand under a face of a state, or beside them.

    Those below the highest node where no other face is active, or more. One in so many is looked at by its first
    corner, then around the nearest of them one in fewer, and in the end each. Any answer is good for an upper bound.
    """
    model = states.model[state]
    node = models.leaf_node[models.face_start[model] + face]
    leaf = node
    below = wp.int32(0)
    while (node << below) < (wp.int32(1) << models.depth[model]):
        below += 1
    start = states.node_start[state]
    climbing = bool(True)
    while climbing and node > 1:
        above = node >> 1
        climbing = (wp.int32(1) << below) < LOOKED_AT or load_node(states, start + above).skip == leaf
        if climbing:
            node = above
            below += 1
    first, count = node << below, wp.int32(1) << below
    best = wp.float64(wp.inf)
    found = face
    while count > 0:
        step = wp.max(1, count / LOOKED_AT)
        nearest = first
        k = wp.int32(0)
        while k < count:
            other = face_at(models, model, first + k)
            if other >= 0:
                corner = models.face_vertex[models.face_start[model] + other][0]
                away = load_vertex(models.vertex_pos, corner) - target
                square = wp.dot(away, away)
                if square < best:
                    best = square
                    found = other
                    nearest = first + k
            k += step
        first = nearest
        count = wp.where(step > 1, step, 0)
    return found


@wp.func
def join_faces(a: corners_type, b: corners_type):
    """Return the weights of corners (rows) at the nearest points of two triangles, and their distance.

    Of triangles that cross, points of edges, which are no nearer than the triangles.
    """
    triangles = scale_triangles(a[0], a[1], a[2], b[0], b[1], b[2])
    near = nearest_features(triangles)
    weights_a, weights_b = feature_weights(near)
    return weights_a, weights_b, wp.sqrt(near.square) * triangles.size


@wp.func
def search_originals(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    state_a: wp.int32,
    state_b: wp.int32,
    face_a: wp.int32,
    face_b: wp.int32,
    point_b: wp.vec3d,
):
    """Return two original faces near each other, and near two faces at LODs and a point of B's in A's frame."""
    model_a, model_b = states.model[state_a], states.model[state_b]
    target = point_b
    found_a, found_b = face_a, face_b
    turn = wp.int32(0)
    while turn < 2:
        found_a = nearest_original(models, states, state_a, face_a, target)
        a = original_corners(models, model_a, found_a)
        weights_a, weights_b, _ = join_faces(a, wp.matrix_from_rows(target, target, target))
        local = wp.transpose(pose.rotation) * (wp.transpose(a) * weights_a - pose.translation)
        found_b = nearest_original(models, states, state_b, face_b, local)
        b = pose_corners(pose, original_corners(models, model_b, found_b))
        weights_a, weights_b, _ = join_faces(a, b)
        target = wp.transpose(b) * weights_b
        turn += 1
    return found_a, found_b


@wp.kernel
def bound_originals_kernel(
    models: ModelPool,
    states: StatePool,
    objects: ObjectPool,
    pair_count: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.vec2i),
    pair_poses: wp.array(dtype=PairPose),
    errors: wp.array(dtype=wp.float64),
    distances_inout: Distances,
):
    """Put what is proved of two originals in the place of what was found of the surfaces at LODs, a thread a pair.

    Where these are proved beyond a distance, the originals are beyond the bracket's lower end.

    Args:
        errors: Certified errors of both objects of each pair, added up [model units], shape [pair].
    """
    p = wp.tid()
    if p >= pair_count[0]:
        return
    a, b = wp.min(pairs[p][0], pairs[p][1]), wp.max(pairs[p][0], pairs[p][1])
    pose = pair_poses[p]
    swapped = pose.swapped != 0
    frame = make_frame(models, states, objects, pose, a, b)
    bracket = distances_inout.bracket[p]
    bracket[0] = wp.max(bracket[0] - errors[p] * frame.stretch * SUM_ROUNDING, wp.float64(0.0))
    faces = distances_inout.faces[p]
    if faces[0] >= 0 and faces[1] >= 0:
        face_a, face_b = wp.where(swapped, faces[1], faces[0]), wp.where(swapped, faces[0], faces[1])
        witness = distances_inout.points[p][wp.where(swapped, 0, 1)]
        target = wp.transpose(objects.rotation[a]) * (witness - objects.position[a])
        state_a, state_b = objects.state[a], objects.state[b]
        face_a, face_b = search_originals(models, states, pose, state_a, state_b, face_a, face_b, target)
        corners_a = original_corners(models, states.model[state_a], face_a)
        corners_b = original_corners(models, states.model[state_b], face_b)
        weights_a, weights_b, d = join_faces(corners_a, pose_corners(pose, corners_b))
        point_a = pose_point(objects.rotation[a], objects.position[a], wp.transpose(corners_a) * weights_a)
        point_b = pose_point(objects.rotation[b], objects.position[b], wp.transpose(corners_b) * weights_b)
        more = wp.float64(4.0) * (frame.stretch - wp.float64(1.0)) * errors[p]
        bracket[1] = wp.max(d * frame.stretch + ((frame.slack + frame.pair_slack) + more), LEAST_DISTANCE)
        distances_inout.distance[p] = wp.max(d, LEAST_DISTANCE)
        write_nearest(p, pose.swapped, face_a, face_b, point_a, point_b, distances_inout)
    distances_inout.bracket[p] = bracket
