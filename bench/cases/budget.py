"""Scenes under a time budget T: the predictive controller, the paper's, a tolerance, and fixed LODs.

T is measured first: the median frame at the finest LODs, after the first second, over BREACH. Where that is less than
what the coarsest LODs take with some room, a budget cannot be held, so meshes are made finer until it is not. On the
CPU one core, and the CPU time of its thread, so that what else the machine does is left out.
"""

import contextlib
import gc
import json
import re
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree.app import draw_controllers, load_scene
from warp_abtree.simulate.budget_report import budget_report, step_response
from warp_abtree.simulate.frame import FrameRow

from ..shapes import knot
from ..timing import medians, one_core, time_in_turn

SCENES = Path(__file__).resolve().parents[2] / "scenes"
NAMES = ("rain", "focus")
OBJECTS = {"cpu": {"rain": 300, "focus": 300}, "cuda": {"rain": 4000, "focus": 1500}}
# What is asked where bodies do not ask: a GPU counts so fast that LODs save little of a frame.
OUTPUT = {"cpu": "count", "cuda": "contacts"}
# Sections of all meshes, times this: a 16,000-face model has 64,000 and 256,000.
SCALES = {"cpu": (1,), "cuda": (1, 2, 4)}
FULL = {"frames": 240, "step": 60, "probe": 90, "selected": 100_000}
QUICK = {"frames": 75, "step": 12, "probe": 6, "selected": 200}
QUICK_OBJECTS = 40
PROBED = 8  # frames of each kind that a probe times
BREACH = 3.5  # how often the finest LODs take the budget
ROOM = 2.0  # how often the coarsest LODs must fit into the budget, or meshes are made finer
CONTROLLERS = ("none", "coarsest", "predictive", "paper", "tolerance")
CONSTANT_LODS = ("none", "coarsest")
FAR = 1000.0  # where objects are kept until the load rises [world units]


def run(device, quick=False, plots=None):
    """Yield one row a scene and controller, all frames after the first second, and one a load that rises by a step.

    Row "select": what selection alone takes for many objects, with the view and the paper's controller, a tolerance or
    the prediction; launches, as one graph on CUDA.
    Rows "probe": what the finest and the coarsest LODs take at a scale of the meshes, and whether that scale is taken.
    Rows "hold": budget_ms is T; breach and breach_p5, how often the finest LODs took it, in the median and in 19 of 20
    frames; within and within_110_percent, fractions of frames within T and T + 10 %; worst, the greatest cost over T;
    longest_over, most frames in a row over T + 10 %; oscillations, how often the LOD of an object reversed, a second;
    errors are certified [world units]. "none" has the finest LODs, "coarsest" the coarsest: no budget below can be
    held. Where LODs are fixed, adds is what a frame takes beyond the sum of its stages, over that sum (median).
    Rows "step": half of the objects join at one frame, without a camera, T from the finest LODs after it. load is how
    often the finest LODs take after it what they took before; peak the greatest cost over T from that frame on;
    back_after the frames until the first within T + 10 %, None where there was none.

    Args:
        plots: Folder for a figure a scene and the rows of its frames, None draws nothing.
    """
    device = wp.get_device(device)
    kind = "cuda" if device.is_cuda else "cpu"
    sizes = QUICK if quick else FULL
    with contextlib.nullcontext() if device.is_cuda else one_core() as core:
        clock = None if core is None else time.thread_time
        yield time_selection(device, sizes["selected"])
        for name in NAMES:
            collect()
            objects = QUICK_OBJECTS if quick else OBJECTS[kind][name]
            yield from BudgetScene(device, name, clock, sizes).run(objects, SCALES[kind], plots)


def collect():
    """Free scenes, which their queries hold, and keep the collector from a full pass within a frame."""
    gc.unfreeze()
    gc.collect()
    gc.freeze()


def time_selection(device, count):
    """Return the row "select"."""
    rng = np.random.default_rng(0)
    models = [ab.Model.from_arrays(*knot(faces)) for faces in (200, 400, 600)]
    scene = ab.Scene(device)
    for i, place in enumerate(rng.uniform(-50, 50, (count, 3)).tolist()):
        scene.add(models[i % 3], (*place, 0, 0, 0, 1), importance=1 + i % 3)
    camera, feedback = ab.Camera.look_at((0, 0, 60), (0, 0, 0)), ab.Feedback(0.0)
    controllers = {
        "paper": ab.PaperController(scene, 8.0),
        "tolerance": ab.ToleranceController(scene, 0.01),
        "predictive": ab.PredictiveController(scene, 8.0),
    }
    launches = {"view": controllers["paper"].view.launch}
    for name, controller in controllers.items():
        controller.view.look(camera)
        launches[name] = lambda controller=controller: (controller.view.launch(), controller.next_lods(feedback))
    times = medians(time_in_turn(launches, device))
    row = {"case": "select", "device": device.name, "objects": count}
    return row | {f"{name}_ms": round(value, 4) for name, value in times.items()}


