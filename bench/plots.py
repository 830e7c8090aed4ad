"""Log-log figures of rows as SVG, where matplotlib is installed."""

from pathlib import Path

from .timing import fit_slope

# Okabe and Ito's colours, which people with any colour vision tell apart; lines differ by dashes and markers as well.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"), ("-", "v"), ("--", "x"))
PANEL = (4.6, 3.9)  # inches


def draw(rows, figures, folder) -> str:
    """Draw every figure that has rows; return the line that says what was drawn, or why nothing was.

    Args:
        rows: What a benchmark yields.
        figures: Dicts: file, and panels side by side, dicts of: title, x (column), xlabel, y (columns and what they
            are called), ylabel, where (column to value), by (column whose values are lines of their own, and the word
            after it; None for one line a column of y).
    """
    try:
        import matplotlib
    except ImportError as error:
        return f"plots skipped: {error}"
    matplotlib.use("Agg")
    matplotlib.rcParams["svg.fonttype"] = "none"  # text stays text
    matplotlib.rcParams["svg.hashsalt"] = "warp_abtree"  # the same rows, the same file
    from matplotlib import pyplot

    Path(folder).mkdir(parents=True, exist_ok=True)
    drawn = []
    for figure in figures:
        panels = [(panel, lines) for panel in figure["panels"] if (lines := find_lines(rows, panel))]
        if not panels:
            continue
        size = (PANEL[0] * len(panels), PANEL[1])
        canvas, axes = pyplot.subplots(1, len(panels), figsize=size, layout="constrained", squeeze=False)
        for (panel, lines), place in zip(panels, axes[0], strict=True):
            draw_panel(place, panel, lines)
        canvas.savefig(Path(folder) / figure["file"], metadata={"Date": None})
        pyplot.close(canvas)
        drawn.append(figure["file"])
    return f"plots in {folder}: {', '.join(drawn) or 'none'}"


def draw_panel(axes, panel, lines):
    columns, parts = list(panel["y"]), list(dict.fromkeys(part for _, part in lines))
    for (column, part), points in lines.items():
        x, y = zip(*sorted(points), strict=True)
        label = panel["y"][column]
        if panel["by"]:
            label += f", {part:,} {panel['by'][1].removesuffix('s' if part == 1 else '')}"
        slope = fit_slope(upper_half(x), upper_half(y))
        label += "" if slope is None else f": slope {slope:.2f}"
        turn = columns.index(column)
        dashes, marker = STYLES[turn % len(STYLES)]
        colour = COLOURS[(parts.index(part) if panel["by"] else turn) % len(COLOURS)]
        axes.loglog(x, y, color=colour, linestyle=dashes, marker=marker, markersize=4, linewidth=1.4, label=label)
    axes.set(title=panel["title"], xlabel=panel["xlabel"], ylabel=panel["ylabel"])
    axes.grid(True, alpha=0.3)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** (0.09 * len(lines)))  # room for the legend
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)


def upper_half(values):
    """Return the upper half of sorted points, where a line has found its slope; all of one or two."""
    return values[len(values) // 2 - 1 :] if len(values) > 2 else values


def find_lines(rows, panel) -> dict:
    """Return the points of a panel's lines, by (column, value of `by`)."""
    lines = {}
    for row in rows:
        if any(row.get(name) != value for name, value in panel["where"].items()) or not row.get(panel["x"]):
            continue
        for column in panel["y"]:
            if row.get(column):
                part = row[panel["by"][0]] if panel["by"] else None
                lines.setdefault((column, part), []).append((row[panel["x"]], row[column]))
    return lines
