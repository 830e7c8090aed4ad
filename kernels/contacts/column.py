"""The faces of a contact, and columns of faces along a direction (`native/triangle/column.cuh`)."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.triangle.corners import load_corner_ids, load_face_pair

wp.set_module_options(native.options())

# Corners of a triangle within the column of another, at most.
COLUMN_CORNERS = native.constant("COLUMN_CORNERS")
# Depth of a column that holds no corner.
NO_DEPTH = wp.constant(wp.float64(-wp.inf))


@wp.struct
class FacePair:
    """The faces of a contact, of the pair's first object and of its second."""

    a0: wp.vec3d  # corners of that of the first object, frame of A, the lower object
    a1: wp.vec3d  # the second
    a2: wp.vec3d  # the third
    b0: wp.vec3d  # corners of that of the second object
    b1: wp.vec3d  # the second
    b2: wp.vec3d  # the third
    normal_a: wp.vec3d  # unit normal of that of the first object, world frame
    normal_b: wp.vec3d  # of that of the second object
    object: wp.int32  # A


@wp.func
def load_pair(trees: Trees, pose: PairPose, object: wp.int32, faces: wp.vec3i, normal_a: wp.vec3d, normal_b: wp.vec3d):
    """Return the faces of a contact, of which `faces` names the pair, and those of the first and the second object.

    Args:
        object: A.
        normal_a, normal_b: As of `FacePair`.
    """
    a = load_corner_ids(trees.states, pose.corner_a + faces[1 + pose.swapped])
    b = load_corner_ids(trees.states, pose.corner_b + faces[2 - pose.swapped])
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    pair, back = FacePair(), pose.swapped != 0
    pair.a0 = wp.where(back, b0, a0)
    pair.a1 = wp.where(back, b1, a1)
    pair.a2 = wp.where(back, b2, a2)
    pair.b0 = wp.where(back, a0, b0)
    pair.b1 = wp.where(back, a1, b1)
    pair.b2 = wp.where(back, a2, b2)
    pair.normal_a = normal_a
    pair.normal_b = normal_b
    pair.object = object
    return pair
