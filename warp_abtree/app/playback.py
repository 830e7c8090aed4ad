"""Playbacks for `view` and `picture`: snapshots, one after another, of a scene that runs or stands, or of meshes.

A playback owns its scene: one thread steps, queries and changes it.
"""

import numpy as np

from warp_abtree.app.render_data import Snapshot, worlds_of
from warp_abtree.app.scene_view import make_view
from warp_abtree.app.toml.control import CONTROLLERS, LodControl
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import Frame
from warp_abtree.simulate.lod_request import LodSweep

SWEEP_PERIOD = 8.0  # seconds from the finest LOD of a mesh to its base and back
OWN_MODE, HOLD_MODE = "scene", "hold"  # LODs as the scene chooses them, and as they are


class Playback:
    """A scene that runs: each step is a frame, timed by stage.

    `view` is its `SceneView` to begin with, `camera` called with a time [s] returns the one that LODs are for, `chosen`
    are the LODs of all objects, and `mode` of `modes` is how they are chosen.
    """

    def __init__(self, scene, title, worlds, time_step, view, camera=None, control=None):
        self.scene, self.title, self.worlds = scene, title, np.asarray(worlds)
        self.time_step, self.view = time_step, view
        self.camera, self.control = camera, control or LodControl()
        self.mode, self._budget = OWN_MODE, None
        self.restart()

    def _begin(self) -> tuple:
        """Return the `Frame` of a new start, its rigid bodies or None, and what chooses its LODs or None."""
        raise NotImplementedError

    def _poses_now(self) -> np.ndarray:
        """Return the poses of all objects now, (n, 7)."""
        raise NotImplementedError

    def restart(self):
        """Go back to the start, in the same mode."""
        self._frame, self._bodies, self._own = self._begin()
        self.number, self.chosen, self._first = 0, self.scene.lods, self.scene.lods
        self._poses = self._poses_now()
        self.choose(self.mode, self._budget)

    @property
    def time(self) -> float:
        """Time of the last snapshot in the scene [s]."""
        return self.number * self.time_step

    def modes(self) -> list[str]:
        """Return the modes of choosing LODs, as `choose` takes them."""
        left_out = ("none",) if self.control.tolerance is not None else ("none", "tolerance")
        return [OWN_MODE, HOLD_MODE, *(name for name in CONTROLLERS if name not in left_out)]

    def choose(self, mode, budget_ms=None):
        """Choose LODs in one of `modes`, by a budget [ms], None for the file's.

        Raises ValueError for a controller without its budget, or another mode, and keeps the mode before.
        """
        if mode == HOLD_MODE:
            inner, self.chosen = None, self.scene.lods
        elif mode == OWN_MODE and (self.control.controller == "none" or budget_ms is None):
            inner = self._own
            self.chosen = self._first if inner is None else self.chosen
        else:
            name = self.control.controller if mode == OWN_MODE else mode
            inner = self.control.asked(name, budget_ms).make(self.scene, self.camera)
        self._frame.lods = (lambda _: self.chosen) if inner is None else inner
        self.mode, self._budget = mode, budget_ms

    @property
    def moves(self) -> bool:
        """Whether steps change anything, or did."""
        return True

    def hold(self, lods):
        """Hold LODs of all objects, (n,), until others are chosen."""
        self.choose(HOLD_MODE)
        self.chosen = np.array(lods, np.int32)

    @property
    def budget_ms(self) -> float | None:
        """T that is held [ms], or None."""
        return getattr(self._frame.lods, "budget_ms", None)

    def query(self, output) -> Snapshot:
        """Query the scene as it is, after LODs, poses or the output changed. Waits for the device."""
        if not np.array_equal(self.chosen, self.scene.lods):
            self.scene.set_lods(self.chosen)
        return self._snapshot(self.scene.intersect(output=output), None)

    def _snapshot(self, result, row):
        result.check()
        return Snapshot(self.number, self.time, self._poses.copy(), self.scene.lods, result, row)

    def step(self, output) -> Snapshot:
        """Run the next frame, with output "count", "faces" or "contacts". Waits for the device."""
        self._frame.output = output
        result = self._frame.step()
        self.chosen, row = self.scene.lods, self._frame.history[-1]
        self.number = row.frame
        self._poses = self._poses_now()
        if self._bodies is not None:
            # The bodies have moved on: the result shown is of their poses now.
            result = self.scene.intersect(output=output)
        return self._snapshot(result, row)


class ScenePlayback(Playback):
    """A scene file, as `load_scene` returned it."""

    def __init__(self, loaded):
        self.loaded = loaded
        head = loaded.scene, loaded.title, loaded.worlds, loaded.time_step, loaded.picture
        super().__init__(*head, camera=loaded.camera, control=loaded.control)

    def _begin(self):
        bodies = self.loaded.make_bodies()
        frame = self.loaded.frame(bodies=bodies)
        return frame, bodies, frame.lods

    def _poses_now(self):
        return self.loaded.motion.poses(self.time) if self._bodies is None else self._bodies.poses()


class StillPlayback(Playback):
    """A scene that stands at its poses; LODs begin where they are, and are swept if told."""

    def __init__(self, scene: Scene, title: str, up="z", sweep=None):
        worlds, view = worlds_of(scene), make_view(up)
        self._held, self.started, self._sweep = scene.poses, scene.lods, sweep
        super().__init__(scene, title, worlds, 1 / 30, view)

    @property
    def moves(self):
        """Whether LODs are swept, or chosen under a budget, or were."""
        return self.number > 0 or (self.mode != HOLD_MODE and (self.mode != OWN_MODE or self._sweep is not None))

    def _begin(self):
        self.scene.set_lods(self.started)
        frame = Frame(self.scene, None, self._sweep, "count", self.time_step)
        frame.warm_up()
        return frame, None, self._sweep

    def _poses_now(self):
        return self._held


class MeshPlayback(StillPlayback):
    """Meshes at poses (n, 7), whose LODs sweep from where they start to the base and back."""

    def __init__(self, models, poses, lods, device=None):
        scene = Scene(device=device)
        for model, pose, lod in zip(models, poses, lods):
            scene.add(model, pose=pose, lod=lod)
        self._sweeps = []
        for model in scene.models:
            mine = np.array([i for i, other in enumerate(models) if other is model])
            start = _fraction_at(model, lods[mine[0]])
            self._sweeps.append(LodSweep([(model, mine)], start, min(start, _fraction_at(model, 0)), SWEEP_PERIOD))
        names = (m.name if m.parts == 1 else f"{m.name} ({m.parts} parts joined)" for m in models)
        super().__init__(scene, " and ".join(dict.fromkeys(names)), "y", self._lods_at)

    def _lods_at(self, time):
        lods = self.started.astype(np.int64)
        for sweep in self._sweeps:
            sweep.apply(sweep.fraction(time), lods)
        return lods


def _fraction_at(model, lod) -> float:
    return model.progressive.active_count(lod) / model.face_count
