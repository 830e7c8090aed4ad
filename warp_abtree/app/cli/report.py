"""Output of all commands: JSON for programs, lines and tables for people, and checks of files to be written."""

import json
import math
import os
import sys
from pathlib import Path

import numpy as np

from warp_abtree.checks.atomic_write import is_special

LISTED = 20  # rows of a table that are printed
WIDEST = 10_000  # characters of a line that is not for a terminal
MEASURED = ("milliseconds", "seconds")  # of which three digits are more than is sure


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


def print_result(result: dict, as_json: bool, digits=6):
    """Print a result as JSON, or a line for each value and a table for each list or dictionary of rows.

    Numbers that are not whole have so many digits, but in JSON.
    """
    if as_json:
        print(json.dumps(plain(result), indent=1, allow_nan=False))
        return
    for key, value in result.items():
        heading = key.replace("_", " ")
        if isinstance(value, dict) and all(isinstance(row, dict) for row in value.values()):
            value = [{heading: name} | row for name, row in value.items()]
        rows = len(value) if isinstance(value, list) or (isinstance(value, np.ndarray) and value.ndim > 1) else 0
        if rows and (isinstance(value, np.ndarray) or isinstance(value[0], dict)):
            print(f"\n{heading}:")
            table = [list(row.values()) if isinstance(row, dict) else row for row in value[:LISTED]]
            _print_table([*([list(value[0])] if isinstance(value, list) else []), *table], digits)
            print(f"and {rows - LISTED:,} more; --json lists all\n" if rows > LISTED else "")
        elif value is not None and not (isinstance(value, list) and not value):
            print(f"{heading:<24}{_shown(value, 3 if key in MEASURED else digits)}")


def _shown(value, digits) -> str:
    """Return a value as people read it."""
    if isinstance(value, dict):
        return ", ".join(f"{key.replace('_', ' ')} {_shown(entry, digits)}" for key, entry in value.items())
    if isinstance(value, np.ndarray) and value.dtype.kind == "f" and np.isnan(value).all():
        return "none"
    if isinstance(value, list | tuple | np.ndarray):
        return " ".join(_shown(entry, digits) for entry in value)
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return show_number(value, digits)
    return f"{value:,}" if isinstance(value, int | np.integer) else "" if value is None else str(value)


def show_number(value, digits=6) -> str:
    """Return a number of so many digits, or more where it is large: six keep two after the point, four none."""
    value = float(value) + 0.0  # no minus before a zero
    if math.isnan(value):
        return "none"
    whole = len(f"{abs(value):.0f}") if abs(value) < 1e15 else 0
    return f"{value:.{max(digits, whole + digits - 4)}g}"


def _print_table(rows, digits):
    """Print rows of values as a table of rich, or where that is not installed with tabs between them."""
    rows = [[_shown(value, digits) for value in row] for row in rows]
    try:
        from rich.console import Console
        from rich.table import Table
    except ImportError:
        print("\n".join("\t".join(row) for row in rows))
        return
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    for row in rows:
        table.add_row(*row)
    # A file or a pipe takes lines of any length; on a terminal what does not fit goes on in its column.
    Console(width=None if sys.stdout.isatty() else WIDEST, markup=False, highlight=False).print(table)


def check_output(path, suffixes, inputs=(), make=False):
    """Refuse a file that could not be written, unless `make` makes its folder, or that is read, before any work."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name must end in {' or '.join(suffixes)}")
    folder = path.parent.parent if make and not path.parent.exists() else path.parent
    if not folder.is_dir():
        told = f"{folder} is no folder" if folder.exists() else f"there is no folder {folder}"
        raise ValueError(f"{path}: {told}")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder")
    if is_special(path):
        raise ValueError(f"{path}: is neither a file nor a folder")
    if not all(os.access(place, os.W_OK) for place in (folder, path) if place.exists()):
        raise ValueError(f"{path}: cannot be written")
    if path.exists() and any(Path(name).exists() and path.samefile(name) for name in inputs):
        raise ValueError(f"{path}: is read, so it is not overwritten")
