"""Arguments of the command line: the parser, types of numbers, and completion in shells."""

import argparse
import contextlib
import re

from warp_abtree.app.toml.folder import scene_names

PROGRAM = "warp-abtree"
EXIT_STATUS = """\
exit status:
  0    done
  1    work was lost, a device failed, the reader of the output went away, or `clash` found interference
  2    bad input; one line on stderr says what and where
  130  interrupted (SIGINT)
  143  terminated (SIGTERM)
"""
MESHES = 'a mesh file, gzipped or not, or "warp:bunny", "warp:bear", "warp:rocks"'
LOD_HELP = "a number with a dot is a fraction of the faces in (0, 1], a whole number a LOD, or tol:X, finest, coarsest"
PRECISION_NAMES = ("exact", "float32")
SCENES_FUNCTION = "_warp_abtree_scenes"  # of the completion scripts
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NEGATIVE = re.compile(rf"-({_NUMBER}|inf|nan)$")


class Parser(argparse.ArgumentParser):
    """A parser that raises ValueError in the place of an exit."""

    def error(self, message):
        raise ValueError(f"{message} (see {self.prog} --help)")

    def add_file(self, *names, **options):
        """Add an argument that is a file, which shells complete."""
        action = self.add_argument(*names, **options)
        with contextlib.suppress(ImportError):
            import shtab

            action.complete = shtab.FILE  # type: ignore[attr-defined]
        return action

    def add_scene(self, *names, **options):
        """Add an argument that is a file or the name of a scene of the package, which shells complete."""
        action = self.add_file(*names, **options)
        if hasattr(action, "complete"):
            action.complete = {**action.complete, **dict.fromkeys(("bash", "zsh"), SCENES_FUNCTION)}
            action.complete["fish"] = " ".join(("(__fish_complete_path)", *scene_names()))

    def add_flag(self, name: str, about: str, default: bool | None = False):
        """Add an option that is true where it is given."""
        self.add_argument(name, action="store_true", default=default, help=about)

    def add_number(self, name: str, about: str, kind=float, default=None):
        """Add an option of a number, or of a whole number by `positive_count`."""
        self.add_argument(name, type=kind, default=default, metavar="X" if kind is float else "N", help=about)

    def add_pose(self, about: str, **options):
        """Add `--pose`, a position and a quaternion."""
        names = ("X", "Y", "Z", "QX", "QY", "QZ", "QW")
        self.add_argument("--pose", nargs=7, type=float, metavar=names, help=about, **options)


def shield_numbers(words) -> list:
    """Return words with a blank before those that argparse would take for options, such as -1e-3."""
    return [f" {word}" if _NEGATIVE.match(word) else word for word in words]


def positive_count(text) -> int:
    """Return a whole number from 1."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no whole number from 1")
    return value


def milliseconds(text) -> float:
    """Return a time above 0, in ms or s, in milliseconds."""
    match = re.fullmatch(rf"\s*(\+?{_NUMBER})\s*(ms|s|)\s*", text)
    value = 0.0 if match is None else float(match[1]) * (1e3 if match[2] == "s" else 1.0)
    if match is None or not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no time above 0, as 8ms or 0.008s")
    if not match[2]:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} has no unit; give {match[1]}ms or {match[1]}s")
    return value


class PrintCompletion(argparse.Action):
    """Print the script by which a shell completes commands, options, files and scenes."""

    def __call__(self, parser, namespace, values, option_string=None):
        try:
            import shtab
        except ImportError:
            raise ValueError(f"{option_string} needs shtab: pip install shtab") from None
        scenes = " ".join(scene_names())
        bash = f'compgen -W "{scenes}" -- "$1"; compgen -f -- "$1"'
        bodies = {"bash": bash, "zsh": f"_alternative 'scenes:scene:({scenes})' 'files:file:_files'"}
        preamble = {shell: f"{SCENES_FUNCTION}() {{ {body}; }}" for shell, body in bodies.items()}
        print(shtab.complete(parser, values, preamble=preamble.get(values, "")))
        parser.exit()
