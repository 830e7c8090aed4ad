"""Launches that are recorded once and repeated while what they were given stands: a fifth of the host's time."""

from functools import partial

import warp as wp


class Commands:
    """Recorded launches of an operator, by name."""

    def __init__(self):
        self._made: dict = {}

    def find(self, name, given: tuple, make) -> list:
        """Return the launches of a name, recorded anew where what they were given has changed.

        Args:
            given: What the launches depend on: generations of the arrays, and numbers.
            make: Returns a list of launches, made by a function that takes what `wp.launch` does.
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
