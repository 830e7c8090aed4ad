"""What `view` and `picture` look at: a scene file that runs, a recorded run, or meshes; one moment after another.

A source owns its scene: one thread steps it, asks it again and changes it.
"""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_abtree.app.recording import FORMAT_NAME, Recording
from warp_abtree.app.toml.control import LodControl
from warp_abtree.app.toml.folder import find_scene
from warp_abtree.app.toml.scene_file import load_scene
from warp_abtree.lod.view import Camera
from warp_abtree.model.model import Model
from warp_abtree.query.result import Result
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import Frame, FrameRow, LodSweep, resolve_lod

OVERLAP = 0.25  # of the smaller extent: by so much a mesh that is given no pose reaches into the one before
SWEEP_PERIOD = 8.0  # seconds from the finest LOD of a mesh to its base and back
OWN, STILL = "scene", "hold"  # LODs as the source chooses them, and as they stand
CONTROLLERS = ("predictive", "paper", "tolerance")


@dataclass(frozen=True, eq=False)
class Moment:
    """A scene at one time, and what was found there.

    Attributes:
        number, time: Frame from 0, and time in the scene [s].
        poses: x y z qx qy qz qw of every object, float64 (n, 7).
        lods: LOD of every object, int32 (n,).
        result: `Result` of what was asked.
        row: `FrameRow` of the frame; None where the scene was only asked again.
    """

    number: int
    time: float
    poses: np.ndarray
    lods: np.ndarray
    result: Result
    row: FrameRow | None


class Source:
    """What all sources share.

    Attributes:
        scene, title: `Scene`, and what to call it.
        worlds: World of each object, int (n,); -1 is in every one.
        time_step: Between frames [s].
        frames: How many `--record` takes.
        length: Frames there are, None where they never end.
        look: eye and up, directions in the world, and world, the one to show first.
        camera: Time [s] to the `Camera` that LODs are for, or None.
        control: `LodControl` of the file.
        hand: LOD by object index, of objects whose LOD people chose.
        can_move: Whether people may move objects.
    """

    can_move = False
    length: int | None = None
    _poses: Any = None

    def __init__(self, scene, title, worlds, time_step, frames, look, camera=None, control=None):
        self.scene, self.title, self.worlds = scene, title, np.asarray(worlds)
        self.time_step, self.frames, self.look = time_step, frames, look
        self.camera, self.control = camera, control or LodControl()
        self.hand: dict[int, int] = {}
        self.number = 0
        self._chosen = scene.lods
        self._poses = None

    @property
    def time(self) -> float:
        """Time of the last moment in the scene [s]."""
        return self.number * self.time_step

    def name_of(self, i) -> str:
        """Return what to call an object."""
        return f"{self.scene.models[self.scene.object_model[i]].name} #{i}"

    def with_hand(self, lods) -> np.ndarray:
        """Return LODs in which objects have what people chose, int32 (n,)."""
        lods = np.array(lods, np.int32)
        lods[list(self.hand)] = list(self.hand.values())
        return lods

    def ways(self) -> list[str]:
        """Return the ways in which LODs may be chosen, as `choose` takes them."""
        ways = [OWN, STILL]
        if self.length is None:
            ways += [name for name in CONTROLLERS if name != "tolerance" or self.control.tolerance is not None]
        return ways

    def choose(self, way, budget_ms=None):
        """Choose LODs in one of `ways`."""
        raise NotImplementedError

    def again(self, output) -> Moment:
        """Ask the scene again where it stands, after LODs, poses, or what is asked, changed. Waits for the device."""
        wanted = self.with_hand(self._chosen)
        if not np.array_equal(wanted, self.scene.lods):
            self.scene.set_lods(wanted)
        return self._moment(self.scene.intersect(output=output), None)

    def _moment(self, result, row):
        result.check()
        return Moment(self.number, self.time, self._poses.copy(), self.scene.lods, result, row)


class _Chooser:
    """Chooses LODs for a `Frame`: by a controller or a function of time, or not at all; what people hold stays."""

    def __init__(self, source):
        self.source = source
        self.inner: Any = None

    @property
    def budget_ms(self):
        return getattr(self.inner, "budget_ms", None)

    def next_lods(self, feedback):
        source, inner = self.source, self.inner
        if hasattr(inner, "next_lods"):
            source._chosen = inner.next_lods(feedback).numpy().copy()
        elif inner is not None:
            source._chosen = np.array(inner(feedback.time), np.int32)
        return wp.array(source.with_hand(source._chosen), dtype=wp.int32, device="cpu")


