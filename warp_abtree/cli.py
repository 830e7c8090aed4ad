"""The command line: ``warp-abtree info|build|query|run|bench|view``.

Exit status 0 when done, 2 with one line on stderr for bad input, 1 where work was lost or a device failed.
"""

import argparse
import contextlib
import json
import math
import os
import re
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree import Model, Scene, describe_mesh, load_mesh, load_scene, resolve_lod

PROGRAM = "warp-abtree"
LISTED_FACES = 20  # face pairs that `query --output faces` prints
NOTICE_DELAY = 1.5  # seconds of compiling before a word about it
STAGES = {
    "refine_ms": "refine and refit",
    "move_ms": "move",
    "broad_ms": "broad phase",
    "query_ms": "query",
    "total_ms": "frame",
}
NOT_BUILT = {
    "bench": "bench is not built yet; `python -m bench` in a checkout has what there is",
    "view": "view is not built yet; `run SCENE --picture PNG` draws a scene",
}
_NEGATIVE = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)$")


class UsageError(ValueError):
    """Bad input; the message is the one line to print."""


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise UsageError(f"{message} (see {self.prog} --help)")


# What people see while they wait.


class Progress:
    """A bar on stderr: redrawn in place on a terminal, a line a stage otherwise; drawn only once a stage takes long.

    Args:
        stream: Where to write; None for sys.stderr.
        delay: Seconds before a stage is shown.
    """

    WIDTH = 30

    def __init__(self, stream=None, delay=0.5, clock=time.monotonic):
        self.stream = sys.stderr if stream is None else stream
        self.live = self.stream.isatty()
        self.delay, self.clock = delay, clock
        self.stage, self.began, self.shown = None, 0.0, None

    def __call__(self, stage, done, total):
        """Show how much of a stage is done."""
        now = self.clock()
        if stage != self.stage:
            self.close()
            self.stage, self.began, self.shown = stage, now, None
        if now - self.began < self.delay:
            return
        part = min(done / total, 1.0) if total else 1.0
        if self.live and (self.shown is None or now - self.shown > 0.05 or part == 1.0):
            bar = "#" * round(self.WIDTH * part)
            self.stream.write(f"\r{stage:<10} [{bar:<{self.WIDTH}}] {100 * part:3.0f} %")
        elif not self.live and self.shown is None:
            self.stream.write(f"{stage} ...\n")
        else:
            return
        self.shown = now
        self.stream.flush()

    def close(self):
        """End the line of the last stage."""
        if self.live and self.shown is not None:
            self.stream.write("\r\x1b[K")
            self.stream.flush()
        self.stage = self.shown = None


def start_warp():
    """Start Warp without its banner, and without its native warning on machines that have no NVIDIA driver."""
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    with tempfile.TemporaryFile() as held:
        kept = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            for line in held.read().decode(errors="replace").splitlines():
                if "Could not find or load the NVIDIA CUDA driver" not in line:
                    print(line, file=sys.stderr)


@contextlib.contextmanager
def compile_notice(stream=None, delay=NOTICE_DELAY):
    """Say once on stderr that kernels are being compiled, if that takes longer than a moment."""
    finished = threading.Event()

    def compiling():
        # While Warp compiles a module, a folder with the process id stands in its cache.
        try:
            return any(f"_p{os.getpid()}_t" in entry.name for entry in os.scandir(wp.config.kernel_cache_dir))
        except (OSError, TypeError):
            return False

    def watch():
        busy = 0.0
        while not finished.wait(0.25):
            busy += 0.25 * compiling()
            if busy > delay:
                print("compiling kernels for this machine; later runs find them in a cache", file=stream or sys.stderr)
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()


# Helpers of several commands.


def _plain(value):
    """Return a value that JSON can hold; numbers that are not finite become null."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _print_json(value):
    print(json.dumps(_plain(value), indent=1, allow_nan=False))


def _print_table(rows):
    """Print rows of texts: the first column to the left, the others to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        cells = [cell.ljust(width) if i == 0 else cell.rjust(width) for i, (cell, width) in enumerate(zip(row, widths))]
        print("  ".join(cells).rstrip())


