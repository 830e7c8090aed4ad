"""Contact witnesses as a policy of the search by threads: what is apart but may be near is offered to slots at once.

Hits are those of a search for faces that intersect; nothing that is apart is listed. Warps list what is apart, and
offer it in a launch of its own, which takes half of the time of offers between the tests of a traversal.
"""

import functools

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.contacts.slots import Slots
from warp_abtree.kernels.intersect import simd
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.intersect.relative_pose import pairs_starter
from warp_abtree.kernels.search.thread_search import FaceLists, FaceTests, ThreadPolicy, thread_search

wp.set_module_options(native.options("contacts/near_offer.cuh", "contacts/offer_list.h"))


@wp.struct
class NearFound:
    """Face pairs that intersect, and slots of those that are apart."""

    hits: Hits  # those that intersect
    slots: Slots  # what those that are apart are offered to


@native.func_native(cpu=True)
def simd_offer_faces(
    trees: Trees,
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

    @wp.func
    def test(
        output: wp.int32,
        trees: Trees,
        batch: PairBatch,
        pair: wp.int32,
        lists: wp.ref[FaceLists],
        found: NearFound,
        tests: wp.ref[FaceTests],
    ):
        """Test leaf pairs, report those that meet, and offer those that are apart."""
        pose, slots = batch.poses[pair], found.slots
        simd.test_gap_pairs(trees, pose, lists, tests)
        bounds = wp.vec2(wp.float32(found.hits.gap[pair] * pose.scale), slots.weight[pair])
        if lists.apart > 0:
            slots.used[pair] = 1
        simd_offer_faces(
            trees, pose, lists.apart, lists.apart_faces, bounds, slots.directions, slots.widths[pair], pair, slots.key
        )
        return simd.report_met(output, pair, pose.swapped, lists, found.hits, tests)

    start = pairs_starter(True)
    headers = (*simd.FILTERS, "contacts/near_offer.cuh", "contacts/offer_list.h")
    return thread_search(ThreadPolicy(headers, True, True, NearFound, start, test, simd.write_counts))
