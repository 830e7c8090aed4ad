"""Atomic writes: whole files on the disk, from several processes at once, and nothing left of those that fail."""

import io
import os
import re
import signal
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.scenes import scene_with

import warp_abtree as ab
from bench.tables import write_json
from warp_abtree.app.cli.query_command import record_found
from warp_abtree.app.pictures.render import write_png
from warp_abtree.checks import atomic_write as files
from warp_abtree.checks.atomic_write import SUFFIX, atomic_write, sweep_up
from warp_abtree.jobs import SweepJob, ThisProcess, run_shards

MODEL = ab.Model.from_arrays(np.eye(3), [[0, 1, 2]])


# Without the package, which takes long to import.
IMPORT = f"""
import sys
sys.path.insert(0, {str(Path(files.__file__).parent)!r})
from atomic_write import atomic_write
"""


@pytest.fixture
def calls(monkeypatch):
    """Give the list into which calls of os.fsync and os.replace go: what is synced, and its size then."""
    calls = []

    def fsync(opened, plain=os.fsync):
        found = os.fstat(opened)
        calls.append(("folder", found.st_ino) if stat.S_ISDIR(found.st_mode) else ("file", found.st_ino, found.st_size))
        plain(opened)

    def replace(source, target, plain=os.replace):
        calls.append(("replace", os.stat(source).st_ino, Path(target).name))
        plain(source, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(os, "replace", replace)
    return calls


def write_bytes(path):
    with atomic_write(path) as file:
        file.write(b"x" * 100)


def run_frame():
    scene = scene_with("cpu", MODEL, MODEL)
    frame = ab.Frame(scene, output="contacts")
    return frame, frame.step()


def make_shards(path):
    run_shards(SweepJob(MODEL, MODEL, np.eye(7)[6:]), path.parent, pool=ThisProcess("cpu"))


SHARD = "shard-000000000000-000000000001"


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_bytes, "bytes"),
        (lambda path: write_json(path, {"study": "x", "parts": {}}), "study.json"),
        (MODEL.save, "model.npz"),
        (lambda path: run_frame()[0].record(path), "rows.csv"),
        (lambda path: record_found(run_frame()[1], path), "found.csv"),
        (lambda path: record_found(run_frame()[1], path), "found.npz"),
        (lambda path: write_png(np.zeros((9, 9, 3), np.uint8), path), "picture.png"),
        (make_shards, "job.json"),
        (make_shards, f"{SHARD}.npz"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_writer_syncs_its_file_then_replaces_then_syncs_the_folder(tmp_path, calls, write, name):
    write(tmp_path / name)
    found = (tmp_path / name).stat()
    at = [call[2:] for call in calls].index((name,))
    assert calls[at - 1 : at + 2] == [
        ("file", found.st_ino, found.st_size),
        ("replace", found.st_ino, name),
        ("folder", tmp_path.stat().st_ino),
    ]
    assert not list(tmp_path.glob(f"*{SUFFIX}"))


@pytest.mark.parametrize("mask", [0o022, 0o077])
def test_permissions_are_those_of_any_new_file(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_bytes(tmp_path / "written")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "written").stat().st_mode) == 0o666 & ~mask


@pytest.mark.parametrize(
    "error", [OSError(28, "No space left"), ValueError("bad"), KeyboardInterrupt(), SystemExit(143)]
)
@pytest.mark.parametrize("where", ["body", "fsync", "replace"])
def test_what_stood_there_stays_if_a_write_fails(tmp_path, monkeypatch, error, where):
    path = tmp_path / "written"
    path.write_text("old")

    def fail(*_):
        raise error

    if where != "body":
        monkeypatch.setattr(os, where, fail)
    with pytest.raises(type(error)) as caught, atomic_write(path) as file:
        file.write(b"new")
        if where == "body":
            fail()
    assert path.read_text() == "old" and [entry.name for entry in tmp_path.iterdir()] == ["written"]
    if isinstance(error, OSError):
        assert caught.value.errno == 28 and caught.value.filename == str(path)