def _load_model(source, progress) -> Model:
    return Model.open(source) if source.lower().endswith(".npz") else Model.load(source, progress=progress)


def _check_output(path, suffixes):
    """Refuse a file that could not be written, before any work."""
    if path.suffix.lower() not in suffixes:
        raise UsageError(f"{path}: the name must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise UsageError(f"{path}: there is no folder {path.parent}")
    if path.is_dir():
        raise UsageError(f"{path}: is a folder")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise UsageError(f"{path}: cannot be written")


# Commands.


def info(options, progress):
    """Say what a mesh file holds."""
    Scene(device=options.device)
    found = describe_mesh(load_mesh(options.mesh))
    if options.json:
        _print_json(found)
        return
    for key, value in found.items():
        print(f"{key.replace('_', ' '):<22}{_shown(value)}")


def _shown(value) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return " ".join(_shown(entry) for entry in value)
    return f"{value:.6g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def build(options, progress):
    """Build a model and save it."""
    _check_output(options.out, [".npz"])
    Scene(device=options.device)
    begin = time.perf_counter()
    model = Model.load(options.mesh, base_faces=options.base_faces, progress=progress)
    seconds = time.perf_counter() - begin
    progress.close()
    model.save(options.out)
    rows = []
    for share in (0.5, 0.2, 0.1, 0.05, 0.01):
        lod = model.lod_for(fraction=share)
        rows.append({"share": share, "lod": lod, "faces": _active(model, lod), "error": model.error_at(lod)})
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
    if options.json:
        _print_json(result)
        return
    print(
        f"{options.out}: {model.face_count:,} faces, {model.vertex_count:,} vertices, {model.lod_max + 1:,} LODs, "
        f"base of {_active(model, 0):,} faces, built in {seconds:.2f} s, {result['bytes'] / 1e6:.1f} MB"
    )
    table = [["faces", "", "LOD", "error", "of the diagonal"]]
    for row in rows:
        numbers = (
            f"{row['faces']:,}",
            f"{row['lod']:,}",
            f"{row['error']:.3g}",
            f"{100 * row['error'] / diagonal:.3g} %",
        )
        table.append([f"{100 * row['share']:g} %", *numbers])
    _print_table(table)


def _active(model, lod):
    return len(model.mesh_at(lod)[2])


def query(options, progress):
    """Intersect two meshes at a pose and two LODs."""
    scene = Scene(device=options.device)
    models = [_load_model(options.a, progress)]
    models.append(models[0] if options.b == options.a else _load_model(options.b, progress))
    progress.close()
    lods = []
    for option, model, wish in (("--lod-a", models[0], options.lod_a), ("--lod-b", models[1], options.lod_b)):
        try:
            lods.append(resolve_lod(model, wish))
        except ValueError as error:
            raise UsageError(f"{option}: {error}") from None
    scene.add(models[0], lod=lods[0])
    try:
        scene.add(models[1], pose=options.pose, lod=lods[1])
    except ValueError as error:
        raise UsageError(f"--{error}") from None
    pair = np.array([[0, 1]])
    scene.intersect(pair, output=options.output)  # loads the kernels, so that the time below is the query's
    begin = time.perf_counter()
    found = scene.intersect(pair, output=options.output)
    milliseconds = 1e3 * (time.perf_counter() - begin)
    bound = sum(model.error_at(lod) for model, lod in zip(models, lods))
    result = {
        "intersects": bool(found.any[0]),
        "count": None if found.count is None else int(found.count[0]),
        "bound": bound,
        "lods": lods,
        "active_faces": [_active(model, lod) for model, lod in zip(models, lods)],
        "node_tests": int(found.node_tests[0]),
        "triangle_tests": int(found.triangle_tests[0]),
        "milliseconds": milliseconds,
        "device": str(scene.device),
    }
    if options.output == "faces":
        result["faces"] = found.faces[:, 1:].tolist()
    if options.json:
        _print_json(result)
        return
    for letter, model, lod, active in zip("AB", models, lods, result["active_faces"]):
        print(f"{letter}: {model.name}, LOD {lod:,} of {model.lod_max:,}, {active:,} of {model.face_count:,} faces")
    print("they intersect" if found.any[0] else "they do not intersect")
    if found.count is not None:
        print(f"intersecting face pairs: {int(found.count[0]):,}")
    print(f"bound on the distance to the original surfaces, error(A) + error(B): {bound:.6g}")
    print(
        f"{milliseconds:.3g} ms on {scene.device}: {result['node_tests']:,} node tests, "
        f"{result['triangle_tests']:,} triangle tests"
    )
    if options.output == "faces" and len(found.faces):
        print("face of A  face of B")
        for a, b in found.faces[:LISTED_FACES, 1:].tolist():
            print(f"{a:9}  {b:9}")
        if len(found.faces) > LISTED_FACES:
            print(f"and {len(found.faces) - LISTED_FACES:,} more; --json lists all")


def run(options, progress):
    """Run a scene file."""
    if options.record:
        _check_output(options.record, [".csv", ".json"])
    if options.picture:
        _check_output(options.picture, [".png"])
        try:
            import matplotlib  # noqa: F401
        except ImportError:
            raise UsageError("--picture needs Matplotlib: pip install matplotlib") from None
    loaded = load_scene(options.scene, device=options.device, progress=progress)
    frames = loaded.frames if options.frames is None else options.frames
    frame = loaded.frame()
    frame.warm_up()
    frame.run(frames, progress=lambda done, total: progress("frames", done, total))
    progress.close()
    if options.record:
        frame.record(options.record)
    if options.picture:
        from warp_abtree.plot import draw_scene

        draw_scene(loaded, options.picture, frame.history[-1].time)
    summary = {
        "title": loaded.title,
        "device": str(loaded.scene.device),
        "time_step": loaded.time_step,
        "models": len(loaded.scene.models),
        "worlds": len(np.unique(loaded.worlds[loaded.worlds >= 0])),
        **frame.summary(),
    }
    if options.json:
        _print_json(summary)
    else:
        _print_summary(summary)
        for path in filter(None, (options.record, options.picture)):
            print(f"wrote {path}")


def _print_summary(summary):
    print(f"{summary['title']}: {summary['frames']} frames on {summary['device']}")
    worlds = f"{summary['worlds']} world{'' if summary['worlds'] == 1 else 's'}"
    span = f"LODs {summary['lod_min']:,} to {summary['lod_max']:,}"
    print(f"{summary['objects']:,} objects of {summary['models']} models in {worlds}, {span}\n")
    table = [["a frame", "mean", "min", "max"]]
    for name, label in (
        ("pairs", "candidate pairs"),
        ("touching", "pairs that intersect"),
        ("hits", "intersecting face pairs"),
        ("faces", "active faces"),
        ("states", "tree states"),
        ("nodes_refitted", "nodes refitted"),
    ):
        spread = summary[name]
        table.append([label, f"{spread['mean']:,.1f}", f"{spread['min']:,.0f}", f"{spread['max']:,.0f}"])
    _print_table(table)
    print()
    table = [["stage [ms]", "mean", "p95", "total"]]
    for name, label in STAGES.items():
        stage = summary["stages"][name]
        table.append([label, f"{stage['mean']:.3f}", f"{stage['p95']:.3f}", f"{stage['total']:.1f}"])
    _print_table(table)


# Arguments.


def _positive(text):
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from 1")
    return value


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = _Parser(
        prog=PROGRAM,
        description="Mesh-mesh interference queries at any level of detail (LOD), in batches, on CUDA or the CPU.",
        epilog=f"examples:\n  {PROGRAM} info cow.obj\n  {PROGRAM} run scenes/bunny_tori.toml --picture bunny_tori.png",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"{PROGRAM} {ab.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, parser_class=_Parser)

    def command(name, function, summary, *examples):
        epilog = (
            "examples:\n" + "\n".join(f"  {PROGRAM} {name} {example}" for example in examples) if examples else None
        )
        sub = commands.add_parser(
            name,
            help=summary,
            description=summary[0].upper() + summary[1:] + ".",
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(function=function)
        sub.add_argument("--device", help='Warp device, "cpu" or "cuda:0"; by default the first GPU, else the CPU')
        sub.add_argument("--json", action="store_true", help="print JSON")
        return sub

    meshes = 'a mesh file, gzipped or not, or "warp:bunny", "warp:bear", "warp:rocks"'
    sub = command("info", info, "say what a mesh holds and what is odd about it", "cow.obj", "warp:bunny --json")
    sub.add_argument("mesh", metavar="MESH", help=meshes)

    sub = command("build", build, "build a model from a mesh and save it", "cow.obj cow.npz --base-faces 100")
    sub.add_argument("mesh", metavar="MESH", help=meshes)
    sub.add_argument("out", metavar="OUT.npz", type=Path, help="file to write")
    sub.add_argument("--base-faces", type=_positive, default=10, metavar="N", help="faces of the coarsest LOD (10)")

    sub = command(
        "query",
        query,
        "intersect two meshes, A at the origin and B at a pose",
        "cow.obj warp:bunny --pose 0.2 0 0 0 0 0 1",
        "cow.npz cow.npz --pose -0.5 0 0 0 0 0 1 --lod-a 0.25 --lod-b tol:0.01 --output faces --json",
    )
    wish = "LOD: a number with a dot is a part of the faces in (0, 1], a whole number a LOD, or tol:X, finest, coarsest"
    sub.add_argument("a", metavar="A", help=f"{meshes}, or a model that build wrote (.npz)")
    sub.add_argument("b", metavar="B", help="the same")
    sub.add_argument(
        "--pose",
        nargs=7,
        type=float,
        default=[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        metavar=("X", "Y", "Z", "QX", "QY", "QZ", "QW"),
        help="pose of B in the frame of A: position and unit quaternion (0 0 0 0 0 0 1)",
    )
    sub.add_argument("--lod-a", default="finest", metavar="LOD", help=f"{wish} (finest)")
    sub.add_argument("--lod-b", default="finest", metavar="LOD", help="the same for B (finest)")
    sub.add_argument("--output", choices=("any", "count", "faces"), default="count", help="what to ask (count)")

    sub = command(
        "run",
        run,
        "run a scene file frame by frame and time its stages",
        "scenes/bunny_tori.toml --picture bunny_tori.png",
        "scenes/herd.toml --frames 10 --device cpu --record herd.csv",
    )
    sub.add_argument("scene", metavar="SCENE.toml", help="scene file; README.md names its keys")
    sub.add_argument("--frames", type=_positive, metavar="N", help="frames to run (the scene's own number)")
    sub.add_argument("--picture", type=Path, metavar="PNG", help="draw the scene, intersecting faces coloured")
    sub.add_argument("--record", type=Path, metavar="FILE", help="write a row a frame, .csv or .json")

    command("bench", None, "benchmarks (not built yet)")
    command("view", None, "look at a scene (not built yet)")
    return parser


def main(argv=None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: Arguments without the program's name; None for those of the process.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    progress = Progress()
    try:
        # argparse takes -1e-3 for an option; with a blank before it, it is a number.
        options, rest = make_parser().parse_known_args([f" {text}" if _NEGATIVE.match(text) else text for text in argv])
        if options.command in NOT_BUILT:
            raise UsageError(NOT_BUILT[options.command])
        if rest:
            raise UsageError(f"unrecognized arguments: {' '.join(rest)} (see {PROGRAM} {options.command} --help)")
        start_warp()
        with compile_notice():
            options.function(options, progress)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader went away; Python must not complain once more when it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, NotImplementedError, MemoryError) as error:
        return _fail(progress, error, 2)
    except RuntimeError as error:  # work was lost, or the device failed
        return _fail(progress, error, 1)
    except KeyboardInterrupt:
        return _fail(progress, "interrupted", 130)
    return 0


def _fail(progress, error, status):
    progress.close()
    print(f"{PROGRAM}: {' '.join(str(error).split()) or type(error).__name__}", file=sys.stderr)
    return status
