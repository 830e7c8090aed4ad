"""Gradient of the distance of an object pair with respect to the poses of both objects.

The nearest points p and q, kept on their objects, have the derivative of the distance d (envelope theorem): along the
unit vector n = (q - p) / d, which points inwards where d is a depth, q adds n and p takes n away. An object at c that
turns by the small rotation vector w about its origin moves its point by w x (p - c), so its part is (p - c) x n.
"""

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.distance.report import Distances, two_twists
from warp_abtree.kernels.triangle.distance import largest_coordinate

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def distance_direction(v: wp.vec3d, d: wp.float64):
    """Return the unit vector of a vector, its opposite where d < 0; zero of points that coincide or are NaN."""
    size = largest_coordinate(v)
    if not (size > wp.float64(0.0) and size < wp.float64(wp.inf)):
        return wp.vec3d()
    return wp.normalize(v / wp.where(d < wp.float64(0.0), -size, size))


@wp.kernel
def find_gradient_kernel(trees: Trees, batch: PairBatch, distances_inout: Distances):
    """Find the gradient of an object pair's distance, a thread a pair, after distance and points."""
    p = wp.tid()
    if p >= batch.count[0] or batch.launched[0] == STALE:
        return
    points = distances_inout.points[p]
    n = distance_direction(points[1] - points[0], distances_inout.distance[p])
    twists = two_twists()
    # Of no direction points may be NaN.
    if wp.dot(n, n) > wp.float64(0.0):
        for k in range(2):
            along = wp.where(k == 0, -n, n)
            turn = wp.cross(points[k] - trees.objects.position[batch.pairs[p][k]], along)
            for i in range(3):
                twists[k, i] = along[i]
                twists[k, 3 + i] = turn[i]
    distances_inout.gradient[p] = twists
