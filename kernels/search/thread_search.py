"""Dual-tree search by threads of the CPU: each takes one object pair after the other, depth first.

Number by number what warps compute on CUDA (`warp_search`), in vector instructions. Items do not wait for one another,
so the processor works on several at once.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from warp_abtree.kernels import native
from warp_abtree.kernels.base.arrays import Trees
from warp_abtree.kernels.base.poses import PairBatch
from warp_abtree.kernels.search.descent import (
    CPU_STACK_LENGTH,
    NEVER,
    WAITING_LENGTH,
    Descent,
    advance,
    count_repeats,
    shuffle_stack,
    start_descent,
)
from warp_abtree.kernels.search.item import OUTPUT_ANY, first_item
from warp_abtree.kernels.search.load_balance import Work, take_thread, take_unit

THREAD_HEADERS = (
    "base/counters.cuh",
    "base/lanes.cuh",
    "search/descend.h",
    "search/load_balance.cuh",
    "search/open_subtrees.h",
    "search/subtrees.h",
)
wp.set_module_options(native.options(*THREAD_HEADERS))


@wp.struct
class ThreadSteps:
    """What a launch of threads does: one thread starts all pairs, alone or before others are there."""

    within: wp.array(dtype=wp.float64)  # distances of pairs, as for `relative_pose_kernel`
    starts: wp.bool  # whether pairs are started
    traverses: wp.bool  # whether they are traversed


@wp.struct
class FaceTests:
    """Counts of an object pair: hits, and tests of face pairs."""

    hits: wp.int64  # face pairs that meet
    near: wp.int64  # those that are apart, and reported
    total: wp.int64  # face pairs tested
    float64: wp.int64  # those that were uncertain in float32
    exact: wp.int64  # those that took exact signs


@wp.struct
class FaceLists:
    """Leaf pairs that wait, and face pairs that filters leave: lists, each with room for 16 more, and their lengths."""

    faces: wp.array(dtype=wp.int64)  # leaf pairs; those that meet take their place, from the first on
    uncertain_faces: wp.array(dtype=wp.int64)  # those that another filter or exact signs decide
    apart_faces: wp.array(dtype=wp.int64)  # those that are apart, perhaps nearer than a gap; [1] where none are listed
    waiting: wp.int32  # leaf pairs
    met: wp.int32  # face pairs that meet
    uncertain: wp.int32  # uncertain ones
    apart: wp.int32  # those that are apart
    tested: wp.int32  # those that the last filter looked at


@wp.func
def make_lists(
    faces: wp.array(dtype=wp.int64), uncertain_faces: wp.array(dtype=wp.int64), apart_faces: wp.array(dtype=wp.int64)
):
    """Return empty lists in memory of a thread."""
    lists = FaceLists()
    lists.faces = faces
    lists.uncertain_faces = uncertain_faces
    lists.apart_faces = apart_faces
    return lists


class ThreadPolicy(NamedTuple):
    """What a search by threads asks of face pairs: functions of a thread, and what they write.

    Attributes:
        headers: Headers that the functions need beside those of the search.
        builds_slabs: Whether slabs of subtrees may be built.
        lists_apart: Whether face pairs that are apart have a list.
        found: Struct of what is found.
        start: (output, trees, batch, within, found, work): starts all pairs.
        test: (output, trees, batch, pair, lists, found, tests) -> hits among the leaf pairs that wait.
        write: (pair, node tests, tests, found): writes the counts of a pair.
    """

    headers: tuple[str, ...]
    builds_slabs: bool
    lists_apart: bool
    found: Any
    start: Callable
    test: Callable
    write: Callable


@functools.cache
def thread_search(policy: ThreadPolicy):
    """Return the kernel whose threads share the object pairs."""
    start_pairs, test, write_counts, found_type = policy.start, policy.test, policy.write, policy.found
    builds_slabs, apart_length = policy.builds_slabs, WAITING_LENGTH if policy.lists_apart else 1

    @wp.kernel(module="unique", module_options=native.options(*THREAD_HEADERS, *policy.headers))
    def search_thread_kernel(
        output: wp.int32,
        trees: Trees,
        plain_tests: wp.int32,
        steps: ThreadSteps,
        batch_inout: PairBatch,
        memory_inout: wp.array2d(dtype=wp.float32),
        found_inout: found_type,
        work_inout: Work,
    ):
        """Start all object pairs, by one thread; take one after the other and search it depth first. CPU only."""
        if steps.starts:
            start_pairs(output, trees, batch_inout, steps.within, found_inout, work_inout)
        if not steps.traverses:
            return
        count = wp.min(batch_inout.count[0], batch_inout.pairs.shape[0])
        stack = wp.zeros(shape=CPU_STACK_LENGTH, dtype=wp.int64)
        below = wp.zeros(shape=CPU_STACK_LENGTH, dtype=wp.int64)
        faces = wp.zeros(shape=WAITING_LENGTH, dtype=wp.int64)
        uncertain = wp.zeros(shape=WAITING_LENGTH, dtype=wp.int64)
        apart = wp.zeros(shape=wp.static(apart_length), dtype=wp.int64)
        lists = make_lists(faces, uncertain, apart)
        for_any = output == OUTPUT_ANY
        descent = Descent()
        descent.thread = take_thread(work_inout.counter)
        p = take_unit(work_inout.counter)
        while p < count:
            pose = batch_inout.poses[p]
            stack[0] = first_item(trees.states, pose)
            slabs = descent.thread < memory_inout.shape[0] and wp.static(builds_slabs) and pose.error < wp.inf
            plain = wp.where(slabs, wp.int64(plain_tests), NEVER)
            start_descent(for_any, plain, count_repeats(p, batch_inout.poses), descent)
            tests = FaceTests()
            while descent.top > 0 or descent.deep > 0:
                lists.waiting = advance(trees, pose, tests.hits, descent, stack, below, memory_inout, faces)
                met = test(output, trees, batch_inout, p, lists, found_inout, tests)
                if for_any:
                    shuffle_stack(met, descent, stack)
            write_counts(p, descent.tests, tests, found_inout)
            p = take_unit(work_inout.counter)

    return search_thread_kernel
