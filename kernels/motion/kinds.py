"""Steps of the search for first contacts by the type of motion: rigid or linear."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import warp as wp

from warp_abtree.kernels.base.arrays import ObjectPool, Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.motion.face_pair import advance_pair
from warp_abtree.kernels.motion.linear import (
    LinearMotion,
    advance_linear_children,
    advance_linear_pair,
    bound_linear_motion,
    start_linear_motion,
)
from warp_abtree.kernels.motion.node_pair import advance_children
from warp_abtree.kernels.motion.path import Motion, Path, bound_motion, pair_skew, start_motion

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def make_motion(paths: wp.array(dtype=Path), ends: ObjectPool, trees: Trees, pose: PairPose, pair: wp.vec2i):
    """Return the motion of objects a < b, and whether neither turns by half a revolution."""
    motion = start_motion(paths, trees, pair)
    motion = bound_motion(motion, trees.states, pose, pair_skew(trees.objects, pair[0], motion.first))
    return motion, paths[pair[0]].angle >= wp.float64(0.0) and paths[pair[1]].angle >= wp.float64(0.0)


@wp.func
def make_linear_motion(paths: wp.array(dtype=Path), ends: ObjectPool, trees: Trees, pose: PairPose, pair: wp.vec2i):
    """Return the linear motion of objects a < b, which turns do not matter for."""
    motion = start_linear_motion(ends, trees, pair)
    motion = bound_linear_motion(motion, trees.states, pose, pair_skew(trees.objects, pair[0], motion.first))
    return motion, True


class Steps(NamedTuple):
    """Steps of the search for motions of a type.

    Attributes:
        make: As `make_motion`.
        advance_nodes: As `node_pair.advance_children`.
        advance_faces: As `face_pair.advance_pair`.
    """

    make: Callable
    advance_nodes: Callable
    advance_faces: Callable


STEPS = {
    Motion: Steps(make_motion, advance_children, advance_pair),
    LinearMotion: Steps(make_linear_motion, advance_linear_children, advance_linear_pair),
}


@cache
def motion_given(kind):
    """Return the struct of what searches for first contacts are given, for motions of a type."""

    @wp.struct
    class MotionGiven:
        tolerance: wp.float64  # of times
        batch: PairBatch  # the object pairs
        ends: ObjectPool  # where objects are at the end
        motion: wp.array(dtype=kind)  # of each object pair

    return MotionGiven