def scale_sections(text, scale):
    """Return a scene file's text with the sections of all generated meshes multiplied."""

    def grow(line):
        return line[1] + re.sub(r"\d+", lambda number: str(scale * int(number[0])), line[2])

    return re.sub(r"(?m)^(\w*sections = |cells = )(.*)$", grow, text)


class BudgetScene:
    """One scene of the benchmark.

    Args:
        clock: Of its frames, None for that of the device.
        sizes: Frames of each part.
    """

    def __init__(self, device, name, clock, sizes):
        self.device, self.name, self.sizes = device, name, sizes
        self.options = {} if clock is None else {"clock": clock}
        self.now = clock or time.perf_counter
        self.output = OUTPUT["cuda" if self.device.is_cuda else "cpu"]
        self.budget = self.loaded = self.poses = None

    def run(self, objects, scales, plots):
        """Yield the rows of the scene."""
        yield from self.probe_scales(objects, scales)
        scene, runs, breach = self.loaded.scene, {}, {}
        self.about = {"scene": self.name, "device": scene.device.name, "objects": scene.object_count}
        for controller in CONTROLLERS:
            frame, adds = self.run_controller(controller)
            if controller == "none":
                costs = steady_costs(frame)
                self.budget = float(np.median(costs)) / BREACH
                breach = {"breach": BREACH, "breach_p5": round(float(np.percentile(costs, 5)) / self.budget, 2)}
            row = {"case": "hold"} | self.about | {"frames": len(frame.history), "budget_ms": round(self.budget, 3)}
            row |= breach | {"controller": controller} | describe_hold(frame, self.budget)
            yield row | ({"adds": round(adds, 4)} if controller in CONSTANT_LODS else {})
            runs[controller] = frame.history
        yield from self.run_step()
        if plots is not None:
            title = f"{self.loaded.title}: {scene.object_count:,} objects, {scene.device.name}"
            print(save_plots(Path(plots), self.name, title, self.budget, runs), flush=True)

    def probe_scales(self, objects, scales):
        """Load the scene at one scale after another until the coarsest LODs leave room in T; yield their rows."""
        path = SCENES / f"{self.name}.toml"
        text = path.read_text(encoding="utf-8")
        for scale in scales:
            self.loaded = None
            collect()
            begin = time.perf_counter()
            loaded = self.loaded = load_scene(path, self.device, objects=objects, text=scale_sections(text, scale))
            seconds = time.perf_counter() - begin
            coarsest, finest = self.probe_costs()
            enough = finest / BREACH >= ROOM * coarsest
            row = {"case": "probe", "scene": self.name, "device": self.device.name}
            row |= {"objects": loaded.scene.object_count, "scale": scale, "load_s": round(seconds, 1)}
            row |= {"faces_max": max(model.face_count for model in loaded.scene.models)}
            row |= {"finest_ms": round(finest, 3), "coarsest_ms": round(coarsest, 3)}
            yield row | {"taken": enough or scale == scales[-1]}
            if enough:
                return

    def probe_costs(self):
        """Return the median T' at the coarsest and at the finest LODs once the scene has run for some frames [ms]."""
        frame = self.loaded.frame(self.output, controller="none", **self.options)
        turn, finest = self.sizes["probe"] + PROBED, self.loaded.base_lods
        frame.lods = lambda time: finest if round(time / frame.time_step) >= turn else 0 * finest
        frame.warm_up()
        frame.run(turn + 1 + PROBED)
        costs = np.array([row.cost_ms for row in frame.history])
        return float(np.median(costs[turn - PROBED : turn])), float(np.median(costs[turn + 1 :]))

    def run_controller(self, controller):
        """Run the scene from its start; return the frame, and what it adds to its stages (median of the frames)."""
        loaded, frames = self.loaded, self.sizes["frames"]
        bodies = loaded.make_bodies()
        asked = {"controller": "none" if controller in CONSTANT_LODS else controller}
        if controller in ("predictive", "paper"):
            asked["budget_ms"] = self.budget
        frame = loaded.frame(self.output, bodies=bodies, **asked, **self.options)
        if controller == "coarsest":
            lods = 0 * loaded.base_lods
            frame.lods = lambda time: lods
        collect()
        adds, poses = [], []
        for number in range(frames):
            if controller == "none" and number >= frames - 2 * self.sizes["step"]:
                poses.append(loaded.motion.poses(number * frame.time_step) if bodies is None else bodies.poses())
            begin = self.now()
            frame.step()
            adds.append(1e3 * (self.now() - begin) / frame.history[-1].total_ms - 1.0)
        if poses:
            self.poses = np.array(poses)
        return frame, float(np.median(adds))

    def run_step(self):
        """Yield the rows of a load that rises by a step."""
        loaded, scene, step, budget, load = self.loaded, self.loaded.scene, self.sizes["step"], None, None
        for controller in ("none", "predictive", "paper"):
            scene.set_lods(loaded.base_lods)
            scene.set_poses(self.poses[-1])
            lods = None if controller == "none" else loaded.control.asked(controller, budget).make(scene, None)
            motion = LoadStep(self.poses, step, loaded.time_step)
            frame = ab.Frame(scene, motion, lods, self.output, loaded.time_step, **self.options)
            frame.warm_up()
            collect()
            costs = np.array([row.cost_ms for row in frame.run(len(self.poses))])
            if controller == "none":
                budget = float(np.median(costs[step:])) / BREACH
                load = BREACH * budget / float(np.median(costs[:step]))
            row = {"case": "step"} | self.about | {"frames": len(costs), "budget_ms": round(budget, 3)}
            row |= {"breach": BREACH, "load": round(load, 2), "controller": controller}
            yield row | describe_step(frame, step, budget)


