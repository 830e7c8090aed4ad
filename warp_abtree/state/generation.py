"""Generations of device arrays: a launch on arrays that were replaced, replayed graphs included, is found out.

A CUDA graph keeps the addresses that it was captured with. Whoever replaces arrays counts a generation first; every
launch writes on the device which generation it was given, and `LaunchGuard.check` compares.
"""

import warp as wp

from warp_abtree.kernels.base.generation import STALE, LaunchRecord

# States of `LaunchRecord.launched` beside generations, which count from 0, and STALE.
NOT_LAUNCHED, INTERRUPTED = -1, -3
# A generation that no launch is given.
SUSPENDED = -1

STALE_GRAPH = (
    "was captured before arrays that it uses were replaced (objects were added, removed or changed, LODs took more "
    "tree states, pairs were filtered out, an update of LODs was interrupted, or a buffer grew); capture it again"
)
FAILED_LAUNCHES = {
    NOT_LAUNCHED: "nothing was launched since this was made or given other pairs",
    INTERRUPTED: "the last launch was interrupted; launch again",
    int(STALE): f"the graph of the last launch {STALE_GRAPH}",
}


class Generation:
    """Counter of array replacements, on the host and on the device.

    Attributes:
        number: On the host.
        now: On the device, int32 (1,); `SUSPENDED` while the contents of the arrays are in doubt.
    """

    def __init__(self, device):
        self.number = 0
        self.now = wp.zeros(1, dtype=wp.int32, device=device)
        self._uneven = False

    def advance(self):
        """Count a replacement. To be called before it, so that an interruption between the two is on the safe side."""
        self._uneven = True
        self.number += 1
        self.resume()

    def given(self) -> int:
        """Return what a launch is given, after bringing to the device what an interruption has kept from it."""
        if self._uneven:
            self.resume()
        return self.number

    def suspend(self):
        """Let no launch pass as current until `resume`."""
        self.now.fill_(SUSPENDED)

    def resume(self):
        """Let launches of the present generation pass, again."""
        self._uneven = True
        self.now.fill_(self.number)
        self._uneven = False


def find_arrays(value) -> dict:
    """Return what keeps device memory in an operator's attributes, by identity: arrays, those of structs, and trees."""
    found, open_values, seen = {}, [value], set()
    while open_values:
        value = open_values.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, wp.array | wp.Bvh):
            found[id(value)] = value
        elif isinstance(value, tuple | list):
            open_values += value
        elif hasattr(value, "_cls") and hasattr(value._cls, "vars"):  # an instance of a Warp struct
            open_values += [getattr(value, name) for name in value._cls.vars]
        elif hasattr(value, "__dict__") and _holds_arrays(type(value)):
            open_values += vars(value).values()
    return found


def _holds_arrays(kind) -> bool:
    """Return whether a class is the library's, but for what outlives its operators and what no graph uses."""
    names = [f"{base.__module__}.{base.__name__}" for base in kind.__mro__]
    own = any(name.startswith("warp_abtree.") for name in names)
    others = {"scene.scene.Scene", "model.model.Model", "query.staging.Staging"}
    return own and not {f"warp_abtree.{name}" for name in others} & set(names)


class LaunchGuard:
    """Tells whether the results of an operator are those of a whole launch on the arrays that are in use.

    Args:
        device: Where the operator launches.
        states: `Generation` of the tree states and objects that it reads.
        filter: `Generation` of the pairs filtered out of the broad phase, where it runs one.

    Attributes:
        buffers: `Generation` of the operator's own arrays.
    """

    def __init__(self, device, states: Generation, filter: Generation | None = None):
        self.device = device
        self.buffers = Generation(device)
        self._states, self._filter = states, filter or self.buffers
        self._record = LaunchRecord()
        self._record.states_now, self._record.filter_now = states.now, self._filter.now
        self._record.buffers_now = self.buffers.now
        self._record.launched = launched = wp.array([NOT_LAUNCHED, 0], dtype=wp.int32, device=device)
        self._outcome = launched[:1]
        self._view = launched.numpy() if device.is_cpu else None
        self._captured: dict = {}
        self._given: tuple = ()

    @property
    def launched(self) -> wp.array:
        """What became of the last launch, device int32 (2,); see `LaunchRecord`."""
        return self._record.launched

    def record(self) -> LaunchRecord:
        """Return the record for a kernel about to be launched, with the generations as they are."""
        self.given()
        return self._record

    def given(self) -> tuple:
        """Bring the record up to date and return its generations: while they stand, so do all arrays of a launch."""
        given = self._states.given(), self._filter.given(), self.buffers.given()
        if given != self._given:
            self._record.states, self._record.filter, self._record.buffers = self._given = given
        return given

    def write_to(self, record: LaunchRecord):
        """Keep a record up to date that is part of another struct, in the place of the guard's own."""
        self._record, self._given = record, ()

    def launching(self, owner):
        """Return a context that marks results as those of no launch where the launches in it do not all happen.

        While a graph is captured, the arrays that `owner` uses are kept from then on, as long as it lives: a graph
        that replays after they were replaced reads and writes memory that is still its own.
        """
        if self.device.is_capturing:
            self._captured |= find_arrays(owner)
        return self

    def __enter__(self):
        return self

    def __exit__(self, error, *_):
        if error is not None:
            self._note(INTERRUPTED)

    def forget(self):
        """Let results count as none until the next launch."""
        self._note(NOT_LAUNCHED)

    def _note(self, outcome: int):
        if self._view is None:
            self._outcome.fill_(outcome)
        else:
            self._view[0] = outcome

    def outcome(self) -> int:
        """Return the first entry of `launched`. Waits for the device."""
        return int((self.launched.numpy() if self._view is None else self._view)[0])

    def check(self, launched: int):
        """Raise RuntimeError where nothing was launched, a launch was interrupted, or it was of a stale graph.

        `launched` is the first entry of the array of this name, as it was read.
        """
        if launched != self.buffers.number:
            why = FAILED_LAUNCHES.get(launched, "buffers were replaced since the last launch; launch again")
            raise RuntimeError(f"there is no result: {why}")

    def clear_stale(self):
        """Forget that a launch was stale."""
        self.launched[1:].fill_(0)
