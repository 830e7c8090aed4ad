"""Jobs on Ray: one actor per GPU or CPU core of a cluster."""

import contextlib
import os
import signal
import threading
from collections import deque

from warp_abtree.checks.arguments import whole_number
from warp_abtree.checks.regime import change_regime

AHEAD = 2  # shards sent to a worker at a time: one running, one queued
ATTEMPTS = 3  # a run is given up when one shard, or the start of a worker, has ended so many workers


def _import_ray():
    try:
        import ray
    except ImportError:
        raise ValueError("Ray is not installed: pip install ray") from None
    return ray


@contextlib.contextmanager
def _sigterm_kept():
    """Restore the program's handler of SIGTERM, which Ray replaces."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if callable(before) and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


class _Actor:
    """Ray actor: holds the task runner of a job, which came once, through the object store."""

    def __init__(self, runner, device):
        change_regime(cpu_threads=1 if device == "cpu" else None)  # one actor per core
        self.runner, self.device = runner, device

    def ready(self):
        return os.getpid()

    def run(self, task):
        return self.runner.run(task, self.device)


class RayPool:
    """Pool of workers on Ray: one actor per GPU, or per CPU core if there is none.

    Models are sent through the object store once. A worker that ends is replaced, and its shards are computed again.
    The calling process writes all shards, so machines need no shared disk.

    Args:
        address: Address of a running cluster, as for `ray.init`; None starts Ray on this machine while the pool is
            open.
        workers: Number of workers; None is one per GPU, or per CPU core.

    Attributes:
        workers: Number of workers.
        pids: Process id of each running worker.
        lost: Workers that ended before their work, in the last job.

    Raises:
        ValueError: Ray is not installed, does not start or does not answer; workers is not a whole number from 1.
    """

    def __init__(self, address=None, workers=None):
        workers = None if workers is None else whole_number(workers, "workers", 1, 2**16)
        self.ray = _import_ray()
        self.pids: dict = {}
        self.lost = 0
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        self._own = not self.ray.is_initialized()
        if self._own:
            options = {"include_dashboard": False, "num_cpus": workers} if address is None else {}
            options |= {"log_to_driver": False, "logging_level": "ERROR"}
            try:
                with _sigterm_kept():
                    self.ray.init(address="local" if address is None else address, **options)
            except Exception as error:
                raise ValueError(f"Ray at {address or 'this machine'}: {error}") from None
        found = self.ray.cluster_resources()
        self.on_gpus = found.get("GPU", 0) >= 1
        self.workers = workers or max(1, int(found.get("GPU" if self.on_gpus else "CPU", 1)))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """Stop Ray if this pool started it."""
        if self._own:
            self._own = False
            self.ray.shutdown()

    def run(self, job, ranges):
        """Yield (start, stop, columns) of each range, once, in order of completion.

        Raises:
            RuntimeError: A shard ended its worker three times, or workers do not start.
        """
        ray, self.lost = self.ray, 0
        # Actors, ranges not sent yet, and by Ray reference (actor, range), of which the range is None while it starts.
        actors: list = []
        self._actors, self._left, self._running = actors, deque(ranges), dict()
        self._failures: dict = {}  # how often each range has ended its actor; of None, how often one failed to start
        runner = ray.put(job.runner())
        try:
            for _ in range(min(self.workers, len(self._left))):
                self._start_actor(runner)
            while self._left or any(part is not None for _, part in self._running.values()):
                done, _ = ray.wait(list(self._running), num_returns=1)
                actor, part = self._running[done[0]]
                try:
                    answer = ray.get(done[0])
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from None
                except (ray.exceptions.RayActorError, ray.exceptions.ObjectLostError) as error:
                    self._take_back(actor, " ".join(str(error).split())[:300])
                    self._start_actor(runner)
                    continue
                del self._running[done[0]]
                if part is None:
                    self.pids[actor] = answer
                    self._failures.pop(None, None)
                for _ in range(AHEAD if part is None else 1):
                    if self._left:
                        following = self._left.popleft()
                        self._running[actor.run.remote(job.task(*following))] = actor, following
                if part is not None:
                    del done  # Ray frees the answer with its last reference
                    yield *part, answer
        finally:
            self.pids.clear()
            for actor in actors:  # a later run has others
                self._kill(actor)

    def _start_actor(self, runner):
        share, device = ({"num_gpus": 1, "num_cpus": 0}, "cuda:0") if self.on_gpus else ({"num_cpus": 1}, "cpu")
        actor = self.ray.remote(_Actor).options(**share).remote(runner, device)
        self._actors.append(actor)
        self._running[actor.ready.remote()] = actor, None

    def _take_back(self, actor, cause):
        """Take back the shards of an actor that ended."""
        self.lost += 1
        self.pids.pop(actor, None)
        self._kill(actor)  # it may be alive if its machine was disconnected
        self._actors.remove(actor)
        lost = [reference for reference, (owner, _) in self._running.items() if owner is actor]
        # Only the first can have ended the actor; the others were queued behind it.
        for place, reference in enumerate(lost):
            part = self._running.pop(reference)[1]
            if place == 0:
                self._failures[part] = self._failures.get(part, 0) + 1
                if self._failures[part] == ATTEMPTS:
                    what = "workers do not start" if part is None else f"shard {part} ended its worker"
                    raise RuntimeError(f"{what}, {ATTEMPTS} times: {cause}")
            if part is not None:
                self._left.appendleft(part)

    def _kill(self, actor):
        with contextlib.suppress(Exception):
            self.ray.kill(actor)
