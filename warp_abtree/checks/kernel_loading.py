"""Kernels compiled by several threads at a time: the first query of a machine would wait for one after the other."""

from collections import deque
from collections.abc import Callable
from contextlib import contextmanager, suppress
from threading import get_ident

import warp as wp

from warp_abtree.checks.cpu_threads import core_count, wait_for, workers
from warp_abtree.checks.package import import_quickly

# Threads beside the calling one: on the CPU each compiles Warp's headers for itself first.
LOADING_THREADS = {"cpu": 1, "cuda": 7}
# The same beside the build of a model, which keeps one core busy itself, and another while its kernels are loaded.
AHEAD_THREADS = {"cpu": 2, "cuda": 6}

# What registers the kernels of a first query, which may not have been imported yet.
FIRST_QUERY = ("warp_abtree.scene.kept_queries",)

_asked: set[tuple] = set()
_first_query: list[Callable] = []
_told: list[Callable] = []


def tell_loading(function: Callable | None):
    """Have a function told (done, total) while `loading` loads kernels, by the thread that calls it; None ends that."""
    _told[:] = [] if function is None else [function]


def _new_kernels(device, kernels) -> deque:
    """Return the modules and block sizes of launches that no thread has loaded in this process."""
    asked = dict.fromkeys((device.alias, kernel.module, block_dim) for kernel, block_dim in kernels)
    return deque(key for key in asked if key not in _asked)


@contextmanager
def loading(device, kernels):
    """Load kernels beside what is done inside, and end when all are loaded; each is loaded once in a process.

    Raises what the compiler says, as a launch would.

    Args:
        kernels: The kernel and the block size of each launch, those first that take longest.
    """
    new = _new_kernels(device, kernels)
    total, done = len(new), []
    threads = min(LOADING_THREADS["cpu" if device.is_cpu else "cuda"], core_count() - 1, len(new))

    def load():
        while new:
            try:
                _, module, block_dim = key = new.popleft()
            except IndexError:  # another thread was faster
                return
            wp.force_load(device, [module], block_dim)
            _asked.add(key)
            done.append(key)
            if get_ident() == caller:
                tell(len(done))

    def tell(count):
        for function in _told if total else []:
            function(count, total)

    caller = get_ident()
    jobs = [workers(threads).submit(load) for _ in range(threads)]
    try:
        tell(0)
        yield
        if jobs:
            load()
    finally:
        new.clear()
        wait_for(jobs)
        tell(total)
    for job in jobs:
        job.result()


def of_first_query(function):
    """Register the function (device, face_counts) that returns what the first query launches, as `loading` takes it."""
    _first_query.append(function)
    return function


@contextmanager
def compiling_ahead(face_count: int, kernels):
    """Load the kernels of a model's build, and compile beside what is done inside, the build, what a query on Warp's
    default device will launch.

    Only what has begun by the end is waited for, and the rest goes on meanwhile. On a GPU nothing is loaded, so that a
    process which only builds models has no CUDA context. What the compiler says, a launch will say again.

    Args:
        kernels: Of the build, as `loading` takes them.
    """
    device, cores = wp.get_device(), core_count()
    kind = "cpu" if device.is_cpu else "cuda"
    new: deque = deque()

    def compile_next():
        with suppress(Exception):  # emptied at the end, or what the compiler says
            _, module, block_dim = new.popleft()
            if kind == "cpu":
                wp.force_load(device, [module], block_dim)
            elif module.options["block_dim"] == block_dim:  # else a launch would look for another file
                wp.compile_aot_module(module, device)

    jobs: list = []
    try:
        with loading(wp.get_device("cpu"), kernels):
            if cores > 1:
                for name in FIRST_QUERY:
                    import_quickly(name)  # while another thread compiles
                new.extend(key for found in _first_query for key in _new_kernels(device, found(device, [face_count])))
                # The threads that `loading` takes later, each with Warp's headers compiled: with two cores the same.
                threads = min(AHEAD_THREADS[kind], max(1, cores - 2), len(new))
                jobs += [workers(threads).submit(compile_next) for _ in range(len(new))]
        yield
        begun = [job for job in jobs if not job.cancel()]
        while new and not all(job.done() for job in begun):
            compile_next()
    finally:
        new.clear()
        wait_for(jobs)
