"""The page of the viewer: its panel, and the loop that turns events into snapshots of the viewer's scene.

The server calls back in threads of its own; callbacks only put an event in a queue, and the thread of `Page.run` acts.
"""

import math
import queue
import time
from typing import Any

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.playback import HOLD, OWN
from warp_abtree.app.render_data import Settings, compose, objects_of_world
from warp_abtree.app.toml.objects import unit
from warp_abtree.app.viewer import text as view_text
from warp_abtree.app.viewer.viewer_scene import ViewerScene
from warp_abtree.lod.view import Camera

FRAME_SECONDS = 1 / 30  # between snapshots that are sent, at least
TEXT_SECONDS = 0.2  # between changes of numbers and plots while it plays
PLOTTED = 240  # frames
BUDGETS = (0.5, 100.0)  # of the slider [ms]
LIGHT = 0.6
DISTANCE = 1.8  # of the first camera, in radii of what is shown
MODES = {
    OWN: "as the scene says",
    HOLD: "hold as they are",
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

    def __init__(self, server, playback, clock=time.monotonic):
        self.server, self.playback = server, playback
        self.cache = geometry.MeshCache(playback.scene)
        self.viewer_scene = ViewerScene(server.scene, self.cache, lambda i: self._post(self._pick, i), clock)
        self.settings = Settings(world=playback.view.world)
        self._eye, self._up = unit(playback.view.eye), unit(playback.view.up)
        if not len(self.shown):
            self.settings.world = int(playback.worlds.max())
        self.playing, self.snapshots = False, 0
        self._events: queue.SimpleQueue = queue.SimpleQueue()
        self._closed = False
        self._rows: list = []
        self._steps, self._dirty = 0, True
        self._text_time = self._snapshot_time = -math.inf
        self._gizmo, self._plotted = None, False
        server.scene.set_up_direction(tuple(self._up))
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label(playback.title)
        self._light()
        self._build()
        server.on_client_connect(self._watch)
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
            self._frame_slider = None
            if playback.length is not None and playback.length > 1:
                self._frame_slider = gui.add_slider("frame", 0, playback.length - 1, 1, 0)
                self._on_change(self._frame_slider, self._seek)
            self._state = gui.add_markdown("")
        with gui.add_folder("Level of detail"):
            names = [MODES[mode] for mode in playback.modes()]
            self._mode = gui.add_dropdown("chosen", names, initial_value=names[0])
            self._on_change(self._mode, lambda _: self._choose())
            self._budget: Any = None  # a slider of viser
            if len(names) > 2:
                first = min(max(getattr(playback, "budget_ms", None) or 16.0, BUDGETS[0]), BUDGETS[1])
                hint = "T: selection, refinement, broad phase and query of a frame"
                self._budget = gui.add_slider("budget [ms]", *BUDGETS, 0.5, first, hint=hint)
                self._on_change(self._budget, lambda _: self._choose())
                self._for_page = gui.add_checkbox("for this page's camera", False, hint="near objects come first")
                self._on_change(self._for_page, self._set_for_page)
            self._all_lod = gui.add_slider(
                "hold all at [%]", 0.0, 100.0, 0.5, 100.0, hint="of the finest LOD, for every object"
            )
            self._on_change(self._all_lod, self._hold_all)
            release = gui.add_button("release all")
            release.on_click(lambda _: self._post(self.playback.held.clear))
        with gui.add_folder("Show"):
            self._build_show(gui)
        with gui.add_folder("Picked object"):
            self._lod = gui.add_slider(
                "hold it at [%]", 0.0, 100.0, 0.5, 100.0, disabled=True, hint="of its finest LOD"
            )
            self._on_change(self._lod, self._hold_picked)
            self._numbers = gui.add_markdown(view_text.NOBODY)
        with gui.add_folder("Frame times [ms]"):
            self._plot = gui.add_uplot(**view_text.time_plot([], PLOTTED), height=220)

    def _build_show(self, gui):
        def box(label, name, hint=None):
            handle = gui.add_checkbox(label, getattr(self.settings, name), hint=hint)
            self._on_change(handle, lambda value: setattr(self.settings, name, value))

        box("intersecting faces", "intersecting")
        box("contacts", "contacts")
        box("contact normals", "normals", "from the first object of a pair to the second")
        box("wireframe", "wireframe")
        box("colours by LOD", "by_lod", "blue is coarse, yellow fine")
        look = gui.add_button("look at all of it")
        look.on_click(lambda event: self._post(self._look, event.client))
        depth = geometry.tree_depth(self.playback.scene, range(self.playback.scene.object_count))
        level = gui.add_slider("tree level", -1, depth, 1, -1, hint="boxes of the active nodes at a level; -1 is none")
        self._on_change(level, lambda value: setattr(self.settings, "level", int(value)))
        box("trees of all objects", "every_tree", "in the place of the picked one's")
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
            self._rows.clear()

    def _seek(self, number):
        self.playing = False
        self.playback.seek(int(number))

    def _choose(self):
        """Choose LODs in the mode of the panel; the slider is the budget of the modes that hold one."""
        mode = next(mode for mode in self.playback.modes() if MODES[mode] == self._mode.value)
        self.playback.choose(mode, self._budget.value if mode in ("predictive", "paper") else None)

    def _set_for_page(self, value):
        self.playback.for_page = value
        self._choose()

    def _lod_of(self, i, percent):
        return round(percent / 100 * self.playback.scene.models[self.playback.scene.object_model[i]].lod_max)

    def _hold_all(self, percent):
        for i in range(self.playback.scene.object_count):
            self.playback.held[i] = self._lod_of(i, percent)
        self._show_held_lod()

    def _hold_picked(self, percent):
        if self.settings.picked is not None:
            self.playback.held[self.settings.picked] = self._lod_of(self.settings.picked, percent)

    def _pick(self, i):
        """Pick an object; a click on the picked one leaves none."""
        self.settings.picked = None if i == self.settings.picked else i
        self._lod.disabled = self.settings.picked is None
        self._show_held_lod()
        self._show_gizmo()

    def _show_held_lod(self):
        i = self.settings.picked
        if i is not None:
            top = self.playback.scene.models[self.playback.scene.object_model[i]].lod_max
            lod = self.playback.held.get(i, int(self.snapshot.lods[i]))
            self._lod.value = round(200 * lod / max(top, 1)) / 2

    def _show_gizmo(self):
        """Give the picked object handles to move it by, where it may be moved."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        i = self.settings.picked
        if i is None or not self.playback.can_move:
            return
        pose = self.snapshot.poses[i]
        size = 0.35 * self.cache.diagonals[self.playback.scene.object_model[i]]
        gizmo = self.server.scene.add_transform_controls(
            "/gizmo", scale=size, position=pose[:3], wxyz=pose[[6, 3, 4, 5]], depth_test=False
        )

        @gizmo.on_update
        def _(event):
            wxyz = np.asarray(event.target.wxyz, np.float64)
            self._post(self.playback.move, i, np.concatenate([event.target.position, wxyz[1:], wxyz[:1]]))

        self._gizmo = gizmo

    # Cameras.

    def _light(self):
        """Put a soft light in the place of viser's own, which bleach colours beside its environment.

        The environment stays as it is: a standalone page would make it anew whenever it begins again.
        """
        scene = self.server.scene
        scene.configure_default_lights(False)
        direction = self._up - np.cross(self._up, self._eye) + 0.6 * self._eye
        scene.add_light_directional("/light", position=tuple(direction), intensity=LIGHT, cast_shadow=False)

    def _overview(self):
        """Return where a camera sees all that is shown: its position, what it looks at, and the radius of that."""
        centre, radius = geometry.bounds(self.cache, self.snapshot, self.shown)
        return centre + DISTANCE * radius * self._eye, centre, radius

    def _place_camera(self):
        first = self.server.initial_camera
        position, centre, radius = self._overview()
        first.position, first.look_at, first.up = tuple(position), tuple(centre), tuple(self._up)
        first.near, first.far = radius / 500, 200 * radius

    def _look(self, client):
        """Bring the camera of a page back to where it sees all."""
        if client is not None:
            client.camera.position, client.camera.look_at, _ = self._overview()

    def _watch(self, client):
        """Follow the camera of a page that opened."""

        @client.camera.on_update
        def _(camera):
            # Before its first frame a camera has its eye at its target.
            try:
                size = camera.image_width, camera.image_height
                options = {"up": camera.up_direction, "field_of_view": float(camera.fov), "size": size}
                far = 4 * float(np.linalg.norm(camera.position - camera.look_at))
                found = Camera.look_at(camera.position, camera.look_at, far=far, **options)
            except ValueError:
                return
            if hasattr(self.playback, "page_camera"):
                self.playback.page_camera = found

    # The loop.

    def run(self, seconds=None):
        """Serve until `close`, or for a time [s]."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not self._closed and time.monotonic() < end:
            if not (self.playing or self._steps or self._dirty):
                try:
                    self._act(self._events.get(timeout=0.1))
                except queue.Empty:
                    self._catch_up()
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
            for client in self.server.get_clients().values():
                client.add_notification("That cannot be", str(error), color="red", auto_close_seconds=8)
        self._dirty = True

    def advance(self):
        """Make the next snapshot, a frame on if it plays or steps, and send what changed."""
        moves = self.playing or self._steps > 0
        try:
            self.snapshot = (self.playback.step if moves else self.playback.query)(self.settings.output)
        except RuntimeError as error:
            self.playing = False
            for client in self.server.get_clients().values():
                client.add_notification("This frame failed", str(error), color="red")
        if self.snapshot.row is not None:
            self._rows.append(self.snapshot.row)
            del self._rows[:-PLOTTED]
        self._steps, self._dirty = max(self._steps - 1, 0), False
        data = self._data = compose(self.cache, self.snapshot, self.shown, self.settings)
        self._send()
        self.snapshots += 1
        now = time.monotonic()
        if not self.playing or now - self._text_time >= TEXT_SECONDS:
            self._text_time = now
            self._show_text(data)
        return data

    def _catch_up(self):
        """Show the last snapshot again where the browser was not ready for all of it."""
        if self.viewer_scene.waits:
            self._send()

    def _send(self):
        camera = self.playback.camera
        with self.server.atomic():
            self.viewer_scene.show(self._data, self.settings, camera and camera(self.snapshot.time))

    def _show_text(self, data):
        self._state.content = view_text.state(self, data)
        if self._frame_slider is not None:
            self._frame_slider.value = self.snapshot.number
        if self.settings.picked is not None and self.settings.picked not in self.playback.held:
            self._show_held_lod()
        self._numbers.content = view_text.numbers(self.playback, self.snapshot, self.cache, self.settings.picked)
        if self._rows or self._plotted:
            self._plotted = bool(self._rows)
            plot = view_text.time_plot(self._rows, PLOTTED)
            self._plot.data = plot["data"]
            if self._plot.scales != plot["scales"]:
                self._plot.scales = plot["scales"]
