"""Times of launches: graph replays between events on CUDA, a clock of the host on the CPU, things in turn."""

import contextlib
import gc
import os
import time
from functools import partial

import numpy as np
import warp as wp

WARM_UP = 2  # rounds before the first that counts


def capture(launch, device):
    """Return a CUDA graph of a launch, whose modules are loaded."""
    with wp.ScopedCapture(device) as captured:
        launch()
    return captured.graph


def make_replay(launch, device):
    """Return a callable that replays a launch as a graph on CUDA, and launches on the CPU, on all of its cores."""
    return partial(wp.capture_launch, capture(launch, device)) if device.is_cuda else launch


def time_graph(graph, device):
    """Return a callable that replays a graph and returns its time [ms], between events."""
    begin, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)

    def run():
        with wp.ScopedDevice(device):
            wp.record_event(begin)
            wp.capture_launch(graph)
            wp.record_event(end)
            return wp.get_event_elapsed_time(begin, end)

    return run


def time_call(call, device="cpu", clock=time.perf_counter):
    """Return a callable that calls something, waits for the device and returns the time [ms].

    Args:
        clock: `time.thread_time` leaves out other threads and processes.
    """

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


def make_runs(launches: dict, device, clock=time.perf_counter) -> dict:
    """Launch each thing once, in order, which compiles it; return callables that run one and return its time [ms]."""
    runs = {}
    for name, launch in launches.items():
        launch()
        wp.synchronize_device(device)
        runs[name] = time_graph(capture(launch, device), device) if device.is_cuda else time_call(launch, device, clock)
    return runs


def time_in_turn(launches: dict, device, repeats=15, clock=time.perf_counter) -> dict:
    """Return the sorted times [ms] of each launch, measured alternately after compilation: events on CUDA."""
    return time_rounds(make_runs(launches, device, clock), repeats)


def medians(times: dict) -> dict:
    """Return the median of each list of times."""
    return {name: float(np.median(values)) for name, values in times.items()}


def summarise(name, times) -> dict:
    """Return the columns of one thing's times [ms]: median and 95th percentile."""
    return {
        f"{name}_ms": round(float(np.median(times)), 4),
        f"{name}_p95_ms": round(float(np.percentile(times, 95)), 4),
    }


def summarise_all(times: dict) -> dict:
    """Return the columns of all times, see `summarise`."""
    return {key: value for name, values in times.items() for key, value in summarise(name, values).items()}


def ratio_of(times, base) -> float:
    """Return the ratio of two medians."""
    return round(float(np.median(times) / np.median(base)), 2)


def fit_slope(sizes, times):
    """Return the slope of the line through (log size, log time): 1 is proportional, 0 constant; None of one point."""
    if len(sizes) < 2:
        return None
    return round(float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(times, float)), 1)[0]), 3)


def crossover(x, excess, always):
    """Return the x, on a logarithmic scale, from which on an excess stays above 0.

    Args:
        always: What to return where it is above 0 everywhere; where it ends below, None is returned.
    """
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
def one_core():
    """Hold this thread, and those it starts, on one core; yield its number, None where the system has no such call."""
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield max(allowed)
    finally:
        os.sched_setaffinity(0, allowed)


def core_count() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def no_garbage_collection():
    """Keep Python's collector out of the times: it would visit the contacts that baselines make by the thousand."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
