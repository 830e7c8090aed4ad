"""Faults injected into a device: memory that ends, and steps that raise, at every step of a call in turn."""

import re
import threading

import warp as wp

from helpers.resources import check_answers, check_scene, describe

SHORTAGE = r"Failed to allocate \d+ bytes on device '{}'"


class Fault:
    """Fails at a chosen step of a call; subclasses say what a step is and how it fails."""

    def __init__(self, device):
        self.device = device
        self.left = None

    def inject(self, call, count):
        """Return (failed, result) of a call whose steps fail after `count` of them."""
        raise NotImplementedError

    def check_scene(self, before, scene):
        """Return what a fault must leave unchanged in a scene, or check that it is still so."""
        raise NotImplementedError

    def everywhere(self, make, call, check):
        """Repeat a call on what is made anew, its first, second, third ... step failing, until it succeeds.

        Args:
            make: Returns what the call is made on.
            call: Called as call(made).
            check: Called as check(before, made) after each failure; with before None it returns what must not change.

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
        allocator = wp.get_device(device).get_allocator()
        self._allocate = allocator.allocate
        monkeypatch.setattr(allocator, "allocate", self.allocate)

    def allocate(self, size):
        if self.left is None:
            return self._allocate(size)
        self.left -= 1
        return self._allocate(size if self.left >= 0 else 2**62)

    def inject(self, call, count):
        self.left = count
        try:
            return False, call()
        except RuntimeError as error:
            assert re.fullmatch(SHORTAGE.format(self.device), str(error)), error
            assert error.__context__ is None, "one error, not an error on the way from another"
            return True, None
        finally:
            self.left = None

    def check_scene(self, before, scene):
        return check_scene(before, scene)

    def check_retry(self, made, make, call):
        """A call that failed once gives what it gives on a scene that saw no failure."""
        assert describe(call(made)) == describe(call(make()))


class Interruption(Fault):
    """One launch, copy, fill or allocation raises: answers are as before, or the operator refuses in one sentence."""

    def __init__(self, device, monkeypatch):
        super().__init__(device)
        allocator = wp.get_device(device).get_allocator()
        for owner, name in (
            (wp, "launch"),
            (wp, "copy"),
            (wp.utils, "radix_sort_pairs"),
            (wp.array, "fill_"),
            (wp.array, "zero_"),
            (wp.array, "assign"),
            (wp.Bvh, "rebuild"),
            (allocator, "allocate"),
        ):
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
        self.left = count
        self.error = (KeyboardInterrupt(), RuntimeError("the kernel cache cannot be written"))[count % 2]
        try:
            return False, call()
        except BaseException as caught:
            assert caught is self.error, f"{caught!r}, not the error that was raised"
            return True, None
        finally:
            self.left = None

    def check_scene(self, before, scene):
        return check_answers(before, scene)


FAULTS = {"memory": MemoryShortage, "interruption": Interruption}
