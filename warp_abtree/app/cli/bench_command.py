"""`warp-abtree bench`: hand over to the benchmarks of a checkout, which an installed package does not carry."""

import importlib
import sys
from pathlib import Path

SUMMARY = "run a benchmark or a study of a checkout (see python -m bench --help there)"
EXAMPLES = ("paper --out found --quick", "tradeoff --out found --device cuda:0", "query --device cpu --json query.json")


def add_arguments(sub):
    """Add the arguments of the command to its parser, which only shows them."""
    sub.add_argument("name", metavar="NAME", help="benchmark or study; python -m bench --help lists them")


def bench(arguments, folder=None) -> int:
    """Run `python -m bench` of a checkout, by default the one of this package, and return its exit status."""
    folder = Path(__file__).resolve().parents[3] if folder is None else Path(folder)
    if not (folder / "bench" / "__main__.py").is_file() or not (folder / "pyproject.toml").is_file():
        raise ValueError("the benchmarks come with a checkout of the project, not with the installed package")
    if not arguments:
        raise ValueError(f"name a benchmark or a study, as in `warp-abtree bench {EXAMPLES[0]}`")
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return importlib.import_module("bench.__main__").main(arguments)
