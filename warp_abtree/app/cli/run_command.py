"""`warp-abtree run`: a scene frame by frame, or a recorded run again."""

import gc
import importlib.util
from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import Parser, milliseconds, positive
from warp_abtree.app.cli.model_commands import active_count
from warp_abtree.app.cli.report import check_output, print_json, print_table
from warp_abtree.app.pictures.plots import draw_run
from warp_abtree.app.pictures.render import import_pyvista
from warp_abtree.app.pictures.scenes import draw_scene
from warp_abtree.app.recording import Recording, record_run, recorded_clock
from warp_abtree.app.styles import STAGE_LABELS
from warp_abtree.app.toml.control import CONTROLLERS
from warp_abtree.app.toml.folder import scene_names
from warp_abtree.app.toml.scene_file import load_scene

SUMMARY = "run a scene frame by frame and time its stages"
EXAMPLES = (
    "bunny_tori --picture bunny_tori.png",
    "scenes/herd.toml --frames 10 --device cpu --record herd.csv",
    "rain --budget 8ms --controller paper --plot plots --record rain.npz",
    "rain.npz",
)
PLOT_NAME = "frames.png"
COUNTS = {
    "pairs": "candidate pairs",
    "intersecting": "pairs that intersect",
    "hits": "intersecting face pairs",
    "faces": "active faces",
    "states": "tree states",
    "nodes_refitted": "nodes refitted",
}
SUMS = {"cost_ms": "select to query, without move", "total_ms": "frame"}


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    about = f"scene file (.toml), or one of {', '.join(scene_names())}; or a recorded run (.npz), which runs again"
    sub.add_file("scene", metavar="SCENE", help=about)
    sub.add_argument("--frames", type=positive, metavar="N", help="frames to run (the scene's own number)")
    sub.add_file("--picture", type=Path, metavar="PNG", help="draw the scene, intersecting faces coloured")
    sub.add_argument("--objects", type=positive, metavar="N", help="about so many objects, by other counts or worlds")
    sub.add_argument("--budget", type=milliseconds, metavar="TIME", help="time of a frame to hold, as 8ms or 0.008s")
    sub.add_argument("--controller", choices=CONTROLLERS, help="what chooses LODs (the scene's own, or predictive)")
    about = "write a row a frame, .csv or .json; .npz holds all and runs again"
    sub.add_file("--record", type=Path, metavar="FILE", help=about)
    sub.add_file("--plot", type=Path, metavar="DIR", help="draw LODs, times and error over the frames there")


def run(options, progress):
    """Run a scene file, or a recording again."""
    again = str(options.scene).lower().endswith(".npz")
    _check(options, again)
    replay = Recording.open(options.scene) if again else None
    if replay is not None:
        loaded = replay.load_scene(options.scene, options.device or replay.settings.device, progress)
        recorded = len(replay.rows)
        frames = recorded if options.frames is None else options.frames
        if frames > recorded:
            raise ValueError(f"--frames: {options.scene} has {recorded} frames")
        asked: dict = {"controller": replay.settings.controller, "budget_ms": replay.settings.budget_ms}
        asked["clock"] = recorded_clock(replay.rows)
    else:
        loaded = load_scene(options.scene, device=options.device, progress=progress, objects=options.objects)
        frames = loaded.frames if options.frames is None else options.frames
        asked = {"controller": options.controller, "budget_ms": options.budget}
    # A full collection of what was loaded takes longer than the budget of a frame.
    gc.collect()
    gc.freeze()
    keep = again or bool(options.record and options.record.suffix.lower() == ".npz")
    named = {"keep": keep, "progress": lambda done, total: progress("frames", done, total)}
    frame, recording = record_run(loaded, frames, **named, **asked)
    progress.close()
    if replay is not None and (different := first_difference(replay, recording)):
        raise RuntimeError(f"{options.scene}: {different}")
    written = [str(path) for path in _write(options, loaded, frame, recording)]
    summary = {
        "title": loaded.title,
        "device": str(loaded.scene.device),
        "time_step": loaded.time_step,
        "models": len(loaded.scene.models),
        "meshes": {
            name: {"mesh": model.name, "faces": model.face_count, "base_faces": active_count(model, 0)}
            for name, model in loaded.models.items()
        },
        "worlds": len(np.unique(loaded.worlds[loaded.worlds >= 0])),
        "controller": recording.settings.controller,
        "replay": str(options.scene) if again else None,
        "written": written,
        **frame.summary(),
    }
    if options.json:
        print_json(summary)
        return
    print_summary(summary)
    for path in written:
        print(f"wrote {path}")


