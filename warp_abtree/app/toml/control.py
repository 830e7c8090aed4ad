"""The table [lod] of a scene file: the controller that chooses the LODs of a run."""

import inspect
from dataclasses import dataclass, field, replace

from warp_abtree.app.toml.errors import fail
from warp_abtree.lod.controllers import PaperController, PredictiveController, ToleranceController
from warp_abtree.scene.scene import Scene

_KINDS = {"predictive": PredictiveController, "paper": PaperController, "tolerance": ToleranceController}
CONTROLLERS = (*_KINDS, "none")
BUDGET_CONTROLLERS = ("predictive", "paper")  # those that hold one


@dataclass(frozen=True)
class LodControl:
    """A controller of LODs and its settings."""

    controller: str = "none"  # of CONTROLLERS; "none" leaves LODs to the objects and their sweeps
    budget_ms: float | None = None  # T [ms]
    tolerance: float | None = None  # of the tolerance controller [units]
    options: dict = field(default_factory=dict)  # those that the file gives, by name

    def asked(self, controller: str | None = None, budget_ms: float | None = None) -> "LodControl":
        """Return this with another controller or budget; a budget alone asks the predictive one where none holds it.

        Raises ValueError for a controller without its budget or tolerance.
        """
        if controller is None:
            keeps = budget_ms is None or self.controller in BUDGET_CONTROLLERS
            controller = self.controller if keeps else "predictive"
        if controller not in CONTROLLERS:
            raise ValueError(f"controller {controller!r} is none of {', '.join(CONTROLLERS)}")
        if budget_ms is not None and controller not in BUDGET_CONTROLLERS:
            raise ValueError(f"controller {controller!r} holds no budget")
        made = replace(self, controller=controller, budget_ms=self.budget_ms if budget_ms is None else budget_ms)
        if controller in BUDGET_CONTROLLERS and made.budget_ms is None:
            raise ValueError(f"controller {controller!r} needs a budget")
        if controller == "tolerance" and made.tolerance is None:
            raise ValueError("controller 'tolerance' needs lod.tolerance of the scene file")
        return made

    def make(self, scene: Scene, camera):
        """Return the controller for a scene, None for "none"."""
        if self.controller == "none":
            return None
        kind, held = _KINDS[self.controller], self.tolerance if self.controller == "tolerance" else self.budget_ms
        taken = inspect.signature(kind).parameters
        return kind(scene, held, camera, **{name: value for name, value in self.options.items() if name in taken})


def make_control(path, table) -> LodControl:
    """Return what [lod] describes; raise SceneError for a controller without its budget or tolerance."""
    if table is None:
        return LodControl()
    from msgspec.structs import asdict

    options = {name: value for name, value in asdict(table).items() if value is not None}
    budget_ms, tolerance = options.pop("budget_ms", None), options.pop("tolerance", None)
    controller = options.pop("controller", "tolerance" if budget_ms is None else "predictive")
    try:
        return LodControl("none", budget_ms, tolerance, options).asked(controller)
    except ValueError as error:
        fail(path, "lod", error)
