"""Scenes under a time budget T: the predictive controller, the paper's, a tolerance, and fixed LODs.

T is measured first: the median frame at the finest LODs, after the first second, over BREACH. On the CPU one core, and
the CPU time of its thread, so that what else the machine does is left out.

Then what an LOD changes of a frame: its stages at the finest and at the coarsest LODs, with all objects of the scenes.

Last, what control costs: a budget that the finest LODs keep makes the controller stay there, so that its frames have
all of its cost and none of its gain.
"""

import gc
import importlib.util
import time

import numpy as np

from warp_abtree.app import load_scene
from warp_abtree.lod.timing import STAGES
from warp_abtree.simulate.budget_report import budget_report

from .. import tables
from ..timing import one_core, summarise

NAMES = ("rain", "focus")
OBJECTS = {"cpu": {"rain": 300, "focus": 300}, "cuda": {"rain": 4000, "focus": 1500}}
# What is asked where bodies do not ask: a GPU counts so fast that LODs save little of a frame.
OUTPUT = {"cpu": "count", "cuda": "contacts"}
FRAMES, QUICK_FRAMES, QUICK_OBJECTS = 240, 75, 40
BREACH = 3.5  # how often the finest LODs take the budget
# What control costs: scenes, how many of their objects, and budgets in frames of the finest LODs.
CONTROLLED = ("focus", "herd", "rain", "worlds")
CONTROLLED_OBJECTS = {"cpu": 200, "cuda": None}
BUDGETS = (2.0, 0.5)
# What an LOD changes of a frame: scenes, and frames of each.
STAGED, STAGED_FRAMES = ("focus", "rain", "worlds"), 60
CONTROLLERS = ("none", "coarsest", "predictive", "paper", "tolerance")


def run(device, quick=False, plots=None):
    """Yield one row a scene and controller, over all frames after the first second; then what control costs.

    budget_ms is T; for what is judged see `budget_report`. "none" has the finest LODs, "coarsest" the coarsest: no
    budget below can be held.

    Rows with lods have the medians of all stages of the second half of the frames. Of rows with a ratio finest_ms is
    the median frame at the finest LODs, half of its runs before and half after those under control; total_ms that under
    the controller, with the medians of its stages.
    """
    kind = "cuda" if device.is_cuda else "cpu"
    options = {} if device.is_cuda else {"clock": time.thread_time}
    with one_core(device):
        for name in NAMES:
            collect()
            loaded = load_scene(name, device, objects=QUICK_OBJECTS if quick else OBJECTS[kind][name])
            runs, budget = {}, None
            for controller in CONTROLLERS:
                asked = options if budget is None else options | {"budget_ms": budget}
                frame = run_controller(loaded, controller, OUTPUT[kind], QUICK_FRAMES if quick else FRAMES, asked)
                steady = [each for each in frame.history if each.time >= 1.0]
                budget = budget or middle(steady) / BREACH
                row = {"scene": name, "objects": loaded.scene.object_count}
                yield row | {"budget_ms": budget, "controller": controller} | describe_hold(frame, steady, budget)
                runs[controller] = frame.history
            if plots is not None:
                draw_runs(name, runs, budget, plots)
        for name in STAGED:
            loaded = load_scene(name, device, objects=QUICK_OBJECTS if quick else None)
            for lods in ("finest", "coarsest"):
                staged = QUICK_FRAMES // 10 if quick else STAGED_FRAMES
                rows = run_settled(loaded, staged, options, coarsest=lods == "coarsest")
                row = {"scene": name, "objects": loaded.scene.object_count, "lods": lods}
                yield row | {column: middle(rows, column) for column in ("hits", *STAGES, "total_ms")}
    frames = QUICK_FRAMES // 10 if quick else FRAMES
    for name in CONTROLLED:
        if name == "herd" and importlib.util.find_spec("pxr") is None:
            continue  # its meshes need usd-core
        objects = QUICK_OBJECTS if quick else CONTROLLED_OBJECTS[kind]
        yield from compare(load_scene(name, device, objects=objects), name, frames)


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


def middle(rows, stage="total_ms"):
    """Return the median of a column of frames."""
    return float(np.median([getattr(row, stage) for row in rows]))


def describe_hold(frame, steady, budget):
    """Return the columns of one run; `steady` are its rows after the first second."""
    found = budget_report(frame.history, budget)
    names = ("within", "within_110_percent", "worst", "oscillations", "error_mean")
    row = {"judged": found["frames"]} | {name: found[name] for name in names}
    row |= summarise({"cost": [each.total_ms for each in steady]})
    row |= {"error_max": max(each.error_max for each in steady)}
    return row | {name: round(np.mean([getattr(each, name) for each in steady])) for name in ("faces", "hits")}


def draw_runs(name, runs, budget, folder):
    """Draw frame times over T, faces and certified errors of a scene under each controller."""
    rows = []
    for controller, history in runs.items():
        for i, row in enumerate(history):
            cost = {"cost": row.total_ms / budget, "faces": row.faces, "error": row.error_mean}
            rows.append({"controller": controller, "frame": i} | cost)
    (figure,) = tables.pick(tables.read_layout("cases/figures.toml")["figure"], case="budget")
    print(tables.draw([figure | {"file": f"budget-{name}.svg"}], rows, folder), flush=True)


def compare(loaded, name, frames):
    """Yield a row a budget of one scene."""
    finest = run_settled(loaded, frames, {})
    for part in BUDGETS:
        budget = part * middle(finest)
        controlled = run_settled(loaded, frames, {"budget_ms": budget}, "predictive")
        finest += run_settled(loaded, frames, {})
        row = {"scene": name, "objects": loaded.scene.object_count, "budget": part, "finest_ms": middle(finest)}
        row |= {column: middle(controlled, column) for column in ("total_ms", *STAGES)}
        yield row | {"error_mean": controlled[-1].error_mean, "ratio": row["total_ms"] / row["finest_ms"]}


def run_settled(loaded, frames, options, controller="none", coarsest=False):
    """Run a scene from its start, all objects at one end of their LODs first; return the second half of its rows."""
    models = [loaded.scene.models[model] for model in loaded.scene.object_model]
    loaded.base_lods, loaded.sweeps = np.array([0 if coarsest else model.lod_max for model in models]), ()
    return run_controller(loaded, controller, "count", frames, options).history[frames // 2 :]
