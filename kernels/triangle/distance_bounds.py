"""Distances of two faces in float32, within an error that is proven: docs/exactness.md, bound 16."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.boxes import map_point
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_near

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

three_points = wp.types.matrix(shape=(3, 3), dtype=wp.float32)


@native.func_native()
def bound_faces(
    own: wp.float32, a: three_points, b: three_points, lower: wp.ref[wp.float32], upper: wp.ref[wp.float32]
):
    """Find a lower and an upper bound of the distance of two triangles, their corners in rows.

    Args:
        own: What errors of the coordinates add.
    """


@wp.func
def load_points(
    trees: Trees, pose: PairPose, translation: wp.vec3, scale: wp.float32, face_a: wp.int32, face_b: wp.int32
):
    """Return the corners of a face of A and of one of B in rows, in A's frame, scaled as the translation is."""
    a, b = load_corner_ids(trees.states, pose.corner_a + face_a), load_corner_ids(trees.states, pose.corner_b + face_b)
    of_a, of_b = three_points(), three_points()
    for k in range(3):
        of_a[k] = load_near(trees.models, a[k]) * scale
        of_b[k] = map_point(pose.rotation32, translation, load_near(trees.models, b[k]) * scale)
    return of_a, of_b
