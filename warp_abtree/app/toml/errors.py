"""The one line that says what is wrong with a scene file."""

from typing import NoReturn

KEY_SHOWN, MESSAGE_SHOWN = 100, 300  # characters of an error


class SceneError(ValueError):
    """What is wrong with a scene file, with the file and the key, in one line."""


def fail(path, key: str, message) -> NoReturn:
    """Raise SceneError about a key of a file."""
    told = f"{path}: {_cut(str(key), KEY_SHOWN)}: {_cut(str(message), MESSAGE_SHOWN)}"
    raise SceneError(" ".join(told.split())) from None


def _cut(text: str, length: int) -> str:
    """Return a text without its middle if it is longer."""
    return text if len(text) <= length else f"{text[: length // 2]} ... {text[-length // 2 :]}"
