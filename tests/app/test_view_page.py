"""The viewer's page on its server, without a browser and in a headless Chromium (playwright, extra dev)."""

import io
import json
import re
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest
from helpers import refused
from helpers.scenes import scene_with
from helpers.viewer import CHROMIUM, FLAGS, make_models, make_playback, run_command, write_scene
from oracles.motion import posed

import warp_abtree as ab

pytest.importorskip("viser", reason="the viewer needs viser (extra view)")

from websockets import Headers

from warp_abtree.app import view
from warp_abtree.app.cli.main import Terminated
from warp_abtree.app.playback import StillPlayback
from warp_abtree.app.viewer import page as module
from warp_abtree.app.viewer.command import serve
from warp_abtree.app.viewer.guard import is_refused, refuse_foreign
from warp_abtree.app.viewer.object_panel import LISTED_OBJECTS
from warp_abtree.app.viewer.page import Page


@pytest.fixture
def server():
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
    page = Page(server, make_playback(device))
    page.run(seconds=0.3)
    return page


def act(page, *action, seconds=0.2):
    page._post(*action)
    page.run(seconds=seconds)


def press(page, name):
    page._run_button(name)
    page.advance()


def choose(page, mode):
    page._mode.value = mode
    page._choose()
    page.advance()


# Who may ask. Headers that are sent, where P is the port, and whether a server at loopback, at all addresses, and at
# a name of its own refuses them.
EVIL = "http://evil.example"
ASKED = [
    ({"Host": "localhost:P"}, "..."),
    ({"Host": "127.0.0.1:P", "Origin": "http://127.0.0.1:P"}, "..."),
    ({"Host": "[::1]:P", "Origin": "http://[::1]:P"}, "..."),
    ({"Host": "localhost:9", "Origin": "http://localhost:9"}, "..."),  # forwarded from another port
    ({"Host": "127.0.0.1:P", "Origin": "http://localhost:P"}, "..."),
    ({"Host": "LOCALHOST.:P"}, "..."),
    ({}, "..."),
    ({"Host": "localhost:P", "Origin": EVIL}, "xxx"),
    ({"Host": "localhost:P", "Origin": "null"}, "xxx"),
    ({"Host": "localhost:P", "Origin": "http://localhost:3000"}, "xxx"),
    ({"Host": "localhost:P", "Origin": "http://localhost.evil.example:P"}, "xxx"),
    ({"Origin": EVIL}, "xxx"),
    ({"Host": "evil.example:P"}, "xxx"),
    ({"Host": "evil.example:P", "Origin": "http://evil.example:P"}, "xxx"),  # whose name leads here
    ({"Host": "127.0.0.1.evil.example:P"}, "xxx"),
    ({"Host": "[::1:P"}, "xxx"),
    ({"Host": "10.1.2.3:P", "Origin": "http://10.1.2.3:P"}, "x.."),
    ({"Host": "10.1.2.3:P", "Origin": "http://10.1.2.4:P"}, "xxx"),
    ({"Host": "NAME:P", "Origin": "http://NAME:P"}, "x.."),
    ({"Host": "view.example:P", "Origin": "http://view.example:P"}, "xx."),
]


def fill(headers, port=8080):
    name = socket.gethostname()
    return [(key, re.sub("P$", str(port), value).replace("NAME", name)) for key, value in headers.items()]


@pytest.mark.parametrize(("headers", "marks"), ASKED)
def test_pages_of_others_are_refused(headers, marks):
    request = SimpleNamespace(headers=Headers(fill(headers)))
    for host, mark in zip(("127.0.0.1", "0.0.0.0", "View.example"), marks):
        assert is_refused(request, host) is (mark == "x")
    assert is_refused(request, "localhost") is is_refused(request, "::1") is (marks[0] == "x")


