"""What steers a run: [camera], [lod] and [dynamics] of scene files."""

import math
from dataclasses import dataclass, replace

import numpy as np

from warp_abtree.app.toml import keys as keys_of
from warp_abtree.lod.controllers import PaperController, PredictiveController, ToleranceController
from warp_abtree.lod.view import Camera
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.motion import Kinematic
from warp_abtree.simulate.rigid_bodies import Dynamics

CONTROLLERS = ("predictive", "paper", "tolerance", "none")
# Which options of [lod] each controller hears.
_OPTIONS = {
    "predictive": ("steps", "spacing", "window", "aim", "low", "hold_frames", "loosest"),
    "paper": ("steps", "window", "threshold_ms"),
    "tolerance": ("steps", "spacing", "window", "loosest"),
}


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A camera that goes straight from one key point to the next, and stands still before the first and after the last.

    Called with a time [s], returns a `Camera`.

    Attributes:
        times: Of the key points [s], rising, (k,).
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


def read_camera(keys) -> CameraPath | None:
    """Check [camera]; None where the file has none."""
    if keys is None:
        return None
    options = {
        "up": keys.take("up", keys_of.direction, np.array([0.0, 1.0, 0.0])),
        "field_of_view": math.radians(keys.take("field_of_view", keys_of.number(1.0, 170.0), 60.0)),
        "size": tuple(keys.take("size", keys_of.vector(2, keys_of.whole(1, 2**20)), [1920, 1080])),
        "far": keys.take("far", keys_of.LENGTH, 100.0),
    }
    loop, points = keys.take("loop", keys_of.truth, False), keys.tables("keys")
    times = [0.0]
    if points:
        if "eye" in keys.values or "target" in keys.values:
            keys.fail(None, "give eye and target, or [[camera.keys]], not both")
        times = [point.take("time", keys_of.number()) for point in points]
    rows = points or [keys]
    ends = [[row.take(name, keys_of.vector(3)) for row in rows] for name in ("eye", "target")]
    for i, point in enumerate(points):
        point.end()
        if i and not times[i] > times[i - 1]:
            point.fail("time", f"{times[i]} is not after the one before, {times[i - 1]}")
    keys.end()
    path = CameraPath(np.array(times), np.array(ends[0]), np.array(ends[1]), loop, options)
    for row, time in zip(rows, times):
        try:
            path(time)
        except ValueError as error:
            row.fail(None, error)
    return path


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
    options: dict | None = None

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
        heard = _OPTIONS[self.controller]
        options = {name: value for name, value in (self.options or {}).items() if name in heard}
        if self.controller == "tolerance":
            return ToleranceController(scene, self.tolerance, camera, **options)
        kind = PaperController if self.controller == "paper" else PredictiveController
        return kind(scene, self.budget_ms, camera, **options)


def read_lod(keys: keys_of.Keys | None) -> LodControl:
    """Check [lod]."""
    if keys is None:
        return LodControl()
    budget = keys.take("budget_ms", keys_of.LENGTH, None)
    tolerance = keys.take("tolerance", keys_of.number(0.0), None)
    controller = keys.take("controller", keys_of.choice(*CONTROLLERS[:-1]), None)
    checks = {
        "steps": keys_of.whole(1, 10_000),
        "spacing": keys_of.choice("ratio", "operations"),
        "window": keys_of.whole(1, 1000),
        "threshold_ms": keys_of.LENGTH,
        "aim": keys_of.PART,
        "low": keys_of.PART,
        "hold_frames": keys_of.whole(0, 2**30),
        "loosest": keys_of.number(1.0),
    }
    options = {name: keys.take(name, check) for name, check in checks.items() if name in keys.values}
    keys.end()
    if controller == "paper" and "spacing" in options:
        keys.fail("spacing", "the LODs of the paper's controller are equal numbers of operations apart")
    if not options.get("low", 0.0) <= options.get("aim", 1.0):
        keys.fail("low", "is above aim")
    if controller is None:
        if budget is None and tolerance is None:
            keys.fail(None, "give budget_ms or tolerance")
        controller = "tolerance" if budget is None else "predictive"
    try:
        return LodControl("none", budget, tolerance, options).asked(controller)
    except ValueError as error:
        keys.fail(None, error)


# Rigid bodies.

BODY = {
    "density": (keys_of.LENGTH, 1.0),
    "restitution": (keys_of.number(0.0, 1.0), 0.0),
    "friction": (keys_of.number(0.0), 0.5),
}


@dataclass(frozen=True)
class DynamicsSettings:
    """What [dynamics] gives.

    Attributes:
        options: gravity, iterations, sleep_time of `Dynamics`.
        body: density, restitution and friction of objects that give none.
    """

    options: dict
    body: dict

    def make(self, scene: Scene, motion: Kinematic, kinematic, body: dict) -> Dynamics:
        """Return rigid bodies that start as the motion does at its time 0.

        Args:
            kinematic: Which objects follow the motion, bool (n,).
            body: density, restitution and friction of each object, (n,).
        """
        angular_velocity = motion.axis * motion.rate[:, None]
        moving = {"velocity": motion.velocity, "angular_velocity": angular_velocity, "kinematic": kinematic}
        return Dynamics(scene, **self.options, **body, **moving)


def read_dynamics(keys) -> DynamicsSettings | None:
    """Check [dynamics]; None where the file has none."""
    if keys is None:
        return None
    checks = {
        "gravity": keys_of.vector(3),
        "iterations": keys_of.whole(1, 10_000),
        "sleep_time": keys_of.LENGTH,
    }
    options = {name: keys.take(name, check) for name, check in checks.items() if name in keys.values}
    options.setdefault("gravity", [0.0, -9.81, 0.0])
    body = {name: keys.take(name, check, default) for name, (check, default) in BODY.items()}
    keys.end()
    return DynamicsSettings(options, body)
