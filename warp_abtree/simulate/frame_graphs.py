"""Graphs of frames: `FrameGraphs`."""

from collections.abc import Callable

import warp as wp

from warp_abtree.lod.timing import Timer


class FrameGraphs:
    """Graphs by what is in them, each captured once, all with the same arrays; and the marks that they make."""

    def __init__(self, timer: Timer):
        self._timer = timer
        self._arrays: tuple = ()
        self._kept: dict[tuple, tuple] = {}

    def find(self, key: tuple, arrays: tuple, launches: list[Callable]):
        """Return the graph of a key, and take it that its marks are made.

        Args:
            arrays: Token of all arrays that it is given; graphs of others are dropped.
            launches: What is captured where there is no graph of this key.
        """
        if arrays != self._arrays:
            self._kept.clear()
            self._arrays = arrays
        marks = self._timer.marks
        if key in self._kept:
            graph, made = self._kept[key]
            marks += made
            return graph
        before = len(marks)
        with wp.ScopedCapture(self._timer.device) as capture:
            for launch in launches:
                launch()
        self._kept[key] = capture.graph, marks[before:]
        return capture.graph
