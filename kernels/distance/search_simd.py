"""Branch and bound for the nearest faces on the CPU: an object pair a thread, in vector instructions.

Node pairs go depth first, but those that are far for what has been found wait until something nearer may be: few are
looked at then that a search from the answer would not. Faces are measured in float32, 16 at a time, within an error
that is proven as in `triangle_pair` with u = 2^-24, coordinates too (docs/exactness.md, bound 16); float64 decides
between those that may be the nearest. It is the same answer that warps give on CUDA.
"""

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.base.poses import PairBatch, PairPose
from warp_abtree.kernels.distance.frame import (
    NO_FACES,
    Nearest,
    NearestFound,
    SearchScale,
    Tolerances,
    scaled_up,
    start_pair,
    tolerance_terms,
)
from warp_abtree.kernels.distance.report import Distances, report_pair
from warp_abtree.kernels.intersect.face_pairs import Hits, PairTests
from warp_abtree.kernels.search.item import first_item, item_first, item_second
from warp_abtree.kernels.search.load_balance import take_thread, take_unit
from warp_abtree.kernels.search.mean_slabs import Slabs, count_uses, has_mean_slabs, make_due
from warp_abtree.kernels.triangle.corners import load_triangles
from warp_abtree.kernels.triangle.triangle_pair import triangle_distance

MODULE_OPTIONS = native.options(
    "base/lanes.cuh", "distance/lists.h", "distance/search.h", "search/load_balance.cuh", "search/slabs.cuh"
)
wp.set_module_options(MODULE_OPTIONS)

NEAREST_WORDS = native.constant("NEAREST_WORDS")


@native.func_native(cpu=True)
def open_search(
    upper: wp.float32,
    found: bool,
    diving: bool,
    first: wp.int64,
    thread: wp.int32,
    memory: wp.array2d(dtype=wp.float32),
):
    """Begin the search of an object pair.

    Args:
        upper: Scaled distance that the nearest faces are not beyond.
        found: Whether there are faces at that distance.
        diving: Whether the nearest node pairs go first until some faces are measured.
        first: The roots.
    """


@native.func_native(cpu=True)
def search_nearest(
    trees: Trees,
    pose: PairPose,
    scaling: SearchScale,
    terms: wp.vec4,
    slabs: Slabs,
    with_slabs: bool,
    thread: wp.int32,
    memory: wp.array2d(dtype=wp.float32),
    tests: wp.ref[PairTests],
) -> bool:
    """Search until many pairs of faces wait for float64; return False at the end, when the tests are known."""


@native.func_native(cpu=True)
def take_nearest(upper: wp.float32, thread: wp.int32, memory: wp.array2d(dtype=wp.float32)) -> wp.int64:
    """Return the faces that wait and seem nearest, -1 if none may be the nearest.

    Args:
        upper: Scaled distance that the nearest faces are not beyond.
    """


@wp.func
def decide_waiting(
    trees: Trees,
    pose: PairPose,
    scaling: SearchScale,
    thread: wp.int32,
    memory: wp.array2d(dtype=wp.float32),
    nearest: wp.ref[Nearest],
):
    """Measure in float64 the faces that wait, the nearest first, while they can improve the nearest."""
    searching = bool(True)
    while searching:
        item = take_nearest(scaled_up(nearest.distance, scaling), thread, memory)
        searching = item >= wp.int64(0)
        if searching:
            d = triangle_distance(load_triangles(trees, pose, item_first(item), item_second(item)))
            if d < nearest.distance or (d == nearest.distance and item < nearest.faces):
                nearest.distance = d
                nearest.faces = item


@wp.struct
class SearchRequest:
    """What a launch does, and the tolerances of distances."""

    tolerances: Tolerances  # when pairs are near enough
    refreshes: wp.bool  # whether a thread that is still alone makes the slabs that are due
    searches: wp.bool  # whether it, or each of several, then takes pairs


@wp.func
def search_pair(
    p: wp.int32,
    before: wp.float64,
    tolerances: Tolerances,
    trees: Trees,
    batch: PairBatch,
    slabs: Slabs,
    thread: wp.int32,
    found: NearestFound,
    hits: Hits,
    memory: wp.array2d(dtype=wp.float32),
):
    """Find the nearest faces of an object pair that does not intersect.

    Where the last launch's faces are now twice or half as far apart, objects have moved far, and other faces are likely
    much nearer: the search begins as without them, which takes 0.8 of the time.

    Args:
        before: Distance that the last launch found, NaN where the faces are not of it.
    """
    pose = batch.poses[p]
    scaling = found.scaling[p]
    nearest = Nearest()
    nearest.distance = found.distance[p]
    nearest.faces = found.faces[p]
    diving = nearest.distance == wp.float64(wp.inf)
    if nearest.faces != NO_FACES:
        diving = nearest.distance > wp.float64(2.0) * before or before > wp.float64(2.0) * nearest.distance
    with_slabs = has_mean_slabs(trees.states, slabs, p)
    terms = tolerance_terms(tolerances, scaling)
    open_search(
        scaled_up(nearest.distance, scaling),
        nearest.faces != NO_FACES,
        diving,
        first_item(trees.states, pose),
        thread,
        memory,
    )
    tests, searching = PairTests(), bool(True)
    while searching:
        searching = search_nearest(trees, pose, scaling, terms, slabs, with_slabs, thread, memory, tests)
        decide_waiting(trees, pose, scaling, thread, memory, nearest)
    hits.node_tests[p] += wp.int64(tests.nodes)
    hits.triangle_tests[p] += wp.int64(tests.faces)
    found.distance[p] = nearest.distance
    found.faces[p] = nearest.faces


@wp.kernel(module="unique", module_options=MODULE_OPTIONS)
def search_thread_kernel(
    request: SearchRequest,
    trees: Trees,
    batch: PairBatch,
    counter_inout: wp.array(dtype=wp.int32),
    slabs_inout: Slabs,
    found_inout: NearestFound,
    hits_inout: Hits,
    distances_out: Distances,
    memory_out: wp.array2d(dtype=wp.float32),
):
    """Take one object pair after the other, search those that do not intersect, and report; CPU only, a thread a core.

    One launch for all, since a launch takes the host as long as a seventh of a search.
    """
    if batch.launched[0] == STALE:
        return
    count = wp.min(batch.count[0], batch.pairs.shape[0])
    if request.refreshes:
        for i in range(counter_inout.shape[0]):
            counter_inout[i] = 0
        slabs_inout.due_count[0] = 0
        for i in range(count):
            count_uses(i, trees, batch.pairs, slabs_inout)
        make_due(0, 1, 0, 1, trees, slabs_inout)
    if not request.searches:
        return
    thread = take_thread(counter_inout)
    if thread >= memory_out.shape[0]:
        return
    p = take_unit(counter_inout)
    while p < count:
        before = found_inout.distance[p]
        start_pair(p, trees, batch, found_inout)
        if hits_inout.any_hit[p] == 0:
            search_pair(
                p, before, request.tolerances, trees, batch, slabs_inout, thread, found_inout, hits_inout, memory_out
            )
        report_pair(p, request.tolerances, trees, batch, found_inout, hits_inout, distances_out)
        p = take_unit(counter_inout)