def test_the_server_refuses_websockets_and_files(server):
    """Answers of HTTP to what `ASKED` sends, as of browsers, over a plain socket."""
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    upgrade |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "viser-v1"}
    for headers, marks in ASKED:
        for more, status in (({}, 200), (upgrade, 101)):
            lines = [f"{key}: {value}" for key, value in [*fill(headers, server.get_port()), *more.items()]]
            with socket.create_connection(("127.0.0.1", server.get_port()), timeout=20) as asked:
                asked.sendall("\r\n".join(["GET / HTTP/1.1", *lines, "", ""]).encode())
                told = asked.recv(100_000)
                assert int(told.split()[1]) == (403 if marks[0] == "x" else status), (headers, more)
                assert status == 101 or marks[0] == "x" or b"text/html" in told
    headers = [("Host", "localhost:1"), ("Origin", "http://localhost:1")]
    for again in headers:
        assert is_refused(SimpleNamespace(headers=Headers([*headers, again])), "127.0.0.1"), "said twice"


@pytest.mark.slow
def test_a_page_stands_until_it_is_told_to_play(page):
    assert page.snapshots == 1 and page.snapshot.number == 0 and "| state | paused |" in page._state.content
    act(page, page._run_button, "step", seconds=0.3)
    assert page.snapshots == 2 and page.snapshot.row.frame == 0 and not page.playing
    act(page, page._run_button, "play", seconds=0.5)
    assert page.playing and page.snapshot.number > 2
    act(page, page._run_button, "play")
    number = page.snapshot.number
    page.run(seconds=0.2)
    assert page.snapshot.number == number
    act(page, page._run_button, "restart")
    assert page.snapshot.number == 0


def make_scene(device, count=0):
    """Return a playback of two balls that meet and a ring, in a still scene, and of many more balls, if asked."""
    ball, ring = make_models()
    second = ball, (1.5, 0, 0, 0, 0, 0, 1), {"name": "Second"}
    scene = scene_with(device, (ball, {"name": "<b>ball</b>"}), second, (ring, (9, 0, 0, 0, 0, 0, 1)))
    far = np.tile([0, 0, 0, 0, 0, 0, 1.0], (count, 1))
    far[:, 2] = 9 + 3 * np.arange(count)
    scene.add_many([ball] * count, far, names=["far"] * count)
    return StillPlayback(scene, "still")


def boxes_of(objects) -> dict:
    return {box.label: box for box, _ in objects._boxes}


def test_objects_are_found_selected_and_hidden(server, device):
    page = Page(server, make_scene(device))
    objects = page.objects
    ball, ring = (model.name for model in page.playback.scene.models)
    assert list(boxes_of(objects)) == ["all 2", "<b>ball</b>", "Second", f"{ring} 2"]
    page.viewer_scene.pick(0)
    page.run(seconds=0.2)
    told, pairs = objects._told.content, page.snapshot.result.count[0]
    assert f"<td>Second ({pairs} face pairs)</td>" in told and pairs > 0 and f"<td>{ball}</td>" in told
    assert objects._select.value == "<b>ball</b>" and len(page._data.boxes) == 12 and not page._level.disabled
    objects.select(1)
    page.advance()
    assert "&lt;b&gt;ball&lt;/b&gt; (" in objects._told.content and "<b>" not in objects._told.content
    act(page, objects.show, [0, 1], False)
    assert page.shown.tolist() == page._data.shown.tolist() == [2]
    assert [box.value for box in boxes_of(objects).values()] == [False, False, False, True]
    objects.show([1], True)
    assert [box.value for box in boxes_of(objects).values()] == [False, False, True, True]
    objects.show([1, 2], False)
    page.advance()
    assert not len(page._data.shown) and page._data.intersecting_count == 0
    objects._filter.value = "sEC"
    objects._list()
    assert list(boxes_of(objects)) == ["Second"] and not boxes_of(objects)["Second"].value
    assert objects._select.options == ("none", "Second")
    objects.select(2)
    assert objects._select.options == ("none", "Second", f"{ring} 2")
    objects.select(None)
    page.advance()
    assert objects._told.content == "" and not len(page._data.boxes) and page._level.disabled


def test_ten_thousand_objects_are_listed_in_part(server, device):
    page = Page(server, make_scene(device, 10_000))
    boxes = boxes_of(page.objects)
    assert len(boxes) == LISTED_OBJECTS + 1 and "all 10,002" in boxes and "far #5" in boxes
    page.objects._filter.value = "#7777"
    page.objects._list()
    assert list(boxes_of(page.objects)) == ["far #7777"]


