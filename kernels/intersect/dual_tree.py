"""Face pairs that intersect, or are nearer than a gap: policies of the search by warps."""

import functools
from typing import Any

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.counters import add_lanes
from warp_abtree.kernels.base.lanes import warp_lane
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import FoundHits
from warp_abtree.kernels.intersect.leaf_pairs import separate_leaf_pairs, test_straddling
from warp_abtree.kernels.intersect.small_trees import SmallLists, gather_leaves, is_small, test_small_trees
from warp_abtree.kernels.search.load_balance import Work, parts_at_once
from warp_abtree.kernels.search.warp_search import TraversalTests, WarpPolicy, warp_search

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def pair_has_hit(pair: wp.int32, found: Any):
    return found.hits.any_hit[pair] != 0


@wp.func
def add_pair_tests(pair: wp.int32, tests: TraversalTests, found: Any):
    """Add the tests of a lane to those of its pair. For all lanes."""
    add_lanes(found.hits.node_tests, pair, wp.int64(tests.nodes))
    add_lanes(found.hits.count, pair, wp.int64(tests.hits))
    add_lanes(found.hits.triangle_tests, pair, wp.int64(wp.where(warp_lane() == 0, tests.faces, 0)))
    add_lanes(found.hits.float64_tests, pair, wp.int64(tests.uncertain))


@functools.cache
def hit_policy(mode: int, for_any: bool) -> WarpPolicy:
    """Return the policy at a precision, or for GAP.

    One for OUTPUT_ANY and one for the other outputs, each with what it takes as constants. Uncertain face pairs wait
    for passes of their own.
    """

    @wp.func
    def try_small(
        output: wp.int32,
        slot: wp.int32,
        task: wp.vec3i,
        count: wp.int32,
        trees: Trees,
        pose: PairPose,
        items: wp.uint64,
        found: FoundHits,
        work: Work,
    ):
        """Compare all leaves of two small trees; return 0, or the parts of a pair for the search."""
        lists = SmallLists()
        if slot < 0 and is_small(pose, work.small_faces):
            task[2] = parts_at_once(task[2], count, work.warps)
            lists = gather_leaves(task, items, trees.states, pose)
        if lists.fits:
            test_small_trees(output, wp.static(for_any), task, lists, trees, pose, items, found.hits)
        return wp.where(lists.fits, 0, task[2])

    headers = ("intersect/small_trees.cuh", "triangle/float32_filter.cuh")
    exact = mode == int(EXACT)
    return WarpPolicy(
        headers,
        mode,
        for_any,
        not exact,
        FoundHits,
        try_small if exact else None,
        separate_leaf_pairs,
        test_straddling,
        pair_has_hit,
        add_pair_tests,
    )


def warp_traversal(mode: int, for_any: bool):
    """Return the kernel that has warps share the object pairs, at a precision, or for GAP."""
    return warp_search(hit_policy(mode, for_any))
