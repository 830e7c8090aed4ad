"""The page of the viewer: its panel, and the loop that turns events into snapshots of the viewer's scene.

The server calls back in threads of its own; callbacks only put an event in a queue, and the thread of `Page.run` acts.
"""

import math
import queue
import time
from dataclasses import replace

import numpy as np

from warp_abtree.app import scene_geometry as geometry
from warp_abtree.app.cli.report import show_number
from warp_abtree.app.playback import HOLD_MODE, OWN_MODE
from warp_abtree.app.render_data import Settings, compose, legend_html, make_legend, objects_of_world
from warp_abtree.app.styles import STAGE_LABELS
from warp_abtree.app.toml.control import BUDGET_CONTROLLERS
from warp_abtree.app.toml.objects import unit
from warp_abtree.app.viewer.object_panel import ObjectPanel
from warp_abtree.app.viewer.viewer_scene import ViewerScene, light_scene, place_camera
from warp_abtree.checks.quaternions import quaternions_of
from warp_abtree.lod.view import Camera

FRAME_SECONDS = 1 / 30  # between snapshots that are sent, at least
TEXT_SECONDS = 0.2  # between changes of numbers while it plays
BUDGETS = (0.5, 100.0)  # of the slider [ms]
FACE_BUDGET = 2_000_000  # faces that are shown to begin with, at most
KEPT_BYTES = 2**28  # of the frames that the slider goes back to
TREE_LEVELS = 10  # of an AB-Tree whose boxes are drawn
MODE_LABELS = {
    OWN_MODE: "as the scene says",
    HOLD_MODE: "hold as they are",
    "predictive": "budget, predicted",
    "paper": "budget, as in the paper",
    "tolerance": "tolerance",
}


