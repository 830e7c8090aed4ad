"""The viewer in a real headless Chromium: what people do with the mouse reaches the scene, and the picture.

Needs viser, playwright and a Chromium of the system. Screenshots stay in the folder that ABTREE_SHOTS names.
"""

import io
import os
import re
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from helpers.viewer import SCENE, make_models, make_playback, write_scene

from warp_abtree.app.open_playback import open_playback

pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
playwright = pytest.importorskip("playwright.sync_api", reason="the browser is driven by playwright (extra dev)")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here (Debian: apt-get install chromium)")

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
WAIT = 40_000  # milliseconds
SIZE = {"width": 1000, "height": 640}


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


class Visit:
    """A browser on a page: its controls by their labels, and its numbers."""

    def __init__(self, browser, address, folder):
        self.folder = Path(os.environ.get("ABTREE_SHOTS", folder))
        self.faults = []
        self.tab = browser.new_page(viewport=SIZE)
        self.tab.set_default_timeout(WAIT)
        self.tab.on("pageerror", lambda error: self.faults.append(str(error)))
        self.tab.goto(address)

    def control(self, label, kind):
        return self.tab.locator(f"xpath=//*[normalize-space(text())='{label}']/following::{kind}[1]")

    def number(self, label):
        return self.control(label, "input[not(@type='checkbox') and not(@type='hidden')]")

    def give(self, label, value):
        field = self.number(label)
        field.fill(str(value))
        field.press("Enter")

    def drag(self, label, part):
        """Drag the thumb of a slider to a fraction of its range."""
        thumb = self.control(label, "*[@role='slider']")
        thumb.scroll_into_view_if_needed()
        box, track = thumb.bounding_box(), thumb.locator("xpath=..").bounding_box()
        self.tab.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.tab.mouse.down()
        self.tab.mouse.move(track["x"] + part * track["width"], box["y"] + box["height"] / 2, steps=8)
        self.tab.mouse.up()

    def numbers(self):
        """Return what the tables say."""
        rows = self.tab.evaluate("() => [...document.querySelectorAll('tr')].map(row => row.innerText.split('\\t'))")
        return {row[0]: row[1] for row in rows if len(row) == 2}

    def wait_for(self, truth):
        """Wait until something holds of the numbers, and return them."""
        end = time.monotonic() + WAIT / 1000
        while time.monotonic() < end:
            found = self.numbers()
            if truth(found):
                return found
            time.sleep(0.1)
        raise AssertionError(f"never came true: {found}")

    def shot(self, name):
        """Keep a screenshot and return its pixels, 0 to 255, (height, width, 3)."""
        data = self.tab.screenshot(path=self.folder / f"{name}.png")
        return np.array(PIL.Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def coloured(pixels):
    """Count pixels of the scene, and of intersecting faces: bright green on the balls, bright yellow on the ring."""
    red, green, blue = pixels[:, : SIZE["width"] // 2].reshape(-1, 3).T
    return {
        "any": int(np.count_nonzero(np.minimum(np.minimum(red, green), blue) < 235)),
        "green": int(np.count_nonzero((green > 1.6 * red) & (green > 1.6 * blue) & (green > 60))),
        "yellow": int(np.count_nonzero((red > 1.4 * blue) & (green > 1.25 * blue) & (green > 0.7 * red) & (red > 90))),
    }


def wait_for_picture(visit, name, truth):
    """Take screenshots until one shows what it should."""
    end = time.monotonic() + WAIT / 1000
    while True:
        found = coloured(visit.shot(name))
        if truth(found):
            return found
        assert time.monotonic() < end, found
        time.sleep(0.3)


def whole(text):
    return int(re.match(r"[\d,]+", text)[0].replace(",", ""))


@pytest.fixture
def serve_playback():
    """Serve pages about sources in threads, and end them."""
    from warp_abtree.app.viewer.command import serve
    from warp_abtree.app.viewer.page import Page

    with serve() as server:
        started = []

        def start(playback):
            page = Page(server, playback)
            thread = threading.Thread(target=page.run)
            thread.start()
            started.append((page, thread))
            return page, f"http://127.0.0.1:{server.get_port()}"

        yield start
        for page, thread in started:
            page.close()
            thread.join(timeout=20)
            assert not thread.is_alive()


def test_meshes_in_a_browser(browser, serve_playback, tmp_path):
    playback = make_playback(make_models(), "cpu")
    page, address = serve_playback(playback)
    visit = Visit(browser, address, tmp_path)
    first = visit.wait_for(lambda found: "faces shown" in found)
    assert first["faces shown"] == f"{2 * 320 + 576:,}" and first["state"] == "paused"
    hits = whole(first["intersecting face pairs"])
    assert hits == page.snapshot.result.count.sum() > 0
    plain = wait_for_picture(visit, "meshes", lambda found: found["green"] > 300 and found["yellow"] > 150)

    # A slider changes the LODs, and the faces shown, down to what the models have there.
    visit.drag("hold all at [%]", 0.3)

    def held():
        of = zip(playback.scene.object_model, page.snapshot.lods)
        return [len(playback.scene.models[owner].mesh_at(int(lod))[1]) for owner, lod in of]

    visit.wait_for(lambda found: whole(found["faces shown"]) == sum(held()) < 500)
    bigger = wait_for_picture(visit, "meshes_coarse", lambda found: found["green"] > 1.2 * plain["green"])
    assert bigger["any"] > 0.8 * plain["any"]

    # Without the colours of intersecting faces, and with boxes of a tree.
    visit.tab.get_by_role("checkbox", name="intersecting faces").uncheck()
    visit.give("object", 1)
    picked = visit.wait_for(lambda found: "certified error" in found)
    assert picked["faces"] == f"{held()[1]} of 576" and picked["meets"] == "#0, #2"
    wait_for_picture(visit, "meshes_picked", lambda found: found["green"] < 0.05 * plain["green"])
    visit.give("tree level", 3)
    assert visit.wait_for(lambda found: "active nodes at level 3" in found)["active nodes at level 3"] == "8"
    visit.drag("hold it at [%]", 0.9)
    finer = visit.wait_for(lambda found: found["faces"] != picked["faces"])
    assert whole(finer["faces"]) > whole(picked["faces"]) and finer["LOD"].endswith("held")
    visit.shot("meshes_tree")

    # The middle of the page shows an object; a click there picks one.
    visit.give("object", -1)
    visit.wait_for(lambda found: "certified error" not in found)
    view = visit.tab.locator("canvas").first.bounding_box()
    visit.tab.mouse.click(view["x"] + 0.5 * view["width"], view["y"] + 0.5 * view["height"])
    clicked = visit.wait_for(lambda found: "certified error" in found)
    assert re.search(r"#[012]$", clicked["object"])
    assert not visit.faults
    visit.tab.close()


def test_a_scene_plays_in_a_browser(browser, serve_playback, tmp_path):
    path = write_scene(
        tmp_path, SCENE.replace("worlds = 2", "worlds = 2\ngrid = { size = [5, 5, 1], spacing = [3, 3, 3] }")
    )
    playback = open_playback([str(path)], "cpu")
    page, address = serve_playback(playback)
    visit = Visit(browser, address, tmp_path)
    visit.wait_for(lambda found: found.get("frame") is None and "time" in found)
    visit.tab.get_by_role("button", name="play").click()
    running = visit.wait_for(lambda found: found.get("state") == "playing" and " frame " in found["time"])
    visit.wait_for(lambda found: found["time"] != running["time"])
    visit.tab.get_by_role("button", name="play").click()
    paused = visit.wait_for(lambda found: found["state"] == "paused")
    visit.tab.get_by_role("button", name="step").click()
    stepped = visit.wait_for(lambda found: found["time"] != paused["time"])
    number = int(stepped["time"].rsplit(" ", 1)[1].replace(",", ""))
    assert number == page.snapshot.number == int(paused["time"].rsplit(" ", 1)[1].replace(",", "")) + 1
    visit.give("budget [ms]", 40)
    visit.tab.get_by_role("button", name="step").click()
    assert visit.wait_for(lambda found: "budget" in found)["budget"] == "40 ms"
    visit.give("world", 1)
    shown = visit.wait_for(lambda found: found["objects shown"].startswith("25 "))
    assert shown["objects shown"] == "25 of 52"
    assert wait_for_picture(visit, "instances", lambda found: found["any"] > 2000)
    assert len(page.viewer_scene._meshes) >= 1, "many objects are instances"
    assert visit.tab.locator(".uplot canvas").count() == 1
    assert not visit.faults
    visit.tab.close()


def test_a_standalone_page_in_a_browser(browser, tmp_path):
    from warp_abtree.app.viewer.command import serve
    from warp_abtree.app.viewer.web_record import record_page

    playback = open_playback([str(write_scene(tmp_path))], "cpu")
    path = tmp_path / "page.html"
    with serve() as server:
        record_page(server, playback, path, 3)
    requests = []
    visit = Visit(browser, "about:blank", tmp_path)
    visit.tab.on("request", lambda request: requests.append(request.url))
    visit.tab.goto(path.as_uri())
    visit.tab.wait_for_selector("#about polygon", state="attached")
    field = visit.tab.locator("input").first  # of the time; giving one pauses
    field.fill("0.5")
    field.press("Enter")
    wait_for_picture(visit, "standalone", lambda found: found["green"] > 150 and found["yellow"] > 150)
    assert [url for url in requests if not url.startswith(("data:", "blob:"))] == [path.as_uri()], "no server"
    assert not visit.faults
    visit.tab.close()
