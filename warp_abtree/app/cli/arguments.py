"""Arguments of the command line: their types, those of `query` and `run`, and completion in shells."""

import argparse
import re
from pathlib import Path

from warp_abtree.app.toml.control import CONTROLLERS
from warp_abtree.app.toml.folder import scene_names

PROGRAM = "warp-abtree"
STATUS = """\
exit status:
  0    done
  1    work was lost, a device failed, or whoever reads the output went away
  2    bad input; one line on stderr says what and where
  130  interrupted (SIGINT)
  143  terminated (SIGTERM)
"""
MESHES = 'a mesh file, gzipped or not, or "warp:bunny", "warp:bear", "warp:rocks"'
_NEGATIVE = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$|^-(inf|nan)$")


class Parser(argparse.ArgumentParser):
    """A parser that raises ValueError in the place of an exit."""

    def error(self, message):
        raise ValueError(f"{message} (see {self.prog} --help)")


def shield_numbers(words) -> list:
    """Return words with a blank before those that argparse would take for options, such as -1e-3."""
    return [f" {word}" if _NEGATIVE.match(word) else word for word in words]


# Types.


def positive(text) -> int:
    """Return a whole number from 1."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no whole number from 1")
    return value


def milliseconds(text) -> float:
    """Return a time above 0 in milliseconds."""
    match = re.fullmatch(r"\s*([\d.eE+-]+)\s*(ms|s)?\s*", text)
    try:
        value = 0.0 if match is None else float(match[1]) * (1e3 if match[2] == "s" else 1.0)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no time above 0, as 8ms or 0.008s")
    return value


# Commands.


def examples_of(name, examples) -> str | None:
    """Return the examples of a command as its help shows them."""
    return "examples:\n" + "\n".join(f"  {PROGRAM} {name} {example}".rstrip() for example in examples)


def add_query_arguments(sub):
    """Add the arguments of `query`."""
    wish = "LOD: a number with a dot is a part of the faces in (0, 1], a whole number a LOD, or tol:X, finest, coarsest"
    sub.add_argument("a", metavar="A", help=f"{MESHES}, or a model that build wrote (.npz)")
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
    sub.add_argument(
        "--output", choices=("any", "count", "faces", "contacts"), default="count", help="what to ask (count)"
    )
    sub.add_argument(
        "--precision",
        choices=("exact", "float32"),
        default="exact",
        help="signs of determinants: exact, or of the rounded ones (exact)",
    )
    sub.add_argument(
        "--record", type=Path, metavar="FILE", help="write face pairs and contacts as .csv, all that is asked as .npz"
    )


def add_run_arguments(sub):
    """Add the arguments of `run`."""
    known = ", ".join(scene_names())
    sub.add_argument(
        "scene",
        metavar="SCENE",
        help=f"scene file (.toml), or one of {known}; or a recorded run (.npz), which runs again",
    )
    sub.add_argument("--frames", type=positive, metavar="N", help="frames to run (the scene's own number)")
    sub.add_argument("--picture", type=Path, metavar="PNG", help="draw the scene, intersecting faces coloured")
    sub.add_argument("--objects", type=positive, metavar="N", help="about so many objects, by other counts or worlds")
    sub.add_argument("--budget", type=milliseconds, metavar="TIME", help="time of a frame to hold, as 8ms or 0.008s")
    sub.add_argument("--controller", choices=CONTROLLERS, help="what chooses LODs (the scene's own, or predictive)")
    sub.add_argument(
        "--record", type=Path, metavar="FILE", help="write a row a frame, .csv or .json; .npz holds all and runs again"
    )
    sub.add_argument("--plot", type=Path, metavar="DIR", help="draw LODs, times and error over the frames there")


# Completion.

_FILES = ("mesh", "a", "b", "scene", "source")  # arguments that are files without being of type Path


class PrintCompletion(argparse.Action):
    """Print the script by which a shell completes commands, options and files."""

    def __call__(self, parser, namespace, values, option_string=None):
        try:
            import shtab
        except ImportError:
            raise ValueError(f"{option_string} needs shtab: pip install shtab") from None
        commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
        for sub in commands.choices.values():
            for action in sub._actions:
                if action.type is Path or action.dest in _FILES:
                    action.complete = shtab.FILE
        print(shtab.complete(parser, values))
        parser.exit()
