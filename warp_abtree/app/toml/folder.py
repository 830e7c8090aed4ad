"""Scenes that come with the package: found by their names, from any folder."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[2]


def scene_folder() -> Path:
    """Return the folder of the scenes: `scenes` of a checkout, or of the installed package."""
    checkout = _PACKAGE.parent
    if (checkout / "pyproject.toml").is_file() and (checkout / "scenes").is_dir():
        return checkout / "scenes"
    return _PACKAGE / "scenes"


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the package, sorted."""
    return sorted(path.stem for path in scene_folder().glob("*.toml"))


def find_scene(path) -> Path:
    """Return the file of a scene that comes with the package if `path` is its bare name, else `path`.

    A file of that name in the current folder goes before.
    """
    path = Path(path)
    bare = path.name == str(path) and path.suffix in ("", ".toml")
    return scene_folder() / f"{path.stem}.toml" if bare and not path.is_file() and path.stem in scene_names() else path
