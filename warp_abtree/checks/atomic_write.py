"""Atomic writes: a file appears whole or not at all, whoever else writes it and whenever the machine stops."""

import contextlib
import errno
import os
import re
import secrets
import stat
from pathlib import Path
from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows, where a file that is open can be neither removed nor renamed
    fcntl = None  # type: ignore[assignment]

SUFFIX = ".partial"
_PARTIAL = re.compile(rf"(.+)\.\d+-[0-9a-f]{{8}}{re.escape(SUFFIX)}", re.S)


@contextlib.contextmanager
def atomic_write(path, mode="wb", **options):
    """Open a file to write that replaces the one at a path in one step, once it is whole and on the disk.

    The file is written beside the path under a name of its own, so that several processes may write one path: the last
    one to finish wins, and a reader sees one of them whole. What stood there stays if anything fails, and so does
    a pipe or a device. Options are those of `open`. Raises OSError with the path that was asked for.
    """
    path, file = Path(path), None
    if is_special(path):
        raise OSError(errno.EINVAL, "is neither a file nor a folder", str(path))
    if not path.name:  # "", "." or "/"
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    try:
        file = _open_partial(path, mode, options)
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            if fcntl is None:
                file.close()
            os.replace(file.name, path)  # before the lock goes with the file
        _sync_folder(path.parent)
    except OSError as error:
        ours = error.filename in (None, str(path), str(path.parent)) or str(error.filename).endswith(SUFFIX)
        if error.errno is None or not ours:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        if file is not None:
            file.close()
            with contextlib.suppress(OSError):
                os.unlink(file.name)


def _open_partial(path, mode, options) -> IO[Any]:
    """Make and lock a file beside a path, with the permissions of any new file."""
    while True:
        # A long name and what is added to it might pass the limit of the file system.
        name = f"{path.name[:48]}.{os.getpid()}-{secrets.token_hex(4)}{SUFFIX}"
        try:
            file = open(path.with_name(name), mode.replace("w", "x"), **options)
        except FileExistsError:
            continue
        _lock(file, wait=True)
        if os.path.exists(file.name):
            return file
        file.close()  # swept up before it was locked


def _lock(file, wait=False) -> bool:
    """Lock a file until it is closed; return False where another open file holds the lock, or there are no locks."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        return False
    return True


def _sync_folder(folder):
    """Bring the names in a folder to the disk, where the system can."""
    if os.name == "nt":
        return
    try:
        opened = os.open(folder, os.O_RDONLY)
    except PermissionError:  # a folder may be written and not read
        return
    try:
        os.fsync(opened)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):  # file systems without it
            raise
    finally:
        os.close(opened)


def is_special(path) -> bool:
    """Return whether a path, or what a link there leads to, exists and is neither a file nor a folder."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def find_partial(folder, names) -> list[Path]:
    """Return the files in a folder that are half-written ones of `atomic_write` by their names, or were.

    Other programs may call files ".partial": `names` is a compiled pattern of the whole names of what is written there.
    """
    found = []
    for entry in os.scandir(folder):
        shape = _PARTIAL.fullmatch(entry.name)
        if shape and names.fullmatch(shape[1]) and entry.is_file(follow_symlinks=False):
            found.append(Path(entry.path))
    return found


def sweep_up(folder, names):
    """Remove what killed writers left half written in a folder; what is being written stays. `names` as above."""
    for path in find_partial(folder, names):
        # A writer holds the lock of its file until the file has its name.
        with contextlib.suppress(OSError):
            if fcntl is None:
                os.unlink(path)
                continue
            with open(path, "r+b") as file:
                if _lock(file):
                    os.unlink(path)