class LiveSource(Source):
    """A scene that runs: each step is a frame, timed by stage.

    Attributes:
        page_camera: `Camera` of who watches, None until it is known.
        for_page: Whether controllers choose LODs for that camera in the place of the scene's.
    """

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self._chooser = _Chooser(self)
        self._way, self._budget = OWN, None
        self.page_camera: Camera | None = None
        self.for_page = False
        self.restart()

    def _begin(self) -> tuple:
        """Return the `Frame` of a new start, its rigid bodies or None, and what chooses its LODs or None."""
        raise NotImplementedError

    def _stand(self) -> np.ndarray:
        """Return where objects stand now, (n, 7)."""
        raise NotImplementedError

    def restart(self):
        """Go back to the start; LODs go on to be chosen as they were."""
        self._frame, self._bodies, own = self._begin()
        self._own = own
        self.number, self._chosen = 0, self.scene.lods
        self._poses = self._stand()
        self._frame.lods = self._chooser
        self.choose(self._way, self._budget)

    def choose(self, way, budget_ms=None):
        """Choose LODs in one of `ways`.

        Args:
            way: "scene", "hold", or a controller.
            budget_ms: T of a controller [ms]; None is the file's.

        Raises:
            ValueError: A controller without its budget, or another way; the way before is kept.
        """
        if way == STILL:
            inner, self._chosen = None, self.scene.lods
        elif way == OWN and (self.control.controller == "none" or (budget_ms is None and not self.for_page)):
            inner = self._own
        else:
            inner = self._control(self.control.controller if way == OWN else way, budget_ms)
        self._chooser.inner, self._way, self._budget = inner, way, budget_ms

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

    def step(self, output) -> Moment:
        """Run the next frame. Waits for the device.

        Args:
            output: "count", "faces" or "contacts".
        """
        self._frame.output = output
        result = self._frame.step()
        row = self._frame.history[-1]
        self.number = row.frame
        self._poses = self._stand()
        if self._bodies is not None:
            # The bodies have moved on: what is shown is where they stand now.
            result = self.scene.intersect(output=output)
        return self._moment(result, row)


class SceneSource(LiveSource):
    """A scene file.

    Args:
        loaded: What `load_scene` returned.
    """

    def __init__(self, loaded):
        self.loaded = loaded
        head = loaded.scene, loaded.title, loaded.worlds, loaded.time_step, loaded.frames, loaded.picture
        super().__init__(*head, camera=loaded.camera, control=loaded.control)

    def _begin(self):
        bodies = self.loaded.make_bodies()
        frame = self.loaded.frame(bodies=bodies)
        return frame, bodies, frame.lods

    def _stand(self):
        return self.loaded.motion.poses(self.time) if self._bodies is None else self._bodies.poses()


class MeshSource(LiveSource):
    """Meshes at poses, whose LODs sweep from where they start to the base and back; people may move them.

    Args:
        models: `Model`s, one an object.
        poses: One each, (n, 7).
        lods: LODs at the start.
        device: Warp device.
    """

    can_move = True

    def __init__(self, models, poses, lods, device=None):
        self._start = np.array(poses, np.float64)
        self._stands = self._start.copy()
        scene = Scene(device=device)
        for model, pose, lod in zip(models, poses, lods):
            scene.add(model, pose=pose, lod=lod)
        self._first = scene.lods
        self._sweeps = []
        for model in scene.models:
            mine = np.array([i for i, other in enumerate(models) if other is model])
            start = _share(model, lods[mine[0]])
            self._sweeps.append(LodSweep([(model, mine)], start, min(start, _share(model, 0)), SWEEP_PERIOD))
        look = SimpleNamespace(eye=[0.4, 0.35, 1.0], up=[0.0, 1.0, 0.0], world=0)
        names = " and ".join(dict.fromkeys(model.name for model in models))
        super().__init__(scene, names, np.zeros(len(models), int), 1 / 30, round(15 * SWEEP_PERIOD) + 1, look)

    def _begin(self):
        self._stands = self._start.copy()
        self.scene.set_poses(self._stands)
        self.scene.set_lods(self._first)
        frame = Frame(self.scene, None, self._sweep, time_step=self.time_step)
        frame.warm_up()
        return frame, None, self._sweep

    def _sweep(self, time):
        lods = self._first.astype(np.int64)
        for sweep in self._sweeps:
            sweep.apply(sweep.fraction(time), lods)
        return lods

    def _stand(self):
        return self._stands

    def move(self, i, pose):
        """Put an object to a pose."""
        self._stands[i] = pose
        self.scene.set_poses(self._stands)
        self._poses = self._stands


def _share(model, lod) -> float:
    return len(model.mesh_at(lod)[2]) / model.face_count


