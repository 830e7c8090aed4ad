"""python -m bench CASE [--device D] [--json FILE] [...]: one of the cases below, its rows printed as they come.

python -m bench paper|tradeoff --out DIR [...]: a study.
python -m bench nightly --out DIR [...]: what became slower since the command ran before.

`python -m bench NAME --help` lists the options of a name.
"""

import argparse
import datetime
import importlib
import inspect
import json
import platform
import shlex
import sys
from pathlib import Path

import numpy as np
import warp as wp

import warp_abtree as ab

from . import tables

NAMES = "assembly baselines broad budget build coarse distance exact frame gate gradients host motion points query"
CASES = (*NAMES.split(), "libraries", "robot", "scale", "sweep", "update")
STUDIES = {"paper": "study", "tradeoff": "study", "nightly": "nightly"}  # and the modules that run them
# Modules of cases that stand beside what they measure; all others are of their names.
BESIDE = {"broad": "baselines.box_tree", "libraries": "baselines.libraries", "gradients": "contacts.gradients"}
BESIDE |= {"points": "contacts.points", "gate": "gate.compare", "motion": "motions.case", "robot": "motions.robot"}
MODULES = {name: f"bench.{BESIDE.get(name, f'cases.{name}')}" for name in CASES}
MODULES |= {name: f"bench.studies.{module}" for name, module in STUDIES.items()}
FIGURES = ("scale", "update")  # cases whose figures are laid out in cases/figures.toml
# A case, and a study, takes the options that its function `run` has as arguments; a case a `wp.Device` before them.
OPTIONS = {
    "quick": {"action": "store_true", "default": None, "help": "the smallest sizes, to try a case out"},
    "models": {"metavar": "DIR", "help": "keep the models there"},
    "plots": {"metavar": "DIR", "help": "draw figures there"},
    "count": {"type": int, "help": "random pairs, and a tenth as many adversarial ones; configurations; or worlds"},
    "out": {"required": True, "metavar": "DIR", "help": "where to write JSON, tables and figures"},
    "only": {"nargs": "+", "metavar": "PART", "help": "run these parts, or cases, alone; others are kept from before"},
    "before": {"metavar": "TREE", "help": "the other checkout"},
}


class Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message):
        self.exit(2, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(argv=None):
    argv = list(sys.argv[1:] if argv is None else argv)
    name = argv[0] if argv else None
    case = importlib.import_module(MODULES[name]) if name in MODULES else None
    taken = set(inspect.signature(case.run).parameters) if case else set()
    parser = Parser(prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*STUDIES, *CASES])
    parser.add_argument("--device", default=None)
    if name not in STUDIES:
        parser.add_argument("--json", metavar="FILE", help="write the rows to a file as well")
    for option, settings in OPTIONS.items():
        if option in taken or (option == "plots" and name in FIGURES):
            parser.add_argument(f"--{option}", **settings)
    options = parser.parse_args(argv)
    if case is None:
        parser.error(f"name a case or a study before its options: {options.name} ...")
    asked = {key: value for key, value in vars(options).items() if key in taken - {"device"} and value is not None}
    if name in STUDIES:
        try:
            case.run(options.device, **asked, command=shlex.join(["python", "-m", "bench", *argv]))
        except case.StudyError as error:
            parser.error(str(error))
        return 0
    wp.config.log_level = wp.LOG_WARNING
    rows = []
    device = wp.get_device(options.device)
    for row in case.run(device, **asked):
        rows.append({key: tables.plain(value) for key, value in ({"device": device.name} | row).items()})
        print("  ".join(f"{key}={value}" for key, value in rows[-1].items()), flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps({**describe_run(), "rows": rows}, indent=1), encoding="utf-8")
    if name in FIGURES and options.plots:
        figures = tables.pick(tables.read_layout("cases/figures.toml")["figure"], case=name)
        print(tables.draw(figures, rows, options.plots), flush=True)
    return 0


def describe_run():
    """Return versions and date."""
    versions = {"warp": wp.config.version, "warp_abtree": ab.__version__, "numpy": np.__version__}
    return versions | {"python": platform.python_version(), "date": datetime.date.today().isoformat()}


if __name__ == "__main__":
    sys.exit(main())
