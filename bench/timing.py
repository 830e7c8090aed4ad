"""Times of launches: graph replays between events on CUDA, a clock of the host on the CPU, things in turn."""

import contextlib
import gc
import os
import time
from functools import partial

import numpy as np
import warp as wp

from warp_abtree.testing import regime

WARM_UP = 2  # rounds before the first that counts


def make_replay(launch, device, captured=None):
    """Return a callable that replays a launch as a graph, by default on CUDA alone; its modules are loaded."""
    if not (device.is_cuda if captured is None else captured):
        return launch
    with wp.ScopedCapture(device) as capture:
        launch()
    return partial(wp.capture_launch, capture.graph)


def time_events(replay, device):
    """Return a callable that replays a graph and returns its time [ms], between events."""
    begin, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)

    def run():
        with wp.ScopedDevice(device):
            wp.record_event(begin)
            replay()
            wp.record_event(end)
            return wp.get_event_elapsed_time(begin, end)

    return run


def host_clock(device):
    """Return the clock [s] of calls from the host: on the CPU the time that the thread ran, whatever else the machine
    does; a GPU works while the thread waits."""
    return time.thread_time if device.is_cpu else time.perf_counter


def time_call(call, device="cpu", clock=time.perf_counter):
    """Return a callable that calls something, waits for the device and returns the time [ms] by a clock [s]."""

    def run():
        wp.synchronize_device(device)
        begin = clock()
        call()
        wp.synchronize_device(device)
        return 1e3 * (clock() - begin)

    return run


def time_rounds(runs: dict, repeats) -> dict:
    """Return the sorted times of callables that return a time each, in turn; the first rounds do not count."""
    times = {name: [] for name in runs}
    for turn in range(WARM_UP + repeats):
        for name, run in runs.items():
            taken = run()
            if turn >= WARM_UP:
                times[name].append(taken)
    return {name: sorted(values) for name, values in times.items()}


def make_runs(launches: dict, device, clock=time.perf_counter, captured=None) -> dict:
    """Launch each thing once, in order, which compiles it; return callables that run one and return its time [ms].

    For `captured` see `make_replay`; on the CPU a graph costs no Python a launch.
    """
    runs = {}
    for name, launch in launches.items():
        launch()
        wp.synchronize_device(device)
        replay = make_replay(launch, device, captured)
        runs[name] = time_events(replay, device) if device.is_cuda else time_call(replay, device, clock)
    return runs


def time_in_turn(launches: dict, device, repeats=15, clock=time.perf_counter) -> dict:
    """Return the sorted times [ms] of each launch, measured alternately after compilation: events on CUDA."""
    return time_rounds(make_runs(launches, device, clock), repeats)


def to_host(query):
    """Return a callable that launches a query and returns its result."""
    return lambda: (query.launch(), query.result())[1]


def time_on_host(calls: dict, device, repeats, clock=None) -> dict:
    """Return the sorted times [ms] of calls that return their answers, in turn, by a clock [s] or `host_clock`."""
    with no_garbage_collection():
        return time_in_turn(calls, wp.get_device("cpu"), repeats, clock or host_clock(device))


def medians(times: dict) -> dict:
    """Return the median of each list of times."""
    return {name: float(np.median(values)) for name, values in times.items()}


def summarise(times: dict) -> dict:
    """Return the columns of times [ms] by name: median and 95th percentile."""
    row = {}
    for name, values in times.items():
        row[f"{name}_ms"] = round(float(np.median(values)), 4)
        row[f"{name}_p95_ms"] = round(float(np.percentile(values, 95)), 4)
    return row


def ratio_of(times, base) -> float:
    """Return the ratio of two medians."""
    return round(float(np.median(times) / np.median(base)), 2)


def fit_slope(sizes, times):
    """Return the slope of the line through (log size, log time): 1 is proportional, 0 constant; None of one point."""
    if len(sizes) < 2:
        return None
    return round(float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(times, float)), 1)[0]), 3)


def crossover(x, excess, always):
    """Return the x, on a logarithmic scale, from which on an excess stays above 0: None where it ends below, and
    `always` where it is above 0 everywhere."""
    below = np.flatnonzero(np.asarray(excess) < 0)
    if not len(below):
        return always
    i = int(below[-1])
    if i == len(x) - 1:
        return None
    return float(np.exp(np.interp(0, excess[i : i + 2], np.log(x[i : i + 2]))))


def upper_half(values):
    """Return the upper half of sorted points, where a line has found its slope; all of one or two."""
    return values[len(values) // 2 - 1 :] if len(values) > 2 else values


@contextlib.contextmanager
def one_core(device=None):
    """Hold this thread, and launches, on one core; yield its number, None where the system has no such call.

    Launches of operators made before too, which else share their work with threads that go on elsewhere. For a GPU,
    where a device is given, nothing is held.
    """
    with contextlib.nullcontext() if device and device.is_cuda else regime(cpu_threads=1):
        if not hasattr(os, "sched_setaffinity") or (device and device.is_cuda):
            yield None
            return
        allowed = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {max(allowed)})
        try:
            yield max(allowed)
        finally:
            os.sched_setaffinity(0, allowed)


@contextlib.contextmanager
def no_garbage_collection():
    """Keep Python's collector out of the times: it would visit the contacts that baselines make by the thousand."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
