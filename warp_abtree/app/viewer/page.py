"""The page of the viewer: its panel, and the loop that turns events into snapshots of the viewer's scene.

The server calls back in threads of its own; callbacks only put an event in a queue, and the thread of `Page.run` acts.
"""

import math
import queue
import time

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.cli.report import show_number
from warp_abtree.app.playback import HOLD_MODE, OWN_MODE
from warp_abtree.app.render_data import Settings, compose, objects_of_world
from warp_abtree.app.styles import STAGE_LABELS
from warp_abtree.app.toml.objects import unit
from warp_abtree.app.viewer.viewer_scene import ViewerScene

FRAME_SECONDS = 1 / 30  # between snapshots that are sent, at least
TEXT_SECONDS = 0.2  # between changes of numbers while it plays
BUDGETS = (0.5, 100.0)  # of the slider [ms]
LIGHT = 0.6
CAMERA_DISTANCE = 1.8  # of the first camera, in radii of what is shown
MODE_LABELS = {
    OWN_MODE: "as the scene says",
    HOLD_MODE: "hold as they are",
    "predictive": "budget, predicted",
    "paper": "budget, as in the paper",
    "tolerance": "tolerance",
}


class Page:
    """A page about a playback, on a viser server, which the page does not stop.

    Attributes:
        settings: `Settings` of the panel.
        playing: Whether frames follow one another.
        snapshot: `Snapshot` that is shown.
        snapshots: How many were sent so far.
    """

    def __init__(self, server, playback):
        self.server, self.playback = server, playback
        self.cache = geometry.MeshCache(playback.scene)
        self.viewer_scene = ViewerScene(server.scene, self.cache)
        self.settings = Settings(world=playback.view.world)
        self._eye, self._up = unit(playback.view.eye), unit(playback.view.up)
        if not len(self.shown):
            self.settings.world = int(playback.worlds.max())
        self.playing, self.snapshots = False, 0
        self._events: queue.SimpleQueue = queue.SimpleQueue()
        self._closed = False
        self._steps, self._dirty = 0, True
        self._text_time = self._snapshot_time = -math.inf
        server.scene.set_up_direction(tuple(self._up))
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label(playback.title)
        self._light()
        self._build()
        self.snapshot = playback.query(self.settings.output)
        self._place_camera()

    @property
    def shown(self) -> np.ndarray:
        """Indices of the objects that are shown."""
        return objects_of_world(self.playback.worlds, self.settings.world)

    # The panel.

    def _build(self):
        gui, playback = self.server.gui, self.playback
        with gui.add_folder("Time"):
            buttons = gui.add_button_group("run", ("play", "step", "restart"))
            buttons.on_click(lambda event: self._post(self._run_button, event.target.value))
            self._state = gui.add_markdown("")
        with gui.add_folder("Level of detail"):
            names = [MODE_LABELS[mode] for mode in playback.modes()]
            self._mode = gui.add_dropdown("chosen", names, initial_value=names[0])
            self._on_change(self._mode, lambda _: self._choose())
            first = min(max(playback.budget_ms or 16.0, BUDGETS[0]), BUDGETS[1])
            hint = "T: selection, refinement, broad phase and query of a frame"
            self._budget = gui.add_slider("budget [ms]", *BUDGETS, 0.5, first, hint=hint)
            self._on_change(self._budget, lambda _: self._choose())
            self._all_lod = gui.add_slider(
                "hold all at [%]", 0.0, 100.0, 0.5, 100.0, hint="of the finest LOD, for every object"
            )
            self._on_change(self._all_lod, self._hold_all)
        with gui.add_folder("Show"):
            self._build_show(gui)

    def _build_show(self, gui):
        def box(label, name, hint=None):
            handle = gui.add_checkbox(label, getattr(self.settings, name), hint=hint)
            self._on_change(handle, lambda value: setattr(self.settings, name, value))

        box("intersecting faces", "intersecting")
        box("colours by LOD", "by_lod", "blue is coarse, yellow fine")
        box("distances", "distances", "of few objects all, of many those whose boxes overlap")
        worlds = np.unique(self.playback.worlds)
        if len(worlds) > 1 and worlds.max() > 0:
            world = gui.add_number("world", self.settings.world, min=0, max=int(worlds.max()), step=1)
            self._on_change(world, lambda value: setattr(self.settings, "world", int(value)))

    def _on_change(self, handle, act):
        """Act on a value that the user set; values that the page sets itself come without a client."""

        @handle.on_update
        def _(event):
            if event.client is not None:
                self._post(lambda: act(handle.value))

    def _post(self, act, *arguments):
        self._events.put((act, arguments))

    # Actions of the user, in the thread of `run`.

    def _run_button(self, name):
        if name == "play":
            self.playing = not self.playing
        elif name == "step":
            self.playing, self._steps = False, self._steps + 1
        else:
            self.playback.restart()

    def _choose(self):
        """Choose LODs in the mode of the panel; the slider is the budget of the modes that hold one."""
        mode = next(mode for mode in self.playback.modes() if MODE_LABELS[mode] == self._mode.value)
        self.playback.choose(mode, self._budget.value if mode in ("predictive", "paper") else None)

    def _hold_all(self, percent):
        scene = self.playback.scene
        self.playback.hold([round(percent / 100 * scene.models[model].lod_max) for model in scene.object_model])
        self._mode.value = MODE_LABELS[HOLD_MODE]

    # Light and camera.

    def _light(self):
        """Put a soft light in the place of viser's own, which bleach colours beside its environment."""
        scene = self.server.scene
        scene.configure_default_lights(False)
        direction = self._up - np.cross(self._up, self._eye) + 0.6 * self._eye
        scene.add_light_directional("/light", position=tuple(direction), intensity=LIGHT, cast_shadow=False)

    def _place_camera(self):
        """Put the first camera where it sees all that is shown."""
        first = self.server.initial_camera
        centre, radius = geometry.bounds(self.cache, self.snapshot, self.shown)
        position = centre + CAMERA_DISTANCE * radius * self._eye
        first.position, first.look_at, first.up = tuple(position), tuple(centre), tuple(self._up)
        first.near, first.far = radius / 500, 200 * radius

    # The loop.

    def run(self, seconds=None):
        """Serve until `close`, or for a time [s]."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not self._closed and time.monotonic() < end:
            if not (self.playing or self._steps or self._dirty):
                try:
                    self._act(self._events.get(timeout=0.1))
                except queue.Empty:
                    if self.viewer_scene.waits:  # the browser was not ready for all of the last snapshot
                        self._send()
                    continue
            while True:
                try:
                    self._act(self._events.get_nowait())
                except queue.Empty:
                    break
            if self._closed:
                return
            self.advance()
            wait = self._snapshot_time + FRAME_SECONDS - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            self._snapshot_time = time.monotonic()

    def close(self):
        """End `run`, from any thread."""
        self._closed = True
        self._events.put((lambda: None, ()))

    def _act(self, event):
        act, arguments = event
        try:
            act(*arguments)
        except ValueError as error:
            self._tell("That cannot be", error, auto_close_seconds=8)
        self._dirty = True

    def _tell(self, what, error, **options):
        for client in self.server.get_clients().values():
            client.add_notification(what, str(error), color="red", **options)

    def advance(self):
        """Make the next snapshot, a frame on if it plays or steps, and send what changed."""
        moves = self.playing or self._steps > 0
        try:
            self.snapshot = (self.playback.step if moves else self.playback.query)(self.settings.output)
        except RuntimeError as error:
            self.playing = False
            self._tell("This frame failed", error)
        self._steps, self._dirty = max(self._steps - 1, 0), False
        self._data = compose(self.cache, self.snapshot, self.shown, self.settings)
        self._send()
        self.snapshots += 1
        now = time.monotonic()
        if not self.playing or now - self._text_time >= TEXT_SECONDS:
            self._text_time = now
            self._show_text()

    def _send(self):
        with self.server.atomic():
            self.viewer_scene.show(self._data)

    def _show_text(self):
        """Show the numbers of the snapshot as a table."""
        data, snapshot, playback = self._data, self.snapshot, self.playback
        row, result = snapshot.row, snapshot.result
        rows = [
            ("state", "playing" if self.playing else "paused"),
            ("time", f"{snapshot.time:.3f} s, frame {snapshot.number:,}"),
            ("objects shown", f"{len(data.shown):,} of {playback.scene.object_count:,}"),
            ("faces shown", f"{data.faces:,}"),
            ("pairs that meet", f"{int(np.count_nonzero(result.any)):,} of {len(result.pairs):,} near"),
            ("certified error, mean", f"{data.error_mean:.3g}"),
            ("intersecting face pairs", f"{data.pair_count:,}"),
            ("intersecting faces", f"{data.intersecting_count:,}"),
        ]
        if len(data.distance):
            rows.append(("least distance", show_number(data.distance.min())))
        if row is not None:
            rows += [(label, f"{getattr(row, name):.1f} ms") for name, label in STAGE_LABELS.items()]
            rows.append(("frame", f"{row.total_ms:.1f} ms"))
            rows += [("budget", f"{row.budget_ms:g} ms")] if row.budget_ms is not None else []
        self._state.content = "\n".join(["| | |", "|:--|--:|", *(f"| {key} | {value} |" for key, value in rows)])