def test_what_does_nothing_is_off(server, device):
    page = Page(server, make_scene(device))
    page.advance()
    assert not page._buttons.visible and not page._time.visible and page._budget.disabled and not page._mode.disabled
    assert "paused" not in page._state.content
    page._budget.value = 7.0
    choose(page, "budget, predicted")
    assert page._buttons.visible and not page._budget.disabled
    page._act((page._run_button, ("play",)))
    page.advance()
    assert page._buttons.options[0] == "pause"
    assert page.playback.budget_ms == 7.0 and "| budget | 7 ms |" in page._state.content
    page._act((page._run_button, ("pause",)))
    page.advance()
    assert page._buttons.options[0] == "play"


def test_a_model_of_one_lod_has_nothing_to_choose(server, device):
    scene = scene_with(device, ab.Model.from_arrays(np.eye(3), [(0, 1, 2)]))
    page = Page(server, StillPlayback(scene, "face", up=(1, 2, 3)))
    assert page._mode.disabled and page._all_lod.disabled
    # The grid lies across up, below the scene.
    turn = page._grid.wxyz[[1, 2, 3, 0]]
    assert np.allclose(posed([(0, 0, 1)], (0, 0, 0, *turn))[0], np.array([1, 2, 3]) / 14**0.5)
    assert page._grid.position @ (1, 2, 3) < 1


@pytest.mark.parametrize("aspect", [0.4, 1.0, 2.5])
def test_the_first_camera_sees_all_in_windows_of_any_shape(server, device, monkeypatch, aspect):
    acts = []
    monkeypatch.setattr(server, "on_client_connect", acts.append)
    page = Page(server, make_scene(device))
    client = SimpleNamespace(camera=SimpleNamespace(aspect=aspect))
    acts[0](client)
    camera, scene = ab.Camera.look_at(client.camera.position, client.camera.look_at), page.playback.scene
    reach = np.tan(0.5 * server.initial_camera.fov)
    for i, pose in enumerate(scene.poses):
        vertices = scene.models[scene.object_model[i]].mesh_at(int(scene.lods[i]))[0]
        x, y, z = camera.view @ (posed(vertices, pose) - camera.eye).T
        assert (z < 0).all() and (np.abs(x / z) < aspect * reach).all() and (np.abs(y / z) < reach).all()


def test_frames_are_looked_at_again(server, device, monkeypatch):
    page = Page(server, make_playback(device))
    page.advance()
    for _ in range(5):
        press(page, "step")
    shown, number = page.snapshot, page.playback.number
    assert page._time.visible and (page._time.min, page._time.max, page._time.value) == (0, 4, 4)
    monkeypatch.setattr(page.playback, "query", None)
    page.settings.distances = True
    page._look_back(1)
    page.advance()
    assert page.snapshot.number == 1 and not len(page._data.distance) and "looking back" in page._state.content
    assert page.snapshot.lods[0] > shown.lods[0] and page.playback.number == number, "LODs fall as they sweep"
    press(page, "step")
    assert page.snapshot.number == number + 1
    monkeypatch.setattr(module, "KEPT_BYTES", 1)
    press(page, "step")
    assert [kept.number for kept in page._kept] == [number + 1, number + 2]


def test_many_faces_are_opened_coarser(server, device, monkeypatch):
    monkeypatch.setattr(module, "FACE_BUDGET", 600)
    playback = make_scene(device)
    first = playback.scene.lods
    page = Page(server, playback)
    page.advance()
    assert 550 < page._data.faces < 650 and (page.snapshot.lods < first).all()
    assert page._mode.value == "hold as they are"
    choose(page, "as the scene says")
    assert page._data.faces == 2 * 320 + 576 and np.array_equal(page.snapshot.lods, first)
    playback.choose("predictive", 50.0)
    assert Page(server, playback)._mode.value == "budget, predicted", "a budget chooses LODs itself"


