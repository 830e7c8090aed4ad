"""Pages of `warp-abtree run --record page.html`: what they hold, and what a headless Chromium draws of them."""

import base64
import io
import json
import re
from time import monotonic

import numpy as np
import pytest
from helpers.viewer import BODIES, CHROMIUM, FLAGS, SCENE, run_command, write_scene

pytest.importorskip("viser", reason="a page is recorded by viser (extra view)")

import msgspec
import PIL.Image
import zstandard

from warp_abtree.app import load_scene
from warp_abtree.app.viewer import recording


def read_page(path) -> tuple:
    """Return the duration [s] and the messages, (time, dictionary with arrays), of a page."""
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', path.read_text())[1])
    raw = zstandard.ZstdDecompressor().decompress(data[8:])
    end = 8 + int.from_bytes(raw[:8], "little")
    head, arrays = msgspec.msgpack.decode(raw[8:end]), []
    for length in head["binaryBufferLengths"]:
        start = -(-end // 8) * 8
        end = start + length
        arrays.append(raw[start:end])

    def filled(value):
        if isinstance(value, dict) and "__binary_index" in value:
            return np.frombuffer(arrays[value["__binary_index"]], value["dtype"])
        return {key: filled(entry) for key, entry in value.items()} if isinstance(value, dict) else value

    return head["durationSeconds"], [(time, filled(message)) for time, message in head["messages"]]


def values_of(messages, name, kind) -> list:
    """Return what messages of a kind say of a node, with their times."""
    return [(at, message) for at, message in messages if (message.get("name"), message["type"]) == (name, kind)]


def record(tmp_path, capsys, text, *words):
    """Record a scene on the CPU; return the page and what the command said."""
    page = tmp_path / "page.html"
    out, _ = run_command(
        capsys, "run", write_scene(tmp_path, text), "--device", "cpu", "--json", "--record", page, *words
    )
    return page, json.loads(out)


@pytest.mark.slow
def test_a_page_holds_what_the_scene_was(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(recording, "PICTURES_MAX", 5)
    text = SCENE.replace("scene = {", 'scene = { title = "a </title> <b>",')
    page, said = record(tmp_path, capsys, text, "--frames", 9)
    assert said["written"] == [str(page)] and said["hits"]["max"] > 0
    assert "<title>a &lt;/title&gt; &lt;b&gt;</title>" in page.read_text() and "a </title>" not in page.read_text()
    duration, messages = read_page(page)
    loaded = load_scene(tmp_path / "scene.toml", device="cpu")
    assert duration == pytest.approx(5 * 2 * loaded.time_step), "every second frame"
    moves = values_of(messages, "/objects/1", "SetPositionMessage")
    frames = [round(time / loaded.time_step) for time, _ in moves]
    assert set(frames) <= {0, 2, 4, 6, 8} and len(set(frames)) > 2
    for frame, (_, message) in zip(frames, moves, strict=True):
        wanted = loaded.motion.poses(frame * loaded.time_step)[1, :3]
        assert np.allclose(message["position"], wanted, rtol=2.0**-11, atol=1e-12)
    (_, first), *later = [
        (at, message.get("props", message.get("updates")))
        for at, message in messages
        if message.get("name") == "/objects/0" and "vertices" in message.get("props", message.get("updates", {}))
    ]
    ball = loaded.scene.models[0]
    for time, arrays in [(0.0, first), *later]:
        lod = loaded.lods_at(time)[0]
        assert np.allclose(arrays["vertices"].reshape(-1, 3), ball.mesh_at(lod)[0], rtol=2.0**-11, atol=1e-12), time
    assert len(later) > 2 and any("/intersecting/0" == message.get("name") for _, message in messages)


@pytest.mark.slow
def test_contact_points_of_bodies(tmp_path, capsys):
    """Of a ball of radius 1 that lies 0.05 deep in a floor at y = -0.9; steps of 10 ms are slowed down."""
    text = BODIES.replace("scene = {}", "scene = { frames = 6, time_step = 0.01 }")
    text = text.replace("dynamics = {}", "dynamics = { gravity = [0, -9.81, 0] }")
    page, _ = record(tmp_path, capsys, text.replace("[0, 0.2, 0]", "[0, 0.05, 0]"))
    duration, messages = read_page(page)
    assert duration == pytest.approx(6 * recording.PICTURE_SECONDS) and ", 7 times slower" in page.read_text()
    (_, cloud), *_ = values_of(messages, "/contacts", "PointCloudMessage")
    points = cloud["props"]["points"].reshape(-1, 3)
    assert len(points) and (np.abs(points[:, 1] + 0.9) < 0.1).all() and (np.hypot(*points[:, [0, 2]].T) < 0.6).all()
    (_, ball), *_ = values_of(messages, "/objects/1", "MeshMessage")
    assert 0 < ball["props"]["opacity"] < 1


def test_rounded_numbers_are_near_and_pack():
    values = np.float32(np.random.default_rng(0).normal(size=1000) * 10.0 ** np.arange(-5, 5).repeat(100))
    near = recording.short_floats(values)
    assert (np.abs(near - values) <= 2.0**-11 * np.abs(values)).all() and not (near.view(np.uint32) & 0x1FFF).any()
    assert np.array_equal(recording.short_floats([0.0, 1.0, -0.5]), np.float32([0.0, 1.0, -0.5]))


def count_coloured(tab) -> int:
    """Count pixels of the right half, without the bar and a notice at the left, that are no grey."""
    pixels = np.array(PIL.Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)
    pixels = pixels[: int(tab.locator("input").first.bounding_box()["y"]) - 8, pixels.shape[1] // 2 :]
    return int(np.count_nonzero(np.ptp(pixels, axis=2) > 12))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
@pytest.mark.parametrize(("width", "height"), [(1000, 640), (390, 844)])
def test_a_page_plays_in_a_browser_without_a_server(tmp_path, capsys, width, height):
    playwright = pytest.importorskip("playwright.sync_api", reason="the browser is driven by playwright (extra dev)")
    page, _ = record(tmp_path, capsys, SCENE, "--frames", 2)
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        tab, faults = chromium.new_page(viewport={"width": width, "height": height}), []
        tab.set_default_timeout(40_000)
        tab.on("pageerror", lambda error: faults.append(str(error)))
        tab.goto(page.as_uri())
        end = monotonic() + 120
        while (drawn := count_coloured(tab)) < 500 and monotonic() < end:
            tab.wait_for_timeout(300)
        assert drawn >= 500
        box, bar = tab.locator("footer").bounding_box(), tab.locator("input").first.bounding_box()
        assert box["y"] + box["height"] <= height and box["width"] <= width and bar["y"] < box["y"]
        assert tab.evaluate("document.documentElement.scrollWidth") == width
        assert not faults
        chromium.close()
