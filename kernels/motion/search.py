"""Branch and bound for the first contact of two trees: depth first, the earliest children first.

Each node pair carries the time up to which it is proved apart, made of its own boxes and those above it alone, and is
dropped if that is after the best time so far. So the earliest time is found whatever the order, on every device. A
thread of the CPU takes one object pair after the other; warps search as in `group`.
"""

from functools import cache

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.generation import STALE
from warp_abtree.kernels.intersect.face_pairs import Hits
from warp_abtree.kernels.motion.face_pair import CLEAR, TO_THE_END, TOUCHES, FirstContact, PairProgress
from warp_abtree.kernels.motion.kinds import STEPS, motion_given
from warp_abtree.kernels.motion.start import OPEN, FirstContacts
from warp_abtree.kernels.search.best_first import BestFirstPolicy, Entry, SearchLists, best_first, start_lists
from warp_abtree.kernels.search.item import Emitted, first_item, item_first, item_second
from warp_abtree.kernels.search.load_balance import take_thread, take_unit
from warp_abtree.kernels.search.nearest_stack import NEAREST_MEMORY, write_bounded
from warp_abtree.kernels.search.warp_stack import STACK_LENGTH, STRADDLING_START

MODULE_OPTIONS = native.options(
    "base/lanes.cuh",
    "exact/apart_until.cuh",
    "exact/determinant.cuh",
    "search/load_balance.cuh",
    "search/nearest_stack.cuh",
)
wp.set_module_options(MODULE_OPTIONS)

# Words of 8 bytes of the lists of a thread of the CPU.
LIST_WORDS = int(STRADDLING_START) + int(STRADDLING_START) // 2


@native.func_native()
def thread_lists(memory: wp.array2d(dtype=wp.int64), thread: wp.int32) -> wp.uint64:
    """Return the address of a CPU thread's lists."""


@wp.struct
class ContactSearch:
    """Search of a thread for the first contact of an object pair."""

    pair: wp.int32  # its number
    best: FirstContact  # so far
    nodes: wp.int32  # pairs of boxes compared
    faces: wp.int32  # pairs of faces advanced


@cache
def contact_policy(kind) -> BestFirstPolicy:
    """Return the policy of threads for motions of a type: face pairs are advanced to their end, one after the other."""
    given_type = motion_given(kind)
    _, advance_nodes, advance_faces = STEPS[kind]

    @wp.func
    def expand(trees: Trees, given: given_type, search: wp.ref[ContactSearch], entry: Entry):
        p, t, best = search.pair, entry.bound, search.best.time
        emitted = Emitted()
        if wp.float64(t) <= best:
            emitted = advance_nodes(trees.states, given.batch.poses[p], given.motion[p], t, best, entry.item, -1)
            search.nodes += emitted.tests
        return emitted

    @wp.func
    def advance(
        trees: Trees, given: given_type, search: wp.ref[ContactSearch], lists: wp.ref[SearchLists], entry: Entry
    ):
        p, best = search.pair, search.best
        progress = PairProgress()
        progress.time = wp.float64(entry.bound)
        progress.mode = TO_THE_END
        if progress.time <= best.time:
            faces = wp.vec2i(item_first(entry.item), item_second(entry.item))
            own, _ = advance_faces(trees, given, p, faces, progress, best.time)
            if own.end != CLEAR and (own.time < best.time or (own.time == best.time and best.end != TOUCHES)):
                # A pair that is undecided at the same time does not matter.
                search.best = own
            search.faces += 1

    return BestFirstPolicy(NEAREST_MEMORY, given_type, ContactSearch, None, expand, advance, advance, turns=True)


@cache
def thread_motion_search(kind):
    """Return the kernel of the CPU's threads for motions of a type."""
    policy = contact_policy(kind)
    search_pair, given_type = best_first(policy), policy.given

    @wp.kernel(module="unique", module_options=MODULE_OPTIONS)
    def search_thread_kernel(
        trees: Trees,
        given: given_type,
        hits_inout: Hits,
        contacts_inout: FirstContacts,
        memory_out: wp.array2d(dtype=wp.int64),
    ):
        """Take one object pair after the other that is open, and search it; CPU only."""
        if given.batch.launched[0] == STALE:
            return
        count = wp.min(given.batch.count[0], given.batch.poses.shape[0])
        thread = take_thread(contacts_inout.counter)
        if thread >= memory_out.shape[0]:
            return
        lists = start_lists(thread_lists(memory_out, thread), STACK_LENGTH)
        p = take_unit(contacts_inout.counter)
        while p < count:
            if contacts_inout.end[p] == OPEN:
                search = ContactSearch()
                search.pair = p
                search.best.time = wp.float64(1.0)
                item = first_item(trees.states, given.batch.poses[p])
                write_bounded(lists.items, 0, item, wp.float32(contacts_inout.time[p]), 0)
                lists.end = 1
                search_pair(trees, given, search, lists)
                contacts_inout.time[p] = search.best.time
                contacts_inout.end[p] = search.best.end
                hits_inout.node_tests[p] += wp.int64(search.nodes)
                hits_inout.triangle_tests[p] += wp.int64(search.faces)
            p = take_unit(contacts_inout.counter)

    return search_thread_kernel
