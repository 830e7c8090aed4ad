"""What controls a run, from [camera], [lod] and [picture]: the camera, the controller of LODs, and the view."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from warp_abtree.app.toml.decode import fail
from warp_abtree.lod.controllers import PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.view import Camera
from warp_abtree.scene.scene import Scene

CONTROLLERS = ("predictive", "paper", "tolerance", "none")
# The options of [lod] that each controller takes.
_OPTIONS = {
    "predictive": ("steps", "spacing", "window", "aim", "low", "hold_frames", "loosest"),
    "paper": ("steps", "window", "threshold_ms"),
    "tolerance": ("steps", "spacing", "window", "loosest"),
}


def unit(vector) -> np.ndarray:
    """Return the direction of a vector that is not 0, of length 1."""
    vector = np.array(vector) / np.abs(vector).max()  # no square overflows or underflows
    return vector / np.linalg.norm(vector)


@dataclass(frozen=True, eq=False)
class PictureView:
    """How a scene is looked at.

    Attributes:
        eye, up: Directions to the eye and upwards, of length 1, (3,).
        world: The world that is shown.
        time: Of the picture [s], or None.
        lods: Fractions of the faces of swept objects, a panel each; empty for both ends of their sweep.
    """

    eye: np.ndarray = field(default_factory=lambda: unit((0.4, 0.35, 1.0)))
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))
    world: int = 0
    time: float | None = None
    lods: tuple = ()


def make_view(path, table) -> PictureView:
    """Return what [picture] describes.

    Raises:
        SceneError: Up points along eye.
    """
    lods = () if table.lods is None else tuple(table.lods) if isinstance(table.lods, list) else (table.lods,)
    view = PictureView(unit(table.eye), unit(table.up), table.world, table.time, lods)
    if not np.linalg.norm(np.cross(view.eye, view.up)) > 1e-6:
        fail(path, "picture.up", "points along eye")
    return view


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A camera that goes straight from one key to the next, and stands still before the first and after the last.

    Called with a time [s], returns a `Camera`.

    Attributes:
        times: Of the keys [s], rising, (k,).
        eyes, targets: Positions there [units], (k, 3).
        loop: Whether it begins again after the last.
        options: up, field_of_view [rad], size, far of `Camera.look_at`.
    """

    times: np.ndarray
    eyes: np.ndarray
    targets: np.ndarray
    loop: bool
    options: dict

    def __call__(self, time: float) -> Camera:
        first, last = self.times[0], self.times[-1]
        if self.loop and last > first:
            time = first + (time - first) % (last - first)
        eye, target = (
            [np.interp(time, self.times, points[:, axis]) for axis in range(3)] for points in (self.eyes, self.targets)
        )
        return Camera.look_at(eye, target, **self.options)


def make_camera(path, table) -> CameraPath | None:
    """Return what [camera] describes; None where the file has none.

    Raises:
        SceneError: Times of keys do not rise, or the camera looks at its own eye.
    """
    if table is None:
        return None
    keys = table.keys or [table]
    times = [key.time for key in table.keys] or [0.0]
    for i in range(1, len(keys)):
        if not times[i] > times[i - 1]:
            fail(path, f"camera.keys[{i}].time", f"{times[i]} is not after the one before, {times[i - 1]}")
    options = {"up": unit(table.up), "field_of_view": math.radians(table.field_of_view)}
    options |= {"size": table.size, "far": table.far}
    eyes, targets = (np.array([getattr(key, name) for key in keys]) for name in ("eye", "target"))
    camera = CameraPath(np.array(times), eyes, targets, table.loop, options)
    for i, time in enumerate(times):
        try:
            camera(time)
        except ValueError as error:
            fail(path, f"camera.keys[{i}]" if table.keys else "camera", error)
    return camera


@dataclass(frozen=True)
class LodControl:
    """Which controller chooses LODs, and with what.

    Attributes:
        controller: One of CONTROLLERS; "none" leaves LODs to the objects and their sweeps.
        budget_ms: T [ms], or None.
        tolerance: Of the tolerance controller [units], or None.
        options: Those that the file gives, by name.
    """

    controller: str = "none"
    budget_ms: float | None = None
    tolerance: float | None = None
    options: dict = field(default_factory=dict)

    def asked(self, controller: str | None = None, budget_ms: float | None = None) -> "LodControl":
        """Return this with another controller or budget; a budget alone asks the predictive one where none holds it.

        Raises:
            ValueError: A controller without its budget or tolerance.
        """
        if controller is None:
            keeps = budget_ms is None or self.controller in ("predictive", "paper")
            controller = self.controller if keeps else "predictive"
        if controller not in CONTROLLERS:
            raise ValueError(f"controller {controller!r} is none of {', '.join(CONTROLLERS)}")
        if budget_ms is not None and controller in ("tolerance", "none"):
            raise ValueError(f"controller {controller!r} holds no budget")
        made = replace(self, controller=controller, budget_ms=self.budget_ms if budget_ms is None else budget_ms)
        if controller in ("predictive", "paper") and made.budget_ms is None:
            raise ValueError(f"controller {controller!r} needs a budget")
        if controller == "tolerance" and made.tolerance is None:
            raise ValueError("controller 'tolerance' needs lod.tolerance of the scene file")
        return made

    def make(self, scene: Scene, camera):
        """Return the controller for a scene, None for "none"."""
        if self.controller == "none":
            return None
        options = {name: value for name, value in self.options.items() if name in _OPTIONS[self.controller]}
        if self.controller == "tolerance":
            return ToleranceController(scene, self.tolerance, camera, **options)
        kind = PaperController if self.controller == "paper" else PredictiveController
        return kind(scene, self.budget_ms, camera, **options)


def make_control(path, table) -> LodControl:
    """Return what [lod] describes.

    Raises:
        SceneError: A controller without its budget or tolerance.
    """
    if table is None:
        return LodControl()
    names = dict.fromkeys(name for options in _OPTIONS.values() for name in options)
    options = {name: getattr(table, name) for name in names if getattr(table, name) is not None}
    controller = table.controller or ("tolerance" if table.budget_ms is None else "predictive")
    try:
        return LodControl("none", table.budget_ms, table.tolerance, options).asked(controller)
    except ValueError as error:
        fail(path, "lod", error)
