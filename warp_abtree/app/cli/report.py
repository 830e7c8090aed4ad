"""What all commands print and check: JSON for programs, tables for people, names of files that are written."""

import json
import math
import os
import sys
from pathlib import Path

import numpy as np


def plain(value):
    """Return a value that JSON can hold; numbers that are not finite become null, structured arrays lists of rows."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, np.void):
        return {name: plain(value[name]) for name in value.dtype.names or ()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def print_json(value):
    """Print a value as JSON."""
    print(json.dumps(plain(value), indent=1, allow_nan=False))


def print_table(rows, left=1):
    """Print rows of texts, the first of them headings; on a terminal by rich, where it is installed.

    Args:
        left: How many columns are aligned to the left; the others to the right.
    """
    if sys.stdout.isatty() and _print_rich_table(rows, left):
        return
    widths = [max(map(len, column)) for column in zip(*rows)]
    for row in rows:
        cells = zip(row, widths)
        print("  ".join(f"{cell:{'<' if i < left else '>'}{n}}" for i, (cell, n) in enumerate(cells)).rstrip())


def _print_rich_table(rows, left) -> bool:
    """Print a table by rich; return whether rich is installed."""
    try:
        from rich import box
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text
    except ImportError:
        return False
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for i, heading in enumerate(rows[0]):
        table.add_column(Text(heading), justify="left" if i < left else "right", overflow="fold")
    for row in rows[1:]:
        table.add_row(*(Text(cell) for cell in row))
    Console().print(table)
    return True


def check_output(path, suffixes, inputs=(), make=False):
    """Refuse a file that could not be written, or that is one of the inputs, before any work.

    Args:
        path: File.
        suffixes: That its name may have.
        inputs: Files that are read.
        make: Whether its folder will be made in the one above.

    Raises:
        ValueError: With what is wrong.
    """
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name must end in {' or '.join(suffixes)}")
    folder = path.parent.parent if make and not path.parent.exists() else path.parent
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder}")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder")
    if not all(os.access(place, os.W_OK) for place in (folder, path) if place.exists()):
        raise ValueError(f"{path}: cannot be written")
    if path.exists() and any(Path(name).exists() and path.samefile(name) for name in inputs):
        raise ValueError(f"{path}: is read, so it is not overwritten")
