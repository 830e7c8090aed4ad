"""Running a job: shards are computed by a pool of workers and written as they come."""

from collections import deque
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

import warp as wp

from warp_abtree.checks.atomic_write import sweep_up
from warp_abtree.checks.device_lock import device_lock
from warp_abtree.jobs.shard_folder import WRITTEN, ShardFolder
from warp_abtree.scene.scene import Scene


class ThisProcess:
    """Pool of workers in this process: one thread per device.

    Args:
        device: Warp device, or a list of them; None for Warp's default.
    """

    lost = 0

    def __init__(self, device=None):
        names = list(device) if isinstance(device, list | tuple) else [device]
        if not names:
            raise ValueError("device: an empty list")
        self.devices = [Scene(name).device for name in names]
        self.workers = len(self.devices)

    def run(self, job, ranges):
        """Yield (start, stop, columns) of each range, once, in any order."""
        runners = [job.runner() for _ in self.devices]
        left = deque(ranges)

        def run(k, part):
            task = job.task(*part)  # each thread reads its own input
            with device_lock(self.devices[k]):
                return runners[k].run(task, self.devices[k])

        # The first shard of each device loads kernels, which only one thread may do at a time.
        alone = len(left) if self.workers == 1 else min(self.workers, len(left))
        for k in range(alone):
            part = left.popleft()
            yield *part, run(k % self.workers, part)
        if not left:
            return
        threads = [ThreadPoolExecutor(1, thread_name_prefix="warp_abtree shard") for _ in runners]
        running: dict = {}
        before = wp.get_device()

        def submit(k):
            if left:
                part = left.popleft()
                running[threads[k].submit(run, k, part)] = k, part

        try:
            for k in [*range(self.workers)] * 2:  # one running, one queued
                submit(k)
            while running:
                for finished in wait(running, return_when=FIRST_COMPLETED).done:
                    k, part = running.pop(finished)
                    submit(k)
                    yield *part, finished.result()
        finally:
            for thread in threads:
                thread.shutdown(cancel_futures=True)
            if wp.get_device() != before:  # Warp's default device is shared by threads
                wp.set_device(before)


def run_shards(job, out, pool=None, progress=None) -> dict:
    """Run a job: write each shard when it is computed, skip shards that a former run has finished.

    Existing shards are checked; damaged or altered ones are computed again. Only a few shards are in memory at a time.
    A folder must not be written to by two runs at once.

    Args:
        job: `SweepJob`.
        out: Folder; made if it does not exist.
        pool: Workers: `RayPool`, or `ThisProcess` by default.
        progress: Called as progress("shards", done, total) after each shard, kept ones included; before that as
            progress("check", done, total) after each existing shard that is checked.

    Returns:
        A dict: count (of poses), intersecting (how many of them do), shards, kept (existing and intact), damaged
        (existing and computed again), workers, and lost (workers that ended before their work).

    Raises:
        ValueError: The folder holds another job, a shard of another or something else; bad options. Nothing is written.
        OSError: A file cannot be read or written.
        RuntimeError: A shard cannot be computed, after several attempts.
    """
    folder = ShardFolder(out, job)
    pool = ThisProcess() if pool is None else pool
    report = progress or (lambda stage, done, total: None)
    total, left = len(folder.left), folder.left
    folder.open(report)
    kept = total - len(left)
    report("shards", kept, total)
    for start, stop, columns in pool.run(job, list(left)) if left else ():
        if (start, stop) not in left:
            raise RuntimeError(f"shard {start} to {stop} was answered twice")
        folder.write(start, stop, columns)
        del left[start, stop]
        report("shards", total - len(left), total)
    if left:
        raise RuntimeError(f"{len(left)} of {total} shards were not answered")
    sweep_up(folder.path, WRITTEN)
    about = {"count": job.count, "intersecting": folder.intersecting}
    about |= {"shards": total, "kept": kept, "damaged": len(folder.damaged)}
    return {**about, "workers": pool.workers, "lost": pool.lost}
