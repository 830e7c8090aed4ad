"""The command line: ``warp-abtree info|build|query|run|sweep|view|picture|bench|doctor``.

Exit status 0 when done, 2 with one line on stderr for bad input, 1 where work was lost or a device failed, 130 and 143
when stopped by SIGINT and SIGTERM.
"""

import argparse
import gc
import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

from warp_abtree.app.cli import bench_command, doctor, report, sweep_command
from warp_abtree.app.cli.arguments import (
    MESHES,
    PROGRAM,
    STATUS,
    Parser,
    PrintCompletion,
    add_query_arguments,
    add_run_arguments,
    examples_of,
    milliseconds,
    positive,
    shield_numbers,
)
from warp_abtree.app.cli.progress import Progress, compile_notice, start_warp
from warp_abtree.app.pictures import picture
from warp_abtree.app.recording import Recording, record_run
from warp_abtree.app.toml.scene_file import load_scene
from warp_abtree.app.viewer import command as view
from warp_abtree.checks.version import __version__
from warp_abtree.model.mesh import describe_mesh, load_mesh, mesh_from_arrays
from warp_abtree.model.model import Model
from warp_abtree.scene.scene import Scene
from warp_abtree.simulate.frame import resolve_lod

PLOT_NAME = "frames.png"
LISTED_SHARES = (0.5, 0.2, 0.1, 0.05, 0.01)  # of the faces, at which `build` says the errors


# Commands.


def info(options, progress):
    """Say what a mesh file or a built model holds."""
    Scene(device=options.device)
    built = sweep_command.is_model(options.mesh)
    found = _describe_model(options.mesh) if built else describe_mesh(load_mesh(options.mesh))
    (report.print_json if options.json else report.print_info)(found)


def _describe_model(path) -> dict:
    model = Model.open(path)
    forest = model.progressive
    found = describe_mesh(mesh_from_arrays(forest.vertex_pos[: model.vertex_count], forest.face_vertex, model.name))
    for key in ("file_vertices", "unreferenced_vertices", "welded_vertices"):
        del found[key]  # a model does not keep them
    return found | {"lods": model.lod_max + 1, "base_faces": _active(model, 0)}


def build(options, progress):
    """Build a model and save it."""
    report.check_output(options.out, [".npz"])
    Scene(device=options.device)
    begin = time.perf_counter()
    model = Model.load(options.mesh, base_faces=options.base_faces, progress=progress)
    seconds = time.perf_counter() - begin
    progress.close()
    model.save(options.out)
    rows = []
    for share in LISTED_SHARES:
        progress("outward bounds", len(rows), len(LISTED_SHARES))
        lod = model.lod_for(fraction=share)
        errors = {f"error_{side}": model.error_at(lod, side=side) for side in ("inward", "outward")}
        rows.append({"share": share, "lod": lod, "faces": _active(model, lod), **errors})
    progress.close()
    diagonal = float(np.linalg.norm(np.ptp(model.mesh_at(model.lod_max)[0], axis=0)))
    result = {
        "file": str(options.out),
        "bytes": options.out.stat().st_size,
        "faces": model.face_count,
        "vertices": model.vertex_count,
        "dropped_faces": len(model.dropped_faces),
        "lods": model.lod_max + 1,
        "base_faces": _active(model, 0),
        "diagonal": diagonal,
        "seconds": seconds,
        "errors": rows,
    }
    (report.print_json if options.json else report.print_build)(result)


def _active(model, lod):
    return len(model.mesh_at(lod)[2])


def query(options, progress):
    """Intersect two meshes at a pose and two LODs."""
    if options.record:
        report.check_output(options.record, [".csv", ".npz"], inputs=(options.a, options.b))
        if options.record.suffix.lower() == ".csv" and options.output in ("any", "count"):
            raise ValueError(f"{options.record}: a row is a face pair; ask --output faces or contacts, or write .npz")
    scene = Scene(device=options.device)
    models = [sweep_command.load_model(options.a, progress)]
    models.append(models[0] if options.b == options.a else sweep_command.load_model(options.b, progress))
    progress.close()
    lods = []
    for option, model, wish in (("--lod-a", models[0], options.lod_a), ("--lod-b", models[1], options.lod_b)):
        try:
            lods.append(resolve_lod(model, wish))
        except ValueError as error:
            raise ValueError(f"{option}: {error}") from None
    scene.add(models[0], lod=lods[0])
    try:
        scene.add(models[1], pose=options.pose, lod=lods[1])
    except ValueError as error:
        raise ValueError(f"--{error}") from None
    pair = np.array([[0, 1]])
    asked = {"output": options.output, "precision": options.precision}
    scene.intersect(pair, **asked)  # loads the kernels, so that the time below is the query's
    begin = time.perf_counter()
    found = scene.intersect(pair, **asked)
    spent = 1e3 * (time.perf_counter() - begin)
    bound = sum(model.error_at(lod) for model, lod in zip(models, lods))
    result = {
        "intersects": bool(found.any[0]),
        "count": None if found.count is None else int(found.count[0]),
        "bound": bound,
        "lods": lods,
        "active_faces": [_active(model, lod) for model, lod in zip(models, lods)],
        "node_tests": int(found.node_tests[0]),
        "triangle_tests": int(found.triangle_tests[0]),
        "milliseconds": spent,
        "device": str(scene.device),
        "precision": options.precision,
    }
    if found.faces is not None:
        result["faces"] = found.faces[:, 1:]
    if found.contacts is not None:
        result["contacts"] = report.flat_contacts(found.contacts)
        result["pair_contacts"] = found.pair_contacts[0]
    if options.record:
        report.record_found(found, options.record)
        result["written"] = [str(options.record)]
    if options.json:
        report.print_json(result)
        return
    report.print_query(result, models, found)
    if options.record:
        print(f"wrote {options.record}")


