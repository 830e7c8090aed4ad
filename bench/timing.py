"""Times of launches: graph replays between events on CUDA, wall clock on the CPU, two things in turn in one process."""

import time

import warp as wp


def _replay(launch, device):
    """Return a callable that runs one launch and its time in milliseconds."""
    launch()
    wp.synchronize_device(device)
    if not device.is_cuda:

        def run():
            begin = time.perf_counter()
            launch()
            return 1e3 * (time.perf_counter() - begin)

        return run
    with wp.ScopedCapture(device) as capture:
        launch()
    begin, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)

    def run():
        with wp.ScopedDevice(device):
            wp.record_event(begin)
            wp.capture_launch(capture.graph)
            wp.record_event(end)
            return wp.get_event_elapsed_time(begin, end)

    return run


def time_in_turn(launches: dict, device, repeats=15) -> dict:
    """Return the sorted times [ms] of each launch, measured alternately."""
    runs = {name: _replay(launch, device) for name, launch in launches.items()}
    times = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            times[name].append(run())
    return {name: sorted(values) for name, values in times.items()}
