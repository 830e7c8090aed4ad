"""The process of a command: errors and progress on stderr, and signals, which leave no half-written file."""

import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp
from conftest import slow_rows
from helpers.samples import SHUTTLE_SCENE
from helpers.viewer import run_command, write_scene

import warp_abtree as ab
from warp_abtree.app.cli import main as cli
from warp_abtree.app.cli import progress as progress_module
from warp_abtree.checks import signals
from warp_abtree.jobs import RayPool
from warp_abtree.jobs import ray_pool as cluster

ROOT = Path(__file__).resolve().parents[2]
HERE = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
INTERRUPT, TERMINATE = signal.SIGINT, signal.SIGTERM
BOTH = (INTERRUPT, TERMINATE)
# A process takes 2 to 3 s of a core, most of it to import: quick tests start one of each kind.
# What a command of this process runs until the signal comes, which a line on stdout asks for.
HANG = """
import sys, time
import numpy as np
import warp_abtree as ab
from warp_abtree.app.cli import main as cli
from warp_abtree.app.cli import progress as progress_module

def hang(file=None, *_, **__):
    if hasattr(file, "write"):
        file.write(b"half" if "b" in file.mode else "half")
        file.flush()
    print("here", flush=True)
    for _ in range(600):  # a signal just before a sleep does not end it: its handler runs after it
        time.sleep(0.1)

PLACE = hang
sys.exit(cli.main())
"""
BUILD = "build ball.obj new.npz"
SWEEP = "sweep ball.npz ball.npz poses.npy --out answers --ray none"


def ignore():
    for number in BOTH:
        signal.signal(number, signal.SIG_IGN)


block = partial(signal.pthread_sigmask, signal.SIG_BLOCK, BOTH)


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path, SHUTTLE_SCENE)
    trimesh.creation.icosphere(1).export("ball.obj")
    ab.Model.load("ball.obj").save("ball.npz")
    np.save("poses.npy", np.eye(7)[[6] * 40])
    return tmp_path


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("words", "place", "before", "number", "status", "left"),
    [
        (BUILD, "np.savez_compressed", ignore, INTERRUPT, 130, []),
        *slow_rows(
            ("run scene.toml --record new.csv", "ab.Frame.run", block, TERMINATE, 143, []),
            (SWEEP, "np.savez", ignore, TERMINATE, 143, ["answers", "answers/job.json"]),
        ),
    ],
)
def test_a_signal_stops_a_command(files, words, place, before, number, status, left):
    for name in re.findall(r"new\.\w+", words):
        Path(name).write_text("old")
    known = set(files.rglob("*"))
    command = [sys.executable, "-c", HANG.replace("PLACE", place), *words.split(), "--device", "cpu"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env={**os.environ, **HERE}, preexec_fn=before, **pipes) as process:
        try:
            assert process.stdout.readline(), process.stderr.read()
            process.send_signal(number)
            shown, errors = process.communicate(timeout=30)
        finally:
            process.kill()
    told = {130: ["warp-abtree: interrupted"], 143: ["warp-abtree: terminated"]}[status]
    assert [line for line in errors.splitlines() if "compiling kernels" not in line] == told
    assert (process.returncode, shown) == (status, "")
    assert sorted(str(path.relative_to(files)) for path in set(files.rglob("*")) - known) == left
    assert all(path.read_text() == "old" for path in files.glob("new.*"))


def run_process(words, code, **variables):
    """Run code with arguments in a process of its own; return its status and what it says."""
    options = {"env": {**os.environ, **HERE, **variables}, "capture_output": True, "text": True, "timeout": 60}
    done = subprocess.run([sys.executable, "-c", code, *words.split()], **options)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("name", ["rows.csv", "rows.json"])
def test_an_interrupted_run_keeps_its_rows(files, capsys, monkeypatch, name):
    def stop(frame, advance=ab.Frame._advance):
        if len(frame.history) == 3:
            raise KeyboardInterrupt
        advance(frame)

    monkeypatch.setattr(ab.Frame, "_advance", stop)
    words = f"run scene.toml --record {name} --device cpu".split()
    assert run_command(capsys, *words, status=130)[1] == ["warp-abtree: interrupted"]
    text = Path(name).read_text()
    rows = json.loads(text) if name.endswith("json") else list(csv.DictReader(io.StringIO(text)))
    assert [int(row["frame"]) for row in rows] == [0, 1, 2]


