"""What stderr shows while people wait: the progress bar, and the word about compiling."""

import io
import os

from warp_abtree import waiting


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_bar_on_a_terminal():
    stream, clock = Terminal(), iter([0.0, 0.1, 1.0, 2.0])
    progress = waiting.Progress(stream, clock=lambda: next(clock))
    for done in (0, 1, 5, 10):
        progress("error", done, 10)
    progress.close()
    assert stream.getvalue().split("\r")[1:3] == [
        f"error      [{'#' * 15:<30}]  50 %",
        f"error      [{'#' * 30}] 100 %",
    ]
    assert stream.getvalue().endswith("\r\x1b[K")


def test_progress_off_a_terminal_is_a_line_a_stage():
    stream, clock = io.StringIO(), iter(range(100))
    progress = waiting.Progress(stream, clock=lambda: next(clock))
    for stage in ("collapse", "error"):
        for done in range(5):
            progress(stage, done, 4)
    progress.close()
    assert stream.getvalue() == "collapse ...\nerror ...\n"


def test_compiling_is_announced(tmp_path):
    stream = io.StringIO()
    cache = tmp_path / "cache"
    (cache / f"wp_module_p{os.getpid()}_t1").mkdir(parents=True)
    before, waiting.wp.config.kernel_cache_dir = waiting.wp.config.kernel_cache_dir, str(cache)
    try:
        with waiting.compile_notice(stream, delay=0.0):
            for _ in range(100):
                if stream.getvalue():
                    break
                waiting.time.sleep(0.05)
    finally:
        waiting.wp.config.kernel_cache_dir = before
    assert stream.getvalue().count("\n") == 1 and "compiling" in stream.getvalue()