def _check(options, again):
    """Refuse options that cannot be met, before any work."""
    if again:
        for name in ("budget", "controller", "objects"):
            if getattr(options, name) is not None:
                raise ValueError(f"--{name}: a recording runs again as it was")
    if options.record:
        check_output(options.record, [".csv", ".json", ".npz"], inputs=[options.scene])
    if options.picture:
        check_output(options.picture, [".png"])
        import_pyvista("--picture")
    if options.plot:
        check_output(options.plot / PLOT_NAME, [".png"], make=True)
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError("--plot needs Matplotlib: pip install warp-abtree[pictures]")


def first_difference(recording: Recording, other: Recording) -> str | None:
    """Return the first difference of a run from a recording, as far as both go, to the bit; None if there is none."""
    for i, (mine, its) in enumerate(zip(recording.rows, other.rows)):
        for name, value in mine.as_dict().items():
            if value != its.as_dict()[name]:
                return f"frame {i}: {name} is {its.as_dict()[name]}, recorded is {value}"
        for name in ("lods", "poses"):
            if getattr(recording, name)[i].tobytes() != getattr(other, name)[i].tobytes():
                return f"frame {i}: {name} are not those recorded"
    return None


def _write(options, loaded, frame, recording) -> list[Path]:
    """Write the files that the options name; return them."""
    if options.record:
        if options.record.suffix.lower() == ".npz":
            recording.save(options.record)
        else:
            frame.record(options.record)
    if options.picture:
        poses = None if loaded.dynamics is None else frame.motion.dynamics.poses()
        chosen = None if recording.settings.controller == "none" else loaded.scene.lods
        draw_scene(loaded, options.picture, frame.history[-1].time, poses, chosen)
    if options.plot:
        options.plot.mkdir(exist_ok=True)
        top = np.array([model.lod_max for model in loaded.scene.models])[loaded.scene.object_model]
        title = f"{loaded.title}: {recording.settings.controller} on {loaded.scene.device}"
        draw_run(frame.history, recording.lods / np.maximum(top, 1), options.plot / PLOT_NAME, title)
    return list(filter(None, (options.record, options.picture, options.plot and options.plot / PLOT_NAME)))


def print_summary(summary):
    """Print counts and times over the frames of a scene."""
    print(f"{summary['title']}: {summary['frames']} frames on {summary['device']}")
    worlds = f"{summary['worlds']} world{'' if summary['worlds'] == 1 else 's'}"
    span = f"LODs {summary['lod_min']:,} to {summary['lod_max']:,}"
    print(f"{summary['objects']:,} objects of {summary['models']} models in {worlds}, {span}\n")
    table = [["model", "faces", "of the base", "mesh"]]
    for name, mesh in summary["meshes"].items():
        table.append([name, f"{mesh['faces']:,}", f"{mesh['base_faces']:,}", mesh["mesh"]])
    print_table(table)
    print()
    table = [["a frame", "mean", "min", "max"]]
    for name, label in COUNTS.items():
        spread = summary[name]
        table.append([label, f"{spread['mean']:,.1f}", f"{spread['min']:,.0f}", f"{spread['max']:,.0f}"])
    print_table(table)
    print()
    table = [["stage [ms]", "mean", "p95", "total"]]
    for name, label in (STAGE_LABELS | SUMS).items():
        stage = summary["stages"][name]
        table.append([label, f"{stage['mean']:.3f}", f"{stage['p95']:.3f}", f"{stage['total']:.1f}"])
    print_table(table)
    print()
    _print_budget(summary)
    if summary["replay"]:
        print(f"as recorded in {summary['replay']}: every row, LOD and pose, bit for bit")


def _print_budget(summary):
    """Print how a budget was held, and what it cost in accuracy."""
    mean, greatest = summary["error_mean"]["mean"], summary["error_max"]["max"]
    print(f"certified error of the objects, original to LOD: {mean:.3g} on average, at most {greatest:.3g}")
    if summary["budget_ms"] is None:
        return
    print(f"budget: {summary['budget_ms']:g} ms, {summary['controller']} controller")
    budget = summary["budget"]
    if budget is None:
        print("no frame after the first second, so the budget is not judged")
        return
    print(
        f"after the first second: {100 * budget['within']:.1f} % of {budget['frames']} frames within it, "
        f"{100 * budget['within_110_percent']:.1f} % within 10 % more; the worst took {budget['worst']:.2f} of it, "
        f"{budget['longest_over']} in a row were over; "
        f"the LOD of an object reversed {budget['oscillations']:.2f} times a second"
    )
