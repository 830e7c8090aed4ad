"""Plots of runs by Matplotlib: LODs, times and errors over the frames."""

from __future__ import annotations

import numpy as np

from warp_abtree.app.pictures.render import BACKGROUND, write_png
from warp_abtree.app.styles import STAGE_LABELS
from warp_abtree.simulate.frame import FrameRow


def _make_figure(size, title):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=100, facecolor=BACKGROUND, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=14, fontweight="bold", color="0.15")
    return figure


def draw_run(rows: list[FrameRow], fractions, path, title: str):
    """Draw LODs (fractions of the finest, (frames, n)), times by stage and certified error of a run to a PNG file."""
    figure = _make_figure((10, 10), title)
    lods, times, errors = figure.subplots(3, 1, sharex=True)
    frames = np.array([row.frame for row in rows])

    low, tenth, middle, ninth, high = np.percentile(fractions, (0, 10, 50, 90, 100), axis=1)
    lods.fill_between(frames, low, high, color="C0", alpha=0.15, linewidth=0, label="all objects")
    lods.fill_between(frames, tenth, ninth, color="C0", alpha=0.35, linewidth=0, label="10 to 90 % of them")
    lods.plot(frames, middle, color="C0", label="median")
    lods.set(ylabel="LOD, relative to the finest", ylim=(-0.03 * high.max() - 1e-6, 1.05 * high.max() + 1e-6))

    stages = [[getattr(row, name) for row in rows] for name in STAGE_LABELS]
    cost = np.sum(stages[:4], axis=0)
    times.stackplot(frames, *stages, labels=STAGE_LABELS.values(), alpha=0.8, linewidth=0, step="mid")
    times.step(frames, cost, where="mid", color="black", linewidth=0.8, label="T': select to query")
    budgets = [row.budget_ms for row in rows if row.budget_ms is not None]
    if budgets:
        times.axhline(budgets[-1], color="red", linewidth=1, label=f"T = {budgets[-1]:g} ms")
        times.axhline(1.1 * budgets[-1], color="red", linewidth=1, linestyle=":", label="T + 10 %")
    # A single slow frame must not compress the rest.
    top = np.percentile(np.sum(stages, axis=0), 99)
    times.set(ylabel="time [ms]", ylim=(0, 1.25 * max(top, *budgets, 1e-6)))

    errors.plot(frames, [row.error_mean for row in rows], color="C3", label="mean of the objects")
    errors.plot(frames, [row.error_max for row in rows], color="C3", linestyle=":", label="greatest")
    errors.set(ylabel="certified error [world units]", xlabel="frame", xlim=(frames[0], max(frames[-1], 1)))
    errors.set_ylim(bottom=0)
    for axes in (lods, times, errors):
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    write_png(figure.canvas, path)


# By controller: label, colour (Okabe and Ito 2008: distinct with any colour vision), dashes, width.
CONTROLLER_STYLES = {
    "none": ("finest LODs", "0.45", "-", 0.9),
    "coarsest": ("coarsest LODs", "0.45", ":", 1.2),
    "tolerance": ("tolerance", "#009E73", "-", 1.0),
    "paper": ("paper's controller", "#D55E00", "-", 1.0),
    "predictive": ("predictive controller", "#0072B2", "-", 1.4),
}


def draw_controllers(runs: dict[str, list[FrameRow]], budget_ms: float, path, title: str):
    """Draw runs of one scene under several controllers to a PNG file: frame times about T, faces, certified error.

    Args:
        runs: Rows of a run by controller: "predictive", "paper", "tolerance", "none" (finest LODs), "coarsest".
        budget_ms: T [ms].
        path: File to write.
        title: Above.

    Raises:
        ValueError: No run, or one of an unknown controller.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    unknown = set(runs) - set(CONTROLLER_STYLES)
    if unknown or not runs:
        raise ValueError(f"runs: {sorted(unknown)} are none of {', '.join(CONTROLLER_STYLES)}, or there are none")
    figure = _make_figure((9, 8.4), title)
    times, faces, errors = figure.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.0, 1.0))
    most = max(row.faces for rows in runs.values() for row in rows)
    for name, (label, colour, dash, width) in CONTROLLER_STYLES.items():
        rows = runs.get(name)
        if rows is None:
            continue
        style = {"color": colour, "linestyle": dash, "linewidth": width, "label": label}
        frames = [row.frame for row in rows]
        times.plot(frames, [row.cost_ms for row in rows], **style)
        faces.plot(frames, [100 * row.faces / most for row in rows], **style)
        errors.plot(frames, [row.error_mean for row in rows], **style)
    times.axhspan(budget_ms, 1.1 * budget_ms, color="#F0E442", alpha=0.7, linewidth=0, label="T to T + 10 %")
    times.axhline(budget_ms, color="black", linewidth=0.9, label=f"T = {budget_ms:.3g} ms")
    costs = np.array([row.cost_ms for rows in runs.values() for row in rows])
    # A single slow frame, and the first fast ones, must not compress the rest.
    times.set(
        yscale="log", ylim=(max(costs.min(), budget_ms / 10) / 1.15, 1.3 * max(np.percentile(costs, 99.5), budget_ms))
    )
    times.set_ylabel("frame time T' [ms]")
    faces.set(yscale="log", ylabel="faces of all objects\n[% of the finest]")
    errors.set(ylabel="certified error, mean\nof the objects [world units]")
    errors.set_xlabel("frame")
    errors.set_ylim(bottom=0)
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    for axes, steps in ((times, (1, 2, 5)), (faces, (1, 3))):
        axes.yaxis.set_major_locator(LogLocator(subs=steps))
        axes.yaxis.set_major_formatter(plain)
        axes.yaxis.set_minor_formatter(NullFormatter())
    for axes in (times, faces, errors):
        axes.set_xlim(0, max(max(row.frame for row in rows) for rows in runs.values()) or 1)
        axes.grid(True, alpha=0.3)
    handles, labels = times.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    write_png(figure.canvas, path)
