"""python -m bench.tables FILE.json ...: write the tables of these rows into the pages that show them.

A study has a page of its own beside its rows, with all tables. Other pages, README.md and docs/*.md, have tables
between <!-- table FILE NAME --> and <!-- end -->. What tables and figures show is laid out in TOML files beside the
cases and studies.
"""

import importlib
import json
import re
import sys
import tomllib
from pathlib import Path

import numpy as np

from warp_abtree.checks.atomic_write import atomic_write

from .timing import fit_slope, upper_half

HERE = Path(__file__).parent
PAGES = ("README.md", "docs/*.md")
PLACE = re.compile(r"(<!-- table (?P<file>\w+) (?P<table>\w+) -->\n)(?:(?!<!-- table).)*?(<!-- end -->)", re.S)
SHOWN_RUN = ("device", "date", "command", "seconds", "warp", "warp_abtree", "numpy", "python")
DIGITS = 5  # significant ones of a number that is kept
# Okabe and Ito's colours, which people with any colour vision tell apart; lines differ by dashes and markers as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
DASHES = ("-", "--", ":", "-.")
STYLE = {"svg.hashsalt": "warp_abtree", "svg.fonttype": "none"}
STYLE |= {"font.size": 9, "lines.markersize": 4, "lines.linewidth": 1.4}
PANEL = (4.6, 3.9)  # inches


def read_layout(name) -> dict:
    """Return the tables and figures of a TOML file of this folder.

    A table's part is by default that of its name; a column [name, heading, format], or its name alone, has by default
    commas between thousands. What a figure does not say is taken from [figures].
    """
    layout = tomllib.loads((HERE / name).read_text(encoding="utf-8"))
    for table in layout.get("table", {}).values():
        table["columns"] = [[each, each] if isinstance(each, str) else each for each in table["columns"]]
    layout["figure"] = [layout.get("figures", {}) | figure for figure in layout.get("figure", [])]
    return layout | {"table": [{"name": key, "part": key} | table for key, table in layout.get("table", {}).items()]}


def pick(rows, **where) -> list:
    """Return the rows that have all of these values, or one of them where a list is given."""
    wanted = {name: value if isinstance(value, list) else [value] for name, value in where.items()}
    return [row for row in rows if all(row.get(name) in values for name, values in wanted.items())]


