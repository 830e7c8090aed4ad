"""One HTML page of a study that needs no other file, its figures as SVG and PNG, and its tables as CSV."""

import base64
import csv
import html as text
import math
import sys
from pathlib import Path

from .parts import cells

# Okabe and Ito's colours, told apart by colour-blind people as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
STYLES = ("-", "--", ":", "-.")
VERDICT = {True: "held", False: "not held", None: "undecided"}
SHOWN_RUN = ("device", "date", "command", "seconds", "warp", "warp_abtree", "numpy", "python")

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 68em; margin: 2em auto; padding: 0 1em; color: #111 }
h1 { font-size: 1.6em } h2 { font-size: 1.25em; margin-top: 2.2em; border-top: 1px solid #bbb; padding-top: .8em }
h3 { font-size: 1em; margin: 1.4em 0 .3em }
table { border-collapse: collapse; font-size: .88em; margin: .3em 0 }
th, td { padding: .2em .7em; border-bottom: 1px solid #ddd; text-align: right; vertical-align: top }
th { border-bottom: 2px solid #888; font-weight: 600 }
.text, .name { text-align: left } .name { white-space: nowrap } .scroll { overflow-x: auto }
.held, .not { white-space: nowrap } .held { color: #00634a } .not { color: #a33b00 }
.note { color: #444; font-size: .9em }
figure { margin: 1em 0; break-inside: avoid } figure img { max-width: 100%; height: auto }
figcaption { color: #444; font-size: .9em }
dl { display: grid; grid-template-columns: max-content auto; gap: .1em 1em; font-size: .9em } dd { margin: 0 }
code { font-size: .92em }
@media print {
body { max-width: none; margin: 0; font-size: 10.5pt } h2, h3 { break-after: avoid } tr { break-inside: avoid }
a { color: inherit; text-decoration: none } .scroll { overflow: visible } nav { display: none } }
"""


def write_tables(finished, folder: Path):
    """Write every table of finished parts as CSV, numbers whole."""
    for done in finished:
        for table in done.part.tables:
            rows = table.rows(done.rows)
            if not rows:
                continue
            folder.mkdir(parents=True, exist_ok=True)
            with open(folder / f"{table.name}.csv", "w", newline="", encoding="utf-8") as file:
                writer = csv.writer(file)
                writer.writerow([column.heading for column in table.columns])
                writer.writerows([[row.get(column.name) for column in table.columns] for row in rows])


def plain_ticks(axis, low, high):
    """Let a logarithmic axis between two numbers have plain numbers as ticks, two at least and no more than fit."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    steps = {6: (1, 1.5, 2, 3, 4, 5, 7), 30: (1, 2, 5), 300: (1, 3), math.inf: (1,)}
    axis.set_major_locator(LogLocator(subs=next(subs for span, subs in steps.items() if high < span * low)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_figures(finished, folder: Path) -> dict:
    """Draw every figure of finished parts as SVG and PNG; return the SVG files by figure name.

    Returns an empty dict where matplotlib is not installed.
    """
    try:
        import matplotlib
    except ImportError as error:
        print(f"plots skipped: {error}", file=sys.stderr)
        return {}
    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    drawn = {}
    setup = {
        "svg.hashsalt": "warp_abtree",
        "axes.prop_cycle": matplotlib.cycler(color=COLOURS),
        "axes.grid": True,
        "grid.alpha": 0.3,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "legend.frameon": False,
        "legend.fontsize": "small",
        "legend.handlelength": 3.2,
        "lines.markersize": 4,
        "font.size": 10,
    }
    with matplotlib.rc_context(setup):
        for done in finished:
            for figure in done.part.figures:
                canvas = Figure(figsize=figure.size, layout="constrained")
                if figure.draw(done.rows, canvas) is False:
                    continue
                folder.mkdir(parents=True, exist_ok=True)
                for ending in ("svg", "png"):
                    metadata = {"Date": None} if ending == "svg" else None
                    canvas.savefig(folder / f"{figure.name}.{ending}", dpi=150, metadata=metadata)
                drawn[figure.name] = folder / f"{figure.name}.svg"
    return drawn


def page(name, finished, drawn) -> str:
    """Return the HTML page of finished parts."""
    parts = "\n".join(_section(done, drawn) for done in finished)
    links = " · ".join(f'<a href="#{done.part.name}">{text.escape(done.part.title)}</a>' for done in finished)
    claims = "".join(_claim_row(done.part, *row) for done in finished for row in judge(done))
    summary = (
        f'<h2>Claims</h2><table><tr><th class="text">claim</th><th class="text">held?</th><th class="text">found</th>'
        f"</tr>{claims}</table>"
        if claims
        else ""
    )
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>warp_abtree: {text.escape(name)}</title><style>{STYLE}</style></head><body>
<h1>warp_abtree: {text.escape(name)}</h1>
{_facts(common_run(finished))}
<nav class="note">{links}</nav>
{summary}
{parts}
</body></html>
"""


def common_run(finished) -> dict:
    """Return what to say of the runs of several parts: values that differ side by side, seconds summed."""
    found = {}
    for key in SHOWN_RUN:
        values = [done.about_run[key] for done in finished if key in done.about_run]
        if key == "seconds":
            found[key] = f"{sum(values):.0f}"
        elif values:
            found[key] = ", ".join(dict.fromkeys(str(value) for value in values))
    if any(done.about_run.get("quick") for done in finished):
        found["size"] = "quick: sizes to try the parts out, not to be quoted"
    return found


def judge(done) -> list:
    """Return (claim, held, finding) of a finished part."""
    return [(claim, *claim.judge(done.rows)) for claim in done.part.claims]


def _facts(facts):
    items = "".join(f"<dt>{text.escape(key)}</dt><dd>{text.escape(str(value))}</dd>" for key, value in facts.items())
    return f"<dl>{items}</dl>"


def _claim_row(part, claim, held, finding):
    style = {True: "held", False: "not", None: "note"}[held]
    return (
        f'<tr><td class="text"><a href="#{part.name}">{text.escape(claim.text)}</a> '
        f'<span class="note">({text.escape(claim.source)})</span></td><td class="text {style}">{VERDICT[held]}</td>'
        f'<td class="text">{text.escape(finding)}</td></tr>'
    )


def _section(done, drawn):
    part = done.part
    blocks = [f'<h2 id="{part.name}">{text.escape(part.title)}</h2>', f"<p>{text.escape(part.about)}</p>"]
    blocks += [
        f'<p><b class="{"held" if held else "not"}">{VERDICT[held].capitalize()}</b>: {text.escape(claim.text)} '
        f"({text.escape(claim.source)}). {text.escape(finding)}</p>"
        for claim, held, finding in judge(done)
    ]
    for figure in part.figures:
        if figure.name in drawn:
            data = base64.b64encode(drawn[figure.name].read_bytes()).decode()
            blocks.append(
                f'<figure><img alt="{text.escape(figure.title)}" src="data:image/svg+xml;base64,{data}">'
                f"<figcaption>{text.escape(figure.title)}. {text.escape(figure.note)}</figcaption></figure>"
            )
    blocks += [_table(table, done.rows) for table in part.tables if table.rows(done.rows)]
    blocks += [f'<p class="note">{text.escape(note)}</p>' for note in done.notes]
    run = done.about_run
    blocks.append(f'<p class="note">{text.escape(run["device"])}, {run["date"]}, {run["seconds"]:.0f} s.</p>')
    return f"<section>{''.join(blocks)}</section>"


def _table(table, rows):
    body = cells(table, rows)
    texts = [all(isinstance(row.get(column.name), str) for row in table.rows(rows)) for column in table.columns]
    styles = [' class="name"' if is_text else "" for is_text in texts]
    head = "".join(
        f"<th{style}>{text.escape(column.heading)}</th>" for column, style in zip(table.columns, styles, strict=True)
    )
    lines = "".join(
        "<tr>" + "".join(f"<td{s}>{text.escape(cell)}</td>" for cell, s in zip(row, styles, strict=True)) + "</tr>"
        for row in body
    )
    note = f'<p class="note">{text.escape(table.note)}</p>' if table.note else ""
    return f'<h3>{text.escape(table.title)}</h3><div class="scroll"><table><tr>{head}</tr>{lines}</table></div>{note}'
