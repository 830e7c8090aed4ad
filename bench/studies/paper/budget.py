"""Figure 4: how the paper's controller moves LODs. The case `budget` measures how controllers hold a budget."""

import numpy as np

import warp_abtree as ab

from .meshes import paper_models

# Figure 4, read off the picture: g in frames 1 to 10, Case 1 until frame 5, Case 2 from frame 6; Q1, Q2, Q3.
FIGURE_4 = ((1, 2, 4, 8, 16, 8, 4, 2, 1, 0), (0, 1, 2, 4, 8, 8, 4, 2, 1, 0), (0, 0, 1, 2, 4, 8, 4, 2, 1, 0))
# Costs over T, a frame each: a climb and a pause first, so that no end of the ladder hides a step; then the figure.
BEFORE = (0.5,) * 6 + (0.95,)
COURSE = (0.5,) * 5 + (1.5,) * 5
STEPS = 100


def run(context):
    """Yield one row a kind of object and frame: the steps that the controller moves it by along the figure's times."""
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
