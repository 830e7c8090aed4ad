"""The process of a command: progress on stderr, and SIGINT and SIGTERM, which leave no half-written file."""

import functools
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers.samples import SHUTTLE_SCENE

import warp_abtree as ab
from warp_abtree.app.cli import main as cli
from warp_abtree.app.cli import progress as progress_module
from warp_abtree.jobs import RayPool
from warp_abtree.jobs import ray_pool as cluster

ROOT = Path(__file__).resolve().parents[2]
STATUS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
BOTH = (signal.SIGINT, signal.SIGTERM)


def ignore():
    for number in BOTH:
        signal.signal(number, signal.SIG_IGN)


def block():
    signal.pthread_sigmask(signal.SIG_BLOCK, BOTH)


def handle_plainly():
    for number in BOTH:
        signal.signal(number, signal.SIG_DFL)


# What a command of this process runs until the signal comes; told on stdout.
HANG = """
import contextlib, sys, time
import numpy as np
import warp_abtree as ab
from warp_abtree.app.cli import main as cli
from warp_abtree.simulate import frame

def hang(file=None, *_, **__):
    if file is not None:
        file.write(b"half" if "b" in file.mode else "half")
        file.flush()
    print("now", flush=True)
    time.sleep(60)

"""
WRITES = {
    "np.savez": HANG + "np.savez = hang",
    "np.savez_compressed": HANG + "np.savez_compressed = hang",
    "csv": HANG + "frame.csv.DictWriter = hang",
    "frames": HANG + "ab.Frame.step = lambda _: hang()",
}


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SHUTTLE_SCENE)
    trimesh.creation.icosphere(1).export("ball.obj")
    ab.Model.load(trimesh.creation.icosphere(1)).save("ball.npz")
    np.save("poses.npy", np.eye(7)[[6] * 40])
    return tmp_path


def start(command, before):
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, preexec_fn=before, **pipes)


def stop(process, number):
    """Send a signal once the process has told that it is at it; return stdout's rest and the lines of stderr."""
    try:
        first = process.stdout.readline()
        assert first, process.stderr.read()
        process.send_signal(number)
        shown, errors = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    return first, shown, [line for line in errors.splitlines() if "compiling kernels" not in line]


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", BOTH, ids=lambda number: number.name)
@pytest.mark.parametrize(
    ("words", "where", "before", "old"),
    [
        ("build ball.obj new.npz", "np.savez_compressed", ignore, None),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("build ball.obj new.npz", "np.savez_compressed", block, "new.npz"),
                ("run scene.toml --record new.csv", "csv", handle_plainly, "new.csv"),
                ("run scene.toml --record new.npz", "frames", ignore, None),
                ("query ball.obj ball.obj --output faces --record new.npz", "np.savez", ignore, "new.npz"),
                ("sweep ball.npz ball.npz poses.npy --out answers --ray none", "np.savez", ignore, None),
            )
        ),
    ],
)
def test_a_signal_stops_a_command(files, words, where, before, old, number):
    if old:
        Path(old).write_text("old")
    script = WRITES[where] + "\nsys.exit(cli.main())"
    process = start([sys.executable, "-c", script, *words.split(), "--device", "cpu"], before)
    known = {path.name for path in files.iterdir()}
    first, shown, errors = stop(process, number)
    status, word = STATUS[number]
    assert first == "now\n" and not shown
    assert process.returncode == status and errors == [f"warp-abtree: {word}"]
    left = {path.name for path in files.iterdir()} - known
    assert left == ({"answers"} if words.startswith("sweep") else set())
    assert not left or [path.name for path in Path("answers").iterdir()] == ["job.json"]
    assert old is None or Path(old).read_text() == "old"


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", BOTH, ids=lambda number: number.name)
@pytest.mark.parametrize("before", [ignore, block, handle_plainly], ids=lambda before: before.__name__)
@pytest.mark.slow
def test_a_signal_stops_the_page(files, number, before):
    pytest.importorskip("viser")
    words = "view ball.obj ball.obj --port 0 --json --device cpu".split()
    process = start([sys.executable, "-m", "warp_abtree", *words], before)
    first, shown, errors = stop(process, number)
    assert json.loads(first)["objects"] == 2 and not shown
    # An interrupt is how people end it.
    expected = (0, []) if number == signal.SIGINT else (143, ["warp-abtree: terminated"])
    assert (process.returncode, errors) == expected


def test_a_caller_keeps_its_signals(files, capsys, monkeypatch):
    """Of a command that is called, and of a program's that runs in another thread than the main one."""
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


def test_a_program_handles_signals(monkeypatch, capsys):
    before = [signal.getsignal(number) for number in BOTH]
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        monkeypatch.setattr(sys, "argv", ["warp-abtree", "info", "warp:cat"])
        assert cli.main() == 2
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        with pytest.raises(cli.Terminated) as caught:
            signal.raise_signal(signal.SIGTERM)
        assert caught.value.code == 143
    finally:
        for number, handler in zip(BOTH, before):
            signal.signal(number, handler)


# Progress.


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


@pytest.mark.slow
def test_no_label_can_be_taken_for_an_error(tmp_path, monkeypatch, capsys):
    """Of any command, were every stage to take long."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "Progress", functools.partial(progress_module.Progress, delay=-1.0))
    (tmp_path / "scene.toml").write_text(SHUTTLE_SCENE)
    trimesh.creation.icosphere(2).export("ball.obj")
    np.save("poses.npy", np.eye(7)[[6, 6]])
    model = ["collapse ...", "LOD bounds ..."]
    sweep = "sweep ball.npz ball.npz poses.npy --out answers --ray none"
    for words, labels in (
        ("build ball.obj ball.npz", [*model, "outward bounds ..."]),
        ("query ball.obj ball.obj", model),
        ("run scene.toml", [*model, *model, "frames ..."]),
        ("picture scene.toml --out picture.png", [*model, *model]),
        (sweep, ["shards ..."]),
        (sweep, ["check ...", "shards ..."]),
    ):
        assert cli.main([*words.split(), "--device", "cpu"]) == 0
        lines = [line for line in capsys.readouterr().err.splitlines() if "compiling kernels" not in line]
        assert lines == labels
        assert not [line for line in lines if re.match(r"error|warning|failed|fatal", line, re.IGNORECASE)]


def test_compiling_is_announced(tmp_path):
    stream = io.StringIO()
    cache = tmp_path / "cache"
    (cache / f"wp_module_p{os.getpid()}_t1").mkdir(parents=True)
    before, progress_module.wp.config.kernel_cache_dir = progress_module.wp.config.kernel_cache_dir, str(cache)
    try:
        with progress_module.compile_notice(stream, delay=0.0):
            for _ in range(100):
                if stream.getvalue():
                    break
                progress_module.time.sleep(0.05)
    finally:
        progress_module.wp.config.kernel_cache_dir = before
    assert stream.getvalue().count("\n") == 1 and "compiling" in stream.getvalue()
