"""What the commands hand over: text for people, JSON for programs, and the files of ``query --record``."""

import csv
import json
import math
import os
import sys
from pathlib import Path

import numpy as np

from warp_abtree.checks.atomic_write import atomic_write

LISTED_FACES = 20  # face pairs or contacts that `query` prints
STAGES = {
    "select_ms": "select LODs",
    "refine_ms": "refine and refit",
    "move_ms": "move",
    "broad_ms": "broad phase",
    "query_ms": "query",
    "answer_ms": "answer",
    "cost_ms": "select to query, without move",
    "total_ms": "frame",
}


# JSON.


def plain(value):
    """Return a value that JSON can hold; numbers that are not finite become null, structured arrays lists of rows."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.void):
        return {name: plain(value[name]) for name in value.dtype.names or ()}
    if isinstance(value, np.ndarray):
        return [plain(entry) for entry in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def flat_contacts(contacts) -> list[dict]:
    """Return the contacts of one object pair as a dictionary each, their faces under `face_a` and `face_b`."""
    names = contacts.dtype.names[2:]
    return [
        {"face_a": a, "face_b": b, **{name: row[name] for name in names}}
        for row, (a, b) in zip(contacts, contacts["faces"].tolist())
    ]


def print_json(value):
    """Print a value as JSON."""
    print(json.dumps(plain(value), indent=1, allow_nan=False))


# Text.


def print_table(rows, left=1):
    """Print rows of texts, the first of them headings; on a terminal by rich, where it is installed.

    Args:
        left: How many columns stand to the left; the others stand to the right.
    """
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    if sys.stdout.isatty() and _print_rich_table(rows, left, sum(widths) + 3 * len(widths)):
        return
    for row in rows:
        cells = [
            cell.ljust(width) if i < left else cell.rjust(width) for i, (cell, width) in enumerate(zip(row, widths))
        ]
        print("  ".join(cells).rstrip())


def _print_rich_table(rows, left, width) -> bool:
    """Print a table by rich; return whether that was done: a table wider than the terminal would lose its ends."""
    try:
        from rich import box
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text
    except ImportError:
        return False
    console = Console()
    if width > console.width:
        return False
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for i, heading in enumerate(rows[0]):
        table.add_column(Text(heading), justify="left" if i < left else "right", no_wrap=True)
    for row in rows[1:]:
        table.add_row(*(Text(cell) for cell in row))
    console.print(table)
    return True


def print_info(found):
    """Print what `describe_mesh` found."""
    for key, value in found.items():
        print(f"{key.replace('_', ' '):<22}{_shown(value)}")


def _shown(value) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return " ".join(_shown(entry) for entry in value)
    return f"{value:.6g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def print_build(result):
    """Print how large a model became, and both sides of its error at some parts of the faces."""
    print(
        f"{result['file']}: {result['faces']:,} faces, {result['vertices']:,} vertices, {result['lods']:,} LODs, "
        f"base of {result['base_faces']:,} faces, built in {result['seconds']:.2f} s, {result['bytes'] / 1e6:.1f} MB"
    )
    print("certified errors: no point of the one surface lies farther than this from the other")
    table = [["faces", "", "LOD", "original to LOD", "of the diagonal", "LOD to original", "of the diagonal"]]
    for row in result["errors"]:
        table.append([f"{100 * row['share']:g} %", f"{row['faces']:,}", f"{row['lod']:,}"])
        for side in ("inward", "outward"):
            error = row[f"error_{side}"]
            table[-1] += [f"{error:.3g}", f"{100 * error / result['diagonal']:.3g} %"]
    print_table(table)


def print_query(result, models, found):
    """Print what was asked of two models, what was found, and what it took.

    Args:
        result: Values that `query --json` prints.
        models: The two `Model`.
        found: `Result` of the one object pair.
    """
    for letter, model, lod, active in zip("AB", models, result["lods"], result["active_faces"]):
        print(f"{letter}: {model.name}, LOD {lod:,} of {model.lod_max:,}, {active:,} of {model.face_count:,} faces")
    print("they intersect" if result["intersects"] else "they do not intersect")
    if result["count"] is not None:
        print(f"intersecting face pairs: {result['count']:,}")
    if found.pair_contacts is not None and result["count"]:
        pair = found.pair_contacts[0]
        print(f"mean point of the contacts: {_vector(pair['point'])}")
        print(f"mean normal, from A to B: {_vector(pair['normal'])}")
        print(f"depth along it, an estimate: {pair['depth']:.6g}")
    print(f"originals lie within this of the surfaces asked, error(A) + error(B): {result['bound']:.6g}")
    print(
        f"{result['milliseconds']:.3g} ms on {result['device']}, precision {result['precision']}: "
        f"{result['node_tests']:,} node tests, {result['triangle_tests']:,} triangle tests"
    )
    if found.faces is not None and len(found.faces):
        _print_faces(found)


def _vector(values, digits=6):
    return " ".join(f"{value + 0.0:.{digits}g}" for value in values.tolist())  # + 0.0: no minus before a zero


def _print_faces(found):
    """Print a line for each of the first face pairs, with their contacts if they were asked."""
    table = [["face of A", "face of B"]]
    if found.contacts is not None:
        table[0] += [*"p0 x,y,z,p1 x,y,z,normal x,y,z".split(","), ""]
    for row, (a, b) in enumerate(found.faces[:LISTED_FACES, 1:].tolist()):
        table.append([f"{a:9}", f"{b:9}"])
        if found.contacts is not None:
            contact = found.contacts[row]
            for name in ("p0", "p1", "normal"):
                table[-1] += _vector(contact[name], digits=4).split()
            table[-1].append("coplanar" if contact["coplanar"] else "")
    print_table(table)
    if len(found.faces) > LISTED_FACES:
        print(f"and {len(found.faces) - LISTED_FACES:,} more; --json lists all, --record writes them")


def print_summary(summary):
    """Print counts and times over the frames of a scene."""
    print(f"{summary['title']}: {summary['frames']} frames on {summary['device']}")
    worlds = f"{summary['worlds']} world{'' if summary['worlds'] == 1 else 's'}"
    span = f"LODs {summary['lod_min']:,} to {summary['lod_max']:,}"
    print(f"{summary['objects']:,} objects of {summary['models']} models in {worlds}, {span}\n")
    table = [["model", "faces", "of the base", "mesh"]]
    for name, mesh in summary["meshes"].items():
        table.append([name, f"{mesh['faces']:,}", f"{mesh['base_faces']:,}", mesh["mesh"]])
    print_table(table)
    print()
    table = [["a frame", "mean", "min", "max"]]
    for name, label in (
        ("pairs", "candidate pairs"),
        ("intersecting", "pairs that intersect"),
        ("hits", "intersecting face pairs"),
        ("faces", "active faces"),
        ("states", "tree states"),
        ("nodes_refitted", "nodes refitted"),
    ):
        spread = summary[name]
        table.append([label, f"{spread['mean']:,.1f}", f"{spread['min']:,.0f}", f"{spread['max']:,.0f}"])
    print_table(table)
    print()
    table = [["stage [ms]", "mean", "p95", "total"]]
    for name, label in STAGES.items():
        stage = summary["stages"][name]
        table.append([label, f"{stage['mean']:.3f}", f"{stage['p95']:.3f}", f"{stage['total']:.1f}"])
    print_table(table)
    print()
    _print_budget(summary)
    if summary.get("replay"):
        print(f"as recorded in {summary['replay']}: every row, LOD and pose, bit for bit")


def _print_budget(summary):
    """Print how a budget was held, and what it cost in accuracy."""
    mean, greatest = summary["error_mean"]["mean"], summary["error_max"]["max"]
    print(f"certified error of the objects, original to LOD: {mean:.3g} on average, at most {greatest:.3g}")
    if summary["budget_ms"] is None:
        return
    print(f"budget: {summary['budget_ms']:g} ms, {summary['controller']} controller")
    budget = summary["budget"]
    if budget is None:
        print("no frame after the first second, so the budget is not judged")
        return
    print(
        f"after the first second: {100 * budget['within']:.1f} % of {budget['frames']} frames within it, "
        f"{100 * budget['within_110_percent']:.1f} % within 10 % more; the worst took {budget['worst']:.2f} of it, "
        f"{budget['longest_over']} in a row were over; "
        f"the LOD of an object reversed {budget['oscillations']:.2f} times a second"
    )


# Files.


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


def record_found(found, path: Path):
    """Write what a query found on one object pair; the file appears whole or not at all.

    A .npz file holds the arrays of `Result` by their names, those that were asked. A .csv file has a row for each face
    pair, with its contact if that was asked; the summary over an object pair has no place there.
    """
    if path.suffix.lower() == ".npz":
        names = ("any", "count", "faces", "contacts", "pair_contacts")
        arrays = {name: getattr(found, name) for name in names if getattr(found, name) is not None}
        with atomic_write(path) as file:
            np.savez(file, **arrays)
    else:
        with atomic_write(path, "w", newline="", encoding="utf-8") as file:
            _write_rows(csv.writer(file), found)


def _write_rows(writer, found):
    header, columns = ["face_a", "face_b"], [found.faces[:, 1:]]
    if found.contacts is not None:
        for name in ("p0", "p1", "normal_a", "normal_b", "normal"):
            header += [f"{name}_{axis}" for axis in "xyz"]
            columns.append(found.contacts[name])
        header.append("coplanar")
        columns.append(found.contacts["coplanar"].astype(int)[:, None])
    writer.writerow(header)
    for parts in zip(*(column.tolist() for column in columns)):
        writer.writerow([entry for part in parts for entry in part])
