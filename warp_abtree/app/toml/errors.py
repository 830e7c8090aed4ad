"""The one line that says what is wrong with a scene file."""

from typing import NoReturn


class SceneError(ValueError):
    """What is wrong with a scene file, with the file and the key, in one line."""


def fail(path, key: str, message) -> NoReturn:
    """Raise SceneError about a key of a file."""
    raise SceneError(" ".join(f"{path}: {key}: {message}".split())) from None
