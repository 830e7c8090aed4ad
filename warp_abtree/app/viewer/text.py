"""Texts, numbers and plots of the viewer."""

import numpy as np

from warp_abtree.app.styles import STAGE_LABELS

COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b")


def _table(rows) -> str:
    return "\n".join(["| | |", "|:--|--:|", *(f"| {key} | {value} |" for key, value in rows)])


def state(page, data) -> str:
    """Return the numbers of a snapshot as a table."""
    snapshot, playback = page.snapshot, page.playback
    result = snapshot.result
    rows = [
        ("state", "playing" if page.playing else "paused"),
        ("time", f"{snapshot.time:.3f} s, frame {snapshot.number:,}"),
        ("objects shown", f"{len(data.shown):,} of {playback.scene.object_count:,}"),
        ("faces shown", f"{data.faces:,}"),
        ("pairs that meet", f"{int(np.count_nonzero(result.any)):,} of {len(result.pairs):,} near"),
        ("certified error, mean", f"{data.error_mean:.3g}"),
        ("intersecting face pairs", f"{data.contact_count:,}"),
        ("intersecting faces", f"{data.intersecting_count:,}"),
    ]
    if snapshot.row is not None:
        rows.append(("frame", f"{snapshot.row.total_ms:.1f} ms on {playback.scene.device}"))
        rows.append(("select to query", f"{snapshot.row.cost_ms:.1f} ms"))
        if snapshot.row.budget_ms is not None:
            rows.append(("budget", f"{snapshot.row.budget_ms:g} ms"))
    return _table(rows)


def time_plot(rows, window: int) -> dict:
    """Return data and series for a uPlot of frame times: stages stacked, the greatest sum behind.

    At least `window` frames are shown; those before the first row took no time. A uPlot that begins without any data
    never finds its axis.
    """
    missing = max(window - len(rows), 0)
    first = rows[0].frame if rows else 0
    frames = np.array([*range(first - missing, first), *(row.frame for row in rows)], np.float64)
    # Without a budget its line is on the axis; NaN would leave the plot without a scale.
    names = (*STAGE_LABELS, "budget_ms")
    times = np.array([[0.0] * missing + [getattr(row, name) or 0.0 for row in rows] for name in names])
    data = [frames, *np.cumsum(times[:-1], axis=0)[::-1], times[-1]]  # the budget is drawn last, over the stages
    series: list[dict] = [{"label": "frame"}]
    for label, colour in zip(reversed(STAGE_LABELS.values()), reversed(COLOURS)):
        series.append({"label": label, "stroke": colour, "fill": colour + "c0", "width": 1})
    series.append({"label": "budget", "stroke": "#ff0000", "width": 1.5})
    return {
        "data": tuple(data),
        "series": tuple(series),
        "scales": {"x": {"time": False}, "y": {"range": (0.0, time_top(rows))}},
        "legend": {"show": True, "live": False},
    }


def time_top(rows) -> float:
    """Return a round number [ms] under which nearly all frames stay: one hitch must not flatten the rest of a plot."""
    if not rows:
        return 1.0
    wanted = max(1.1 * float(np.percentile([row.total_ms for row in rows], 95)), rows[-1].budget_ms or 0.0, 1e-3)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(next(power * step for step in (1, 1.5, 2, 3, 5, 7, 10) if power * step >= wanted * (1 - 1e-9)))