def test_a_scene_made_in_python_is_shown(device, capsys):
    scene = ab.Scene(device)
    (ball, ring), half = make_models(), 0.5**0.5
    poses = np.array([(0, 0, 0, 0, 0, 0, 1), (0.6, 0.1, 0, half, 0, 0, half), (9, 0, 0, 0, 0, 0, 1)])
    scene.add_many([ball, ring, ball], poses, worlds=[0, 0, 2], lods=[9, ring.lod_max, 3])
    shown = []

    def act(page, seconds):
        shown.append(page.snapshot)
        page._hold_all(0.0)
        page.advance()
        shown.append(page.snapshot)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Page, "run", act)
        view(scene, "my scene", port=0, seconds=0.1)
    assert re.fullmatch(r"my scene: http://localhost:\d+ \(Ctrl-C ends\)\n", capsys.readouterr().out.split("Module")[0])
    assert np.allclose(shown[0].poses, poses) and shown[0].lods.tolist() == [9, ring.lod_max, 3]
    assert shown[0].result.pairs.tolist() == [[0, 1]] and shown[0].result.any.all()
    assert shown[1].lods.tolist() == [0, 0, 0] and scene.lods.tolist() == [9, ring.lod_max, 3]
    assert np.allclose(scene.batch().objects.pool.position.numpy(), poses[:, :3])


def test_what_cannot_be_shown_or_served(device, tmp_path, capsys):
    refused(TypeError, "not a Scene", view, make_models()[0])
    refused(ValueError, "no object", view, ab.Scene(device))
    for port in (-1, 65_536):
        refused(ValueError, "port", view, ab.Scene(device), port=port)
    with pytest.raises(ValueError, match="cannot be kept from foreign pages"), refuse_foreign("127.0.0.1"):
        pass
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        _, errors = run_command(capsys, "view", write_scene(tmp_path), "--port", port, status=2)
    assert f"127.0.0.1:{port}: cannot be served at (Address already in use)" in errors[0]


@pytest.mark.parametrize(("stop", "status"), [(KeyboardInterrupt(), 0), (Terminated(143), 143)])
def test_an_interrupt_is_how_people_end_it(tmp_path, capsys, monkeypatch, stop, status):
    def run(page, seconds):
        raise stop

    monkeypatch.setattr(Page, "run", run)
    shown, errors = run_command(capsys, "view", write_scene(tmp_path), "--port", 0, "--json", status=status)
    found = json.loads(shown)
    assert (found["objects"], found["title"]) == (4, "scene") and found["address"].startswith("http://localhost:")
    assert errors == ([] if status == 0 else ["warp-abtree: terminated"])


def count_green(tab) -> int:
    pixels = np.array(PIL.Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)
    red, green, blue = pixels[:, :500].reshape(-1, 3).T
    return int(np.count_nonzero((green > 1.6 * red) & (green > 1.6 * blue) & (green > 60)))


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here (Debian: apt-get install chromium)")
def test_a_page_draws_and_its_controls_reach_the_scene():
    playwright = pytest.importorskip("playwright.sync_api", reason="the browser is driven by playwright (extra dev)")
    with serve() as server, playwright.sync_playwright() as driver:
        page = Page(server, make_playback("cpu"))
        thread = threading.Thread(target=page.run)
        thread.start()
        try:
            chromium = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            tab, faults = chromium.new_page(viewport={"width": 1000, "height": 640}), []
            tab.set_default_timeout(40_000)
            tab.on("pageerror", lambda error: faults.append(str(error)))
            tab.goto(f"http://127.0.0.1:{server.get_port()}")
            tab.get_by_text("paused").wait_for()
            while count_green(tab) < 300:
                tab.wait_for_timeout(300)
            tab.get_by_role("checkbox", name="intersecting faces").uncheck()
            tab.get_by_role("button", name="step").click()
            tab.get_by_text("frame 0").wait_for()
            while count_green(tab) > 50:
                tab.wait_for_timeout(300)
            assert page.snapshot.row.frame == 0 and not page.settings.intersecting
            for name in ("play", "pause"):
                tab.get_by_role("button", name=name).click()
            tab.get_by_role("button", name="play").wait_for()
            assert not page.playing and page.snapshot.number > 0
            tab.mouse.click(250, 320)  # amid the objects
            tab.get_by_text("position").wait_for()
            assert page.objects.selected == 1
            assert not faults
            chromium.close()
        finally:
            page.close()
            thread.join(timeout=20)
        assert not thread.is_alive()
