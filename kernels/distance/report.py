"""Report of a distance search: the distance, the bracket around it, and the nearest points in the world."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, Trees, load_vertex, no_vector
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairBatch, pose_point
from warp_abtree.kernels.distance.frame import NO_FACES, NearestFound, Tolerances, cut_of, slack_of
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.search.item import item_first, item_second
from warp_abtree.kernels.triangle.corners import load_triangles
from warp_abtree.kernels.triangle.distance import DISTANCE_MAX
from warp_abtree.kernels.triangle.triangle_pair import feature_weights, nearest_features

wp.set_module_options(native.options())

# Of surfaces that do not intersect though their distance rounds to 0.
LEAST_DISTANCE = wp.constant(wp.float64(2.0**-1022))

two_points = wp.types.matrix(shape=(2, 3), dtype=wp.float64)
two_twists = wp.types.matrix(shape=(2, 6), dtype=wp.float64)


@wp.struct
class Distances:
    """Answers, a row an object pair, its objects in the order in which the pair names them."""

    distance: wp.array(dtype=wp.float64)  # 0 where they intersect, infinite where proved beyond [world units]
    bracket: wp.array(dtype=wp.vec2d)  # proven lower and upper bound [world units]
    points: wp.array(dtype=two_points)  # nearest point of each, NaN where proved beyond [world units]
    faces: wp.array(dtype=wp.vec2i)  # the faces that they lie on, -1 where proved beyond
    gradient: wp.array(dtype=two_twists)  # by translation and rotation vector of each, see `gradient`


@wp.func
def write_nearest(
    p: wp.int32,
    swapped: wp.int32,
    face_a: wp.int32,
    face_b: wp.int32,
    point_a: wp.vec3d,
    point_b: wp.vec3d,
    distances: Distances,
):
    """Write points and faces in the order in which a pair names its objects."""
    if swapped != 0:
        distances.points[p] = wp.matrix_from_rows(point_b, point_a)
        distances.faces[p] = wp.vec2i(face_b, face_a)
    else:
        distances.points[p] = wp.matrix_from_rows(point_a, point_b)
        distances.faces[p] = wp.vec2i(face_a, face_b)


@wp.func
def blend_corners(models: ModelPool, corner: wp.vec4i, weights: wp.vec3d):
    """Return a point of a face, by the weights of its corners."""
    x = weights[0] * load_vertex(models.vertex_pos, corner[0])
    x = x + weights[1] * load_vertex(models.vertex_pos, corner[1])
    return x + weights[2] * load_vertex(models.vertex_pos, corner[2])


@wp.func
def report_pair(
    p: wp.int32,
    tolerances: Tolerances,
    trees: Trees,
    batch: PairBatch,
    found: NearestFound,
    hits: Hits,
    distances: Distances,
):
    """Report an object pair; of those that intersect only what needs no position."""
    zero = wp.float64(0.0)
    if hits.any_hit[p] != 0:
        distances.distance[p] = zero
        distances.bracket[p] = wp.vec2d(zero, zero)
        return
    pose = batch.poses[p]
    if found.faces[p] == NO_FACES:
        beyond = wp.min(found.beyond[p], DISTANCE_MAX)
        distances.distance[p] = wp.float64(wp.inf)
        distances.bracket[p] = wp.vec2d(beyond, wp.float64(wp.inf))
        write_nearest(p, 0, -1, -1, no_vector(), no_vector(), distances)
        return
    scaling = found.scaling[p]
    d = found.distance[p]
    cut = cut_of(scaling, tolerances, d)
    lower = wp.max((cut - slack_of(scaling, cut)) / scaling.stretch, zero)
    distances.distance[p] = wp.max(d, LEAST_DISTANCE)
    distances.bracket[p] = wp.vec2d(lower, wp.max(d * scaling.stretch + slack_of(scaling, d), LEAST_DISTANCE))
    face_a, face_b = item_first(found.faces[p]), item_second(found.faces[p])
    near = nearest_features(load_triangles(trees, pose, face_a, face_b))
    weights_a, weights_b = feature_weights(near)
    a, b = wp.min(batch.pairs[p][0], batch.pairs[p][1]), wp.max(batch.pairs[p][0], batch.pairs[p][1])
    point_a = blend_corners(trees.models, trees.states.face_corner[pose.corner_a + face_a], weights_a)
    point_b = blend_corners(trees.models, trees.states.face_corner[pose.corner_b + face_b], weights_b)
    point_a = pose_point(trees.objects.rotation[a], trees.objects.position[a], point_a)
    point_b = pose_point(trees.objects.rotation[b], trees.objects.position[b], point_b)
    write_nearest(p, pose.swapped, face_a, face_b, point_a, point_b, distances)


@wp.kernel
def report_distance_kernel(
    tolerances: Tolerances, trees: Trees, batch: PairBatch, found: NearestFound, hits: Hits, distances_out: Distances
):
    """Report an object pair a thread, see `report_pair`."""
    p = wp.tid()
    if p >= batch.count[0] or batch.launched[0] == STALE:
        return
    report_pair(p, tolerances, trees, batch, found, hits, distances_out)
