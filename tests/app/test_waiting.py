"""What stderr shows while people wait: the progress bar, and the word about compiling."""

import functools
import io
import os
import re

import numpy as np
import pytest
import trimesh
from helpers.samples import SHUTTLE_SCENE

from warp_abtree.app.cli import main as cli
from warp_abtree.app.cli import progress as waiting


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_bar_on_a_terminal():
    stream, clock = Terminal(), iter([0.0, 0.1, 1.0, 2.0])
    progress = waiting.Progress(stream, clock=lambda: next(clock))
    for done in (0, 1, 5, 10):
        progress("LOD bounds", done, 10)
    progress.close()
    assert stream.getvalue().split("\r")[1:3] == [
        f"LOD bounds   [{'#' * 15:<30}]  50 %",
        f"LOD bounds   [{'#' * 30}] 100 %",
    ]
    assert stream.getvalue().endswith("\r\x1b[K")


def test_progress_off_a_terminal_is_a_line_a_stage():
    stream, clock = io.StringIO(), iter(range(100))
    progress = waiting.Progress(stream, clock=lambda: next(clock))
    for stage in ("collapse", "LOD bounds"):
        for done in range(5):
            progress(stage, done, 4)
    progress.close()
    assert stream.getvalue() == "collapse ...\nLOD bounds ...\n"


@pytest.mark.slow
def test_no_label_can_be_taken_for_an_error(tmp_path, monkeypatch, capsys):
    """Of any command, were every stage to take long."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "Progress", functools.partial(waiting.Progress, delay=-1.0))
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
