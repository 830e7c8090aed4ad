"""Threads that use one GPU take turns: Warp keeps one current stream a device, whatever the thread."""

import contextlib
import os
import threading

_locks: dict = {}

if hasattr(os, "register_at_fork"):
    # A lock that another thread held stays locked in a forked child.
    os.register_at_fork(after_in_child=_locks.clear)


def device_turn(device):
    """Return a context in which no other thread has its turn on a GPU; on the CPU threads go side by side.

    `wp.array.numpy` makes the null stream a device's current one for a moment (Warp 1.19), so that two threads on one
    GPU would launch on each other's streams, and could leave that one behind, on which no graph can be captured.

    Args:
        device: `wp.Device`.
    """
    return _locks.setdefault(device.alias, threading.RLock()) if device.is_cuda else contextlib.nullcontext()
