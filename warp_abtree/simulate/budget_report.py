"""Report of a run of frames against its time budget: `budget_report`; the least it can cost: `cost_at_coarsest`."""

import numpy as np


def budget_report(rows, budget_ms: float | None = None, after: float = 1.0) -> dict | None:
    """Report how frames held a budget.

    Args:
        rows: `FrameRow`s in their order.
        budget_ms: T [ms]; None takes the budget of each row, and rows without one are left out.
        after: Frames before this time in the scene [s] are left out.

    Returns:
        None where no row is left, else a dict: frames; within and within_110_percent, fractions of the frames within T
        and 1.1 T; worst, the greatest cost over T; longest_over, the longest run of frames over 1.1 T; oscillations,
        how often the LOD of an object reversed its direction, a second; error_mean, the mean `Model.error_at` [world
        units].
    """
    rows = [row for row in rows if row.time >= after and (budget_ms or row.budget_ms) is not None]
    if not rows:
        return None
    ratio = np.array([row.total_ms / (budget_ms or row.budget_ms) for row in rows])
    # Where the runs of frames over the limit begin and end.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ratio > 1.1, [0]]).astype(int)))
    span = (rows[-1].time - rows[0].time) * len(rows) / max(len(rows) - 1, 1)
    oscillations = sum(row.oscillations / row.objects for row in rows)
    return {
        "frames": len(rows),
        "within": float(np.mean(ratio <= 1.0)),
        "within_110_percent": float(np.mean(ratio <= 1.1)),
        "worst": float(ratio.max()),
        "longest_over": int((edges[1::2] - edges[::2]).max(initial=0)),
        "oscillations": float(oscillations / span) if span > 0 else 0.0,
        "error_mean": float(np.mean([row.error_mean for row in rows])),
    }


def cost_at_coarsest(rows) -> float | None:
    """Return the median cost of frames with every object at LOD 0 [ms], None unless they are half of all or more.

    The first frame is left out. No controller can hold a budget below it.
    """
    costs = [row.total_ms for row in rows[1:] if row.lod_max == 0]
    return float(np.median(costs)) if costs and 2 * len(costs) >= len(rows) - 1 else None
