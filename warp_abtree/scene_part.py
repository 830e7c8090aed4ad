"""The parts of a `MultiScene`: a scene a device, in a process or a thread that does what it is told."""

import contextlib
import multiprocessing
import pickle
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from warp_abtree.intersect import COUNTERS, Query
from warp_abtree.scene import Scene

# What of a result goes back.
FIELDS = ("pairs", "any", "count", "faces", "contacts", "pair_contacts", "apart", *COUNTERS)


class _Part:
    """The objects of one device: what a process or a thread is asked."""

    def __init__(self, device):
        self.device = device
        self.models: dict = {}
        self.scene: Any = None  # a Scene once it is built

    def build(self, models, objects, excluded):
        for key, model in models.items():
            self.models[key] = pickle.loads(model) if isinstance(model, bytes) else model
        self.scene = None  # its memory first
        scene = Scene(self.device)
        for model, *rest in objects:
            scene.add(self.models[model], *rest)
        if len(excluded):
            scene.filter(excluded)
        scene.arrays()
        self.scene = scene

    def set_poses(self, poses):
        self.scene.set_poses(poses)

    def set_lods(self, lods):
        self.scene.set_lods(lods)

    def broad_phase(self):
        return self.scene.broad_phase()

    def tree_state(self, i):
        return self.scene.tree_state(i)

    def intersect(self, *asked):
        result = self.scene.intersect(*asked)
        return {name: getattr(result, name) for name in FIELDS}


def _answer(part, name, arguments):
    """Return (answer, error, seconds) of a call."""
    begin = time.perf_counter()
    try:
        return getattr(part, name)(*arguments), None, time.perf_counter() - begin
    except Exception as error:
        return None, error, time.perf_counter() - begin


def _serve(connection, device, cores):
    """Answer calls until the other end goes away."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for the parent, which stops its workers
    wp.config.log_level = wp.LOG_WARNING
    Query.cores = cores
    part = _Part(device)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            answer, error, seconds = _answer(part, *connection.recv())
            if error is not None:
                try:
                    pickle.loads(pickle.dumps(error))
                except Exception:  # of a library, with arguments of its own
                    error = RuntimeError(f"{type(error).__name__}: {error}")
            connection.send((answer, error, seconds))


class ProcessPart:
    """A part in a process of its own."""

    def __init__(self, device, cores):
        context = multiprocessing.get_context("spawn")  # neither Warp nor CUDA survives a fork
        self.connection, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, device, cores), daemon=True)
        self.process.start()
        far.close()

    def begin(self, name, arguments):
        self.connection.send((name, arguments))

    def finish(self):
        return self.connection.recv()

    def exit_code(self):
        self.process.join(1.0)
        return self.process.exitcode

    def stop(self):
        self.connection.close()  # which ends it, unless it is at work
        self.process.terminate()
        self.process.join()


class ThreadPart:
    """A part in a thread of this process."""

    def __init__(self, device):
        self.part = _Part(device)
        self.pool = ThreadPoolExecutor(1, thread_name_prefix="warp_abtree part")

    def begin(self, name, arguments):
        self.job = self.pool.submit(_answer, self.part, name, arguments)

    def finish(self):
        return self.job.result()

    def stop(self):
        self.pool.shutdown()
