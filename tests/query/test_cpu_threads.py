"""Launches that several threads of the CPU share: every item once, errors raised, nothing kept afterwards."""

import gc
import threading
import weakref
from functools import partial

import numpy as np
import pytest
import warp as wp

from warp_abtree.checks.cpu_threads import cores_for, launch_on_cores, workers
from warp_abtree.kernels import native
from warp_abtree.kernels.base.counters import take_slots


@wp.kernel(module="unique", module_options=native.options("base/counters.cuh"))
def count_item_kernel(count: int, taken: wp.array[int], seen: wp.array[int]):
    i = take_slots(taken, 1)
    while i < count:
        seen[i] = seen[i] + 1
        i = take_slots(taken, 1)


def test_threads_take_every_item_once_and_raise_what_fails():
    for threads, count in ((1, 17), (2, 1), (3, 1000), (7, 16), (2, 100)):
        seen, taken = (wp.zeros(length, dtype=int, device="cpu") for length in (count, 1))
        inputs = [count, taken, seen]
        launch_on_cores(partial(wp.launch, count_item_kernel, 1, inputs, device="cpu"), cores_for(count, 1, threads))
        # Each thread that began before the items were gone has found that none is left.
        assert (seen.numpy() == 1).all() and 1 <= taken.numpy()[0] - count <= min(threads, count)
    with pytest.raises(Exception, match="'seen'"):
        launch_on_cores(partial(wp.launch, count_item_kernel, 1, [100, taken, 3.5], device="cpu"), 2)


def test_a_busy_thread_keeps_no_launch_that_ended_without_it():
    go_on, items = threading.Event(), np.zeros(1)
    busy, kept = workers(1).submit(go_on.wait), weakref.ref(items)
    try:
        launch_on_cores(partial(items.fill, 1), 2)
        del items
        gc.collect()
        assert kept() is None
    finally:
        go_on.set()
        busy.result()