class RecordedSource(Source):
    """A recorded run: poses and LODs as they were, asked anew; times are those of the recording.

    Args:
        recording, loaded: `Recording`, and the scene file in it.
    """

    length: int

    def __init__(self, recording, loaded):
        head = loaded.scene, loaded.title, loaded.worlds, loaded.time_step, len(recording.rows), loaded.picture
        super().__init__(*head, camera=loaded.camera)
        self.recording, self.length = recording, len(recording.rows)
        self._way = OWN
        self.restart()

    def restart(self):
        """Go back to the first frame."""
        self.seek(0)
        self._fresh = True

    def choose(self, way, budget_ms=None):
        """Take LODs from the recording ("scene"), or leave them ("hold")."""
        if way not in (OWN, STILL):
            raise ValueError("a recording holds its LODs")
        self._way, self._chosen = way, self.scene.lods

    def seek(self, number):
        """Go to a frame."""
        self.number, self._fresh = int(number) % self.length, False
        if self._way == OWN:
            self._chosen = self.recording.lods[self.number].copy()
        self._poses = self.recording.poses[self.number]
        self.scene.set_poses(self._poses)

    def step(self, output) -> Moment:
        """Show the next frame, after the last the first. Waits for the device."""
        self.seek(self.number if self._fresh else self.number + 1)
        moment = self.again(output)
        return self._moment(moment.result, self.recording.rows[self.number])


# Opening.


def open_source(paths, device=None, progress=None, objects=None, poses=(), lod=None) -> Source:
    """Open what people name on the command line.

    Args:
        paths: One scene file (.toml) or recorded run (.npz), or meshes and built models (.npz).
        device, progress: As for `load_scene`.
        objects: As for `load_scene`; for scene files.
        poses: Of the meshes after the first, (k, 7); those left out are laid beside the mesh before, a little inside.
        lod: Wish of every mesh as for `resolve_lod`; None is the finest.

    Raises:
        ValueError: With what is wrong with them; SceneError, MeshError and ModelError among them.
    """
    paths = [str(find_scene(path)) for path in paths]
    suffixes = [Path(path).suffix.lower() for path in paths]
    recorded = len(paths) == 1 and suffixes[0] == ".npz" and _is_recording(paths[0])
    if recorded or ".toml" in suffixes:
        if len(paths) > 1:
            raise ValueError(f"{paths[suffixes.index('.toml')]}: a scene file is looked at alone")
        for name, value in (("--pose", len(poses)), ("--lod", lod is not None)):
            if value:
                raise ValueError(f"{name}: for meshes; {paths[0]} says where its objects are and at which LODs")
    if recorded:
        if objects is not None:
            raise ValueError("--objects: a recording has its own")
        recording = Recording.open(paths[0])
        if len(recording.poses) == 0:
            raise ValueError(f"{paths[0]}: holds no poses")
        return RecordedSource(recording, recording.load_scene(paths[0], device=device, progress=progress))
    if ".toml" in suffixes:
        return SceneSource(load_scene(paths[0], device=device, progress=progress, objects=objects))
    if objects is not None:
        raise ValueError("--objects: for scene files")
    if len(poses) >= len(paths):
        raise ValueError(f"--pose: {len(poses)} given for the {len(paths) - 1} meshes after the first")
    Scene(device=device)  # refuses a device that is not there before models are built
    known: dict[str, Model] = {}
    for path in paths:
        if path not in known:
            built = Path(path).suffix.lower() == ".npz"
            known[path] = Model.open(path) if built else Model.load(path, progress=progress)
    models = [known[path] for path in paths]
    wish = "finest" if lod is None else lod
    try:
        lods = [resolve_lod(model, wish) for model in models]
    except ValueError as error:
        raise ValueError(f"--lod: {error}") from None
    places = lay_out(models)
    if len(poses):
        places[1 : 1 + len(poses)] = poses
    try:
        return MeshSource(models, places, lods, device)
    except ValueError as error:
        raise ValueError(f"--{error}") from None


def add_source_arguments(sub, positive):
    """Add the arguments that name what is looked at."""
    sub.add_argument(
        "source",
        nargs="+",
        metavar="SCENE_OR_MESHES",
        help="one scene file (.toml) or recorded run (.npz); or meshes and built models (.npz)",
    )
    sub.add_argument(
        "--pose",
        nargs=7,
        type=float,
        action="append",
        default=[],
        metavar=("X", "Y", "Z", "QX", "QY", "QZ", "QW"),
        help="pose of the second mesh, again for the third; without it each stands beside the one before, a bit inside",
    )
    sub.add_argument("--lod", metavar="LOD", help="LOD of meshes, as for query (finest)")
    sub.add_argument("--objects", type=positive, metavar="N", help="about so many objects of a scene, as for run")


def _is_recording(path) -> bool:
    try:
        with np.load(path, allow_pickle=False) as file:
            return str(file["format"]) == FORMAT_NAME
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile):
        return False


def lay_out(models) -> np.ndarray:
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
