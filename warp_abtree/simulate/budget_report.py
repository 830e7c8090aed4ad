"""Reports of a run of frames: `summarise_rows`; against its time budget: `budget_report`, `cost_at_coarsest`."""

from functools import partial

import numpy as np

from warp_abtree.lod.timing import STAGES

COUNTS = "states pairs intersecting hits faces nodes_refitted node_tests triangle_tests error_mean error_max".split()


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


def summarise_rows(rows, after: float = 1.0) -> dict:
    """Return `Frame.summary` of one `FrameRow` or more."""

    def reduce(name, **reductions):
        values = np.array([getattr(row, name) for row in rows], np.float64)  # None is NaN
        return {key: float(reduction(values)) for key, reduction in reductions.items()}

    p95, budget = partial(np.percentile, q=95), rows[-1].budget_ms
    return {
        "frames": len(rows),
        "objects": rows[-1].objects,
        "stages": {name: reduce(name, mean=np.mean, p95=p95, total=np.sum) for name in (*STAGES, "total_ms")},
        **{name: reduce(name, mean=np.mean, min=np.min, max=np.max) for name in COUNTS},
        "lod_min": min(row.lod_min for row in rows),
        "lod_max": max(row.lod_max for row in rows),
        "budget_ms": budget,
        "coarsest_ms": None if budget is None else cost_at_coarsest(rows),
        "budget": budget_report(rows, after=after),
    }