# A signal comes while the module of $STOP_AT is looked for, whose importer catches what a handler raises.
STOP_AT = """
import os, signal, sys, time
{signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}  # as shells do in the background

class Stop:
    def find_spec(self, name, *_):
        if name == os.environ["STOP_AT"]:
            try:
                os.kill(os.getpid(), int(os.environ["NUMBER"]))
                time.sleep(0.1)
            except BaseException:
                pass

sys.meta_path.insert(0, Stop())
from warp_abtree.__main__ import main
from warp_abtree.checks import signals
signals.DELAY = float(os.environ["DELAY"])
sys.exit(main())
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("module", "number", "delay", "told"),
    [
        ("pxr", INTERRUPT, 0.01, (130, "warp-abtree: interrupted\n")),  # of a command that runs already
        *slow_rows(
            ("trimesh", TERMINATE, 0.01, (143, "warp-abtree: terminated\n")),
            ("pxr", TERMINATE, 60.0, (143, "warp-abtree: terminated\n")),  # and that ends before it comes again
        ),
    ],
)
def test_a_signal_during_imports_is_not_caught(module, number, delay, told):
    variables = {"STOP_AT": module, "NUMBER": str(number.value), "DELAY": str(delay)}
    status, _, errors = run_process("info warp:bunny", STOP_AT, **variables)
    assert (status, errors) == told


SIGNALLED = "import os, time\ndef __del__():\n    os.kill(os.getpid(), number)\n    time.sleep(0.05)\n__del__()"


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", BOTH)
@pytest.mark.parametrize("file", ["model.py", signals.IMPORTS])
def test_a_signal_waits_for_imports_and_finalisers(monkeypatch, file, number):
    """It comes again once they have ended; and goes to handlers that others set before that."""
    seen, timers, before = [], [], [signal.getsignal(each) for each in BOTH]

    def note(kind):
        return lambda number, frame: seen.append((kind, number))

    def timer(_, send, arguments):
        return SimpleNamespace(start=lambda: timers.append(partial(send, *arguments)))

    monkeypatch.setattr(signals.threading, "Timer", timer)
    code = compile(SIGNALLED.replace("__del__", "load" if file == signals.IMPORTS else "__del__"), file, "exec")
    try:
        for take_over in (False, True):
            signal.signal(number, signals.not_swallowed(note("ours")))
            exec(code, {"number": number})
            assert not seen and len(timers) == 1
            end_timer = timers.pop()
            signals.handle_signals(note("theirs"), note("theirs")) if take_over else end_timer()
            end = time.monotonic() + 20
            while not seen and time.monotonic() < end:
                time.sleep(0.001)
            assert seen.pop() == ("theirs" if take_over else "ours", number)
    finally:
        for each, handler in zip(BOTH, before):
            signal.signal(each, handler)


THING = """
import atexit, os, sys
from warp_abtree.__main__ import main

class Thing:
    def __del__(self, kill=os.kill, number=os.getpid()):
        kill(number, 2)
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("last", "status", "errors"),
    [
        ("sys.kept = Thing()", 0, ""),  # after the last code a signal changes nothing
        ("atexit.register(os.kill, os.getpid(), 2)", 130, "warp-abtree: interrupted\n"),
    ],
)
def test_the_version_needs_no_warp_and_ends_as_a_signal_says(last, status, errors):
    code = f"{THING}\nsys.modules['warp'] = None\nstatus = main()\n{last}\nsys.exit(status)"
    assert run_process("--version", code) == (status, f"warp-abtree {ab.__version__}\n", errors)


def test_a_kernel_cache_that_cannot_be_written_names_its_variable(files, capsys, monkeypatch):
    words, cache = ("info", "ball.obj", "--device", "cpu"), files / "ball.obj" / "cache"
    with monkeypatch.context() as patch:
        patch.setattr(wp.config, "kernel_cache_dir", str(cache))
        patch.setattr(cli, "start_warp", lambda: os.makedirs(cache))
        _, (error,) = run_command(capsys, *words, status=2)
    assert "ball.obj/cache" in error
    assert error.endswith(" (Warp's kernel cache; WARP_CACHE_PATH names a folder that can be written)")
    _, (error,) = run_command(capsys, "info", "gone.obj", *words[2:], status=2)
    assert "WARP_CACHE_PATH" not in error


def test_a_caller_keeps_its_signals(files, capsys, monkeypatch):
    """Of a command that is called, and of a program's that runs in another thread than the main one."""
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    before = [signal.getsignal(number) for number in BOTH]
    words = ["info", "ball.obj", "--device", "cpu"]
    assert cli.main(words) == 0
    monkeypatch.setattr(sys, "argv", ["warp-abtree", *words])
    status = []
    thread = threading.Thread(target=lambda: status.append(cli.main()))
    thread.start()
    thread.join()
    assert status == [0] and not capsys.readouterr().err
    assert [signal.getsignal(number) for number in BOTH] == before
    assert warnings.formatwarning(UserWarning("a\nb"), UserWarning, "some.py", 7) == "warp-abtree: a\nb\n"


def test_ray_leaves_a_program_its_handler(monkeypatch):
    before, theirs = signal.getsignal(signal.SIGTERM), lambda number, frame: None
    ray = SimpleNamespace(is_initialized=lambda: False, cluster_resources=lambda: {"CPU": 1}, shutdown=lambda: None)
    ray.init = lambda **_: signal.signal(signal.SIGTERM, theirs)
    monkeypatch.setattr(cluster, "_import_ray", lambda: ray)
    try:
        for ours, kept in ((cli.terminate, cli.terminate), (signal.SIG_DFL, theirs)):
            signal.signal(signal.SIGTERM, ours)
            RayPool(workers=1).close()
            assert signal.getsignal(signal.SIGTERM) is kept
    finally:
        signal.signal(signal.SIGTERM, before)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_on_a_terminal_is_a_bar(monkeypatch):
    pytest.importorskip("rich")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    stream, clock = Terminal(), iter([0.0, 0.1, *np.arange(1.0, 20.0)])
    progress = progress_module.Progress(stream, clock=lambda: next(clock))
    for done in (0, 1, 5, 10):
        progress("LOD bounds", done, 10)
    progress.close()
    assert stream.getvalue().endswith("\x1b[2K"), "the bar is cleared"
    for done in range(5):
        progress.compiling(done, 4)
    assert progress.stage is None and stream.getvalue().endswith("\x1b[2K")
    shown = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", stream.getvalue()).replace("\r", "\n")
    assert list(dict.fromkeys(re.findall(r"LOD bounds .* (\d+)%", shown))) == ["0", "50", "100"]
    assert re.findall(r"compiling kernels .* (\d of 4)", shown)[-1] == "4 of 4"


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