def run(options, progress):
    """Run a scene file, or a recording again."""
    again = str(options.scene).lower().endswith(".npz")
    _check_run(options, again)
    replay = Recording.open(options.scene) if again else None
    if replay is not None:
        device = options.device or replay.settings["device"]
        loaded = replay.load_scene(options.scene, device=device, progress=progress)
        frames = len(replay.rows) if options.frames is None else options.frames
        if frames > len(replay.rows):
            raise ValueError(f"--frames: {options.scene} has {len(replay.rows)} frames")
        asked = {name: replay.settings[name] for name in ("controller", "budget_ms")}
    else:
        loaded = load_scene(options.scene, device=options.device, progress=progress, objects=options.objects)
        frames = loaded.frames if options.frames is None else options.frames
        asked = {"controller": options.controller, "budget_ms": options.budget}
    # A full collection of what was loaded takes longer than the budget of a frame.
    gc.collect()
    gc.freeze()
    frame, recording = record_run(
        loaded,
        frames,
        replay,
        keep=again or bool(options.record and options.record.suffix.lower() == ".npz"),
        progress=lambda done, total: progress("frames", done, total),
        **asked,
    )
    progress.close()
    different = None if replay is None else replay.difference(recording)
    if different:
        raise RuntimeError(f"{options.scene}: {different}")
    written = _write_run(options, loaded, frame, recording)
    summary = {
        "title": loaded.title,
        "device": str(loaded.scene.device),
        "time_step": loaded.time_step,
        "models": len(loaded.scene.models),
        "meshes": {
            name: {"mesh": model.name, "faces": model.face_count, "base_faces": _active(model, 0)}
            for name, model in loaded.models.items()
        },
        "worlds": len(np.unique(loaded.worlds[loaded.worlds >= 0])),
        "controller": recording.settings["controller"],
        "replay": str(options.scene) if again else None,
        "written": [str(path) for path in written],
        **frame.summary(),
    }
    if options.json:
        report.print_json(summary)
    else:
        report.print_summary(summary)
        for path in written:
            print(f"wrote {path}")


def _check_run(options, again):
    """Refuse options that cannot be met, before any work."""
    if again:
        for name in ("budget", "controller", "objects"):
            if getattr(options, name) is not None:
                raise ValueError(f"--{name}: a recording runs again as it was")
    if options.record:
        report.check_output(options.record, [".csv", ".json", ".npz"], inputs=[options.scene])
    if options.picture:
        report.check_output(options.picture, [".png"])
    if options.plot:
        report.check_output(options.plot / PLOT_NAME, [".png"], make=True)
    for name in ("picture", "plot"):
        if getattr(options, name):
            try:
                import matplotlib  # noqa: F401
            except ImportError:
                raise ValueError(f"--{name} needs Matplotlib: pip install matplotlib") from None


def _write_run(options, loaded, frame, recording):
    """Write what a run was asked to; return the files."""
    if options.record:
        if options.record.suffix.lower() == ".npz":
            recording.save(options.record)
        else:
            frame.record(options.record)
    if options.picture:
        from warp_abtree.app.pictures.plot import draw_scene

        poses = None if loaded.dynamics is None else frame.motion.dynamics.poses()
        chosen = None if recording.settings["controller"] == "none" else loaded.scene.lods
        draw_scene(loaded, options.picture, frame.history[-1].time, poses, chosen)
    if options.plot:
        from warp_abtree.app.pictures.plot import draw_run

        options.plot.mkdir(exist_ok=True)
        top = np.array([model.lod_max for model in loaded.scene.models])[loaded.scene.object_model]
        title = f"{loaded.title}: {recording.settings['controller']} on {loaded.scene.device}"
        draw_run(frame.history, recording.lods / np.maximum(top, 1), options.plot / PLOT_NAME, title)
    return list(filter(None, (options.record, options.picture, options.plot and options.plot / PLOT_NAME)))


