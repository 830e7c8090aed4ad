"""Playbacks for `view` and `picture`: snapshots, one after another, of a scene that runs or stands, or of meshes.

A playback owns its scene: one thread steps, queries and changes it.
"""

from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import Parser, positive_count
from warp_abtree.app.cli.model_commands import load_models, lod_at
from warp_abtree.app.render_data import Snapshot, worlds_of
from warp_abtree.app.scene_view import make_view
from warp_abtree.app.toml.control import CONTROLLERS, LodControl
from warp_abtree.app.toml.folder import find_scene
from warp_abtree.app.toml.scene_file import load_assembly, load_scene
from warp_abtree.interop.scenes import is_assembly
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import Frame
from warp_abtree.simulate.lod_request import LodSweep
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import SteppedMotion

OVERLAP = 0.25  # of the smaller extent: by so much a mesh without a pose reaches into the one before
SWEEP_PERIOD = 8.0  # seconds from the finest LOD of a mesh to its base and back
OWN_MODE, HOLD_MODE = "scene", "hold"  # LODs as the scene chooses them, and as they are


class Playback:
    """A scene that runs: each step is a frame, timed by stage.

    `view` is its `SceneView` to begin with, `begin` returns a `Frame` of the scene at its start, `camera` called with a
    time [s] returns the one that LODs are for, `chosen` are the LODs of all objects, and `mode` of `modes` is how they
    are chosen.
    """

    def __init__(self, scene, title, worlds, time_step, view, begin, camera=None, control=None):
        self.scene, self.title, self.worlds = scene, title, np.asarray(worlds)
        self.time_step, self.view, self._begin = time_step, view, begin
        self.camera, self.control = camera, control or LodControl()
        self.mode, self._budget = OWN_MODE, None
        self.restart()

    def restart(self):
        """Go back to the start, in the same mode."""
        self._frame = self._begin()
        self.number, self.chosen, self._first = 0, self.scene.lods, self.scene.lods
        self._own, self._poses = self._frame.lods, self._find_poses()
        self.choose(self.mode, self._budget)

    def _find_poses(self) -> np.ndarray:
        """Return the poses of the last snapshot, of rigid bodies those after it."""
        motion = self._frame.motion
        return motion.poses(self.time) if isinstance(motion, Kinematic) else self.scene.poses

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
        self.chosen, row, motion = self.scene.lods, self._frame.history[-1], self._frame.motion
        self.number = row.frame
        if motion is not None:
            self._poses = self._find_poses()
        if isinstance(motion, SteppedMotion):
            # The bodies have moved on: the result shown is of their poses now.
            result = self.scene.intersect(output=output)
        return self._snapshot(result, row)


class ScenePlayback(Playback):
    """A scene file, as `load_scene` returned it."""

    def __init__(self, loaded):
        head = loaded.scene, loaded.title, loaded.worlds, loaded.time_step, loaded.picture
        super().__init__(*head, loaded.frame, loaded.camera, loaded.control)


class StillPlayback(Playback):
    """A scene that stands at its poses; LODs begin where they are, and are swept if told."""

    def __init__(self, scene: Scene, title: str, up="z", sweep=None):
        worlds, view = worlds_of(scene), make_view(up)
        self.started, self._sweep = scene.lods, sweep
        super().__init__(scene, title, worlds, 1 / 30, view, self._start)

    @property
    def moves(self):
        """Whether LODs are swept, or chosen under a budget, or were."""
        return self.number > 0 or (self.mode != HOLD_MODE and (self.mode != OWN_MODE or self._sweep is not None))

    def _start(self) -> Frame:
        self.scene.set_lods(self.started)
        frame = Frame(self.scene, None, self._sweep, "count", self.time_step)
        frame.warm_up()
        return frame


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


def open_playback(paths, device=None, progress=None, objects=None, poses=(), lod=None) -> Playback:
    """Open one scene file (.toml), one file of several objects, or meshes and built models (.npz).

    Poses (k, 7) are of the meshes after the first; those left out are laid beside the mesh before, a little inside.
    `lod` is of every mesh, None the finest; `objects` is for scene files alone, as for `load_scene`.
    """
    paths = [str(find_scene(path)) for path in paths]
    scenes = [path for path in paths if Path(path).suffix.lower() == ".toml"]
    if scenes and len(paths) > 1:
        raise ValueError(f"{scenes[0]}: a scene file is looked at alone")
    if objects is not None and not scenes:
        raise ValueError("--objects: for scene files")
    if not scenes and (len(paths) > 1 or not is_assembly(paths[0])):
        return _open_meshes(paths, device, progress, poses, lod)
    for name, value in (("--pose", len(poses)), ("--lod", lod is not None)):
        if value:
            raise ValueError(f"{name}: for meshes; {paths[0]} says where its objects are and at which LODs")
    if scenes:
        return ScenePlayback(load_scene(paths[0], device=device, progress=progress, objects=objects))
    return ScenePlayback(load_assembly(Path(paths[0]), device, progress))


def _open_meshes(paths, device, progress, poses, lod) -> MeshPlayback:
    if len(poses) >= len(paths):
        raise ValueError(f"--pose: {len(poses)} given for the {len(paths) - 1} meshes after the first")
    Scene(device=device)  # refuses a device that does not exist before models are built
    models = load_models(paths, progress)
    lods = [lod_at("--lod", model, "finest" if lod is None else lod) for model in models]
    places = row_poses(models)
    if len(poses):
        places[1 : 1 + len(poses)] = poses
    try:
        return MeshPlayback(models, places, lods, device)
    except ValueError as error:
        raise ValueError(f"--{error}") from None


def add_playback_arguments(sub: Parser):
    """Add the arguments that name what is shown."""
    about = "one scene file (.toml) or file of several objects, or meshes and built models (.npz)"
    sub.add_scene("source", nargs="+", metavar="SCENE_OR_MESHES", help=about)
    about = "pose of the second mesh, again for the third; without it each stands beside the one before, a bit inside"
    sub.add_pose(about, action="append", default=[])
    sub.add_argument("--lod", metavar="LOD", help="LOD of meshes, as for query (finest)")
    sub.add_number("--objects", "about so many objects of a scene, as for run", positive_count)


def row_poses(models) -> np.ndarray:
    """Return poses (n, 7) in a row along x, in which each model reaches a little into the one before."""
    places = np.zeros((len(models), 7))
    places[:, 6] = 1.0
    boxes = []
    for model in models:
        vertices = model.mesh_at(model.lod_max)[0]
        boxes.append((vertices.min(axis=0), vertices.max(axis=0)))
    middle = 0.5 * (boxes[0][0] + boxes[0][1])
    for i in range(1, len(models)):
        (before_lower, before_upper), (lower, upper) = boxes[i - 1], boxes[i]
        places[i, :3] = middle - 0.5 * (lower + upper)
        inside = OVERLAP * min(upper[0] - lower[0], before_upper[0] - before_lower[0])
        places[i, 0] = places[i - 1, 0] + before_upper[0] - inside - lower[0]
    return places
