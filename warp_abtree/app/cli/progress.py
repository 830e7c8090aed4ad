"""Messages on stderr during long work: a progress bar, a word about kernels being compiled, and no banner of Warp."""

import contextlib
import os
import sys
import tempfile
import threading
import time
from datetime import timedelta

import warp as wp

ESTIMATE_DELAY = 5.0  # seconds of a stage before its first estimate
YEAR = 366 * 86400  # seconds
NOTICE_DELAY = 1.5  # seconds of compiling before a word about it
COMPILING = "compiling kernels"


class Progress:
    """On a terminal a bar of rich, where that is installed; otherwise lines. Stages within a delay [s] are not shown.

    A stage begins with a line; a long one says how much is done and what is left, each time after twice as long.
    """

    def __init__(self, stream=None, delay=0.5, clock=time.monotonic):
        self.stream = sys.stderr if stream is None else stream
        self.delay, self.clock = delay, clock
        self.stage, self.began, self.shown = None, 0.0, None
        self._bar, self._told = None, ESTIMATE_DELAY / 2

    def __call__(self, stage, done, total):
        """Show how much of a stage is done."""
        now = self.clock()
        if stage != self.stage:
            self.close()
            self.stage, self.began = stage, now
        if now - self.began < self.delay:
            return
        if self.shown is None:
            self._bar = _start_bar(self.stream, stage) if self.stream.isatty() else None
            if self._bar is None:
                print(f"{stage} ...", file=self.stream, flush=True)
        elif self._bar is None:
            self._estimate(done, total, now - self.began)
            return
        elif now - self.shown <= 0.05 and done < total:
            return
        self.shown = now
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, completed=done, total=max(total, 1), refresh=True)

    def compiling(self, done, total):
        """Show how many kernels are loaded, as `tell_loading` asks for."""
        self(COMPILING, done, total)
        if done >= total:
            self.close()

    def _estimate(self, done, total, spent):
        """Say how much is done, if that was not said for as long as the stage had taken then."""
        if 0 < done < total and spent >= 2 * self._told:
            self._told = spent
            left = round(spent * (total - done) / done)
            about = str(timedelta(seconds=left)) if left < YEAR else "years"
            print(f"{self.stage}: {done:,} of {total:,}, about {about} left", file=self.stream, flush=True)

    def close(self):
        """End the bar of the last stage."""
        if self._bar is not None:
            self._bar[0].stop()
        self._bar = self.stage = self.shown = None
        self._told = ESTIMATE_DELAY / 2


def _start_bar(stream, stage):
    """Return a running bar of rich, and its task; None where rich is not installed."""
    try:
        from rich import progress
        from rich.console import Console
    except ImportError:
        return None
    # No thread of its own redraws it: that would take time from frames that are being timed.
    columns = *progress.Progress.get_default_columns(), progress.MofNCompleteColumn(separator=" of ")
    bar = progress.Progress(*columns, console=Console(file=stream), transient=True, auto_refresh=False)
    bar.start()
    return bar, bar.add_task(stage)


def start_warp():
    """Start Warp without its banner, and without its native warning on machines that have no NVIDIA driver."""
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    with tempfile.TemporaryFile() as held:
        kept = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            for line in held.read().decode(errors="replace").splitlines():
                if "Could not find or load the NVIDIA CUDA driver" not in line:
                    print(line, file=sys.stderr)


@contextlib.contextmanager
def compile_notice(stream=None, delay=NOTICE_DELAY, progress=None):
    """Say once on stderr that kernels are being compiled, if that takes longer than a moment and no bar shows it."""
    finished = threading.Event()

    def compiling():
        # While Warp compiles a module, its cache has a folder whose name contains the process id.
        try:
            return any(f"_p{os.getpid()}_t" in entry.name for entry in os.scandir(wp.config.kernel_cache_dir))
        except (OSError, TypeError):
            return False

    def watch():
        busy = 0.0
        while not finished.wait(0.25):
            busy += 0.25 * compiling()
            if busy > delay and not (progress and progress.stage == COMPILING):
                print("compiling kernels for this machine; later runs find them in a cache", file=stream or sys.stderr)
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
