"""Recorded launches, repeated while what they were given stands: a fifth of the host's time.

On a GPU those of a whole call become a graph: one launch in place of seven.
"""

from functools import partial

import warp as wp

# A capture takes some milliseconds.
CALLS_BEFORE_GRAPH = 4


class Commands:
    """Recorded launches of an operator, by name."""

    def __init__(self):
        self._made: dict = {}
        self._call: tuple = ()
        self._times, self._graph = 0, None

    def find(self, name, given: tuple, make) -> list:
        """Return the launches of a name, recorded anew where what they were given has changed: generations, numbers.

        `make` returns a list of launches, in their order, made by a function that takes what `wp.launch` does.
        """
        before, commands = self._made.get(name, (None, []))
        if before != given:
            # Warp records nothing for a launch of no thread.
            commands = [command for command in make(partial(wp.launch, record_cmd=True)) if command is not None]
            self._made[name] = given, commands
        return commands

    def find_callables(self, name, given: tuple, device, make) -> list:
        """Return what `find` does as callables, which launch as `wp.launch` does while a graph is captured."""
        if device.is_capturing:
            return make(partial(partial, wp.launch))
        return [command.launch for command in self.find(name, given, make)]

    def repeat_call(self, given: tuple, device, launch):
        """Launch a whole call, by a graph on a GPU once it has come a few times alike.

        `given` is as for `find`, with addresses that `find` need not know; `launch` only launches.
        """
        if given != self._call:
            self._call, self._times, self._graph = given, 0, None
        self._times += 1
        if self._graph is None and device.is_cuda and self._times == CALLS_BEFORE_GRAPH:
            with wp.ScopedCapture(device) as capture:
                launch()
            self._graph = capture.graph
        if self._graph is None:
            launch()
        else:
            wp.capture_launch(self._graph)
