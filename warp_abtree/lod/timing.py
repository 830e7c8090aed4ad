"""Stages of a frame, the clocks that time them, and the fit of times to counted work."""

import math
from time import perf_counter
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy

STAGES = ("select_ms", "refine_ms", "move_ms", "broad_ms", "query_ms", "answer_ms")
"""Stages of a frame in their order. T is a budget for all of them: for the frame that users see."""

RATES = {
    "selected": 2e-7,
    "lod_change": 8e-4,
    "node_refitted": 5e-8,
    "posed": 1e-7,
    "candidate": 5e-7,
    "query": 3e-4,
    "node_test": 7e-9,
    "triangle_test": 1.4e-8,
}
"""Seconds that `WorkClock` takes for an object selected, any change of LODs, a node refitted, an object posed, a
candidate pair, a query, a test of two boxes, a test of two triangles: about those of a CPU."""


class WorkClock:
    """A clock that advances with counted work alone: frames are the same on every machine.

    Args:
        rates: Seconds a unit of work, by name; the others are as in RATES.

    Attributes:
        seconds: Its reading.

    Raises:
        ValueError: An unknown name, or a rate that is negative or not finite.
    """

    def __init__(self, rates: dict | None = None):
        unknown = set(rates or ()) - set(RATES)
        if unknown:
            raise ValueError(f"rates: {sorted(unknown)[0]!r} is none of {', '.join(RATES)}")
        self.rates = {**RATES, **(rates or {})}
        for name, rate in self.rates.items():
            value = to_numpy(rate, f"rates: {name!r}")
            if value.shape != () or not (np.isfinite(value) and value >= 0):
                raise ValueError(f"rates: {name!r} is {rate!r}, not a finite number of seconds from 0")
        self.seconds = 0.0

    def __call__(self) -> float:
        """Return the seconds charged so far."""
        return self.seconds

    def charge(self, **work):
        """Advance by some units of work."""
        self.seconds += sum(self.rates[name] * count for name, count in work.items())


# Marks of a frame, at most.
MARKS_MOST = 16


class Timer:
    """Times the stages of one frame after another [whole ns].

    On CUDA and without a clock of its own it records events, which a graph may do too: what it marks there while a
    graph is captured, a replay marks again.

    `clock` returns seconds, read when a frame begins and at every mark; None is the host's clock, on CUDA events.

    Attributes:
        counts_work: Whether the clock takes the counted work of each stage.
        marks: Stages marked in this frame so far; what a graph marks again is added to them.
    """

    def __init__(self, device, clock):
        self.device = device
        self.counts_work = hasattr(clock, "charge")
        self.clock: Any = perf_counter if clock is None else clock
        self.uses_events = clock is None and device.is_cuda
        made = MARKS_MOST if self.uses_events else 0
        self._events = [wp.Event(device, enable_timing=True) for _ in range(made)]
        self.marks: list[str] = []
        self._readings: list[int] = []

    def begin(self):
        """Begin a frame."""
        self.marks, self._readings = [], []
        self._read()

    def mark(self, stage: str, count=dict):
        """End a part of a stage, which may have several. (synchronization point without events)

        `count` returns the counted work of that part by name; it is called for a clock that takes it.
        """
        if self.device.is_capturing and not self.uses_events:
            return
        self.marks.append(stage)
        if self.counts_work:
            self.clock.charge(**count())
        self._read()

    def _read(self):
        if not self.uses_events:
            wp.synchronize_device(self.device)
            self._readings.append(round(1e9 * self.clock()))
            return
        wp.get_stream(self.device).record_event(self._events[len(self.marks)])

    def stage_ms(self) -> dict:
        """Return the stages of the frame [ms], exact to the nanosecond. (synchronization point on CUDA)"""
        if self.uses_events:
            wp.synchronize_event(self._events[len(self.marks)])
            pairs = zip(self._events, self._events[1 : len(self.marks) + 1])
            spans = [round(1e6 * wp.get_event_elapsed_time(*pair, synchronize=False)) for pair in pairs]
        else:
            spans = np.diff(self._readings).tolist()
        total = dict.fromkeys(STAGES, 0)
        for stage, span in zip(self.marks, spans, strict=True):
            total[stage] += span
        return {stage: span / 1e6 for stage, span in total.items()}


class CostFit:
    """Least-squares fit of time against work with exponential forgetting; slope and intercept are at least 0.

    Where the work hardly varies the line goes through the origin. A time off the line by more than a factor of 2 is
    clamped to it, so that a single hitch of the machine moves the line little.
    """

    FORGET = 0.9  # factor on the weight of an observation at each new one

    def __init__(self):
        self.sums = [0.0] * 5  # of weights, work, time, work squared, work times time

    def add(self, work: float, time: float):
        """Add an observation."""
        slope, intercept = self.line()
        expected = slope * work + intercept
        if self.sums[0] > 2 and expected > 0:
            time = min(max(time, 0.5 * expected), 2.0 * expected)
        new = 1.0, work, time, work * work, work * time
        self.sums = [self.FORGET * old + added for old, added in zip(self.sums, new)]

    def line(self) -> tuple[float, float]:
        """Return slope and intercept, NaN before the first observation."""
        weight, x, y, xx, xy = self.sums
        if weight == 0:
            return math.nan, math.nan
        x, y, xx, xy = x / weight, y / weight, xx / weight, xy / weight
        if x <= 0:
            return 0.0, y
        slope, spread = y / x, xx - x * x
        if spread > 1e-4 * x * x:
            slope = min(max((xy - x * y) / spread, 0.0), slope)
        return slope, y - slope * x