def plain(value):
    """Return a value of a row as JSON keeps it: floats to `DIGITS` significant digits, no NaN."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    raise TypeError(f"a row holds a {type(value).__name__}")


def write_json(path, study):
    """Write a study, {"study": name, "parts": {name: {"run", "notes", "rows"}}}, a row on a line."""
    parts = [
        f'{json.dumps(name)}: {{"run": {json.dumps(part["run"])}, "notes": {json.dumps(part["notes"])}, "rows": [\n'
        + ",\n".join(map(json.dumps, part["rows"]))
        + "\n]}"
        for name, part in study["parts"].items()
    ]
    with atomic_write(path, "w", encoding="utf-8") as file:
        file.write(f'{{"study": {json.dumps(study["study"])}, "parts": {{\n' + ",\n".join(parts) + "\n}}\n")


def shown(value, form=",") -> str:
    """Return a value as a table prints it."""
    if value is None or isinstance(value, bool):
        return {None: "-", True: "yes", False: "no"}[value]
    return value.replace("|", "\\|") if isinstance(value, str) else format(value, form)


def select_rows(layout, study):
    """Return the rows of a table or figure: of its part, chosen by `where`, and summarised where it says so.

    A layout's `rows` are [part, where, *texts], each with the values of one row of the study in its texts.
    """
    if "rows" in layout:
        return [show_row(study, layout["columns"], *row) for row in layout["rows"]]
    rows = pick(study["parts"].get(layout["part"], {"rows": []})["rows"], **layout.get("where", {}))
    if rows and "select" in layout:
        rows = importlib.import_module(f"bench.studies.{study['study']}").SUMMARIES[layout["select"]](rows)
    return rows


def show_row(study, columns, part, where, *texts) -> dict:
    """Return a row of texts, the values of one row of the study filled in."""
    (row,) = pick(study["parts"][part]["rows"], **where)
    return {name: text.format(**row) for (name, _), text in zip(columns, texts, strict=True)}


def markdown_table(layout, study, short=None) -> str:
    """Return a table of a study as Markdown; of `short` only its `columns`, and the rows that `where` selects."""
    short = short or {}
    rows = pick(select_rows(layout, study), **short.get("where", {}))
    if not rows:
        return "Not measured in this run."
    columns = []
    for name, heading, *form in layout["columns"]:
        if name in short.get("columns", [name]):
            values = [row.get(name) for row in rows]
            rule = "---" if any(isinstance(value, str) for value in values) else "--:"
            columns.append([heading, rule, *(shown(value, *form) for value in values)])
    return "\n".join("| " + " | ".join(line) + " |" for line in zip(*columns))


def markdown_run(study) -> str:
    """Return what is known of device, date, versions and command as a Markdown list; seconds are summed."""
    runs = [part["run"] for part in study["parts"].values()]
    lines = []
    for key in SHOWN_RUN:
        values = [run[key] for run in runs if key in run]
        text = f"{sum(values):.0f}" if key == "seconds" else ", ".join(dict.fromkeys(map(str, values)))
        if values and (key not in ("device", "command") or len(set(values)) == 1):  # else each table says it
            lines.append(f"- {key}: `{text}`" if key == "command" else f"- {key}: {text}")
    if any(run.get("quick") for run in runs):
        lines.append("- size: quick, to try the parts out, not to be quoted")
    return "\n".join(lines)


def say_run(run) -> str:
    """Return the device and the command of a part."""
    return f"{run['device']}: `{run['command']}`."


def study_page(study) -> str:
    """Return all tables of a study as one Markdown page; each says its device and command where these differ."""
    ran = {name: say_run(part["run"]) for name, part in study["parts"].items()}
    devices = list(dict.fromkeys(part["run"]["device"] for part in study["parts"].values()))
    layout = read_layout(f"studies/{study['study']}.toml")
    title = layout.get("title", f"Study {study['study']}: {', '.join(devices) or 'nothing'}")
    blocks = [f"# {title}", markdown_run(study)]
    for table in layout["table"]:
        if table["part"] in study["parts"]:
            blocks += [f"## {table['title']}"] + [ran[table["part"]]] * (len(set(ran.values())) > 1)
            blocks += [markdown_table(table, study)] + ([table["note"]] if "note" in table else [])
    blocks += [note for part in study["parts"].values() for note in part["notes"]]
    return "\n\n".join(blocks) + "\n"


def fill_page(text, name, study) -> str:
    """Return the text of a page with the tables of a file of rows in their places, each with its device and command.

    Of a layout that has `short` only that is shown; a table that has none is a ValueError.
    """
    layouts = {table["name"]: table for table in read_layout(f"studies/{study['study']}.toml")["table"]}

    def fill(place):
        if place["file"] != name:
            return place[0]
        if place["table"] not in layouts:
            raise ValueError(f"no table {place['table']} in bench/studies/{study['study']}.toml")
        layout, said = layouts[place["table"]], ""
        if layout["part"] in study["parts"]:
            said = f"\n{say_run(study['parts'][layout['part']]['run'])} "
        return f"{place[1]}{markdown_table(layout, study, layout.get('short'))}\n{said}{place[4]}"

    return PLACE.sub(fill, text)


def find_pages(file) -> dict:
    """Return what the pages that show a file's rows hold: a study's own, and all that have places for its tables."""
    study = json.loads(file.read_text(encoding="utf-8"))
    texts = {file.with_suffix(".md"): study_page(study)}
    for page in sorted(path for pattern in PAGES for path in HERE.parent.glob(pattern)):
        text = page.read_text(encoding="utf-8")
        if any(place["file"] == file.stem for place in PLACE.finditer(text)):
            texts[page] = fill_page(text, file.stem, study)
    return texts


def draw(figures, rows, folder) -> str:
    """Draw figures of rows as SVG; return the line that says what was drawn, or why nothing was.

    Args:
        figures: As in a layout: file, and panels side by side (none is one), each with title, x and y (columns, y with
            what they are called), xlabel, ylabel; also where (column to value), by (column whose values are lines of
            their own), unit (the word after these values), split (column whose values are panels of their own), slope
            (whether labels show it), xscale and yscale ("log"). A panel takes what it does not say from its figure.
        rows: A list; or a function that returns those of a figure.
    """
    try:
        import matplotlib
    except ImportError as error:
        return f"plots skipped: {error}"
    from matplotlib.figure import Figure

    Path(folder).mkdir(parents=True, exist_ok=True)
    drawn = []
    with matplotlib.rc_context(STYLE):
        for figure in figures:
            found = rows(figure) if callable(rows) else rows
            whole = {key: value for key, value in figure.items() if key not in ("where", "panels")}
            panels = [pair for panel in figure.get("panels", [{}]) for pair in split_panel(whole | panel, found)]
            panels = [(panel, lines) for panel, own in panels if (lines := find_lines(own, panel))]
            if not panels:
                continue
            columns = min(3, len(panels))
            lines = -(-len(panels) // columns)
            canvas = Figure(figsize=(PANEL[0] * columns, PANEL[1] * lines), layout="constrained")
            for i, (panel, points) in enumerate(panels):
                draw_panel(canvas.add_subplot(lines, columns, i + 1), panel, points)
            canvas.savefig(Path(folder) / figure["file"], metadata={"Date": None})
            drawn.append(figure["file"])
    return f"plots in {folder}: {', '.join(drawn) or 'none'}"


def split_panel(panel, rows):
    """Return (panel, its rows), one for each value of the column that splits it."""
    rows = pick(rows, **panel.get("where", {}))
    if "split" not in panel:
        return [(panel, rows)]
    values = list(dict.fromkeys(row[panel["split"]] for row in rows))
    order = list(dict.fromkeys(row.get(panel.get("by")) for row in rows))
    return [
        (panel | {"title": str(value), "legend": i == 0, "order": order}, pick(rows, **{panel["split"]: value}))
        for i, value in enumerate(values)
    ]


def find_lines(rows, panel) -> dict:
    """Return the points of a panel's lines, by (column, value of `by`)."""
    lines = {}
    logarithmic = [panel.get(name, "log") == "log" for name in ("xscale", "yscale")]
    for row in rows:
        for column in panel["y"]:
            point = row.get(panel["x"]), row.get(column)
            if all(value is not None and (value or not log) for value, log in zip(point, logarithmic)):
                lines.setdefault((column, row.get(panel.get("by"))), []).append(point)
    return lines


