"""`python -m bench nightly --out DIR`: times of the cases day by day, and what became slower than before.

Each case runs a few times. DIR/history.jsonl takes one line a case: device, versions, and for each series (a row's key
and a column of times) the time of every run. A series became slower where its median is above those of the lines before
by more than its times vary, within a run of this command or from one to the next.
"""

import importlib
import json

import numpy as np
import warp as wp

from .. import tables
from ..__main__ import describe_run
from .study import Context, StudyError, describe_device, open_folder

# What tells the rows of a case apart, whatever is measured.
KEYS = {
    "query": ("faces", "pairs", "distance"),
    "coarse": ("pairs", "distance", "fraction"),
    "update": ("case", "splits", "faces", "states"),
    "frame": ("objects", "ladder"),
    "host": ("pairs", "distance", "output"),
    "sweep": ("model", "case", "poses"),
    "distance": ("workload",),
}
OTHERS = ("peer", "fcl", "bvh", "goal")  # columns that are no time of the library
RUNS, BEFORE = 3, 7  # runs of a case; lines that a new one is compared with
LEAST = 0.05  # fraction below which no change is named: times of one process differ by as much from another's


def run(device, out, only=None, quick=False, command=None):
    """Run the cases, or those of some names, append their lines; say what became slower."""
    folder = open_folder(device, out, only, KEYS)
    lines = read_history(folder / "history.jsonl")
    about = describe_run() | {"device": describe_device(wp.get_device(device)), "quick": quick, "command": command}
    for name in only or KEYS:
        Context.progress(name)
        line = {"case": name, **about, "series": measure(name, device, quick)}
        before = same_kind(lines, line)
        lines.append(line)
        with open(folder / "history.jsonl", "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        for series, was, now, noise in find_slower(before, line["series"]):
            print(f"slower: {name}: {series}: {was:.4g} -> {now:.4g} ms, {now / was:.2f} times; noise {noise:.2f}")
        print(f"{name}: {len(line['series'])} series, {len(before)} lines before", flush=True)


def measure(name, device, quick) -> dict:
    """Return the times [ms] of every series of a case, one a run."""
    case, series = importlib.import_module(f"bench.cases.{name}"), {}
    for _ in range(RUNS):
        for row in case.run(wp.get_device(device), quick=quick):
            key = " ".join(f"{column}={row[column]}" for column in KEYS[name] if column in row)
            for column, value in row.items():
                if not column.endswith("_ms") or column.endswith("_p95_ms") or column.startswith(OTHERS):
                    continue
                if isinstance(value, int | float):
                    series.setdefault(f"{key} {column.removesuffix('_ms')}", []).append(tables.plain(value))
    return series


def read_history(path) -> list:
    """Return the lines of a history, none where there is no file; raise a StudyError at one of another command."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    try:
        lines = list(map(json.loads, lines))
        if all({"case", "device", "quick", "series"} <= set(line) for line in lines):
            return lines
    except (ValueError, TypeError):
        pass
    raise StudyError(f"{path}: a line is none of this command's; move the file away")


def same_kind(lines, line) -> list:
    """Return the last lines of the same case, device and size."""
    kind = ("case", "device", "quick")
    return tables.pick(lines, **{name: line[name] for name in kind})[-BEFORE:]


def find_slower(before, series) -> list:
    """Return (series, median before, median now, noise) of what became slower by more than its own noise [ms].

    The noise is the most that runs of one line, or the medians of the lines before, differ by: a ratio. So it takes two
    lines before.
    """
    found = []
    for name, times in series.items():
        known = [line["series"][name] for line in before if name in line["series"]]
        if len(known) < 2:
            continue
        medians = [float(np.median(values)) for values in known]
        noise = max([max(values) / min(values) for values in (*known, times, medians)])
        was, now = float(np.median(medians)), float(np.median(times))
        if now > was * max(noise, 1 + LEAST):
            found.append((name, was, now, noise))
    return found
