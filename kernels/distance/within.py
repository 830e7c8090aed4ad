"""Face pairs within a distance of each other: policies of both searches over one function of a face pair.

Boxes, and slabs where there are any, drop what is proved farther apart; each face pair that is left is visited once,
in any order. A visit writes what it finds so that the order does not matter: flags, counts, minima.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.lanes import warp_lane, warp_sync
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.dual_tree import add_pair_tests, pair_has_hit
from warp_abtree.kernels.intersect.face_pairs import Hits, test_faces
from warp_abtree.kernels.intersect.relative_pose import pairs_starter
from warp_abtree.kernels.intersect.simd import write_counts
from warp_abtree.kernels.search.item import OUTPUT_ANY, OUTPUT_COUNT, item_first, item_second
from warp_abtree.kernels.search.thread_search import FaceLists, FaceTests, ThreadPolicy, thread_search
from warp_abtree.kernels.search.warp_search import WarpPolicy, warp_search
from warp_abtree.kernels.search.warp_stack import (
    STACK_LENGTH,
    STRADDLING_START,
    WarpLists,
    push_straddling,
    read_item,
)
from warp_abtree.kernels.triangle.corners import load_face_pair, load_triangles
from warp_abtree.kernels.triangle.distance import triangles_near
from warp_abtree.kernels.triangle.triangle_pair import triangle_distance

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


class Question(NamedTuple):
    """What is asked of face pairs.

    Attributes:
        visit: (pair, faces, trees, pose, own) -> whether a face pair is a hit. Faces are (of A, of B), A the object
            with the smaller index; the pair names B first where `pose.swapped` is 1.
        own: Type of what a visit is given and writes: a Warp struct, or a number.
        for_any: Whether one hit ends an object pair.
        headers: Headers that a visit needs beside those of the searches.
    """

    visit: Callable
    own: Any
    for_any: bool
    headers: tuple[str, ...] = ()

    @property
    def output(self) -> int:
        """What a traversal calls it."""
        return int(OUTPUT_ANY if self.for_any else OUTPUT_COUNT)


@functools.cache
def found_struct(own_type):
    """Return the struct of what searches find: the hits of each pair, and what visits write."""

    @wp.struct
    class Visited:
        hits: Hits  # counts of face pairs
        own: own_type  # of the visits

    return Visited


@functools.cache
def warp_within(question: Question):
    """Return the kernel that has warps share the object pairs."""
    visit, for_any, found_type = question.visit, question.for_any, found_struct(question.own)

    @wp.func
    def separate(mode: wp.int32, own: wp.ref[WarpLists], popped: wp.int32, trees: Trees, pose: PairPose):
        """Let leaf pairs wait as straddling pairs."""
        lane = warp_lane()
        own.leaf_pairs -= popped
        item = read_item(own.items, STACK_LENGTH + own.leaf_pairs + wp.min(lane, popped - 1))
        push_straddling(own.items, own.straddling, lane < popped, item, 0)
        warp_sync()

    @wp.func
    def test(
        mode: wp.int32,
        output: wp.int32,
        own: wp.ref[WarpLists],
        popped: wp.int32,
        pair: wp.int32,
        trees: Trees,
        pose: PairPose,
        found: found_type,
    ):
        """Visit face pairs, one a lane."""
        lane, is_hit = warp_lane(), bool(False)
        own.straddling -= popped
        item = read_item(own.items, STRADDLING_START + own.straddling + wp.min(lane, popped - 1))
        if lane < popped:
            is_hit = visit(pair, wp.vec2i(item_first(item), item_second(item)), trees, pose, found.own)
        if is_hit:
            found.hits.any_hit[pair] = 1
        warp_sync()
        return is_hit, False

    return warp_search(
        WarpPolicy(question.headers, 0, for_any, True, found_type, None, separate, test, pair_has_hit, add_pair_tests)
    )


@functools.cache
def thread_within(question: Question):
    """Return the kernel whose threads share the object pairs."""
    visit, for_any, found_type = question.visit, question.for_any, found_struct(question.own)

    @wp.func
    def test(
        output: wp.int32,
        trees: Trees,
        batch: PairBatch,
        pair: wp.int32,
        lists: wp.ref[FaceLists],
        found: found_type,
        tests: wp.ref[FaceTests],
    ):
        """Visit face pairs, one after the other."""
        met = wp.int32(0)
        for i in range(lists.waiting):
            if not wp.static(for_any) or met == 0:
                tests.total += wp.int64(1)
                faces = wp.vec2i(item_first(lists.faces[i]), item_second(lists.faces[i]))
                if visit(pair, faces, trees, batch.poses[pair], found.own):
                    met += 1
        if met > 0:
            found.hits.any_hit[pair] = 1
        tests.hits += wp.int64(met)
        return met

    start = pairs_starter(True)
    policy = ThreadPolicy(question.headers, not for_any, False, found_type, start, test, write_counts)
    return thread_search(policy)


# Headers that visits need which ask for distances.
DISTANCE_HEADERS = ("exact/determinant.cuh",)


@wp.func
def face_distance(trees: Trees, pose: PairPose, faces: wp.vec2i):
    """Return the least distance of a face of A and one of B [world units], 0 where they intersect."""
    distance = wp.float64(0.0)
    if test_faces(EXACT, trees, pose, faces[0], faces[1]) != 1:
        distance = triangle_distance(load_triangles(trees, pose, faces[0], faces[1]))
    return distance


@wp.func
def visit_near(pair: wp.int32, faces: wp.vec2i, trees: Trees, pose: PairPose, own: wp.int32):
    """Return False where faces are proved farther apart than `within`, in float64."""
    a = trees.states.face_corner[pose.corner_a + faces[0]]
    b = trees.states.face_corner[pose.corner_b + faces[1]]
    a0, a1, a2, b0, b1, b2 = load_face_pair(trees.models, pose, a, b)
    return triangles_near(pose.within, a0, a1, a2, b0, b1, b2) == 1


# Which object pairs are not proved farther apart than a distance.
PROVED_APART = Question(visit_near, wp.int32, True)
