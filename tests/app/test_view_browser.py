"""The viewer in a headless Chromium: the page draws, and its controls reach the scene. Needs viser and playwright."""

import io
import shutil
import threading

import numpy as np
import PIL.Image
import pytest
from helpers.viewer import make_models, make_playback

pytest.importorskip("viser", reason="the viewer needs viser (extra view)")
playwright = pytest.importorskip("playwright.sync_api", reason="the browser is driven by playwright (extra dev)")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here (Debian: apt-get install chromium)")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
WAIT = 40_000  # milliseconds


def count_green(tab) -> int:
    """Count pixels of intersecting faces of the balls."""
    pixels = np.array(PIL.Image.open(io.BytesIO(tab.screenshot())).convert("RGB")).astype(int)
    red, green, blue = pixels[:, :500].reshape(-1, 3).T
    return int(np.count_nonzero((green > 1.6 * red) & (green > 1.6 * blue) & (green > 60)))


def test_a_page_draws_and_its_controls_reach_the_scene():
    from warp_abtree.app.viewer.command import serve
    from warp_abtree.app.viewer.page import Page

    with serve() as server, playwright.sync_playwright() as driver:
        page = Page(server, make_playback(make_models(), "cpu"))
        thread = threading.Thread(target=page.run)
        thread.start()
        try:
            chromium = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
            tab, faults = chromium.new_page(viewport={"width": 1000, "height": 640}), []
            tab.set_default_timeout(WAIT)
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
            assert not faults
            chromium.close()
        finally:
            page.close()
            thread.join(timeout=20)
        assert not thread.is_alive()
