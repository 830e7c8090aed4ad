"""Models that were built before, kept in a folder: a mesh that comes again is opened instead of built.

The folder is $WARP_ABTREE_CACHE if that is set, and none if it is "off"; else $XDG_CACHE_HOME/warp_abtree, else
~/.cache/warp_abtree. It may be deleted at any time. Nothing that goes wrong with it is an error: the model is built.
"""

import contextlib
import hashlib
import os
import re
import stat
from pathlib import Path

import numpy as np

from warp_abtree.checks.atomic_write import atomic_write, sweep_up
from warp_abtree.checks.package import __version__
from warp_abtree.model.files.read import split_file_name

VARIABLE = "WARP_ABTREE_CACHE"
SIZE_LIMIT = 2 << 30  # bytes in the folder; the models that were used least recently go
KEY_DIGITS = 40
_NAME = re.compile(rf"[0-9a-f]{{{KEY_DIGITS}}}\.npz")  # a folder that the user names may hold other files
BUILDER = 5  # grows with each change of what is built of the same mesh
LEAST_FACES = 1_000  # smaller models are built as fast as opened
SELF_CONTAINED = {"obj", "ply", "stl", "off", "glb"}  # other formats may refer to further files


def cache_folder() -> Path | None:
    """Return the folder of the cache, None if it is off or nowhere."""
    named = os.environ.get(VARIABLE, "")
    if named:
        return None if named.lower() == "off" else Path(named).expanduser()
    base = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(base):
        return Path(base) / "warp_abtree"
    try:
        return Path.home() / ".cache" / "warp_abtree"
    except RuntimeError:  # no home
        return None


def file_key(source, *options) -> str | None:
    """Return the key of a model built of a mesh file; None if the file's bytes alone do not decide it."""
    if not isinstance(source, str | os.PathLike):
        return None
    path = Path(source)
    _, kind, zipped = split_file_name(path)
    if kind not in SELF_CONTAINED or not path.is_file():  # what a pipe holds can be read once
        return None
    try:
        data = path.read_bytes()
    except OSError:
        return None
    if kind == "glb" and (zipped or b'"uri"' in data):
        return None
    return _key([data], (kind, zipped), *options)


def mesh_key(mesh, *options) -> str:
    """Return the key of a model built of a `Mesh`."""
    return _key([mesh.vertices.tobytes(), mesh.faces.tobytes()], len(mesh.vertices), *options)


def _key(parts, *options) -> str:
    found = hashlib.blake2b(repr((__version__, BUILDER, *options)).encode(), digest_size=KEY_DIGITS // 2)
    for part in parts:
        found.update(hashlib.blake2b(part).digest())
    return found.hexdigest()


def find_model(key, open_model):
    """Return what `open_model` makes of the file of a key, None if there is none that is whole."""
    path = _path(key)
    if path is None or not path.is_file():  # a pipe would be waited for
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            if str(file["key"]) != key:
                return None
        model = open_model(path)
    except Exception:  # NumPy's readers raise whatever goes wrong inside them
        return None
    with contextlib.suppress(OSError):
        os.utime(path)  # used now
    return model


def error_key(key) -> str | None:
    """Return the key of the certified errors of the model of a key."""
    return None if key is None else _key([], key, "errors")


def find_errors(key, length: int) -> np.ndarray | None:
    """Return the certified errors of a key, float64 (length,), None if there are none that are whole."""

    def read(path):
        with np.load(path, allow_pickle=False) as file:
            errors, digest = file["lod_error"], file["digest"]
        if errors.shape != (length,) or digest.tobytes() != hashlib.blake2b(errors.tobytes()).digest():
            raise ValueError("altered")
        return errors

    return find_model(key, read)


def keep_errors(key, errors: np.ndarray):
    """Write certified errors to the file of a key."""
    digest = np.frombuffer(hashlib.blake2b(errors.tobytes()).digest(), np.uint8)
    keep_model(key, {"lod_error": errors, "digest": digest})


def keep_model(key, arrays):
    """Write the arrays of a model to the file of a key, and make room for it."""
    path = _path(key)
    if path is None or sum(value.nbytes for value in arrays.values()) > SIZE_LIMIT:
        return
    with contextlib.suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        sweep_up(path.parent, _NAME)
        with atomic_write(path) as file:
            np.savez(file, key=np.array(key), **arrays)  # compressing takes longer than building
        _make_room(path)


def _path(key) -> Path | None:
    folder = cache_folder()
    return None if folder is None or key is None else folder / f"{key}.npz"


def _make_room(newest):
    """Remove the models that were used least recently, but not the newest, until the rest is within the limit."""
    files = []
    for path in newest.parent.iterdir():
        with contextlib.suppress(OSError):
            about = path.lstat()
            if _NAME.fullmatch(path.name) and stat.S_ISREG(about.st_mode):
                files.append((path != newest, -about.st_mtime_ns, about.st_size, path))
    total = 0
    for other, _, size, path in sorted(files):
        total += size
        if total > SIZE_LIMIT and other:
            with contextlib.suppress(OSError):
                path.unlink()
