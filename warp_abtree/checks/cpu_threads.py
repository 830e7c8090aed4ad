"""Launches on several cores of the CPU: Warp runs one on one thread, so a launch is dealt out to several."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor, wait


def core_count() -> int:
    """Return the cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


@functools.cache
def workers(count: int):
    """Return threads for work beside the calling one, the same for the same count."""
    return ThreadPoolExecutor(count, thread_name_prefix="warp_abtree")


if hasattr(os, "register_at_fork"):
    # Threads do not come along into a forked child: it would wait for ever for those of its parent.
    os.register_at_fork(after_in_child=workers.cache_clear)


def launch_on_cores(launch, count, cores, least=1):
    """Launch a kernel on several threads of the CPU, which share a number of items; waits for them.

    Each thread of the kernel takes one item after the other until there are none. It writes what belongs to its item
    alone, or with true atomics: Warp's own are none on the CPU.

    Args:
        launch: Launches a kernel that is loaded, one thread of it.
        least: Items that make a further core worth its while.
    """
    cores = max(1, min(cores, count // least))
    deal = []
    try:
        for _ in range(1, cores):
            deal.append(workers(cores - 1).submit(launch))
        launch()
    finally:
        wait_for(deal)
    for job in deal:
        job.result()


def wait_for(jobs):
    """Wait until no thread touches the arrays of a launch any more, whatever interrupts that; raise it then."""
    interruption = None
    while not all(job.done() for job in jobs):
        try:
            wait(jobs)
        except BaseException as error:
            interruption = error
    if interruption is not None:
        raise interruption
