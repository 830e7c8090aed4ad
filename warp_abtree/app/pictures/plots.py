"""Plots of runs by Matplotlib: LODs, times and errors over the frames."""

from __future__ import annotations

import numpy as np

from warp_abtree.app.pictures.render import figure_image, new_figure, write_png
from warp_abtree.app.styles import STAGE_LABELS
from warp_abtree.simulate.frame_row import FrameRow


def draw_run(rows: list[FrameRow], fractions, path, title: str):
    """Draw LODs (fractions of the finest, (frames, n)), times by stage and certified error of a run to a PNG file."""
    figure = new_figure((10, 10), layout="constrained")
    figure.suptitle(title, fontsize=14, fontweight="bold", color="0.15")
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
    write_png(figure_image(figure), path)