def test_errors_name_the_path_that_was_asked_for(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for name, kind in (
        ("missing/x.npz", FileNotFoundError),
        ("file/x.npz", NotADirectoryError),
        ("folder", IsADirectoryError),
        ("/", IsADirectoryError),
        ("x" * 300, OSError),
    ):
        with pytest.raises(kind) as caught, atomic_write(tmp_path / name):
            pass
        assert caught.value.filename == str(tmp_path / name) and SUFFIX not in str(caught.value)
    with pytest.raises(FileNotFoundError) as caught, atomic_write(tmp_path / "copy"):
        open(tmp_path / "source")
    assert caught.value.filename == str(tmp_path / "source"), "the error is not about the copy"
    with pytest.raises(OSError, match=r"^no errno$"), atomic_write(tmp_path / "copy"):
        raise OSError("no errno")
    with pytest.raises(io.UnsupportedOperation), atomic_write(tmp_path / "copy") as file:
        file.read()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]


HALF = """
with atomic_write(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    print("half", flush=True)
    sys.stdin.readline()
    file.write(b" and half")
"""


def test_sweeping_up_leaves_what_another_process_is_writing(tmp_path):
    commands = [[sys.executable, "-c", IMPORT + HALF, tmp_path / name] for name in ("live", "dead")]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    live, dead = (subprocess.Popen(command, **pipes) for command in commands)
    try:
        assert live.stdout.readline() == dead.stdout.readline() == "half\n"
        (tmp_path / f"dead.{live.pid}-0123abcd{SUFFIX}").touch()  # of a writer that had the same id once
        (tmp_path / "other").touch()
        strangers = [f"film{SUFFIX}", f"dead.1{SUFFIX}", f"undead.1-0123abcd{SUFFIX}"]
        for name in strangers:
            (tmp_path / name).touch()
        os.symlink(tmp_path / "other", tmp_path / f"dead.2-0123abcd{SUFFIX}")
        os.mkfifo(tmp_path / f"dead.3-0123abcd{SUFFIX}")
        dead.send_signal(signal.SIGKILL)
        dead.wait()
        assert len(list(tmp_path.glob(f"*{SUFFIX}"))) == 8
        sweep_up(tmp_path, re.compile("live|dead"))
        kept = sorted(path.name for path in tmp_path.glob(f"*{SUFFIX}") if not path.name.startswith("live."))
        assert kept == sorted([*strangers, f"dead.2-0123abcd{SUFFIX}", f"dead.3-0123abcd{SUFFIX}"])
        assert len(list(tmp_path.glob("live.*"))) == 1
        live.communicate("\n")
        assert live.returncode == 0
    finally:
        for process in (live, dead):
            process.kill()
            process.communicate()
    assert (tmp_path / "live").read_text() == "half and half" and not list(tmp_path.glob("live.*"))


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
def test_a_pipe_or_a_device_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    os.symlink(tmp_path / "pipe", tmp_path / "link")
    os.symlink(os.devnull, tmp_path / "null")
    for name in ("pipe", "link", "null"):
        with pytest.raises(OSError, match="is neither a file nor a folder") as caught, atomic_write(tmp_path / name):
            pass
        assert caught.value.filename == str(tmp_path / name)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["link", "null", "pipe"]
    assert (tmp_path / "pipe").is_fifo()


def test_a_file_that_is_swept_up_before_it_is_locked_is_made_again(tmp_path, monkeypatch):
    made = []

    def lock(file, wait=False, plain=files._lock):
        made.append(file.name)
        if len(made) == 1:
            os.unlink(file.name)
        return plain(file, wait)

    monkeypatch.setattr(files, "_lock", lock)
    write_bytes(tmp_path / "written")
    assert len(set(made)) == 2 and (tmp_path / "written").stat().st_size == 100


def test_a_name_that_another_writer_has_is_not_taken(tmp_path, monkeypatch):
    names = iter(["same", "same", "other"])
    monkeypatch.setattr(files.secrets, "token_hex", lambda _: next(names))
    with atomic_write(tmp_path / "written") as first:
        first.write(b"first")
        first.flush()
        with atomic_write(tmp_path / "written") as second:
            second.write(b"second")
        assert (tmp_path / "written").read_bytes() == b"second"
    assert (tmp_path / "written").read_bytes() == b"first"