# The parser.


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = Parser(
        prog=PROGRAM,
        description="Mesh-mesh interference queries at any level of detail (LOD), in batches, on CUDA or the CPU.",
        epilog=f"examples:\n  {PROGRAM} doctor\n  {PROGRAM} info cow.obj\n"
        f"  {PROGRAM} run bunny_tori --picture bunny_tori.png\n\n{STATUS}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {__version__}")
    shells = ("bash", "zsh", "tcsh", "fish")
    parser.add_argument(
        "--print-completion", action=PrintCompletion, choices=shells, help="print the completion script of a shell"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=Parser)

    def command(name, function, summary, *examples):
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog=examples_of(name, examples),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(function=function)
        sub.add_argument("--device", help='Warp device, "cpu" or "cuda:0"; by default the first GPU, else the CPU')
        sub.add_argument("--json", action="store_true", help="print JSON")
        return sub

    about = "say what a mesh or a built model holds and what is odd about it"
    sub = command("info", info, about, "cow.obj", "cow.npz", "warp:bunny --json")
    sub.add_argument("mesh", metavar="MESH", help=f"{MESHES}, or a model that build wrote (.npz)")

    sub = command("build", build, "build a model from a mesh and save it", "cow.obj cow.npz --base-faces 100")
    sub.add_argument("mesh", metavar="MESH", help=MESHES)
    sub.add_argument("out", metavar="OUT.npz", type=Path, help="file to write")
    sub.add_argument("--base-faces", type=positive, default=10, metavar="N", help="faces of the coarsest LOD (10)")

    sub = command(
        "query",
        query,
        "intersect two meshes, A at the origin and B at a pose",
        "cow.obj warp:bunny --pose 0.2 0 0 0 0 0 1",
        "cow.npz cow.npz --pose -0.5 0 0 0 0 0 1 --lod-a 0.25 --lod-b tol:0.01 --output faces --json",
        "cow.npz cow.npz --pose 0.2 0 0 0 0 0 1 --output contacts --record contacts.csv",
    )
    add_query_arguments(sub)
    sub = command(
        "run",
        run,
        "run a scene frame by frame and time its stages",
        "bunny_tori --picture bunny_tori.png",
        "scenes/herd.toml --frames 10 --device cpu --record herd.csv",
        "rain --budget 8ms --controller paper --plot plots --record rain.npz",
        "rain.npz",
    )
    add_run_arguments(sub)
    command("bench", None, bench_command.SUMMARY, *bench_command.EXAMPLES)
    view.add_arguments(command("view", view.view, view.SUMMARY, *view.EXAMPLES), positive, milliseconds)
    picture.add_arguments(command("picture", picture.picture, picture.SUMMARY, *picture.EXAMPLES), positive)
    words = sweep_command.SUMMARY, *sweep_command.EXAMPLES
    sweep_command.add_arguments(command("sweep", sweep_command.sweep, *words), positive)
    command("doctor", doctor.doctor, doctor.SUMMARY, *doctor.EXAMPLES)
    return parser


class Terminated(SystemExit):
    """SIGTERM came: a command ends as after an interrupt, and removes what it has half written."""


def _terminate(number, frame):
    raise Terminated(128 + number)


def _handle_signals():
    """Let SIGINT and SIGTERM stop the command, although the process may have inherited that they are ignored.

    Shells start background jobs with SIGINT ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # only the main thread may, and signals come there
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminate)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})


def main(argv=None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: Arguments without the program's name; None for those of the process, which then handles signals, too.
    """
    progress = Progress()
    try:
        if argv is None:
            _handle_signals()
        argv = list(sys.argv[1:] if argv is None else argv)
        if argv[:1] == ["bench"] and argv[1:] not in (["-h"], ["--help"]):
            start_warp()
            return bench_command.bench(argv[1:])
        options, rest = make_parser().parse_known_args(shield_numbers(argv))
        if rest:
            raise ValueError(f"unrecognized arguments: {' '.join(rest)} (see {PROGRAM} {options.command} --help)")
        start_warp()
        with compile_notice():
            status = options.function(options, progress) or 0
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader went away; Python must not complain once more when it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, MemoryError) as error:
        return _fail(progress, error, 2)
    except RuntimeError as error:  # work was lost, or the device failed
        return _fail(progress, error, 1)
    except KeyboardInterrupt:
        return _fail(progress, "interrupted", 130)
    except Terminated as error:
        return _fail(progress, "terminated", error.code)
    return status


def _fail(progress, error, status):
    progress.close()
    print(f"{PROGRAM}: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
