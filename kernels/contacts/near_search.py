"""Contact witnesses as policies of the search: what is apart but may be near is offered to slots where it is found.

Hits are those of a search for faces that intersect. Nothing that is apart is listed, but for face pairs that float32
leaves uncertain by warps, which wait for later passes.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import ModelPool, StatePool, Trees
from warp_abtree.kernels.base.lanes import warp_lane
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.contacts.slots import Slots, offer_pair
from warp_abtree.kernels.intersect import dual_tree, simd
from warp_abtree.kernels.intersect.face_pairs import GAP, OUTPUT_ANY, Hits
from warp_abtree.kernels.intersect.leaf_pairs import report_straddling, separate_leaf_pairs, take_straddling
from warp_abtree.kernels.intersect.relative_pose import pairs_starter
from warp_abtree.kernels.search.item import item_first, item_second
from warp_abtree.kernels.search.load_balance import Work
from warp_abtree.kernels.search.thread_search import FaceTests, ThreadPolicy, thread_search
from warp_abtree.kernels.search.warp_search import TraversalTests, WarpPolicy, warp_search
from warp_abtree.kernels.search.warp_stack import WarpLists

wp.set_module_options(native.options("contacts/near_offer.cuh", "contacts/offer_list.h"))


@wp.struct
class NearFound:
    """Face pairs that intersect, and slots of those that are apart."""

    hits: Hits  # those that intersect
    slots: Slots  # what those that are apart are offered to


@functools.cache
def warp_near_search():
    """Return the kernel that has warps share the object pairs."""

    @wp.func
    def try_small(
        output: wp.int32,
        slot: wp.int32,
        task: wp.vec3i,
        count: wp.int32,
        trees: Trees,
        pose: PairPose,
        items: wp.uint64,
        found: NearFound,
        work: Work,
    ):
        return False

    @wp.func
    def separate(own: wp.ref[WarpLists], popped: wp.int32, trees: Trees, pose: PairPose):
        separate_leaf_pairs(GAP, own, popped, trees, pose)

    @wp.func
    def test(
        output: wp.int32,
        own: wp.ref[WarpLists],
        popped: wp.int32,
        pair: wp.int32,
        trees: Trees,
        pose: PairPose,
        found: NearFound,
    ):
        """Test straddling pairs, report those that meet or are uncertain, and offer those that are apart."""
        item, meet = take_straddling(GAP, own, popped, trees, pose)
        taken = warp_lane() < popped
        if meet == 0 and taken:
            offer_pair(trees, pose, pair, item_first(item), item_second(item), found.hits.gap, found.slots)
        return report_straddling(output, taken, meet, item, pair, pose.swapped, found.hits)

    @wp.func
    def has_hit(pair: wp.int32, found: NearFound):
        return dual_tree.pair_has_hit(pair, found.hits)

    @wp.func
    def add_tests(pair: wp.int32, tests: TraversalTests, found: NearFound):
        dual_tree.add_pair_tests(pair, tests, found.hits)

    policy = WarpPolicy(
        ("contacts/near_offer.cuh",), False, True, NearFound, try_small, separate, test, has_hit, add_tests
    )
    return warp_search(policy)


@native.func_native(cpu=True)
def simd_offer_faces(
    models: ModelPool,
    states: StatePool,
    pose: PairPose,
    count: wp.int32,
    faces: wp.array(dtype=wp.int64),
    bounds: wp.vec2,
    directions: wp.array(dtype=wp.float32),
    widths: wp.vec2i,
    pair: wp.int32,
    slots: wp.array(dtype=wp.int64),
):
    """Offer so many face pairs to the slots of their object pair, 16 at a time.

    Args:
        bounds: The gap at unit size, and the weight of directions.
    """


@functools.cache
def thread_near_search():
    """Return the kernel whose threads share the object pairs."""
    start_pairs = pairs_starter(True)

    @wp.func
    def start(
        output: wp.int32,
        trees: Trees,
        batch: PairBatch,
        within: wp.array(dtype=wp.float64),
        found: NearFound,
        work: Work,
    ):
        start_pairs(output, trees, batch, within, found.hits, work)

    @wp.func
    def test(
        output: wp.int32,
        trees: Trees,
        batch: PairBatch,
        pair: wp.int32,
        waiting: wp.int32,
        faces: wp.array(dtype=wp.int64),
        uncertain: wp.array(dtype=wp.int64),
        apart: wp.array(dtype=wp.int64),
        found: NearFound,
        tests: wp.ref[FaceTests],
    ):
        """Test leaf pairs, report those that meet, and offer those that are apart."""
        pose, parted, slots = batch.poses[pair], simd.Filtered(), found.slots
        simd.test_gap_pairs(trees, pose, waiting, faces, uncertain, apart, parted, tests)
        bounds = wp.vec2(wp.float32(found.hits.gap[pair] * pose.scale), slots.weight[pair])
        widths, count = slots.widths[pair], parted.apart
        simd_offer_faces(
            trees.models, trees.states, pose, count, apart, bounds, slots.directions, widths, pair, slots.key
        )
        return simd.report_met(output, pair, pose.swapped, parted.met, faces, found.hits, tests)

    @wp.func
    def write(p: wp.int32, node_tests: wp.int64, tests: FaceTests, found: NearFound):
        simd.write_counts(p, node_tests, tests, found.hits)

    headers = (*simd.FILTERS, "contacts/near_offer.cuh", "contacts/offer_list.h")
    return thread_search(ThreadPolicy(headers, True, True, NearFound, start, test, write), int(OUTPUT_ANY))
