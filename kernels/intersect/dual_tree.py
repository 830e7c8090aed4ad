"""Face pairs that intersect, or are nearer than a gap: policies of the search by warps."""

import functools

import warp as wp

from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.counters import add_warp_sum
from warp_abtree.kernels.base.lanes import warp_lane
from warp_abtree.kernels.base.poses import PairPose
from warp_abtree.kernels.exact.predicates import EXACT
from warp_abtree.kernels.intersect.face_pairs import OUTPUT_ANY, Hits
from warp_abtree.kernels.intersect.leaf_pairs import separate_leaf_pairs, test_straddling
from warp_abtree.kernels.intersect.small_trees import SmallLists, gather_leaves, is_small, test_small_trees
from warp_abtree.kernels.search.load_balance import Work, parts_at_once
from warp_abtree.kernels.search.warp_search import TraversalTests, WarpPolicy, warp_search
from warp_abtree.kernels.search.warp_stack import WarpLists

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def pair_has_hit(pair: wp.int32, found: Hits):
    return found.any_hit[pair] != 0


@wp.func
def add_pair_tests(pair: wp.int32, tests: TraversalTests, found: Hits):
    """Add the tests of a lane to those of its pair. For all lanes."""
    add_warp_sum(found.node_tests, pair, tests.nodes)
    add_warp_sum(found.count, pair, tests.hits)
    add_warp_sum(found.triangle_tests, pair, wp.where(warp_lane() == 0, tests.faces, 0))
    add_warp_sum(found.float64_tests, pair, tests.uncertain)


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
        found: Hits,
        work: Work,
    ):
        """Compare all leaves of two small trees; return 0, or the parts of a pair for the search."""
        lists = SmallLists()
        if wp.static(mode == int(EXACT)):
            if slot < 0 and is_small(pose, work.small_faces):
                task[2] = parts_at_once(task[2], count, work.warps)
                lists = gather_leaves(task, items, trees.states, pose)
        if lists.fits:
            asked = wp.where(wp.static(for_any), OUTPUT_ANY, output)
            test_small_trees(asked, wp.static(for_any), task, lists, trees, pose, items, found)
        return wp.where(lists.fits, 0, task[2])

    @wp.func
    def separate(own: wp.ref[WarpLists], popped: wp.int32, trees: Trees, pose: PairPose):
        separate_leaf_pairs(wp.static(mode), own, popped, trees, pose)

    @wp.func
    def test(
        output: wp.int32,
        own: wp.ref[WarpLists],
        popped: wp.int32,
        pair: wp.int32,
        trees: Trees,
        pose: PairPose,
        found: Hits,
    ):
        asked = wp.where(wp.static(for_any), OUTPUT_ANY, output)
        return test_straddling(asked, wp.static(mode), own, popped, pair, trees, pose, found)

    headers = ("intersect/small_trees.cuh", "triangle/float32_filter.cuh")
    within = mode != int(EXACT)
    return WarpPolicy(headers, for_any, within, Hits, try_small, separate, test, pair_has_hit, add_pair_tests)


def warp_traversal(mode: int, for_any: bool):
    """Return the kernel that has warps share the object pairs, at a precision, or for GAP."""
    return warp_search(hit_policy(mode, for_any))
