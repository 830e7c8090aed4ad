"""Studies: `python -m bench paper|tradeoff --out DIR`.

A study is a package with PARTS, functions that yield rows, and SUMMARIES, functions of rows that its tables and figures
use. It writes DIR/STUDY.json after each part, and in the end STUDY.md and figures, laid out in STUDY.toml.
"""

import importlib
import json
import os
import platform
import sys
import time
from functools import partial
from pathlib import Path

import warp as wp

import warp_abtree as ab

from .. import tables, timing
from ..__main__ import describe_run
from ..meshes import ModelFolder


class Context:
    """What a part may use.

    Attributes:
        device: `wp.Device`.
        quick: Whether the smallest sizes are asked: all parts together take less than two minutes on two cores.
        notes: What the tables say below, such as a library that is not installed.
    """

    def __init__(self, device, quick, models):
        self.device, self.quick, self.models, self.notes = wp.get_device(device), quick, models, []

    def size(self, full, quick):
        """Return one of two sizes."""
        return quick if self.quick else full

    def model(self, *names, base_faces=10) -> ab.Model:
        """Return the model of the first mesh at hand, see `meshes.ModelFolder.load`; built once and kept on disk."""
        model = self.models.load(names, base_faces)
        if model.name != names[0]:
            self.note(f"{names[0]} is not at hand; {model.name} stands in for it.")
        return model

    def library(self, module):
        """Return an optional module, or None and note that."""
        try:
            return importlib.import_module(module)
        except ImportError as error:
            self.note(f"{module} is skipped: {error}.")
            return None

    def note(self, text):
        """Note something once."""
        if text not in self.notes:
            self.notes.append(text)

    @staticmethod
    def progress(text):
        """Say what is being done."""
        print(f"  {text}", file=sys.stderr, flush=True)

    def time_graphs(self, launches: dict) -> dict:
        """Return the median time [ms] of launches by name, captured as graphs on any device and replayed in turn.

        Turns keep the order of the dict, so launches there and back may stand side by side.
        """
        runs = timing.make_runs(launches, self.device, time.thread_time, captured=True)
        return timing.medians(timing.time_rounds(runs, self.size(21, 5)))

    def time_launches(self, launches, repeats=None, on_core=False) -> dict:
        """Return the median time [ms] of launches by name, in turn: on CUDA of graph replays.

        Else, and of what runs on the host whatever the device (`on_core`), the CPU time of one thread on one core, each
        launch once untimed before: caches are full of what ran before, which may have been large.
        """
        if self.device.is_cuda and not on_core:
            return timing.medians(timing.time_in_turn(launches, self.device, repeats or self.size(9, 3)))
        clocked = {name: timing.time_call(launch, clock=time.thread_time) for name, launch in launches.items()}
        runs = {name: lambda run=run: (run(), run())[1] for name, run in clocked.items()}
        with timing.one_core(), timing.no_garbage_collection():
            return timing.medians(timing.time_rounds(runs, repeats or self.size(7, 3)))


def find_study(name):
    """Return the package of a study."""
    return importlib.import_module(f"{__package__}.{name}")


def describe_device(device) -> str:
    """Return the name of a GPU, or the processor and its cores."""
    return device.name if device.is_cuda else f"{platform.processor()}, {os.cpu_count()} cores"


class StudyError(ValueError):
    """What was asked for is not there."""


def open_folder(device, out, only, names) -> Path:
    """Return the folder to write to, which is made; raise a StudyError where there is no such part or device."""
    wp.config.log_level = wp.LOG_WARNING
    unknown = sorted(set(only or ()) - set(names))
    if unknown:
        raise StudyError(f"no part {', '.join(unknown)}; there are {', '.join(names)}")
    try:
        ab.Scene(device)
        Path(out).mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        raise StudyError(str(error)) from error
    return Path(out)


def run(device, name, out, quick=False, models=None, only=None, command=None):
    """Run the parts of a study, or some of them, and write what they found."""
    parts = find_study(name).PARTS
    out = open_folder(device, out, only, parts)
    folder, file = ModelFolder(models or out / "models"), out / f"{name}.json"
    study = {"study": name, "parts": {}}
    if only and file.is_file():
        study = json.loads(file.read_text(encoding="utf-8"))
    for part in only or parts:
        print(f"{name}: {part}", file=sys.stderr, flush=True)
        context, begin = Context(device, quick, folder), time.perf_counter()
        rows = [{key: tables.plain(value) for key, value in row.items()} for row in parts[part](context)]
        about = {"device": describe_device(context.device), "quick": quick, **describe_run(), "command": command}
        about["seconds"] = tables.plain(time.perf_counter() - begin)
        study["parts"][part] = {"run": about, "notes": context.notes, "rows": rows}
        tables.write_json(file, study)
    (out / f"{name}.md").write_text(tables.study_page(study), encoding="utf-8")
    figures = tables.read_layout(f"studies/{name}.toml")["figure"]
    print(tables.draw(figures, partial(tables.select_rows, study=study), out))
    print(f"wrote {file} and {name}.md")
