"""Steps of the search for first contacts by the type of motion: rigid or linear."""

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool, StatePool, Trees
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.motion.face_pair import PairProgress, advance_pair
from warp_abtree.kernels.motion.linear import (
    EndPoses,
    LinearMotion,
    advance_linear_children,
    advance_linear_pair,
    bound_linear_motion,
    start_linear_motion,
)
from warp_abtree.kernels.motion.node_pair import advance_children, box_motion
from warp_abtree.kernels.motion.path import Motion, Paths, bound_motion, pair_skew, place_motion, start_motion

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def make_motion(kind: Motion, paths: Paths, ends: ObjectPool, trees: Trees, pose: PairPose, pair: wp.vec2i):
    """Return the motion of objects a < b of the kind that is named."""
    motion = start_motion(paths, trees, pair)
    return bound_motion(motion, trees.states, pose, pair_skew(trees.objects, pair[0], motion.first))


@wp.func
def make_motion(  # noqa: F811 - Warp takes the one for the type
    kind: LinearMotion, paths: Paths, ends: ObjectPool, trees: Trees, pose: PairPose, pair: wp.vec2i
):
    motion = start_linear_motion(ends, trees, pair)
    return bound_linear_motion(motion, trees.states, pose, pair_skew(trees.objects, pair[0], motion.first))


@wp.func
def has_way(kind: Motion, paths: Paths, pair: wp.vec2i):
    """Return whether neither object turns by half a revolution, where that matters."""
    return paths.angle[pair[0]] >= wp.float64(0.0) and paths.angle[pair[1]] >= wp.float64(0.0)


@wp.func
def has_way(kind: LinearMotion, paths: Paths, pair: wp.vec2i):  # noqa: F811
    return True


@wp.func
def advance_nodes(
    states: StatePool,
    pose: PairPose,
    motion: Motion,
    t: wp.float32,
    best: wp.float64,
    item: wp.int64,
    live: wp.int32,
):
    """Expand an item from time t on, see `node_pair.advance_children`."""
    boxes = box_motion(motion, place_motion(motion, wp.float64(t)))
    return advance_children(states, pose, motion, boxes, t, best, item, live)


@wp.func
def advance_nodes(  # noqa: F811
    states: StatePool,
    pose: PairPose,
    motion: LinearMotion,
    t: wp.float32,
    best: wp.float64,
    item: wp.int64,
    live: wp.int32,
):
    return advance_linear_children(states, pose, motion, t, best, item, live)


@wp.func
def advance_faces(
    tolerance: wp.float64,
    trees: Trees,
    poses: EndPoses,
    pose: PairPose,
    motion: Motion,
    faces: wp.vec2i,
    before: PairProgress,
    best: wp.float64,
):
    """Return the `FirstContact` of a face of A and one of B, and the steps made so far."""
    contact, steps = advance_pair(tolerance, trees, pose, motion, faces, before, best)
    return contact, steps


@wp.func
def advance_faces(  # noqa: F811
    tolerance: wp.float64,
    trees: Trees,
    poses: EndPoses,
    pose: PairPose,
    motion: LinearMotion,
    faces: wp.vec2i,
    before: PairProgress,
    best: wp.float64,
):
    contact = advance_linear_pair(tolerance, trees, poses, pose, motion, faces[0], faces[1], before.time, best)
    return contact, wp.int32(0)
