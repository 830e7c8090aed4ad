"""Studies: `python -m bench paper|tradeoff|all --out DIR`, each a list of parts whose rows become tables and figures.

A part that is finished is kept as DIR/parts/NAME.json and not run again while its settings, its versions and the source
of its module are the same.
"""

import argparse
import datetime
import functools
import hashlib
import importlib
import inspect
import json
import os
import platform
import shlex
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab
from warp_abtree.checks.atomic_write import atomic_write

from . import html, meshes, timing
from .parts import Finished, Part, plain

STUDIES = ("paper", "tradeoff")
STUDY_NAMES = (*STUDIES, "all")


class Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


class Context:
    """What a part may use.

    Attributes:
        device: `wp.Device`.
        quick: Whether the smallest sizes are asked: all parts together take less than two minutes on two cores.
        notes: What the report says below the part, such as a peer that is not installed.
    """

    def __init__(self, device, quick, models, progress):
        self.device, self.quick = wp.get_device(device), quick
        self.progress = progress
        self.notes = []
        self._models = models

    @property
    def models_folder(self) -> Path:
        """Folder that keeps built models, and what else takes long to make."""
        return self._models.folder

    def size(self, full, quick):
        """Return one of two sizes."""
        return quick if self.quick else full

    def model(self, *names, base_faces=10) -> ab.Model:
        """Return the model of the first mesh at hand, see `meshes.ModelFolder.load`; built once and kept on disk."""
        model = self._models.load(names, base_faces, self.progress)
        if model.name != names[0]:
            self.note(f"{names[0]} is not at hand; {model.name} stands in for it.")
        return model

    def has(self, name) -> bool:
        """Return whether a mesh is at hand."""
        return self._models.has(name)

    def peer(self, module):
        """Return an optional module, or None and say so in the report."""
        try:
            return importlib.import_module(module)
        except ImportError as error:
            self.note(f"{module} is skipped: {error}.")
            return None

    def note(self, text):
        """Say something below the part in the report, once."""
        if text not in self.notes:
            self.notes.append(text)

    def time_in_turn(self, launches: dict, repeats=None) -> dict:
        """Return the median time [ms] of launches that only launch, by name, measured in turn.

        Graph replays between events on CUDA, wall clock on the CPU.
        """
        repeats = repeats or self.size(15, 3)
        times = timing.time_in_turn(launches, self.device, repeats)
        return {name: float(np.median(values)) for name, values in times.items()}

    def time_graphs(self, launches: dict, repeats=None) -> dict:
        """Return the median time [ms] of launches by name, captured as graphs on any device and replayed in turn.

        On the CPU a graph costs no Python a launch and runs in this thread, whose own CPU time is taken: others on the
        machine count for little. Turns keep the order of the dict, so launches there and back may stand side by side.
        """
        runs = {}
        for name, launch in launches.items():
            launch()
            graph = timing.capture(launch, self.device)
            replay = functools.partial(wp.capture_launch, graph)
            runs[name] = timing.time_graph(graph, self.device) if self.device.is_cuda else time_thread(replay)
        times = timing.time_rounds(runs, repeats or self.size(21, 5))
        return {name: float(np.median(values)) for name, values in times.items()}

    def time_alone(self, launches: dict, repeats=None) -> dict:
        """Return the median time [ms] of launches that a graph of the CPU cannot hold, by name, in turn.

        As `time_graphs`, but on the CPU called as they are: comparable with it but for some microseconds a launch.
        """
        if self.device.is_cuda:
            return self.time_graphs(launches, repeats)
        times = timing.time_rounds({name: time_thread(x) for name, x in launches.items()}, repeats or self.size(21, 5))
        return {name: float(np.median(values)) for name, values in times.items()}


def time_thread(call):
    """Return a callable that calls something and returns the CPU time that this thread took [ms]."""

    def run():
        begin = time.thread_time_ns()
        call()
        return 1e-6 * (time.thread_time_ns() - begin)

    return run


class Bar:
    """A bar on stderr: parts done, and how far the stage of the present one is; a line a part where it is no terminal.

    Args:
        total: Parts of the study.
    """

    WIDTH = 30

    def __init__(self, total, stream=None):
        self.stream = sys.stderr if stream is None else stream
        self.live = self.stream.isatty()
        self.total, self.number, self.name, self.shown = total, 0, "", 0.0

    def start(self, name, kept):
        """Begin with another part."""
        self.number, self.name = self.number + 1, name
        if not self.live:
            self.stream.write(f"{self.number}/{self.total} {name}{' (kept)' if kept else ' ...'}\n")
            self.stream.flush()
        self("", 0, 1)

    def __call__(self, stage, done, total):
        """Show how much of a stage is done."""
        now = time.monotonic()
        if not self.live or (now - self.shown < 0.1 and 0 < done < total):
            return
        self.shown = now
        part = (self.number - 1 + min(1.0, done / max(total, 1))) / self.total
        bar = "#" * round(self.WIDTH * part)
        self.stream.write(f"\r\x1b[K[{bar:<{self.WIDTH}}] {self.number}/{self.total} {self.name} {stage}"[:110])
        self.stream.flush()

    def close(self):
        """End the line."""
        if self.live:
            self.stream.write("\r\x1b[K")
            self.stream.flush()


def describe_run(device, quick) -> dict:
    """Return what the times of a part depend on: device, versions, size."""
    versions = {"warp": wp.config.version, "warp_abtree": ab.__version__, "numpy": np.__version__}
    name = device.name if device.is_cuda else f"{processor_name()}, {core_count()} cores"
    return {"device": name, "kind": "cuda" if device.is_cuda else "cpu", "quick": quick, **versions} | {
        "python": platform.python_version()
    }


