"""Kernels compiled by several threads at a time: the first query of a machine would wait for one after the other."""

from collections import deque
from contextlib import contextmanager

import warp as wp

from warp_abtree.checks.cpu_threads import core_count, wait_for, workers

# Threads beside the calling one: on the CPU each compiles Warp's headers for itself first.
THREADS = {"cpu": 1, "cuda": 3}

_asked: set[tuple] = set()


@contextmanager
def loading(device, kernels):
    """Load kernels beside what is done inside, and end when all are loaded; each is loaded once in a process.

    Args:
        device: Of the launches, `wp.Device`.
        kernels: The kernel and the block size of each launch, those first that take longest.

    Raises:
        Exception: What the compiler says, as a launch would.
    """
    asked = dict.fromkeys((device.alias, kernel.module, block_dim) for kernel, block_dim in kernels)
    new = deque(key for key in asked if key not in _asked)
    threads = min(THREADS["cpu" if device.is_cpu else "cuda"], core_count() - 1, len(new))

    def load():
        while new:
            try:
                _, module, block_dim = key = new.popleft()
            except IndexError:  # another thread was faster
                return
            wp.force_load(device, [module], block_dim)
            _asked.add(key)

    jobs = [workers(threads).submit(load) for _ in range(threads)]
    try:
        yield
        if jobs:
            load()
    finally:
        new.clear()
        wait_for(jobs)
    for job in jobs:
        job.result()