def draw_panel(axes, panel, lines):
    columns, parts = list(panel["y"]), panel.get("order") or list(dict.fromkeys(part for _, part in lines))
    axes.set_xscale(panel.get("xscale", "log"))
    scale = panel.get("yscale", "log")
    axes.set_yscale(scale, **({"linthresh": panel["least"], "linscale": 0.4} if scale == "symlog" else {}))
    for (column, part), points in lines.items():
        x, y = zip(*(points if panel.get("unsorted") else sorted(points)), strict=True)
        name = f"{part:,} {panel['unit'].removesuffix('s' if part == 1 else '')}" if "unit" in panel else part
        label = ", ".join(str(text) for text in (panel["y"][column], name if "by" in panel else "") if text != "")
        if panel.get("slope") and len(x) > 1:
            label += f": slope {fit_slope(upper_half(x), upper_half(y)):.2f}"
        turn = columns.index(column)
        colour = parts.index(part) if "by" in panel else turn
        style = {"color": COLOURS[colour % len(COLOURS)], "linestyle": DASHES[turn % len(DASHES)]}
        style["marker"] = MARKERS[max(turn, colour) % len(MARKERS)] if panel.get("markers", True) else ""
        axes.plot(x, y, label=label, **style)
    if panel.get("xscale", "log") == "log":
        label_ticks(axes.xaxis, [x for points in lines.values() for x, _ in points])
    axes.set(title=panel.get("title", ""), xlabel=panel["xlabel"], ylabel=panel["ylabel"])
    if "least" in panel:  # no error is negative
        axes.set_ylim(bottom=-0.3 * panel["least"])
    axes.grid(True, alpha=0.3)
    if panel.get("legend", True):
        axes.legend(fontsize=8, framealpha=0.6)


def label_ticks(axis, values):
    """Label a logarithmic axis so that no two labels overlap, whatever it spans."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axis.set_minor_formatter(NullFormatter())
    if max(values) < 100 * min(values):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")


def main(files) -> int:
    """Write the pages that show these files' rows."""
    for file in map(Path, files):
        for page, text in find_pages(file).items():
            page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