def processor_name() -> str:
    """Return what the processor calls itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def core_count() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def fingerprint(part: Part) -> str:
    """Return a digest of what a part is written in: its module, what that takes from bench/, and the timing."""
    home = inspect.getmodule(part.run)
    used = {home.__name__, __name__, timing.__name__}
    for value in vars(home).values():
        name = value.__name__ if inspect.ismodule(value) else getattr(value, "__module__", None)
        used |= {name} if str(name).startswith(f"{__package__}.") else set()
    sources = (Path(sys.modules[name].__file__).read_bytes() for name in sorted(used))
    return hashlib.sha256(b"".join(sources)).hexdigest()[:16]


def read_part(part: Part, folder: Path, conditions: dict):
    """Return a part that was run under these conditions before, None if there is none."""
    try:
        kept = json.loads((folder / "parts" / f"{part.name}.json").read_text(encoding="utf-8"))
        if all(kept["run"].get(name) == value for name, value in conditions.items()):
            return Finished(part, kept["rows"], kept["run"], kept["notes"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass  # none, or none that can be read
    return None


def run_part(part: Part, context: Context, folder: Path, conditions: dict, command: str) -> Finished:
    """Run a part, keep its rows in a file and return them."""
    begin = time.perf_counter()
    rows = []
    for row in part.run(context):
        rows.append({name: plain(value) for name, value in row.items()})
    run = conditions | {"date": datetime.date.today().isoformat(), "command": command}
    run["seconds"] = plain(time.perf_counter() - begin)
    file = folder / "parts" / f"{part.name}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_text(file, write_json({"run": run, "notes": context.notes, "rows": rows}, 2))
    return Finished(part, rows, run, list(context.notes))


def write_json(data, depth=4) -> str:
    """Return JSON with a line for each member down to a depth, so that a row stands on one line."""
    if depth == 0 or not isinstance(data, dict | list) or not data:
        return json.dumps(data)
    if isinstance(data, list):
        lines = [write_json(item, 0) for item in data]
        return "[\n" + ",\n".join(lines) + "\n]"
    lines = [f"{json.dumps(name)}: {write_json(item, depth - 1)}" for name, item in data.items()]
    return "{\n" + ",\n".join(lines) + "\n}"


def write_text(path: Path, text: str):
    """Write a file that appears whole or not at all."""
    with atomic_write(path, "w", encoding="utf-8") as file:
        file.write(text)


def run_study(name, parts, folder, device=None, quick=False, models=None, command="", again=False, only=None) -> list:
    """Run the parts of a study and write what they found: JSON, CSV, figures and one HTML page.

    Args:
        name: The study's, and that of its files: NAME.json, NAME.html.
        parts: `Part`s, in the order of the report.
        folder: Where to write.
        models: Folder that keeps built models; None is one inside `folder`.
        again: Run parts that are there already.
        only: Names of the parts to run; others are in the report if they are there already.

    Returns:
        `Finished`, one a part.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kept_models = meshes.ModelFolder(models or folder / "models")
    bar = Bar(len(parts))
    finished = []
    try:
        for part in parts:
            context = Context(device, quick, kept_models, bar)
            conditions = describe_run(context.device, quick) | {"source": fingerprint(part)}
            asked = only is None or part.name in only
            done = None if again and asked else read_part(part, folder, conditions)
            bar.start(part.name, done is not None or not asked)
            if done is None and asked:
                done = run_part(part, context, folder, conditions, command)
            finished += [done] if done else []
    finally:
        bar.close()
    write_study(name, finished, folder)
    return finished


def write_study(name, finished, folder: Path):
    """Write JSON, CSV, figures and the HTML page of parts that were run."""
    data = {done.part.name: {"run": done.about_run, "notes": done.notes, "rows": done.rows} for done in finished}
    write_text(folder / f"{name}.json", write_json({"study": name, "parts": data}))
    html.write_tables(finished, folder / "tables")
    drawn = html.draw_figures(finished, folder / "figures")
    write_text(folder / f"{name}.html", html.page(name, finished, drawn))


def find_parts(name) -> tuple:
    """Return the parts of a study: PARTS of the module of its name."""
    return importlib.import_module(f".{name}", __package__).PARTS


def main(argv) -> int:
    """Run `python -m bench paper|tradeoff|all`."""
    parser = Parser(prog="python -m bench", description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=STUDY_NAMES)
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="where to write, and what to resume")
    parser.add_argument("--device", default=None, help='Warp device; by default the first GPU, else "cpu"')
    parser.add_argument("--quick", action="store_true", help="the smallest sizes: under two minutes on two cores")
    parser.add_argument("--models", type=Path, metavar="DIR", help="keep built models there (OUT/models)")
    parser.add_argument("--only", nargs="+", metavar="PART", help="these parts alone")
    parser.add_argument("--again", action="store_true", help="run parts that are finished, too")
    options = parser.parse_args(argv)
    wp.config.log_level = wp.LOG_WARNING
    names = STUDIES if options.name == "all" else (options.name,)
    parts = [part for name in names for part in find_parts(name)]
    unknown = set(options.only or ()) - {part.name for part in parts}
    if unknown:
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(part.name for part in parts)}")
    try:
        ab.Scene(options.device)
        options.out.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    command = shlex.join(["python", "-m", "bench", *argv])
    finished = run_study(
        options.name,
        parts,
        options.out,
        options.device,
        options.quick,
        options.models,
        command,
        options.again,
        options.only,
    )
    for done in finished:
        for claim in done.part.claims:
            held, finding = claim.judge(done.rows)
            print(f"{html.VERDICT[held]:>10}  {done.part.name}: {claim.text}. {finding}")
    print(f"wrote {options.out / options.name}.html")
    return 0