class Page:
    """A page about a playback, on a viser server, which the page does not stop.

    `playing` is whether frames follow one another; `snapshot` is shown, the last of the `snapshots` sent so far.
    """

    def __init__(self, server, playback):
        self.server, self.playback = server, playback
        self.cache = geometry.MeshCache(playback.scene)
        self.viewer_scene = ViewerScene(server.scene, self.cache, pick=lambda i: self._post(self.objects.select, i))
        self.settings = Settings(world=playback.view.world)
        self._eye, self._up = unit(playback.view.eye), unit(playback.view.up)
        if not (playback.worlds == self.settings.world).any() and not (playback.worlds == -1).any():
            self.settings.world = int(playback.worlds.max())
        self.playing, self.snapshots = False, 0
        self._events: queue.SimpleQueue = queue.SimpleQueue()
        self._closed = False
        self._steps, self._dirty = 0, True
        self._kept, self._past = [], None  # snapshots of frames, and the one of them that is shown
        self._text_time = self._snapshot_time = -math.inf
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.gui.main_panel.dock_right()
        server.gui.set_panel_label(playback.title)
        light_scene(server.scene, self._eye, self._up)
        self._build(self._open_coarser())
        self.snapshot = playback.query(self.settings.output)
        self._keep()
        self._place_camera()

    @property
    def shown(self) -> np.ndarray:
        """Indices of the objects that are shown."""
        found = objects_of_world(self.playback.worlds, self.settings.world)
        return found[self.objects.visible[found]]

    def _open_coarser(self) -> str:
        """Hold coarser LODs where there are more than FACE_BUDGET faces; return what the panel says of it."""
        playback, models, lods = self.playback, self.playback.scene.models, self.playback.chosen.copy()
        found = objects_of_world(playback.worlds, self.settings.world)
        groups = geometry.group_objects(geometry.mesh_keys(playback.scene, lods), found).items()
        meshes = [(models[owner], lod, members) for key, members in groups for owner, lod in [geometry.split_key(key)]]
        total = sum(model.progressive.active_count(lod) * len(members) for model, lod, members in meshes)
        if total <= FACE_BUDGET or (playback.mode, playback.control.controller) != (OWN_MODE, "none"):
            return ""
        for model, lod, members in meshes:
            fraction = model.progressive.active_count(lod) / model.face_count
            lods[members] = model.lod_for(fraction=FACE_BUDGET / total * fraction)
        playback.hold(lods)
        return f"Some {FACE_BUDGET:,} of {total:,} faces to begin with; **{MODE_LABELS[OWN_MODE]}** shows all."

    # The panel.

    def _build(self, opened):
        gui, playback = self.server.gui, self.playback
        fixed = not any(model.lod_max for model in playback.scene.models)
        with gui.add_folder("State"):
            self._buttons = gui.add_button_group("run", ("play", "step", "restart"))
            self._buttons.on_click(lambda event: self._post(self._run_button, event.target.value))
            self._time = gui.add_slider("frame", 0, 1, 1, 0, hint="frames that were run, to look at again")
            self._on_change(self._time, self._look_back)
            self._state = gui.add_markdown("")
        self.objects = ObjectPanel(gui, playback.scene, np.flatnonzero(playback.worlds >= -1), self._on_change)
        with gui.add_folder("Level of detail"):
            names = [MODE_LABELS[mode] for mode in playback.modes()]
            self._mode = gui.add_dropdown("chosen", names, initial_value=MODE_LABELS[playback.mode], disabled=fixed)
            self._on_change(self._mode, lambda _: self._choose())
            first = min(max(playback.budget_ms or 16.0, BUDGETS[0]), BUDGETS[1])
            hint = "T: selection, refinement, broad phase and query of a frame"
            self._budget = gui.add_slider("budget [ms]", *BUDGETS, 0.5, first, hint=hint)
            self._on_change(self._budget, lambda _: self._choose())
            hint = "of the finest LOD, for every object"
            self._all_lod = gui.add_slider("hold all at [%]", 0.0, 100.0, 0.5, 100.0, disabled=fixed, hint=hint)
            self._on_change(self._all_lod, self._hold_all)
            gui.add_markdown(opened, visible=bool(opened))
        with gui.add_folder("Show"):
            self._build_show(gui, fixed, alone=np.count_nonzero(playback.worlds >= -1) < 2)

    def _build_show(self, gui, fixed, alone):
        def box(label, name, hint=None, disabled=False):
            handle = gui.add_checkbox(label, getattr(self.settings, name), hint=hint, disabled=disabled)
            self._on_change(handle, lambda value: setattr(self.settings, name, value))

        scene = self.playback.scene
        self._legend = gui.add_html("")
        box("intersecting faces", "intersecting", disabled=alone)
        box("colours by LOD", "by_lod", disabled=fixed)
        box("distances", "distances", "of few objects all, of many those whose boxes overlap", disabled=alone)
        box("contact points", "contacts", hint="objects see-through", disabled=alone)
        box("wireframe", "wireframe")
        axes, grid = gui.add_checkbox("axes", False), gui.add_checkbox("grid", False)
        self._on_change(axes, lambda value: setattr(self.server.scene.world_axes, "visible", value))
        self._on_change(grid, lambda value: setattr(self._grid, "visible", value))
        deepest = max(model.face_count for model in scene.models).bit_length()
        hint = "boxes of the selected object's AB-Tree; 0 is the root"
        self._level = gui.add_slider("tree level", 0, max(min(deepest, TREE_LEVELS), 1), 1, 0, disabled=True, hint=hint)
        self._on_change(self._level, lambda value: setattr(self.settings, "tree_level", int(value)))
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
        if name in ("play", "pause"):
            self.playing = not self.playing
        elif name == "step":
            self.playing, self._steps = False, self._steps + 1
        else:
            self.playback.restart()
            self._kept.clear()
        self._past = None

    def _look_back(self, number):
        """Show a frame that was run, as it was; nothing is queried again."""
        kept = {snapshot.number: snapshot for snapshot in self._kept[:-1]}  # the last one is of now
        self.playing, self._past = False, kept.get(int(number))

    def _choose(self):
        """Choose LODs in the mode of the panel; the slider is the budget of the modes that hold one."""
        mode = next(mode for mode in self.playback.modes() if MODE_LABELS[mode] == self._mode.value)
        self.playback.choose(mode, self._budget.value if mode in BUDGET_CONTROLLERS else None)
        self._past = None

    def _hold_all(self, percent):
        scene = self.playback.scene
        self.playback.hold([round(percent / 100 * scene.models[model].lod_max) for model in scene.object_model])
        self._mode.value, self._past = MODE_LABELS[HOLD_MODE], None

    def _place_camera(self):
        """Put the first camera where it sees all that is shown, and a grid below."""
        centre, radius = ball = geometry.bounds(self.cache, self.snapshot, self.shown)
        position = place_camera(self.server.initial_camera, ball, self._eye, self._up)

        @self.server.on_client_connect
        def _(client):  # a window that is higher than wide sees less
            client.camera.position = centre + (position - centre) / min(client.camera.aspect, 1.0)
            client.camera.look_at = centre

        scene, size = self.server.scene, 10.0 ** math.floor(math.log10(radius))
        scene.world_axes.axes_length, scene.world_axes.axes_radius = size, size / 80
        turn = quaternions_of(Camera.look_at(self._up, np.zeros(3)).view.T[None])[0]  # z to up
        place = {"position": tuple(centre - radius * self._up), "wxyz": turn[[3, 0, 1, 2]]}
        sizes = {"cell_size": size / 10, "section_size": size, "fade_distance": 20 * radius}
        self._grid = scene.add_grid("/grid", infinite_grid=True, visible=False, **sizes, **place)

    # The loop.

    def run(self, seconds=None):
        """Serve until `close`, or for a time [s]."""
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not self._closed and time.monotonic() < end:
            is_idle = not (self.playing or self._steps or self._dirty)
            try:
                while True:
                    self._act(self._events.get(is_idle, 0.1))
                    is_idle = False
            except queue.Empty:
                if is_idle:
                    if self.viewer_scene.waits:  # the browser was not ready for all of the last snapshot
                        self._send()
                    continue
            if self._closed:
                return
            self.advance()
            time.sleep(max(0.0, self._snapshot_time + FRAME_SECONDS - time.monotonic()))
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
        self._dirty, self._text_time = True, -math.inf

    def _tell(self, what, error, **options):
        for client in self.server.get_clients().values():
            client.add_notification(what, str(error), color="red", **options)

    def advance(self):
        """Make the next snapshot, a frame on if it plays or steps, and send what changed."""
        moves = self.playing or self._steps > 0
        try:
            self.snapshot = self._past or (self.playback.step if moves else self.playback.query)(self.settings.output)
            if self._past is None:
                self._keep()
        except RuntimeError as error:
            self.playing = False
            self._tell("This frame failed", error)
        self._steps, self._dirty = max(self._steps - 1, 0), False
        settings = replace(self.settings, selected=self.objects.selected)
        if self._past is not None:  # the scene has moved on, and answers for now
            settings = replace(settings, selected=None, distances=False, contacts=False)
        self._data = compose(self.cache, self.snapshot, self.shown, settings)
        self._send()
        self.snapshots += 1
        now = time.monotonic()
        if not self.playing or now - self._text_time >= TEXT_SECONDS:
            self._text_time = now
            self._show_text()

    def _keep(self):
        """Keep the snapshot for the slider, in the place of one of the same frame; drop the first ones of too many."""
        kept, snapshot = self._kept, self.snapshot
        if kept and kept[-1].number == snapshot.number:
            kept.pop()
        kept.append(snapshot)
        faces = 0 if snapshot.result.faces is None else snapshot.result.faces.nbytes
        size = snapshot.poses.nbytes + snapshot.lods.nbytes + snapshot.result.pairs.nbytes + faces
        del kept[: -max(KEPT_BYTES // max(size, 1), 2)]

    def _send(self):
        with self.server.atomic():
            self.viewer_scene.show(self._data)

    def _show_text(self):
        """Show the numbers of the snapshot as a table."""
        data, snapshot, playback = self._data, self.snapshot, self.playback
        row, result = snapshot.row, snapshot.result
        self._show_controls()
        state = "playing" if self.playing else "paused" if self._past is None else "looking back"
        first = [("state", state), ("time", f"{snapshot.time:.3f} s, frame {snapshot.number:,}")]
        rows = [
            *(first if playback.moves else []),
            ("objects shown", f"{len(data.shown):,} of {playback.scene.object_count:,}"),
            ("faces shown", f"{data.faces:,}"),
            ("pairs that meet", f"{int(np.count_nonzero(result.any)):,} of {len(result.pairs):,} near"),
            *([("certified error, mean", f"{data.error_mean:.3g}")] if data.error_mean == data.error_mean else []),
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

    def _show_controls(self):
        """Show the legend, the selected object and the slider of frames; turn off what does nothing now."""
        playback, kept = self.playback, self._kept
        self._buttons.options = ("pause" if self.playing else "play", "step", "restart")
        self._buttons.visible, self._time.visible = playback.moves, len(kept) > 1
        self._time.min, self._time.max = kept[0].number, kept[-1].number
        self._time.value = self.snapshot.number
        self._budget.disabled = playback.mode not in BUDGET_CONTROLLERS
        self._level.disabled = self.objects.selected is None
        self.objects.tell(self.snapshot)
        self._legend.content = legend_html(make_legend(playback.scene, [self._data], self.settings.by_lod))
