"""What `view` and `picture` show: a scene file that runs, a recorded run, or meshes; one snapshot after another.

A playback owns its scene: one thread steps, queries and changes it.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warp_abtree.app.render_data import Snapshot
from warp_abtree.app.toml.control import CONTROLLERS, LodControl
from warp_abtree.lod.view import Camera
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import Frame, LodSweep

SWEEP_PERIOD = 8.0  # seconds from the finest LOD of a mesh to its base and back
OWN, HOLD = "scene", "hold"  # LODs as the scene chooses them, and as they are


class MeshView(NamedTuple):
    """How meshes are looked at: directions to the eye and upwards, and the world that is shown."""

    eye: tuple[float, float, float] = (0.4, 0.35, 1.0)
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    world: int = 0


class Playback:
    """What all playbacks share.

    Attributes:
        worlds: World of each object, int (n,); -1 is in every one.
        frames: How many `--record` takes.
        length: Number of frames, None where they never end.
        view: eye and up, directions, and world, to begin with.
        camera: Called with a time [s], returns the `Camera` that LODs are for; or None.
        chosen: LOD of every object before those that are held, int (n,).
        held: LOD by object index, of objects whose LOD the user holds.
    """

    can_move = False
    length: int | None = None
    _poses: Any = None

    def __init__(self, scene, title, worlds, time_step, frames, view, camera=None, control=None):
        self.scene, self.title, self.worlds = scene, title, np.asarray(worlds)
        self.time_step, self.frames, self.view = time_step, frames, view
        self.camera, self.control = camera, control or LodControl()
        self.held: dict[int, int] = {}
        self.number = 0
        self.chosen = scene.lods
        self._poses = None

    @property
    def time(self) -> float:
        """Time of the last snapshot in the scene [s]."""
        return self.number * self.time_step

    def name_of(self, i) -> str:
        """Return what to call an object."""
        return f"{self.scene.models[self.scene.object_model[i]].name} #{i}"

    def with_held(self, lods) -> np.ndarray:
        """Return LODs with those that are held in their places, int32 (n,)."""
        lods = np.array(lods, np.int32)
        lods[list(self.held)] = list(self.held.values())
        return lods

    def modes(self) -> list[str]:
        """Return the modes of choosing LODs, as `choose` takes them."""
        modes = [OWN, HOLD]
        if self.length is None:
            names = [name for name in CONTROLLERS if name != "none"]
            modes += [name for name in names if name != "tolerance" or self.control.tolerance is not None]
        return modes

    def choose(self, mode, budget_ms=None):
        """Choose LODs in one of `modes`."""
        raise NotImplementedError

    def query(self, output) -> Snapshot:
        """Query the scene as it is, after LODs, poses or the output changed. Waits for the device."""
        wanted = self.with_held(self.chosen)
        if not np.array_equal(wanted, self.scene.lods):
            self.scene.set_lods(wanted)
        return self._snapshot(self.scene.intersect(output=output), None)

    def _snapshot(self, result, row):
        result.check()
        return Snapshot(self.number, self.time, self._poses.copy(), self.scene.lods, result, row)


class _Chooser:
    """Chooses LODs for a `Frame`: by a controller or a function of time, or not at all; held LODs stay."""

    def __init__(self, playback):
        self.playback = playback
        self.inner: Any = None

    @property
    def budget_ms(self):
        return getattr(self.inner, "budget_ms", None)

    def next_lods(self, feedback):
        playback, inner = self.playback, self.inner
        if hasattr(inner, "next_lods"):
            playback.chosen = inner.next_lods(feedback).numpy().copy()
        elif inner is not None:
            playback.chosen = np.array(inner(feedback.time), np.int32)
        return wp.array(playback.with_held(playback.chosen), dtype=wp.int32, device="cpu")


class LivePlayback(Playback):
    """A scene that runs: each step is a frame, timed by stage.

    Attributes:
        page_camera: `Camera` of the page, None until it is known.
        for_page: Whether controllers choose LODs for that camera in the place of the scene's.
    """

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self._chooser = _Chooser(self)
        self._mode, self._budget = OWN, None
        self.page_camera: Camera | None = None
        self.for_page = False
        self.restart()

    def _begin(self) -> tuple:
        """Return the `Frame` of a new start, its rigid bodies or None, and what chooses its LODs or None."""
        raise NotImplementedError

    def _poses_now(self) -> np.ndarray:
        """Return the poses of all objects now, (n, 7)."""
        raise NotImplementedError

    def restart(self):
        """Go back to the start; the mode of choosing LODs stays."""
        self._frame, self._bodies, own = self._begin()
        self._own = own
        self.number, self.chosen = 0, self.scene.lods
        self._poses = self._poses_now()
        self._frame.lods = self._chooser
        self.choose(self._mode, self._budget)

    def choose(self, mode, budget_ms=None):
        """Choose LODs in one of `modes`.

        Args:
            mode: "scene", "hold", or a controller.
            budget_ms: T of a controller [ms]; None is the file's.

        Raises:
            ValueError: A controller without its budget, or another mode; the mode before is kept.
        """
        if mode == HOLD:
            inner, self.chosen = None, self.scene.lods
        elif mode == OWN and (self.control.controller == "none" or (budget_ms is None and not self.for_page)):
            inner = self._own
        else:
            inner = self._control(self.control.controller if mode == OWN else mode, budget_ms)
        self._chooser.inner, self._mode, self._budget = inner, mode, budget_ms

    def _control(self, name, budget_ms):
        if name == "tolerance":
            budget_ms = None
        camera = self._camera_at if self.for_page or self.camera is not None else None
        return self.control.asked(name, budget_ms).make(self.scene, camera)

    def _camera_at(self, time):
        if self.camera is None or (self.for_page and self.page_camera is not None):
            return self.page_camera or Camera.look_at(eye=(0, 0, 1), target=(0, 0, 0))
        return self.camera(time)

    @property
    def budget_ms(self) -> float | None:
        """T that is held [ms], or None."""
        return self._chooser.budget_ms

    def step(self, output) -> Snapshot:
        """Run the next frame. Waits for the device.

        Args:
            output: "count", "faces" or "contacts".
        """
        self._frame.output = output
        result = self._frame.step()
        row = self._frame.history[-1]
        self.number = row.frame
        self._poses = self._poses_now()
        if self._bodies is not None:
            # The bodies have moved on: the result shown is of their poses now.
            result = self.scene.intersect(output=output)
        return self._snapshot(result, row)


class ScenePlayback(LivePlayback):
    """A scene file, as `load_scene` returned it."""

    def __init__(self, loaded):
        self.loaded = loaded
        head = loaded.scene, loaded.title, loaded.worlds, loaded.time_step, loaded.frames, loaded.picture
        super().__init__(*head, camera=loaded.camera, control=loaded.control)

    def _begin(self):
        bodies = self.loaded.make_bodies()
        frame = self.loaded.frame(bodies=bodies)
        return frame, bodies, frame.lods

    def _poses_now(self):
        return self.loaded.motion.poses(self.time) if self._bodies is None else self._bodies.poses()


class MeshPlayback(LivePlayback):
    """Meshes at poses (n, 7), whose LODs sweep from where they start to the base and back; the user may move them."""

    can_move = True

    def __init__(self, models, poses, lods, device=None):
        self._start = np.array(poses, np.float64)
        self._placed = self._start.copy()
        scene = Scene(device=device)
        for model, pose, lod in zip(models, poses, lods):
            scene.add(model, pose=pose, lod=lod)
        self._first = scene.lods
        self._sweeps = []
        for model in scene.models:
            mine = np.array([i for i, other in enumerate(models) if other is model])
            start = _fraction_at(model, lods[mine[0]])
            self._sweeps.append(LodSweep([(model, mine)], start, min(start, _fraction_at(model, 0)), SWEEP_PERIOD))
        names = " and ".join(dict.fromkeys(model.name for model in models))
        super().__init__(scene, names, np.zeros(len(models), int), 1 / 30, round(15 * SWEEP_PERIOD) + 1, MeshView())

    def _begin(self):
        self._placed = self._start.copy()
        self.scene.set_poses(self._placed)
        self.scene.set_lods(self._first)
        frame = Frame(self.scene, None, self._sweep, time_step=self.time_step)
        frame.warm_up()
        return frame, None, self._sweep

    def _sweep(self, time):
        lods = self._first.astype(np.int64)
        for sweep in self._sweeps:
            sweep.apply(sweep.fraction(time), lods)
        return lods

    def _poses_now(self):
        return self._placed

    def move(self, i, pose):
        """Put an object to a pose."""
        self._placed[i] = pose
        self.scene.set_poses(self._placed)
        self._poses = self._placed


def _fraction_at(model, lod) -> float:
    return len(model.mesh_at(lod)[2]) / model.face_count


class RecordedPlayback(Playback):
    """A recorded run: poses and LODs as they were, queried anew; times are those of the recording."""

    length: int

    def __init__(self, recording, loaded):
        head = loaded.scene, loaded.title, loaded.worlds, loaded.time_step, len(recording.rows), loaded.picture
        super().__init__(*head, camera=loaded.camera)
        self.recording, self.length = recording, len(recording.rows)
        self._mode = OWN
        self.restart()

    def restart(self):
        """Go back to the first frame."""
        self.seek(0)
        self._fresh = True

    def choose(self, mode, budget_ms=None):
        """Take LODs from the recording ("scene"), or leave them as they are ("hold")."""
        if mode not in (OWN, HOLD):
            raise ValueError("a recording holds its LODs")
        self._mode, self.chosen = mode, self.scene.lods

    def seek(self, number):
        """Go to a frame."""
        self.number, self._fresh = int(number) % self.length, False
        if self._mode == OWN:
            self.chosen = self.recording.lods[self.number].copy()
        self._poses = self.recording.poses[self.number]
        self.scene.set_poses(self._poses)

    def step(self, output) -> Snapshot:
        """Show the next frame, after the last the first. Waits for the device."""
        self.seek(self.number if self._fresh else self.number + 1)
        snapshot = self.query(output)
        return self._snapshot(snapshot.result, self.recording.rows[self.number])
