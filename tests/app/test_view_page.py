"""The page on its server, without a browser; the standalone page; the command, and one line for anything bad."""

import socket
import threading
import time

import pytest
import trimesh
from helpers.viewer import make_models, make_playback, write_scene

from warp_abtree.app import load_scene
from warp_abtree.app.cli import main as cli
from warp_abtree.app.open_playback import open_playback


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path)
    trimesh.creation.box().export("box.obj")
    return tmp_path


@pytest.fixture
def server():
    pytest.importorskip("viser")
    from warp_abtree.app.viewer.command import serve

    before = set(threading.enumerate())
    with serve() as server:
        yield server
        assert len(left_over(before)) > 0
    end = time.monotonic() + 10
    while left_over(before) and time.monotonic() < end:
        time.sleep(0.05)
    assert not left_over(before), "threads end with the server"


def left_over(before):
    """Return threads that came since, without those that the library keeps for its launches."""
    since = set(threading.enumerate()) - before
    return [thread.name for thread in since if not thread.name.startswith("warp_abtree")]


@pytest.fixture
def page(server, device):
    from warp_abtree.app.viewer.page import Page

    page = Page(server, make_playback(make_models(), device))
    page.run(seconds=0.3)
    return page


@pytest.mark.slow
def test_a_page_stands_until_it_is_told_to_play(page):
    assert page.snapshots == 1 and page.snapshot.number == 0 and "| state | paused |" in page._state.content
    page._post(page._run_button, "step")
    page.run(seconds=0.3)
    assert page.snapshots == 2 and page.snapshot.row.frame == 0 and not page.playing
    page._post(page._run_button, "play")
    page.run(seconds=0.5)
    assert page.playing and page.snapshot.number > 2 and len(page._rows) == page.snapshot.number + 1
    page._post(page._run_button, "play")
    page.run(seconds=0.2)
    number = page.snapshot.number
    page.run(seconds=0.2)
    assert page.snapshot.number == number
    page._post(page._run_button, "restart")
    page.run(seconds=0.2)
    assert page.snapshot.number == 0 and not page._rows


@pytest.mark.slow
def test_what_people_do_reaches_the_scene(page):
    top = page.playback.scene.models[0].lod_max
    page._post(page._hold_all, 50.0)
    page.run(seconds=0.2)
    assert page.snapshot.lods.tolist() == [round(0.5 * top), 141, round(0.5 * top)]
    page._mode.value, page._budget.value = "budget, predicted", 7.0
    page._post(page._choose)
    page.run(seconds=0.2)
    assert page.playback.budget_ms == 7.0
    page._post(page._run_button, "step")
    page.run(seconds=0.3)
    assert page.snapshot.row.budget_ms == 7.0


def test_a_port_that_is_taken(files, capsys):
    pytest.importorskip("viser")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert cli.main(["view", "box.obj", "--port", str(port)]) == 2
    assert f"127.0.0.1:{port}: cannot be served at (Address already in use)" in capsys.readouterr().err


def test_a_recording_has_a_slider_of_frames(files, server):
    from warp_abtree.app.recording import record_run
    from warp_abtree.app.viewer.page import Page

    record_run(load_scene("scene.toml", device="cpu"), 4)[1].save("run.npz")
    page = Page(server, open_playback(["run.npz"], "cpu"))
    page._post(page._seek, 2)
    page.run(seconds=0.3)
    assert page.snapshot.number == 2 and page._frame_slider.value == 2 and page._budget is None
    page._post(page._run_button, "step")
    page.run(seconds=0.3)
    assert page.snapshot.number == 3 and page.snapshot.row.frame == 3
