"""python -m bench NAME [--device D] [--json FILE] [...]: one of the cases below, its rows printed as they come.

python -m bench paper|tradeoff|all --out DIR [...]: a study, see `bench/study.py`.
"""

import datetime
import inspect
import json
import platform
import sys

import numpy as np
import warp as wp

import warp_abtree as ab

from . import (
    budget,
    build,
    exact,
    frame,
    memory,
    peers,
    plots,
    precision,
    query,
    scale,
    scaling,
    study,
    sweep,
    update,
)

CASES = {
    "budget": budget.run,
    "build": build.run,
    "exact": exact.run,
    "frame": frame.run,
    "memory": memory.run,
    "peers": peers.run,
    "precision": precision.run,
    "query": query.run,
    "scale": scale.run,
    "scaling": scaling.run,
    "sweep": sweep.run,
    "update": update.run,
}
FIGURES = {"build": build.FIGURES, "scale": scale.FIGURES, "update": update.FIGURES}
# Cases that take the folder of their figures themselves, and how each draws what it kept there.
DRAWN = {"budget": budget.draw_saved}
# What only some cases take, by the name of their argument.
OPTIONS = ("count", "devices", "predict", "processes", "quick", "largest", "models")


def main(argv=None):
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv and argv[0] in study.STUDY_NAMES:
        return study.main(argv)
    parser = study.Parser(prog="python -m bench", description=__doc__)
    parser.add_argument("name", choices=[*study.STUDY_NAMES, *sorted(CASES)])
    parser.add_argument("--device", default=None)
    parser.add_argument("--json", metavar="FILE", help="write the rows to a file as well")
    parser.add_argument("--quick", action="store_true", default=None, help="the smallest sizes, to try a case out")
    parser.add_argument("--largest", type=int, metavar="FACES", help="build, scale, update: leave larger meshes out")
    parser.add_argument("--models", metavar="DIR", help="build, memory, scale, update: keep the models there")
    parser.add_argument("--plots", metavar="DIR", help="budget, build, scale, update: draw figures there")
    parser.add_argument("--rows", metavar="FILE", help="with --plots: draw what --json wrote, in place of a run")
    parser.add_argument("--count", type=int, help="exact: random pairs; a tenth as many adversarial ones")
    parser.add_argument("--devices", help="scaling: Warp devices with commas between (cpu,cpu)")
    parser.add_argument("--predict", metavar="FILE", help="scaling: read what --json wrote, and predict from it")
    parser.add_argument("--processes", type=int, help="exact: processes that run the oracle")
    options = parser.parse_args(argv)
    if options.name in study.STUDY_NAMES:
        parser.error(f"a study is named before its options: {options.name} ...")
    run = CASES[options.name]
    asked = {name: getattr(options, name) for name in OPTIONS if getattr(options, name) is not None}
    for name in asked:
        if name not in inspect.signature(run).parameters:
            parser.error(f"{options.name} takes no --{name}")
    if options.plots and options.name not in (*FIGURES, *DRAWN):
        parser.error(f"{options.name} takes no --plots")
    if options.rows and (not options.plots or options.json):
        parser.error("--rows goes with --plots, without --json")
    if options.name in DRAWN and options.rows:
        print(DRAWN[options.name](options.rows))
        return 0
    if options.name in DRAWN and options.plots:
        asked["plots"] = options.plots
    if options.rows:
        with open(options.rows) as file:
            rows = json.load(file)["rows"]
    else:
        rows = print_rows(run(options.device, **asked))
    if options.json:
        with open(options.json, "w") as file:
            json.dump({**describe_run(), "rows": rows}, file, indent=1)
    if options.plots and options.name in FIGURES:
        print(plots.draw(rows, FIGURES[options.name], options.plots), flush=True)
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
