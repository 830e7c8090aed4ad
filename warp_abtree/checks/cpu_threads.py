"""Launches on several cores of the CPU: Warp runs one on one thread, so a launch is dealt out to several."""

import functools
import os
import threading
from concurrent.futures import ThreadPoolExecutor, wait

from warp_abtree.checks.regime import current_regime


def core_count() -> int:
    """Return the cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def cores_for(count: int, least: int, rooms: int) -> int:
    """Return how many cores share `count` items, of `least` or more each; there is memory for `rooms`."""
    return max(1, min(current_regime().cpu_threads or rooms, rooms, count // least))


@functools.cache
def workers(count: int):
    """Return threads for work beside the calling one, the same for the same count."""
    return ThreadPoolExecutor(count, thread_name_prefix="warp_abtree")


if hasattr(os, "register_at_fork"):
    # Threads do not come along into a forked child: it would wait for ever for those of its parent.
    os.register_at_fork(after_in_child=workers.cache_clear)


class _Share:
    """A launch on further threads: none begins after `close`, which waits for those that have.

    So a thread that an interruption has kept from being noted does not work on arrays that others go on to use.
    """

    def __init__(self, launch):
        self._launch, self._is_open, self._running = launch, True, 0
        self._changed = threading.Condition()
        self.error: BaseException | None = None

    def run(self):
        """Launch, unless this is closed; for a thread."""
        with self._changed:
            if not self._is_open:
                return
            self._running += 1
        try:
            self._launch()
        except BaseException as error:
            self.error = error
        finally:
            with self._changed:
                self._running -= 1
                self._changed.notify_all()

    def close(self):
        """Wait until no thread touches the arrays of the launch any more, whatever interrupts that; raise it then."""
        interruption = None
        while self._is_open or self._running:
            try:
                with self._changed:
                    self._is_open = False
                    while self._running:
                        self._changed.wait()
            except BaseException as error:
                interruption = error
        self._launch = None  # a busy thread that comes later must not keep its arrays until then
        if interruption is not None:
            raise interruption


def launch_on_cores(launch, cores):
    """Launch a kernel that is loaded on several threads of the CPU, the calling one too, which share its items; waits.

    Each thread of the kernel takes one item after the other until there are none. It writes what belongs to its item
    alone, or with true atomics: Warp's own are none on the CPU.
    """
    if cores == 1:
        launch()
        return
    share = _Share(launch)
    try:
        for _ in range(1, cores):
            workers(cores - 1).submit(share.run)
        launch()
    finally:
        try:
            share.close()
        finally:  # where an interruption came before it had begun
            share.close()
    if share.error is not None:
        raise share.error


def wait_for(jobs):
    """Wait until no thread touches the arrays of jobs any more, whatever interrupts that; raise it then."""
    interruption = None
    while not all(job.done() for job in jobs):
        try:
            wait(jobs)
        except BaseException as error:
            interruption = error
    if interruption is not None:
        raise interruption
