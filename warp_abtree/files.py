"""Files that appear whole or not at all."""

import contextlib
import os
from pathlib import Path


@contextlib.contextmanager
def whole_file(path, mode="wb", **options):
    """Open a file to write that takes its place at a path once it is whole; what stood there before stays until then.

    Args:
        mode, options: As for `open`.

    Raises:
        OSError: The file cannot be written; it names the path that was asked for.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, mode, **options) as file:
            yield file
        os.replace(partial, path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        partial.unlink(missing_ok=True)
