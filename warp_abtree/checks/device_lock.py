"""One lock per GPU: Warp keeps one current stream per device, whatever the thread."""

import contextlib
import os
import threading

_locks: dict = {}

if hasattr(os, "register_at_fork"):
    # In a forked child a lock that another thread holds would stay locked.
    os.register_at_fork(after_in_child=_locks.clear)


def device_lock(device):
    """Return a context that excludes other threads from a GPU; on the CPU threads run concurrently.

    `wp.array.numpy` makes the null stream a device's current one for a moment (Warp 1.19), so that two threads on one
    GPU would launch on each other's streams, and could leave that one behind, on which no graph can be captured.
    """
    return _locks.setdefault(device.alias, threading.RLock()) if device.is_cuda else contextlib.nullcontext()
