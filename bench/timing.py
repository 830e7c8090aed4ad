"""Times of launches: graph replays between events on CUDA, wall clock on the CPU, two things in turn in one process."""

import time

import numpy as np
import warp as wp

WARM_UP = 2  # rounds before the first that counts


def capture(launch, device):
    """Return a CUDA graph of a launch, whose modules are loaded."""
    with wp.ScopedCapture(device) as captured:
        launch()
    return captured.graph


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


def time_wall(launch, device, clock=time.perf_counter):
    """Return a callable that calls something, waits for the device and returns the time [ms] by the wall clock.

    Args:
        clock: Another clock [s]: `time.thread_time` leaves out what else the machine does, and other threads' work.
    """

    def run():
        wp.synchronize_device(device)
        begin = clock()
        launch()
        wp.synchronize_device(device)
        return 1e3 * (clock() - begin)

    return run


def time_both(call, device):
    """Call something that cannot be captured; return its time [ms] by the wall clock and between events.

    The second is that of the stream, its waits for the host included; on the CPU there is none, and it is the first.
    """
    wp.synchronize_device(device)
    events = []
    if device.is_cuda:
        events = [wp.Event(device, enable_timing=True) for _ in range(2)]
        wp.get_stream(device).record_event(events[0])
    begin = time.perf_counter()
    call()
    if events:
        wp.get_stream(device).record_event(events[1])
    wp.synchronize_device(device)
    wall = 1e3 * (time.perf_counter() - begin)
    return wall, wp.get_event_elapsed_time(*events) if events else wall


def time_rounds(runs: dict, repeats) -> dict:
    """Return the sorted times of callables that return a time each, asked in turn; the first rounds do not count."""
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
        runs[name] = time_graph(capture(launch, device), device) if device.is_cuda else time_wall(launch, device, clock)
    return runs


def time_in_turn(launches: dict, device, repeats=15, clock=time.perf_counter) -> dict:
    """Return the sorted times [ms] of each launch, measured alternately; compilation is over before.

    Args:
        clock: Of the CPU, see `time_wall`; on CUDA times are those between events.
    """
    return time_rounds(make_runs(launches, device, clock), repeats)


def summarise(name, times) -> dict:
    """Return the columns of one thing's times [ms]: median and 95th percentile."""
    return {
        f"{name}_ms": round(float(np.median(times)), 4),
        f"{name}_p95_ms": round(float(np.percentile(times, 95)), 4),
    }


def fit_slope(sizes, times):
    """Return the slope of the line through (log size, log time): 1 is proportional, 0 constant; None of one point."""
    if len(sizes) < 2:
        return None
    return round(float(np.polyfit(np.log(np.asarray(sizes, float)), np.log(np.asarray(times, float)), 1)[0]), 3)
