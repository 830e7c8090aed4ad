"""Stages of a frame, and the clocks that time them: the host's, one that counts work, one that replays a run."""

import csv
import json
import os
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.checks.arguments import to_numpy

STAGES = ("select_ms", "refine_ms", "move_ms", "broad_ms", "query_ms", "answer_ms")
COST_STAGES = ("select_ms", "refine_ms", "broad_ms", "query_ms")
"""Stages of T = TR + TB + TQ + TLOD (paper, section 4.2): selection, refinement with refitting, queries with their
broad phase; movement is not among them."""

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


class ReplayClock:
    """A clock that replays the times of a recorded run, so that the run repeats itself exactly.

    Args:
        rows: The history of that run: `FrameRow`s, or the .json or .csv file that `Frame.record` wrote.

    Raises:
        ValueError: A file that is missing, or no such history.
    """

    def __init__(self, rows):
        if isinstance(rows, str | os.PathLike):
            rows = _read_rows(Path(rows))
        else:
            rows = [row.as_dict() for row in rows]
        stages = np.array([[row[stage] for stage in STAGES] for row in rows], np.float64).reshape(-1, len(STAGES))
        ticks = np.concatenate([np.zeros((len(rows), 1)), np.round(1e6 * stages)], axis=1)
        self._ticks = iter((1e-9 * np.cumsum(ticks)).tolist())
        self._frames = len(rows)

    def __call__(self) -> float:
        """Return the next reading [s].

        Raises:
            RuntimeError: The recorded run was not that long.
        """
        try:
            return next(self._ticks)
        except StopIteration:
            raise RuntimeError(f"the recorded clock ends after {self._frames} frames") from None


def _read_rows(path):
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = json.load(file) if path.suffix.lower() == ".json" else list(csv.DictReader(file))
        if not rows:
            raise ValueError("no frames")
        rows = [{stage: float(row[stage]) for stage in STAGES} for row in rows]
        if not np.isfinite([list(row.values()) for row in rows]).all():
            raise ValueError("a stage is not finite")
        return rows
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise ValueError(f"{path}: not the history of a run ({type(error).__name__}: {error})") from None


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


class Timer:
    """Times the stages of one frame after another [whole ns].

    Args:
        device: Where the work runs.
        clock: Seconds, read len(STAGES) + 1 times a frame; None is the host's clock, on CUDA events.

    Attributes:
        counts_work: Whether the clock takes the counted work of each stage.
    """

    def __init__(self, device, clock):
        self.device = device
        self.counts_work = hasattr(clock, "charge")
        self.clock: Any = perf_counter if clock is None else clock
        self._events = None
        if clock is None and device.is_cuda:
            self._events = [wp.Event(device, enable_timing=True) for _ in range(len(STAGES) + 1)]
        self._marks = []

    def begin(self):
        """Begin a frame."""
        self._marks = []
        self.mark()

    def mark(self, **work):
        """End a stage; a clock without events is read when the device has finished. (synchronization point)"""
        if self._events is not None:
            wp.get_stream(self.device).record_event(self._events[len(self._marks)])
            self._marks.append(None)
            return
        wp.synchronize_device(self.device)
        if self.counts_work:
            self.clock.charge(**work)
        self._marks.append(round(1e9 * self.clock()))

    def stage_ms(self) -> dict:
        """Return the stages of the frame [ms], exact to the nanosecond. (synchronization point on CUDA)"""
        if self._events is not None:
            pairs = zip(self._events, self._events[1:])
            spans = [round(1e6 * wp.get_event_elapsed_time(begin, end)) for begin, end in pairs]
        else:
            spans = np.diff(self._marks).tolist()
        return {stage: span / 1e6 for stage, span in zip(STAGES, spans, strict=True)}
