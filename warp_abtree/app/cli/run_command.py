"""`warp-abtree run`: a scene frame by frame."""

import contextlib
import gc
import importlib.util
import os
import sys
from pathlib import Path

import numpy as np

from warp_abtree.app.cli.arguments import PROGRAM, Parser, milliseconds, positive_count
from warp_abtree.app.cli.report import check_output, print_result
from warp_abtree.app.pictures.render import draw_run, import_pyvista
from warp_abtree.app.pictures.scenes import draw_scene
from warp_abtree.app.toml.control import CONTROLLERS
from warp_abtree.app.toml.folder import scene_names
from warp_abtree.app.toml.scene_file import load_scene
from warp_abtree.app.viewer.command import import_viser, serve
from warp_abtree.app.viewer.recording import SceneRecording

SUMMARY = "run a scene frame by frame and time its stages"
EXAMPLES = (
    "bunny_tori --picture bunny_tori.png",
    "scenes/herd.toml --frames 10 --device cpu --record herd.csv",
    "rain --budget 8ms --controller paper --plot plots",
)
PLOT_NAME, PAGE = "frames.png", ".html"
PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg", ".webp", ".gif")


def add_arguments(sub: Parser):
    """Add the arguments of the command to its parser."""
    about = f"scene file (.toml), file of several objects, or one of {', '.join(scene_names())}"
    sub.add_scene("scene", metavar="SCENE", help=about)
    sub.add_number("--frames", "frames to run (the scene's own number)", positive_count)
    sub.add_file("--picture", type=Path, metavar="PNG", help="draw the scene, intersecting faces coloured")
    sub.add_number("--objects", "about so many objects, by other counts or worlds", positive_count)
    sub.add_argument("--budget", type=milliseconds, metavar="TIME", help="time of a frame to hold, as 8ms or 0.008s")
    sub.add_argument("--controller", choices=CONTROLLERS, help="what chooses LODs (the scene's own, or predictive)")
    about = "write a row a frame as it ends, .csv or .json, or a page that plays the frames, .html"
    sub.add_file("--record", type=Path, metavar="FILE", help=about)
    sub.add_file("--plot", type=Path, metavar="DIR", help="draw LODs, times and error over the frames there")


def run(options, progress):
    """Run a scene file."""
    _check(options)
    loaded = load_scene(options.scene, device=options.device, progress=progress, objects=options.objects)
    frames = loaded.frames if options.frames is None else options.frames
    # A full collection of what was loaded takes longer than the budget of a frame.
    gc.collect()
    gc.freeze()
    controller = loaded.control.asked(options.controller, options.budget).controller
    frame = loaded.frame(controller=options.controller, budget_ms=options.budget)
    lods = []
    with contextlib.ExitStack() as stack:
        page = None
        if options.record and options.record.suffix.lower() == PAGE:
            page = SceneRecording(stack.enter_context(serve()), loaded, frames, controller != "none")
        elif options.record:
            frame.record(options.record)

        def after_frame(done, total):
            if options.plot:
                lods.append(loaded.scene.lods)
            if page is not None:
                page.add(frame.history[-1])
            progress("frames", done, total)

        frame.run(frames, after_frame)
        progress.close()
        if page is not None:
            page.write(options.record)
    written = [str(path) for path in _write(options, loaded, frame, (controller, lods))]
    summary = {
        "title": loaded.title,
        "device": str(loaded.scene.device),
        "time_step": loaded.time_step,
        "models": len(loaded.scene.models),
        "meshes": {
            name: {"mesh": model.name, "faces": model.face_count, "base_faces": model.progressive.active_count(0)}
            for name, model in loaded.models.items()
        },
        "worlds": len(np.unique(loaded.worlds[loaded.worlds >= 0])),
        "controller": controller,
        "written": written,
        **frame.summary(),
    }
    print_result(summary, options.json, digits=4)
    budget, least = summary["budget_ms"], summary["coarsest_ms"]
    if budget is not None and least is not None and least > budget:
        about = f"a budget of {budget:g} ms is impossible here: with every object at its coarsest LOD frames take"
        print(f"{PROGRAM}: {about} {least:.3g} ms", file=sys.stderr)


def _check(options):
    """Refuse options that cannot be met, before any work."""
    if options.record:
        check_output(options.record, [".csv", ".json", PAGE], inputs=[options.scene])
        if options.record.suffix.lower() == PAGE:
            import_viser("--record of a page")
    if options.picture:
        check_output(options.picture, [".png"])
        import_pyvista("--picture")
    if options.plot:
        if os.path.lexists(options.plot) and not options.plot.is_dir():
            raise ValueError(f"--plot: {options.plot} is no folder, in which {PLOT_NAME} is drawn")
        if options.plot.suffix.lower() in PICTURES and not options.plot.exists():
            raise ValueError(f"--plot: {options.plot} names a picture; give a folder, in which {PLOT_NAME} is drawn")
        check_output(options.plot / PLOT_NAME, [".png"], make=True)
        if importlib.util.find_spec("matplotlib") is None:
            raise ValueError("--plot needs Matplotlib: pip install matplotlib")


def _write(options, loaded, frame, chosen) -> list[Path]:
    """Write the files that the options name; return them. `chosen` is the controller and the LODs of each frame."""
    controller, lods = chosen
    if options.picture:
        poses = None if loaded.dynamics is None else frame.motion.dynamics.poses()
        last = None if controller == "none" else loaded.scene.lods
        draw_scene(loaded, options.picture, frame.history[-1].time, poses, last)
    if options.plot:
        options.plot.mkdir(exist_ok=True)
        top = np.array([model.lod_max for model in loaded.scene.models])[loaded.scene.object_model]
        title = f"{loaded.title}: {controller} on {loaded.scene.device}"
        draw_run(frame.history, np.array(lods) / np.maximum(top, 1), options.plot / PLOT_NAME, title)
    return list(filter(None, (options.record, options.picture, options.plot and options.plot / PLOT_NAME)))
