"""Budget reports and step responses of rows made up by hand."""

import pytest

from warp_abtree.simulate.budget_report import budget_report, step_response
from warp_abtree.simulate.frame import FrameRow


def make_rows(costs, budget=10.0, step=0.5):
    rows = []
    for i, cost in enumerate(costs):
        values = dict.fromkeys(FrameRow.names()[:-2], 0)
        values |= {"frame": i, "time": i * step, "objects": 4, "oscillations": i % 2, "error_mean": float(i)}
        rows.append(FrameRow(**{**values, "budget_ms": budget, "query_ms": cost, "move_ms": 99.0}))
    return rows


def test_reports_count_frames_within_a_budget():
    rows = make_rows([50, 50, 10, 10.5, 11, 11.5, 12, 8, 40, 9])
    report = budget_report(rows)
    assert report == {
        "frames": 8,
        "within": 3 / 8,
        "within_110_percent": 5 / 8,
        "worst": 4.0,
        "longest_over": 2,
        "oscillations": pytest.approx(4 / 4 / 4.0),
        "error_mean": 5.5,
    }
    assert budget_report(rows, after=0.0)["within"] == 3 / 10
    assert budget_report(rows, budget_ms=20.0)["within"] == 7 / 8
    assert budget_report(rows, after=5.0) is None and budget_report(make_rows([1.0] * 9, None)) is None
    assert step_response(rows, 0) == {"peak": 5.0, "frames": 2}
    assert step_response(rows, 5) == {"peak": 4.0, "frames": 2}
    assert step_response(rows, 8) == {"peak": 4.0, "frames": 1}
    assert step_response(make_rows([30, 40]), 1) == {"peak": 4.0, "frames": None}
    with pytest.raises(ValueError, match="frame 10"):
        step_response(rows, 10)
