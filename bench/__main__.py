"""python -m bench CASE [--device D] [--json FILE] [...]: one of the cases below, its rows printed as they come.

python -m bench paper|tradeoff|all --out DIR [...]: a study, see `python -m bench paper --help`.
"""

import argparse
import datetime
import importlib
import inspect
import json
import platform
import sys
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from . import tables

CASES = (
    "baselines",
    "budget",
    "build",
    "exact",
    "frame",
    "precision",
    "query",
    "scale",
    "scaling",
    "sweep",
    "update",
)
STUDIES = ("paper", "tradeoff", "all")
FIGURES = ("build", "scale", "update")  # laid out in cases/figures.toml
# What only some cases take, by the name of their argument.
OPTIONS = ("count", "devices", "processes", "quick", "largest", "models")


class Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def case_parser():
    parser = Parser(prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*STUDIES, *CASES])
    parser.add_argument("--device", default=None)
    parser.add_argument("--json", metavar="FILE", help="write the rows to a file as well")
    parser.add_argument("--quick", action="store_true", default=None, help="the smallest sizes, to try a case out")
    parser.add_argument("--largest", type=int, metavar="FACES", help="build, scale, update: leave larger meshes out")
    parser.add_argument("--models", metavar="DIR", help="build, scale, update: keep the models there")
    parser.add_argument("--plots", metavar="DIR", help="budget, build, scale, update: draw figures there")
    parser.add_argument("--rows", metavar="FILE", help="with --plots: draw what --json wrote, in place of a run")
    parser.add_argument("--count", type=int, help="exact: random pairs; a tenth as many adversarial ones")
    parser.add_argument("--devices", help="scaling: Warp devices with commas between (cpu,cpu)")
    parser.add_argument("--processes", type=int, help="exact: processes that run the oracle")
    return parser


def main(argv=None):
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv and argv[0] in STUDIES:
        return importlib.import_module("bench.studies.study").main(argv)
    parser = case_parser()
    options = parser.parse_args(argv)
    if options.name in STUDIES:
        parser.error(f"a study is named before its options: {options.name} ...")
    case = importlib.import_module(f"bench.cases.{options.name}")
    asked = {name: getattr(options, name) for name in OPTIONS if getattr(options, name) is not None}
    for name in asked:
        if name not in inspect.signature(case.run).parameters:
            parser.error(f"{options.name} takes no --{name}")
    if options.plots and options.name not in (*FIGURES, "budget"):
        parser.error(f"{options.name} takes no --plots")
    if options.rows and (not options.plots or options.json):
        parser.error("--rows goes with --plots, without --json")
    if options.name == "budget":  # which draws itself, from the rows of its frames
        if options.rows:
            print(case.draw_saved(options.rows))
            return 0
        asked |= {"plots": options.plots} if options.plots else {}
    if options.rows:
        rows = json.loads(Path(options.rows).read_text(encoding="utf-8"))["rows"]
    else:
        rows = print_rows(case.run(options.device, **asked))
    if options.json:
        Path(options.json).write_text(json.dumps({**describe_run(), "rows": rows}, indent=1), encoding="utf-8")
    if options.plots and options.name in FIGURES:
        layout = tables.read_layout("cases/figures.toml")
        figures = [figure for figure in layout["figure"] if figure["case"] == options.name]
        print(tables.draw(figures, rows, options.plots), flush=True)
    return 0


def print_rows(found):
    """Print rows as they come and return them."""
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    for row in found:
        rows.append(row)
        print("  ".join(f"{key}={value}" for key, value in row.items()), flush=True)
    return rows


def describe_run():
    """Return versions and date."""
    versions = {"warp": wp.config.version, "warp_abtree": ab.__version__, "numpy": np.__version__}
    return versions | {"python": platform.python_version(), "date": datetime.date.today().isoformat()}


if __name__ == "__main__":
    sys.exit(main())
