"""Scene files as typed tables."""

import math
import re
from itertools import accumulate
from pathlib import Path

from warp_abtree.app.toml.errors import SceneError, fail
from warp_abtree.app.toml.folder import scene_names

FILE_SIZE_LIMIT = 2**24  # bytes of a file
DEPTH_LIMIT = 16  # of tables and lists in one another
TABLE_LIMIT = 2**18  # of a file, those that dotted keys make among them; the parser takes 1 KB for one
# Strings and comments, those without an end among them: all in one pass, without going back.
_QUOTED = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+"{0,5}|"(?:[^"\\\n]|\\.)*+"?'
    r"|'''(?:[^']|'(?!''))*+'{0,5}|'[^'\n]*+'?|#[^\n]*+",
    re.S,
)
_PIECE = re.compile(r"(^[ \t]*\[)?[^\n=,\[\]{}]+(=?)|\{", re.M)  # a header, a key, a value, or an inline table
NO_SCENE = "is no scene file, which is TOML (.toml); info, query, view and picture take meshes and models"
TOML_TYPES = {
    "object": "a table",
    "array": "a list",
    "str": "a string",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
}


def read_tables(path: Path, text: str | None = None):
    """Return the `SceneTable` of a scene file, or of `text` in its place; its models are `ModelTable`s."""
    try:
        import msgspec
    except ImportError:
        raise SceneError(f"{path}: scene files need msgspec: pip install msgspec") from None
    from warp_abtree.app.toml import tables

    try:
        tree = _parse(path, msgspec, text)
    except ValueError as error:  # bytes that are no UTF-8 among them
        if text is None and path.suffix.lower() not in ("", ".toml"):
            raise SceneError(f"{path}: {NO_SCENE}") from None
        raise error if isinstance(error, SceneError) else SceneError(f"{path}: not valid TOML: {error}") from None
    except FileNotFoundError as error:
        known = ", ".join(scene_names())
        raise SceneError(f"{path}: {error.strerror}; scenes that come with the package: {known}") from None
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    _check_values(path, "", tree)

    def convert(table, kind, where=""):
        try:
            return msgspec.convert(table, kind)
        except msgspec.ValidationError as error:
            fail(path, *_explain(str(error), where, tables.CHOICES))

    scene = convert(tree, tables.SceneTable)
    models = {}
    for name, table in scene.models.items():
        models[name] = convert(table, tables.AnyShape if "shape" in table else tables.ModelTable, f"models.{name}")
    return msgspec.structs.replace(scene, models=models)


def _parse(path, msgspec, text: str | None):
    """Return the TOML of a file, or of `text` in its place, as dictionaries and lists."""
    if text is None:
        with open(path, "rb") as file:
            written = file.read(FILE_SIZE_LIMIT + 1)
    else:
        written = text.encode()
    if len(written) > FILE_SIZE_LIMIT:
        fail(path, "the file", f"has more than {FILE_SIZE_LIMIT:,} bytes")
    text = written.decode("utf-8-sig")  # some editors write a mark in front
    _check_text(path, text)
    try:
        return msgspec.toml.decode(text)
    except RecursionError:
        fail(path, f"line {_deepest_line(text)}", f"nested more than {DEPTH_LIMIT} deep")


def _check_text(path, text: str):
    """Refuse what the parser would take too long or too much memory for."""
    bare = _QUOTED.sub(lambda found: "'" + "\n" * found[0].count("\n"), text)
    tables = 0
    for found in _PIECE.finditer(bare):
        dots = found[0].count(".")
        if dots > DEPTH_LIMIT:
            line = bare.count("\n", 0, found.start()) + 1
            fail(path, f"line {line}", f"a key nested more than {DEPTH_LIMIT} deep")
        head = found[1] is not None or found[0] == "{"
        tables += head + (dots if head or found[2] else 0)
    if tables > TABLE_LIMIT:
        fail(path, "the file", f"has more than {TABLE_LIMIT:,} tables")


def _deepest_line(text: str) -> int:
    """Return the line at which the most brackets are open."""
    brackets = list(re.finditer(r"[\[{\]}]", text))
    depths = list(accumulate(1 if found[0] in "[{" else -1 for found in brackets))
    return text.count("\n", 0, brackets[depths.index(max(depths))].start()) + 1


def _check_values(path, key, value, depth=0):
    """Refuse infinities and NaN anywhere, which TOML can write, and what is nested deeper than any key needs."""
    if depth > DEPTH_LIMIT:
        fail(path, key, f"nested more than {DEPTH_LIMIT} deep")
    if isinstance(value, float) and not math.isfinite(value):
        fail(path, key, f"{value} is not a finite number")
    elif isinstance(value, dict):
        for name, entry in value.items():
            _check_values(path, f"{key}.{name}" if key else name, entry, depth + 1)
    elif isinstance(value, list):
        for i, entry in enumerate(value):
            _check_values(path, f"{key}[{i}]", entry, depth + 1)


def _explain(error: str, where: str, choices: dict) -> tuple[str, str]:
    """Return the key that an error of msgspec is about, and what is wrong, in the words of TOML.

    Args:
        error: "MESSAGE - at `$.PATH`", or a message alone about the whole table, whose key is `where`.
        choices: Names that a key may have.
    """
    message, _, place = error.partition(" - at `$")
    key = where + place.rstrip("`")
    if found := re.match(r"Object contains unknown field `(.*)`$", message, re.S):
        return f"{key}.{found[1]}".strip("."), "unknown key"
    if found := re.match(r"Object missing required field `(.*)`$", message):
        return key.strip(".") or "the file", f"the key {found[1]!r} is missing"
    if found := re.match(r"([a-z_.\[\]0-9]+): (.*)", message):  # raised by a table about one of its keys
        return f"{key}.{found[1]}".strip("."), found[2]
    names = choices.get(key.rpartition(".")[2])
    if message.startswith("Invalid") and names:
        return key.strip("."), f"{message.split(' ')[-1]} is none of {', '.join(names)}"
    message = re.sub(
        r"`([a-z |]+)`",
        lambda found: " or ".join(TOML_TYPES.get(name, name) for name in found[1].split(" | ") if name != "null"),
        message,
    )
    return key.strip(".") or "the file", message[0].lower() + message[1:]
