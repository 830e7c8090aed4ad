"""Log-log figures of rows as SVG, where matplotlib is installed."""

from pathlib import Path

from .timing import fit_slope

STYLES = ("-", "--", ":")


def draw(rows, figures, folder) -> str:
    """Draw every figure that has rows; return the line that says what was drawn, or why nothing was.

    Args:
        rows: What a benchmark yields.
        figures: Dicts: file, title, x and y (column names), ylabel, and of a line: where (column to value), by (column
            whose values are lines of their own, None for one line a column of y).
    """
    try:
        import matplotlib
    except ImportError as error:
        return f"plots skipped: {error}"
    matplotlib.use("Agg")
    matplotlib.rcParams["svg.fonttype"] = "none"  # text stays text
    from matplotlib import pyplot

    Path(folder).mkdir(parents=True, exist_ok=True)
    drawn = []
    for figure in figures:
        lines = find_lines(rows, figure)
        if not lines:
            continue
        canvas, axes = pyplot.subplots(figsize=(7, 5), layout="constrained")
        parts = list(dict.fromkeys(part for _, part in lines))
        for (column, part), points in lines.items():
            x, y = zip(*sorted(points), strict=True)
            name = column.removesuffix("_ms").removesuffix("_mib").replace("_", " ")
            label = ", ".join([name, *([f"{figure['by']} {part:,}"] if figure["by"] else [])])
            slope = fit_slope(x, y)
            style = {"color": f"C{parts.index(part)}", "linestyle": STYLES[figure["y"].index(column)]}
            if not figure["by"]:
                style = {}
            label += "" if slope is None else f": slope {slope:.2f}"
            axes.loglog(x, y, marker="o", markersize=3, label=label, **style)
        axes.set(title=figure["title"], xlabel=figure["x"].replace("_", " "), ylabel=figure["ylabel"])
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize="small")
        canvas.savefig(Path(folder) / figure["file"])
        pyplot.close(canvas)
        drawn.append(figure["file"])
    return f"plots in {folder}: {', '.join(drawn) or 'none'}"


def find_lines(rows, figure) -> dict:
    """Return the points of a figure's lines, by (column, value of `by`)."""
    lines = {}
    for row in rows:
        if any(row.get(name) != value for name, value in figure["where"].items()) or not row.get(figure["x"]):
            continue
        for column in figure["y"]:
            if row.get(column):
                part = row[figure["by"]] if figure["by"] else None
                lines.setdefault((column, part), []).append((row[figure["x"]], row[column]))
    return lines
