"""Scenes under a time budget T: the predictive controller, the paper's, a tolerance, and fixed LODs.

T is measured first: the median frame at the finest LODs, after the first second, over BREACH. On the CPU one core, and
the CPU time of its thread, so that what else the machine does is left out.
"""

import contextlib
import gc
import time
from pathlib import Path

import numpy as np
import warp as wp

from warp_abtree.app import load_scene
from warp_abtree.simulate.budget_report import budget_report

from .. import tables
from ..timing import one_core

SCENES = Path(__file__).resolve().parents[2] / "scenes"
NAMES = ("rain", "focus")
OBJECTS = {"cpu": {"rain": 300, "focus": 300}, "cuda": {"rain": 4000, "focus": 1500}}
# What is asked where bodies do not ask: a GPU counts so fast that LODs save little of a frame.
OUTPUT = {"cpu": "count", "cuda": "contacts"}
FRAMES, QUICK_FRAMES, QUICK_OBJECTS = 240, 75, 40
BREACH = 3.5  # how often the finest LODs take the budget
CONTROLLERS = ("none", "coarsest", "predictive", "paper", "tolerance")


def run(device, quick=False, plots=None):
    """Yield one row a scene and controller, over all frames after the first second.

    budget_ms is T; for what is judged see `budget_report`. "none" has the finest LODs, "coarsest" the coarsest: no
    budget below can be held. plots is a folder for a figure a scene, None draws nothing.
    """
    device = wp.get_device(device)
    kind = "cuda" if device.is_cuda else "cpu"
    with contextlib.nullcontext() if device.is_cuda else one_core() as core:
        options = {} if core is None else {"clock": time.thread_time}
        for name in NAMES:
            collect()
            loaded = load_scene(
                SCENES / f"{name}.toml", device, objects=QUICK_OBJECTS if quick else OBJECTS[kind][name]
            )
            runs, budget = {}, None
            for controller in CONTROLLERS:
                asked = options if budget is None else options | {"budget_ms": budget}
                frame = run_controller(loaded, controller, OUTPUT[kind], QUICK_FRAMES if quick else FRAMES, asked)
                budget = budget or float(np.median(steady_costs(frame))) / BREACH
                row = {"scene": name, "device": device.name, "objects": loaded.scene.object_count}
                yield row | {"budget_ms": round(budget, 3), "controller": controller} | describe_hold(frame, budget)
                runs[controller] = frame.history
            if plots is not None:
                draw_runs(name, runs, budget, plots)


def collect():
    """Free scenes, which their queries hold, and keep the collector from a full pass within a frame."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()


def run_controller(loaded, controller, output, frames, options):
    """Run a scene from its start and return the frame."""
    asked = {"controller": "none" if controller == "coarsest" else controller} | options
    if controller not in ("predictive", "paper"):
        asked.pop("budget_ms", None)
    frame = loaded.frame(output, bodies=loaded.make_bodies(), **asked)
    if controller == "coarsest":
        frame.lods = lambda time: 0 * loaded.base_lods
    collect()
    frame.run(frames)
    return frame


def steady_costs(frame):
    """Return T' of all frames after the first second [ms]."""
    return np.array([row.total_ms for row in frame.history if row.time >= 1.0])


def describe_hold(frame, budget):
    """Return the columns of one run."""
    found, costs = budget_report(frame.history, budget), steady_costs(frame)
    rows = [row for row in frame.history if row.time >= 1.0]
    digits = {"within": 4, "within_110_percent": 4, "worst": 2, "oscillations": 3, "error_mean": 5}
    return {"judged": found["frames"]} | {
        **{name: round(found[name], count) for name, count in digits.items()},
        "cost_ms": round(float(np.median(costs)), 3),
        "cost_p95_ms": round(float(np.percentile(costs, 95)), 3),
        "error_max": round(max(row.error_max for row in rows), 5),
        "faces": round(float(np.mean([row.faces for row in rows]))),
        "hits": round(float(np.mean([row.hits for row in rows]))),
    }


def draw_runs(name, runs, budget, folder):
    """Draw frame times over T, faces and certified errors of a scene under each controller."""
    rows = [
        {
            "controller": controller,
            "frame": i,
            "cost": row.total_ms / budget,
            "faces": row.faces,
            "error": row.error_mean,
        }
        for controller, history in runs.items()
        for i, row in enumerate(history)
    ]
    (figure,) = tables.pick(tables.read_layout("cases/figures.toml")["figure"], case="budget")
    print(tables.draw([figure | {"file": f"budget-{name}.svg"}], rows, folder), flush=True)
