"""Corners of active faces, in the frame of the pair's first object."""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, Trees, load_vertex
from warp_abtree.kernels.base.nodes import load_constant
from warp_abtree.kernels.base.poses import PairPose, pose_point
from warp_abtree.kernels.triangle.distance import scale_triangles

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def load_corners(trees: Trees, pose: PairPose, face_a: wp.int32, face_b: wp.int32, corner: wp.array(dtype=wp.vec3d)):
    """Put the corners of a face of A and of one of B, both in A's frame, into places 0..2 and 3..5."""
    a = trees.states.face_corner[pose.corner_a + face_a]
    b = trees.states.face_corner[pose.corner_b + face_b]
    for k in range(3):
        corner[k] = load_vertex(trees.models.vertex_pos, a[k])
        corner[3 + k] = pose_point(pose.rotation, pose.translation, load_vertex(trees.models.vertex_pos, b[k]))


@wp.func
def load_triangles(trees: Trees, pose: PairPose, face_a: wp.int32, face_b: wp.int32):
    """Return the corners of a face of A and of one of B, in A's frame."""
    a = trees.states.face_corner[pose.corner_a + face_a]
    b = trees.states.face_corner[pose.corner_b + face_b]
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    return scale_triangles(a0, a1, a2, b0, b1, b2)


@native.func_native()
def load_corner(corners: wp.array(dtype=wp.vec4i), i: wp.int32) -> wp.vec4i: ...


@wp.func
def load_corner_ids(states: StatePool, i: wp.int32):
    return load_corner(states.face_corner, i)


@wp.func
def load_near(models: ModelPool, vertex: wp.int32):
    x = load_constant(models.vertex_near, wp.int64(vertex))
    return wp.vec3(x[0], x[1], x[2])


@wp.func
def load_face_pair(models: ModelPool, pose: PairPose, a: wp.vec4i, b: wp.vec4i):
    """Return the corners of a face of A and of one of B, of their vertices, in A's frame."""
    a0, a1 = load_vertex(models.vertex_pos, a[0]), load_vertex(models.vertex_pos, a[1])
    b0, b1 = load_vertex(models.vertex_pos, b[0]), load_vertex(models.vertex_pos, b[1])
    a2, b2 = load_vertex(models.vertex_pos, a[2]), load_vertex(models.vertex_pos, b[2])
    r, t = pose.rotation, pose.translation
    return a0, a1, a2, pose_point(r, t, b0), pose_point(r, t, b1), pose_point(r, t, b2)