class LoadStep:
    """Poses of a run, frame by frame, half of the objects far away until one of them."""

    def __init__(self, poses, step, time_step):
        self.rows, self.step, self.time_step = poses, step, time_step
        count = poses.shape[1]
        late = np.random.default_rng(0).random(count) < 0.5
        self.away = np.zeros((count, 3))
        self.away[late, 0] = FAR * (1 + np.arange(late.sum()))

    def __len__(self):
        return self.rows.shape[1]

    def poses(self, time, out):
        frame = round(time / self.time_step)
        out[:] = self.rows[min(frame, len(self.rows) - 1)]
        if frame < self.step:
            out[:, :3] += self.away
        return out


def steady_costs(frame):
    """Return T' of all frames after the first second [ms]."""
    return np.array([row.cost_ms for row in frame.history if row.time >= 1.0])


def describe_hold(frame, budget):
    """Return the columns of one run."""
    found, costs = budget_report(frame.history, budget), steady_costs(frame)
    rows = [row for row in frame.history if row.time >= 1.0]
    return {
        "judged": found["frames"],
        "within": round(found["within"], 4),
        "within_110_percent": round(found["within_110_percent"], 4),
        "worst": round(found["worst"], 2),
        "longest_over": found["longest_over"],
        "cost_ms": round(float(np.median(costs)), 3),
        "cost_p95_ms": round(float(np.percentile(costs, 95)), 3),
        "oscillations": round(found["oscillations"], 3),
        "error_mean": round(found["error_mean"], 5),
        "error_max": round(max(row.error_max for row in rows), 5),
        "faces": round(float(np.mean([row.faces for row in rows]))),
        "hits": round(float(np.mean([row.hits for row in rows]))),
    }


def describe_step(frame, step, budget):
    """Return the columns of one load step."""
    found, costs = step_response(frame.history, step, budget), np.array([row.cost_ms for row in frame.history])
    return {
        "before": round(float(np.median(costs[step // 2 : step])) / budget, 2),
        "peak": round(found["peak"], 2),
        "back_after": found["frames"],
        "within_110_percent": round(float(np.mean(costs[step:] <= 1.1 * budget)), 4),
        "error_mean": round(float(np.mean([row.error_mean for row in frame.history[step:]])), 5),
    }


def save_plots(folder, name, title, budget, runs) -> str:
    """Write the rows of all frames, and a figure of them; return what was drawn."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = {"title": title, "budget_ms": budget, "runs": {key: [asdict(row) for row in runs[key]] for key in runs}}
    (folder / f"budget-{name}.json").write_text(json.dumps(kept), encoding="utf-8")
    return draw_saved(folder / f"budget-{name}.json")


def draw_saved(path) -> str:
    """Draw what `save_plots` wrote, beside it; return what was drawn."""
    kept = json.loads(Path(path).read_text(encoding="utf-8"))
    runs = {key: [FrameRow(**row) for row in rows] for key, rows in kept["runs"].items()}
    drawn = Path(path).with_suffix(".png")
    draw_controllers(runs, kept["budget_ms"], drawn, kept["title"])
    return f"plots: {drawn}"
