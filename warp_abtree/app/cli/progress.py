"""What stderr shows while people wait: a progress bar, a word about kernels being compiled, and no banner of Warp."""

import contextlib
import os
import sys
import tempfile
import threading
import time

import warp as wp

NOTICE_DELAY = 1.5  # seconds of compiling before a word about it


def _start_bar(stage):
    """Return a bar of rich on stderr that runs, and its task; None where rich is not installed."""
    try:
        from rich import progress
        from rich.console import Console
    except ImportError:
        return None
    columns = progress.TextColumn("{task.description}"), progress.BarColumn(), progress.TaskProgressColumn()
    # No thread of its own redraws it: that would take time from frames that are being timed.
    console = Console(stderr=True)
    bar = progress.Progress(
        *columns, progress.TimeRemainingColumn(), console=console, transient=True, auto_refresh=False
    )
    bar.start()
    return bar, bar.add_task(stage)


class Progress:
    """A bar on stderr: redrawn in place on a terminal, a line a stage otherwise; drawn only once a stage takes long.

    On the terminal of the process rich draws it, where that is installed.

    Args:
        stream: Where to write; None for sys.stderr.
        delay: Seconds before a stage is shown.
    """

    WIDTH = 30

    def __init__(self, stream=None, delay=0.5, clock=time.monotonic):
        self.stream = sys.stderr if stream is None else stream
        self.live = self.stream.isatty()
        self.delay, self.clock = delay, clock
        self.stage, self.began, self.shown = None, 0.0, None
        self._bar = None

    def __call__(self, stage, done, total):
        """Show how much of a stage is done."""
        now = self.clock()
        if stage != self.stage:
            self.close()
            self.stage, self.began, self.shown = stage, now, None
        if now - self.began < self.delay:
            return
        part = min(done / total, 1.0) if total else 1.0
        if self.live and self.stream is sys.stderr and self.shown is None:
            self._bar = _start_bar(stage)
        if self.live and self.shown is not None and now - self.shown <= 0.05 and part < 1.0:
            return
        if self._bar is not None:
            bar, task = self._bar
            bar.update(task, completed=part, total=1.0, refresh=True)
        elif self.live:
            drawn = "#" * round(self.WIDTH * part)
            self.stream.write(f"\r{stage:<12} [{drawn:<{self.WIDTH}}] {100 * part:3.0f} %")
        elif self.shown is None:
            self.stream.write(f"{stage} ...\n")
        else:
            return
        self.shown = now
        self.stream.flush()

    def close(self):
        """End the line of the last stage."""
        if self._bar is not None:
            self._bar[0].stop()
            self._bar = None
        elif self.live and self.shown is not None:
            self.stream.write("\r\x1b[K")
            self.stream.flush()
        self.stage = self.shown = None


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
def compile_notice(stream=None, delay=NOTICE_DELAY):
    """Say once on stderr that kernels are being compiled, if that takes longer than a moment."""
    finished = threading.Event()

    def compiling():
        # While Warp compiles a module, a folder with the process id stands in its cache.
        try:
            return any(f"_p{os.getpid()}_t" in entry.name for entry in os.scandir(wp.config.kernel_cache_dir))
        except (OSError, TypeError):
            return False

    def watch():
        busy = 0.0
        while not finished.wait(0.25):
            busy += 0.25 * compiling()
            if busy > delay:
                print("compiling kernels for this machine; later runs find them in a cache", file=stream or sys.stderr)
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
