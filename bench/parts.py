"""What a study is made of: parts, whose rows become tables, figures and claims."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

DIGITS = 5  # significant ones of a number that is kept


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: Key in the rows.
        heading: What stands above it, with its unit: "update [ms]".
        format: Format specification of numbers, as ",", ".3g" or ".1%"; text is printed as it is, None as "-".
    """

    name: str
    heading: str
    format: str = ""


@dataclass(frozen=True)
class Table:
    """A table of a part's rows.

    Attributes:
        name: Unique among all studies; the name of the CSV file and of the markers in docs/.
        where: Columns that a row must have at these values to be in the table.
        select: Turns the rows left by `where` into those that are printed; None prints them all.
        note: A paragraph below it.
    """

    name: str
    title: str
    columns: tuple
    where: dict = field(default_factory=dict)
    select: Callable | None = None
    note: str = ""

    def rows(self, rows) -> list:
        """Return the rows that stand in the table."""
        found = pick(rows, **self.where)
        return found if self.select is None else list(self.select(found))


@dataclass(frozen=True)
class Figure:
    """A figure of a part's rows.

    Attributes:
        name: Unique among all studies; the name of the files.
        draw: Called as draw(rows, figure) with a matplotlib Figure of `size` inches in constrained layout; returns
            False where the rows hold nothing to draw.
        note: A paragraph below it.
    """

    name: str
    title: str
    draw: Callable
    size: tuple = (7.0, 4.5)
    note: str = ""


@dataclass(frozen=True)
class Claim:
    """A sentence that the rows bear out or not.

    Attributes:
        text: The claim.
        source: Who claims it: "paper", "section 5.2"; "this project".
        judge: Called as judge(rows); returns (held, finding): held True, False, or None where the rows cannot tell;
            finding says by how much, in numbers.
    """

    text: str
    source: str
    judge: Callable


@dataclass(frozen=True)
class Part:
    """One experiment of a study.

    Attributes:
        name: Unique among all studies; the name of its files.
        run: Called as run(context); yields rows: dicts of plain numbers, strings, booleans and None. It checks its
            answers before it yields a time.
        about: What was done, a paragraph of plain text for the report.
    """

    name: str
    title: str
    run: Callable
    about: str = ""
    tables: tuple = ()
    figures: tuple = ()
    claims: tuple = ()


@dataclass
class Finished:
    """A part that was run: its rows, and how they came about."""

    part: Part
    rows: list
    about_run: dict
    notes: list


def pick(rows, **where) -> list:
    """Return the rows that have all of these values."""
    return [row for row in rows if all(row.get(name) == value for name, value in where.items())]


def plain(value):
    """Return a value of a row as JSON keeps it: floats to `DIGITS` significant digits, no NaN."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if value is None or isinstance(value, str):
        return value
    raise TypeError(f"a row holds a {type(value).__name__}")


def shown(value, form="") -> str:
    """Return a value as a table prints it."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else format(value, form)


def cells(table: Table, rows) -> list:
    """Return the printed cells of a table, row by row."""
    return [[shown(row.get(column.name), column.format) for column in table.columns] for row in table.rows(rows)]
