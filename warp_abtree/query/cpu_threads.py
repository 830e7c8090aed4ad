"""Launches on several cores of the CPU: Warp runs one on one thread, so a launch is dealt out to several."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor, wait

import warp as wp


def core_count() -> int:
    """Return the cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


@functools.cache
def _workers(count: int):
    return ThreadPoolExecutor(count, thread_name_prefix="warp_abtree")


if hasattr(os, "register_at_fork"):
    # Threads do not come along into a forked child: it would wait for ever for those of its parent.
    os.register_at_fork(after_in_child=_workers.cache_clear)


class RecordedLaunches:
    """Launches on this thread, replayed as recorded while their inputs hold the same bytes.

    Most of the time of a launch goes into packing its inputs, a struct field by field.
    """

    def __init__(self):
        self._recorded = {}

    def launch(self, kernel, dim, inputs, device):
        """Launch a kernel; while a graph is captured, without a record."""
        if device.is_capturing:
            wp.launch(kernel, dim=dim, inputs=inputs, device=device)
            return
        given = [dim, *(bytes(value.__ctype__()) if hasattr(value, "__ctype__") else value for value in inputs)]
        before, command = self._recorded.get(kernel, (None, None))
        if given != before:
            command = wp.launch(kernel, dim=dim, inputs=inputs, device=device, record_cmd=True)
            self._recorded[kernel] = given, command
        command.launch()


def launch_on_cores(kernel, count, inputs, device, cores, least=1):
    """Launch a kernel on several threads of the CPU, which share a number of items; waits for them.

    Each thread of the kernel takes one item after the other until there are none. It writes what belongs to its item
    alone, or with true atomics: Warp's own are none on the CPU. While a graph is captured, one thread launches, since
    only its launches would be recorded.

    Args:
        least: Items that make a further core worth its while.
    """
    cores = max(1, min(cores, count // least))
    if cores > 1 and device.is_capturing:
        cores = 1
    if cores > 1:
        wp.load_module(kernel.module, device)  # modules load on one thread
    deal = []
    try:
        for _ in range(1, cores):
            deal.append(_workers(cores - 1).submit(wp.launch, kernel, dim=1, inputs=inputs, device=device))
        wp.launch(kernel, dim=1, inputs=inputs, device=device)
    finally:
        _wait_for(deal)
    for job in deal:
        job.result()


def _wait_for(jobs):
    """Wait until no thread touches the arrays of a launch any more, whatever interrupts that; raise it then."""
    interruption = None
    while not all(job.done() for job in jobs):
        try:
            wait(jobs)
        except BaseException as error:
            interruption = error
    if interruption is not None:
        raise interruption
