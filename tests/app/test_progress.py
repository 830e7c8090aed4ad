"""Progress of a command on stderr: a bar on a terminal, else lines with estimates, and a word about compiling."""

import io
import os
import re
import sys
import time

import pytest

from warp_abtree.app.cli import progress as progress_module


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_on_a_terminal_is_a_bar(monkeypatch):
    pytest.importorskip("rich")
    monkeypatch.setenv("TERM", "xterm")
    stream, clock = Terminal(), iter([0.0, 0.1, 1.0, 2.0])
    progress = progress_module.Progress(stream, clock=lambda: next(clock))
    for done in (0, 1, 5, 10):
        progress("LOD bounds", done, 10)
    progress.close()
    shown = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", stream.getvalue())
    assert list(dict.fromkeys(re.findall(r"LOD bounds .* (\d+)%", shown.replace("\r", "\n")))) == ["0", "50", "100"]
    assert stream.getvalue().endswith("\x1b[2K"), "the bar is cleared"


def test_kernels_are_counted_on_a_terminal(monkeypatch):
    pytest.importorskip("rich")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    stream, clock = Terminal(), iter([0.0, 1.0, 2.0, 3.0, 4.0])
    progress = progress_module.Progress(stream, clock=lambda: next(clock))
    for done in range(5):
        progress.compiling(done, 4)
    shown = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", stream.getvalue())
    assert re.findall(r"compiling kernels .* (\d of 4)", shown.replace("\r", "\n"))[-1] == "4 of 4"
    assert progress.stage is None and stream.getvalue().endswith("\x1b[2K"), "the bar is cleared"


@pytest.mark.parametrize("terminal", [False, True])
def test_progress_without_a_bar_is_a_line_a_stage(monkeypatch, terminal):
    monkeypatch.setitem(sys.modules, "rich", None)
    stream, clock = (Terminal if terminal else io.StringIO)(), iter(range(100))
    progress = progress_module.Progress(stream, clock=lambda: next(clock))
    for stage in ("collapse", "LOD bounds"):
        for done in range(5):
            progress(stage, done, 4)
    progress.close()
    assert stream.getvalue() == "collapse ...\nLOD bounds ...\n"


def test_long_stages_are_estimated():
    """At 5 s, and whenever twice the time has gone by: of 1,000 steps of a second each."""
    stream, now = io.StringIO(), [0]
    progress = progress_module.Progress(stream, clock=lambda: now[0])
    for done in range(101):
        now[0] = done
        progress("frames", done, 1000)
    progress("other", 0, 2)
    now[0] += 7
    progress("other", 1, 2)
    progress("other", 1, 2)
    seen = [(5, "0:16:35"), (10, "0:16:30"), (20, "0:16:20"), (40, "0:16:00"), (80, "0:15:20")]
    lines = [f"frames: {done} of 1,000, about {left} left" for done, left in seen]
    for done in range(8):
        now[0] += 1
        progress("frames", done, 10**30)
    lines += ["other ...", "other: 1 of 2, about 0:00:07 left", "frames ..."]
    *seen, last = stream.getvalue().splitlines()
    assert seen == ["frames ...", *lines] and last.endswith(", about years left")


def test_compiling_is_announced(tmp_path, monkeypatch):
    stream, now = io.StringIO(), time.monotonic()
    (tmp_path / f"wp_module_p{os.getpid()}_t1").mkdir()
    monkeypatch.setattr(progress_module.wp.config, "kernel_cache_dir", str(tmp_path))
    with progress_module.compile_notice(stream, delay=0.0):
        while not stream.getvalue() and time.monotonic() < now + 5:
            time.sleep(0.05)
    assert stream.getvalue().count("\n") == 1 and "compiling" in stream.getvalue()
