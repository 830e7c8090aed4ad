"""Faults injected into a device, memory that ends and steps that raise; scenes to inject them into, and checks."""

import re
import threading
from contextlib import contextmanager

import numpy as np
import warp as wp

import warp_abtree as ab
from helpers import scenes
from warp_abtree.query.result import VECTORS
from warp_abtree.state.arrays import SLOT_COLUMNS

PAIRS = np.array([(0, 1), (1, 2), (3, 1)])
MORE_PAIRS = np.array([(i, j) for i in range(4) for j in range(4) if i != j])


def describe(result):
    """Return results, LOD statistics or arrays as comparable bytes."""
    names = ("pairs", "any", "count", "faces", "apart", "contacts", "pair_contacts")
    if hasattr(result, "nodes_refitted"):
        names = ("state", "lod", "full", "k", "nodes_refitted")
    values = [result] if isinstance(result, np.ndarray) or result is None else [getattr(result, n) for n in names]
    return [None if value is None else np.asarray(value).tobytes() for value in values]


def add_objects(device):
    return scenes.add_objects(device, ("small ball", "torus") * 2, seed=1, spread=0.4, fractions=(0.4, 0.2))


def make_scene(device):
    """Return a scene that has been asked, with states that are shared, copied and freed."""
    scene = add_objects(device)
    lods = scene.lods
    scene.set_lods(lods - [0, 3, 5, 9])
    scene.set_lods(lods)
    scene.intersect(PAIRS, output="faces")
    return scene


def answers(scene):
    found = describe(scene.intersect(PAIRS, output="faces"))
    return found + describe(scene.intersect(MORE_PAIRS, output="count"))


def check_scene(before, scene):
    """Return all that a scene holds and answers, or check that it still does."""
    states = scene.batch().states.pool
    now = [getattr(states, name).numpy().tobytes() for name in SLOT_COLUMNS]
    now += [*scenes.everything(scene), *answers(scene)]
    assert before in (None, now)
    return now


def check_answers(before, scene):
    """Return all that a scene answers, or check that it still does; states may have moved in the pool."""
    objects = scene.batch().objects.pool
    now = [scene.lods, *answers(scene), scene.broad_phase(), objects.rotation.numpy(), objects.position.numpy()]
    for state in map(scene.tree_state, range(scene.object_count)):
        now += [state.lod, state.status, state.lower, state.upper, state.skip]
    now = [np.asarray(value).tobytes() for value in now]
    assert before in (None, now)
    return now


def check_buffer_lengths(queries):
    """Check that all arrays are as long as there is room for, or kernels write past an end."""
    for query in queries:
        rooms = query.rooms
        pairs, hits = ([query.pairs, query.pair_poses, query.hits.any_hit, query.hits.count], [query.hits.face])
        pairs += [] if query.near is None else [query.near.any_hit, query.near.count, query.distances_of("within")]
        pairs += [] if query.broad_phase is None else [query.broad_phase.pairs]
        if isinstance(query, ab.ContactQuery):
            means, contacts = query.pair_contacts, query.contacts
            pairs += [means.point, means.normal, query.start[1:]]
            hits += [query.faces, *(getattr(contacts, name) for name in (*VECTORS, "coplanar"))]
        assert {len(array) for array in pairs} == {rooms.pairs} and {len(array) for array in hits} == {rooms.hits}
        for asked in (asked for stage in query.stages for asked in stage.arrays(rooms)):
            assert asked.is_in_place(), f"{asked.name}: not {asked.shape}"


@contextmanager
def refusing(*sentences, kind=RuntimeError):
    """Allow an error that says one of some sentences, and no other."""
    try:
        yield
    except kind as error:
        assert any(sentence in str(error) for sentence in sentences), error


SHORTAGE = r"Failed to allocate \d+ bytes on device '{}'"


class Fault:
    """Fails at a chosen step of a call; subclasses say what a step is, how it fails, and what it leaves unchanged."""

    def __init__(self, device):
        self.device, self.allocator = device, wp.get_device(device).get_allocator()
        self.left = None  # steps until one fails, None outside of calls

    def inject(self, call, count):
        """Return (failed, result) of a call whose steps fail after so many of them."""
        self.left = count
        try:
            return False, call()
        except BaseException as error:
            self.check_error(error)
            return True, None
        finally:
            self.left = None

    def everywhere(self, make, call, check):
        """Repeat call(make()), its first, second, third ... step failing, until it succeeds.

        After each failure check(before, made) is called; with None for `before` it returns what must not change.

        Returns:
            How many steps there are, and what the call returned without a fault.
        """
        for count in range(1000):
            made = make()
            before = check(None, made)
            failed, result = self.inject(lambda made=made: call(made), count)
            if not failed:
                return count, result
            check(before, made)
            self.check_retry(made, make, call)
        raise AssertionError("the call never ends")

    def check_retry(self, made, make, call):
        """Check that a call that failed once can be repeated, where the fault promises that."""


class MemoryShortage(Fault):
    """Every allocation fails from some allocation on: one clear error, and nothing has changed."""

    def __init__(self, device, monkeypatch):
        super().__init__(device)
        self._allocate = self.allocator.allocate
        monkeypatch.setattr(self.allocator, "allocate", self.allocate)

    def allocate(self, size):
        if self.left is None:
            return self._allocate(size)
        self.left -= 1
        return self._allocate(size if self.left >= 0 else 2**62)

    def check_error(self, error):
        assert re.fullmatch(SHORTAGE.format(self.device), str(error)) and isinstance(error, RuntimeError), error
        assert error.__context__ is None, "one error, not an error on the way from another"

    check_scene = staticmethod(check_scene)

    def check_retry(self, made, make, call):
        """A call that failed once gives what it gives on a scene that saw no failure."""
        assert describe(call(made)) == describe(call(make()))


class Interruption(Fault):
    """One launch, copy, fill or allocation raises: answers are as before, or the operator refuses in one sentence."""

    def __init__(self, device, monkeypatch):
        super().__init__(device)
        steps = [(wp, "launch"), (wp.Launch, "launch"), (wp, "copy"), (wp.utils, "radix_sort_pairs")]
        steps += [(wp.array, "fill_"), (wp.array, "zero_"), (wp.array, "assign"), (self.allocator, "allocate")]
        for owner, name in steps:
            monkeypatch.setattr(owner, name, self._counted(getattr(owner, name)))

    def _counted(self, original):
        def call(*args, **options):
            # Threads that launch on further cores are not interrupted: Ctrl-C reaches the main thread alone.
            if self.left is not None and threading.current_thread() is threading.main_thread():
                self.left -= 1
                if self.left < 0:
                    self.left = None
                    raise self.error
            return original(*args, **options)

        return call

    def inject(self, call, count):
        self.error = (KeyboardInterrupt(), RuntimeError("the kernel cache cannot be written"))[count % 2]
        return super().inject(call, count)

    def check_error(self, error):
        assert error is self.error, f"{error!r}, not the error that was raised"

    check_scene = staticmethod(check_answers)


FAULTS = {"memory": MemoryShortage, "interruption": Interruption}
