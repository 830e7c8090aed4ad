"""Figure 4, and a budget held by the paper's controller and the predictive one."""

from pathlib import Path

import numpy as np

import warp_abtree as ab
from warp_abtree.app import load_scene
from warp_abtree.lod.timing import WorkClock
from warp_abtree.simulate.budget_report import budget_report

from .meshes import paper_models

SCENE = Path(__file__).resolve().parents[3] / "scenes" / "focus.toml"
# Figure 4, read off the picture: g in frames 1 to 10, Case 1 until frame 5, Case 2 from frame 6; Q1, Q2, Q3.
FIGURE_4 = ((1, 2, 4, 8, 16, 8, 4, 2, 1, 0), (0, 1, 2, 4, 8, 8, 4, 2, 1, 0), (0, 0, 1, 2, 4, 8, 4, 2, 1, 0))
# Costs over T, a frame each: a climb and a pause first, so that no end of the ladder hides a step; then the figure.
BEFORE = (0.5,) * 6 + (0.95,)
COURSE = (0.5,) * 5 + (1.5,) * 5
STEPS = 100
CONTROLLERS = ("paper", "predictive")
BREACH = 3.0  # T is a third of the median frame at the finest LODs
AFTER = 1.0  # seconds of a scene before frames are judged


def run(context):
    """Yield one row a kind of object and frame of figure 4, and one a controller that holds a budget."""
    yield from step_figure_4(context)
    yield from hold_budget(context)


def step_figure_4(context):
    """Yield the steps by which the paper's controller moves objects of all three kinds along the figure's times."""
    (model, *_) = paper_models(context, largest=False)
    scene = ab.Scene(context.device)
    for importance in (1, 2, 3):
        scene.add(model, importance=importance, lod=0)
    budget = 10.0
    controller = ab.PaperController(scene, budget, steps=STEPS)
    levels = []
    for i, cost in enumerate((*BEFORE, *COURSE)):
        stages = {"select_ms": 0.0, "refine_ms": 0.0, "broad_ms": 0.0, "query_ms": cost * budget}
        lods = controller.next_lods(ab.Feedback(time=i / 60, stage_ms=stages)).numpy()
        levels.append(np.round(lods * STEPS / model.lod_max).astype(int))
    moved = np.diff(np.array(levels), axis=0)[len(BEFORE) - 1 :]
    for frame in range(len(COURSE)):
        for kind in range(3):
            row = {"case": "figure 4", "frame": frame + 1, "kind": f"Q{kind + 1}"}
            yield row | {"moved": abs(moved[frame, kind]), "paper": FIGURE_4[kind][frame]}


def hold_budget(context):
    """Yield one row a controller of the focus scene.

    T is a third of the median frame at the finest levels. Times are counted work (`WorkClock`), so that the run repeats
    everywhere; the case `budget` measures.
    """
    objects = context.size(1000 if context.device.is_cuda else 150, 30)
    frames = context.size(240, 90)
    loaded = load_scene(SCENE, device=context.device, objects=objects)
    finest = loaded.frame(controller="none", clock=WorkClock())
    finest.run(frames // 2)
    budget = float(np.median([row.total_ms for row in finest.history if row.time >= AFTER / 2])) / BREACH
    for controller in CONTROLLERS:
        context.progress(f"{controller} controller")
        frame = loaded.frame(controller=controller, budget_ms=budget, clock=WorkClock())
        frame.run(frames)
        judged = budget_report(frame.history, budget, after=AFTER)
        about = {"case": "budget", "controller": controller, "objects": loaded.scene.object_count}
        about |= {name: judged[name] for name in ("frames", "within", "worst", "error_mean")}
        yield about | {"within_110_percent": judged["within_110_percent"], "oscillations": judged["oscillations"]}
