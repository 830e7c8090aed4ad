"""A standalone page of a run: viser's own client with the recorded scene inside, and a title in a corner."""

import html
from pathlib import Path
from typing import Any

from warp_abtree.app.viewer.page import Page
from warp_abtree.checks.atomic_write import atomic_write

# The canvas would fade in whenever the run begins again.
PANEL = """<style>canvas {{ opacity: 1 !important; }}
#about {{ position: fixed; left: 12px; bottom: 52px; font: 13px sans-serif; }}</style>
<details id="about" open><summary>{title}</summary>{text}</details>"""


def record_page(server, playback, path: Path, frames: int, progress=None):
    """Run a playback from its start for some frames and write a page that plays them and needs no server."""
    played = 0.0
    page = Page(server, playback, clock=lambda: played)
    page.playing = True
    hits = []
    recorder: Any = None  # of viser
    for done in range(1, frames + 1):
        data = page.advance()
        if not page.playing:
            raise RuntimeError(f"frame {page.snapshot.number} failed")
        if recorder is None:
            # From here on the recorder receives every change; the scene as it is becomes the start.
            recorder = server.get_scene_serializer()
        recorder.insert_sleep(playback.time_step)
        played += playback.time_step
        hits.append(data.contact_count)
        if progress is not None:
            progress("frames", done, frames)
    text = (
        f"<div>{playback.scene.object_count:,} objects, {frames:,} frames on {playback.scene.device}; "
        f"{min(hits):,} to {max(hits):,} intersecting face pairs</div>"
    )
    about = PANEL.format(title=html.escape(playback.title), text=text)
    written = recorder.as_html()
    end = written.rindex("</body>")
    with atomic_write(path, "w", encoding="utf-8") as file:
        file.write(written[:end] + about + written[end:])
