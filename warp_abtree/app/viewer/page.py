"""The page of the viewer: its panel, and the loop that turns what people do into moments on the stage.

The server calls back in threads of its own; callbacks only leave a note, and the one thread that runs `Page.run` acts.
"""

import math
import queue
import time
from typing import Any

import numpy as np

from warp_abtree.app.viewer import text as view_text
from warp_abtree.app.viewer.playback import OWN, STILL
from warp_abtree.app.viewer.render_data import tree_depth
from warp_abtree.app.viewer.viewer_scene import Composer, Settings, Stage
from warp_abtree.lod.view import Camera

FRAME_SECONDS = 1 / 30  # between moments that are sent, at the least
TEXT_SECONDS = 0.2  # between changes of numbers and plots while it plays
PLOTTED = 240  # frames
BUDGETS = (0.5, 100.0)  # of the slider [ms]
LIGHT = 0.6
DISTANCE = 1.6  # of the first camera, in radii of what is shown
WAYS = {
    OWN: "as the scene says",
    STILL: "hold as they are",
    "predictive": "budget, predicted",
    "paper": "budget, as in the paper",
    "tolerance": "tolerance",
}


class Page:
    """A page about a source, on a viser server.

    Args:
        server: `viser.ViserServer`; the page does not stop it.
        source: `Source`.
        clock: Seconds, by which the browser is given time.

    Attributes:
        settings: `Settings` as people left them.
        playing: Whether it goes on by itself.
        moments: Sent so far.
        rate: Moments a second, of late.
    """

    def __init__(self, server, source, clock=time.monotonic):
        self.server, self.source = server, source
        self.composer = Composer(source)
        self.stage = Stage(server.scene, self.composer.cache, on_pick=lambda i: self._note(self._pick, i), clock=clock)
        self.settings = Settings(world=source.look.world)
        if not len(self.composer.shown(self.settings)):
            self.settings.world = int(source.worlds.max())
        self.playing, self.moments, self.rate = False, 0, 0.0
        self._notes: queue.SimpleQueue = queue.SimpleQueue()
        self._closed = False
        self._rows: list = []
        self._steps, self._dirty = 0, True
        self._text_time = self._moment_time = -math.inf
        self._gizmo, self._plotted = None, False
        server.scene.set_up_direction(tuple(source.look.up))
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label(source.title)
        self._light()
        self._build()
        server.on_client_connect(self._watch)
        self.moment = source.again(self.settings.output)
        self._place_camera()

    # The panel.

    def _build(self):
        gui, source = self.server.gui, self.source
        with gui.add_folder("Time"):
            buttons = gui.add_button_group("run", ("play", "step", "restart"))
            buttons.on_click(lambda event: self._note(self._run_button, event.target.value))
            self._frame_slider = None
            if source.length is not None and source.length > 1:
                self._frame_slider = gui.add_slider("frame", 0, source.length - 1, 1, 0)
                self._hear(self._frame_slider, self._seek)
            self._state = gui.add_markdown("")
        with gui.add_folder("Level of detail"):
            names = [WAYS[way] for way in source.ways()]
            self._way = gui.add_dropdown("chosen", names, initial_value=names[0])
            self._hear(self._way, lambda _: self._choose())
            self._budget: Any = None  # a slider of viser
            if len(names) > 2:
                first = min(max(getattr(source, "budget_ms", None) or 16.0, BUDGETS[0]), BUDGETS[1])
                hint = "T: selection, refinement, broad phase and query of a frame"
                self._budget = gui.add_slider("budget [ms]", *BUDGETS, 0.5, first, hint=hint)
                self._hear(self._budget, self._set_budget)
                self._for_page = gui.add_checkbox("for this page's camera", False, hint="near objects come first")
                self._hear(self._for_page, self._set_for_page)
            self._all_lod = gui.add_slider(
                "hold all at [%]", 0.0, 100.0, 0.5, 100.0, hint="of the finest LOD, for every object"
            )
            self._hear(self._all_lod, self._hold_all)
            release = gui.add_button("release all")
            release.on_click(lambda _: self._note(self._release, None))
        with gui.add_folder("Show"):
            self._build_show(gui)
        with gui.add_folder("Picked object"):
            count = source.scene.object_count
            self._picked = gui.add_number("object", -1, min=-1, max=count - 1, step=1, hint="or click it; -1 is none")
            self._hear(self._picked, lambda i: self._pick(int(i), from_number=True))
            self._lod = gui.add_slider(
                "hold it at [%]", 0.0, 100.0, 0.5, 100.0, disabled=True, hint="of its finest LOD"
            )
            self._hear(self._lod, self._hold_picked)
            self._own = gui.add_button("release it", disabled=True)
            self._own.on_click(lambda _: self._note(self._release, self.settings.picked))
            self._numbers = gui.add_markdown(view_text.NOBODY)
        with gui.add_folder("Frame times [ms]"):
            self._plot = gui.add_uplot(**view_text.time_plot([], PLOTTED), height=220)

    def _build_show(self, gui):
        def box(label, name, hint=None):
            handle = gui.add_checkbox(label, getattr(self.settings, name), hint=hint)
            self._hear(handle, lambda value: setattr(self.settings, name, value))

        box("intersecting faces", "struck")
        box("contacts", "contacts")
        box("contact normals", "normals", "from the first object of a pair to the second")
        box("wireframe", "wireframe")
        box("colours by LOD", "by_lod", "blue is coarse, yellow fine")
        look = gui.add_button("look at all of it")
        look.on_click(lambda event: self._note(self._look, event.client))
        depth = tree_depth(self.source.scene, range(self.source.scene.object_count))
        level = gui.add_slider("tree level", -1, depth, 1, -1, hint="boxes of the active nodes at a level; -1 is none")
        self._hear(level, lambda value: setattr(self.settings, "level", int(value)))
        box("trees of all objects", "every_tree", "in the place of the picked one's")
        worlds = np.unique(self.source.worlds)
        if len(worlds) > 1 and worlds.max() > 0:
            world = gui.add_number("world", self.settings.world, min=0, max=int(worlds.max()), step=1)
            self._hear(world, lambda value: setattr(self.settings, "world", int(value)))

    def _hear(self, handle, act):
        """Act on a value that a person set; values that the page sets itself come without a client."""

        @handle.on_update
        def _(event):
            if event.client is not None:
                self._note(lambda: act(handle.value))

    def _note(self, act, *arguments):
        self._notes.put((act, arguments))

    # What people do. These run in the thread of `run`.

    def _run_button(self, name):
        if name == "play":
            self.playing = not self.playing
        elif name == "step":
            self.playing, self._steps = False, self._steps + 1
        else:
            self.source.restart()
            self._rows.clear()

    def _seek(self, number):
        self.playing = False
        self.source.seek(int(number))

    def _chosen_way(self):
        names = self.source.ways()
        return next(way for way in names if WAYS[way] == self._way.value)

    def _choose(self, budget_ms=None):
        way = self._chosen_way()
        if budget_ms is None and way in ("predictive", "paper"):
            budget_ms = self._budget.value
        self.source.choose(way, budget_ms)

    def _set_budget(self, value):
        """Hold a budget, by the predictive controller where none holds one yet."""
        way = self._chosen_way()
        own = self.source.control.controller if way == OWN else way
        if own not in ("predictive", "paper"):
            self._way.value = WAYS["predictive"]
        self._choose(float(value))

    def _set_for_page(self, value):
        self.source.for_page = value
        self._choose(None if self.source.budget_ms is None else self._budget.value)

    def _lod_of(self, i, percent):
        return round(percent / 100 * self.source.scene.models[self.source.scene.object_model[i]].lod_max)

    def _hold_all(self, percent):
        for i in range(self.source.scene.object_count):
            self.source.hand[i] = self._lod_of(i, percent)
        self._show_own_lod()

    def _hold_picked(self, percent):
        if self.settings.picked is not None:
            self.source.hand[self.settings.picked] = self._lod_of(self.settings.picked, percent)
            self._own.disabled = False

    def _release(self, i):
        if i is None:
            self.source.hand.clear()
        else:
            self.source.hand.pop(i, None)
        self._own.disabled = True

    def _pick(self, i, from_number=False):
        self.settings.picked = None if i < 0 else i
        if not from_number:
            self._picked.value = i
        self._lod.disabled = i < 0
        self._show_own_lod()
        self._show_gizmo()

    def _show_own_lod(self):
        i = self.settings.picked
        self._own.disabled = i is None or i not in self.source.hand
        if i is not None:
            top = self.source.scene.models[self.source.scene.object_model[i]].lod_max
            lod = self.source.hand.get(i, int(self.moment.lods[i]))
            self._lod.value = round(200 * lod / max(top, 1)) / 2

    def _show_gizmo(self):
        """Give the picked object handles to move it by, where it may be moved."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        i = self.settings.picked
        if i is None or not self.source.can_move:
            return
        pose = self.moment.poses[i]
        size = 0.35 * self.composer.cache.diagonals[self.source.scene.object_model[i]]
        gizmo = self.server.scene.add_transform_controls(
            "/gizmo", scale=size, position=pose[:3], wxyz=pose[[6, 3, 4, 5]], depth_test=False
        )

        @gizmo.on_update
        def _(event):
            wxyz = np.asarray(event.target.wxyz, np.float64)
            self._note(self.source.move, i, np.concatenate([event.target.position, wxyz[1:], wxyz[:1]]))

        self._gizmo = gizmo

    # Cameras.

    def _light(self):
        """Put a soft light in the place of viser's own, which wash colours out beside its environment.

        The environment stays as it is: a standalone page would make it anew whenever it begins again.
        """
        scene, up, eye = self.server.scene, np.asarray(self.source.look.up), np.asarray(self.source.look.eye)
        scene.configure_default_lights(False)
        way = up - np.cross(up, eye) + 0.6 * eye
        scene.add_light_directional("/light", position=tuple(way), intensity=LIGHT, cast_shadow=False)

    def _place_camera(self):
        centre, radius = self.composer.frame_of(self.moment, self.settings)
        first = self.server.initial_camera
        first.look_at = tuple(centre)
        first.position = tuple(centre + DISTANCE * radius * np.asarray(self.source.look.eye))
        first.up = tuple(self.source.look.up)
        first.near, first.far = radius / 500, 200 * radius

    def _look(self, client):
        """Bring the camera of a page back to where it sees all."""
        if client is not None:
            centre, radius = self.composer.frame_of(self.moment, self.settings)
            client.camera.position = centre + DISTANCE * radius * np.asarray(self.source.look.eye)
            client.camera.look_at = centre

    def _watch(self, client):
        """Follow the camera of a page that opened."""

        @client.camera.on_update
        def _(camera):
            # A camera that stands on what it looks at, as before its first frame, sees nothing.
            try:
                size = camera.image_width, camera.image_height
                options = {"up": camera.up_direction, "field_of_view": float(camera.fov), "size": size}
                far = 4 * float(np.linalg.norm(camera.position - camera.look_at))
                found = Camera.look_at(camera.position, camera.look_at, far=far, **options)
            except ValueError:
                return
            if hasattr(self.source, "page_camera"):
                self.source.page_camera = found

    # The loop.

    def run(self, seconds=None):
        """Serve until `close`, or for a time [s]."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not self._closed and time.monotonic() < end:
            if not (self.playing or self._steps or self._dirty):
                try:
                    self._act(self._notes.get(timeout=0.1))
                except queue.Empty:
                    self._catch_up()
                    continue
            while True:
                try:
                    self._act(self._notes.get_nowait())
                except queue.Empty:
                    break
            if self._closed:
                return
            self.advance()
            wait = self._moment_time + FRAME_SECONDS - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            self._measure_rate()

    def close(self):
        """End `run`, from any thread."""
        self._closed = True
        self._notes.put((lambda: None, ()))

    def _act(self, note):
        act, arguments = note
        try:
            act(*arguments)
        except ValueError as error:
            for client in self.server.get_clients().values():
                client.add_notification("That cannot be", str(error), color="red", auto_close_seconds=8)
        self._dirty = True

    def advance(self):
        """Make the next moment, a frame on if it plays or steps, and send what changed."""
        moves = self.playing or self._steps > 0
        try:
            self.moment = (self.source.step if moves else self.source.again)(self.settings.output)
        except RuntimeError as error:
            self.playing = False
            for client in self.server.get_clients().values():
                client.add_notification("This frame failed", str(error), color="red")
        if self.moment.row is not None:
            self._rows.append(self.moment.row)
            del self._rows[:-PLOTTED]
        self._steps, self._dirty = max(self._steps - 1, 0), False
        drawing = self._drawing = self.composer.compose(self.moment, self.settings)
        with self.server.atomic():
            self.stage.show(drawing, self.settings)
        self.moments += 1
        now = time.monotonic()
        if not self.playing or now - self._text_time >= TEXT_SECONDS:
            self._text_time = now
            self._say(drawing)
        return drawing

    def _catch_up(self):
        """Show the last moment again where the browser was not ready for all of it."""
        if self.stage.waits:
            with self.server.atomic():
                self.stage.show(self._drawing, self.settings)

    def _measure_rate(self):
        now = time.monotonic()
        span = now - self._moment_time
        self._moment_time = now
        self.rate = 0.0 if span > 1 else 0.9 * self.rate + 0.1 / span if self.rate else 1 / span

    def _say(self, drawing):
        self._state.content = view_text.state(self, drawing)
        if self._frame_slider is not None:
            self._frame_slider.value = self.moment.number
        if self.settings.picked is not None and self.settings.picked not in self.source.hand:
            self._show_own_lod()
        self._numbers.content = view_text.numbers(self.source, self.moment, self.composer.cache, self.settings.picked)
        if self._rows or self._plotted:
            self._plotted = bool(self._rows)
            plot = view_text.time_plot(self._rows, PLOTTED)
            self._plot.data = plot["data"]
            if self._plot.scales != plot["scales"]:
                self._plot.scales = plot["scales"]
