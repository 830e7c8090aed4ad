"""Scene files as typed tables."""

import math
import re
from pathlib import Path

from warp_abtree.app.toml.errors import SceneError, fail
from warp_abtree.app.toml.folder import scene_names

TYPES = {
    "object": "a table",
    "array": "a list",
    "str": "a string",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
}


def import_msgspec(path):
    """Return msgspec, which reads a file.

    Raises:
        SceneError: It is not installed.
    """
    try:
        import msgspec
    except ImportError:
        raise SceneError(f"{path}: scene files need msgspec: pip install msgspec") from None
    return msgspec


def read_tables(path: Path, text: str | None = None):
    """Return the `SceneTable` of a scene file, or of `text` in its place; its models are `ModelTable`s."""
    msgspec = import_msgspec(path)
    from warp_abtree.app.toml import tables

    try:
        text = path.read_bytes().decode() if text is None else text
        tree = msgspec.toml.decode(text)
    except FileNotFoundError as error:
        known = ", ".join(scene_names())
        raise SceneError(f"{path}: {error.strerror}; scenes that come with the package: {known}") from None
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # bytes that are no UTF-8 among them
        raise SceneError(f"{path}: not valid TOML: {error}") from None
    _check_finite(path, "", tree)

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


def _check_finite(path, key, value):
    """Refuse infinities and NaN anywhere, which TOML can write."""
    if isinstance(value, float) and not math.isfinite(value):
        fail(path, key, f"{value} is not a finite number")
    elif isinstance(value, dict):
        for name, entry in value.items():
            _check_finite(path, f"{key}.{name}" if key else name, entry)
    elif isinstance(value, list):
        for i, entry in enumerate(value):
            _check_finite(path, f"{key}[{i}]", entry)


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
    message = re.sub(r"`([a-z |]+)`", lambda found: _in_toml(found[1]), message)
    return key.strip(".") or "the file", message[0].lower() + message[1:]


def _in_toml(types: str) -> str:
    """Return types of msgspec, as "int | null", in the words of TOML."""
    return " or ".join(TYPES.get(name, name) for name in types.split(" | ") if name != "null")
