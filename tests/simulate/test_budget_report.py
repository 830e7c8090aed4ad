"""Budget reports of rows made up by hand."""

from dataclasses import replace

import pytest

from warp_abtree.simulate.budget_report import budget_report, cost_at_coarsest
from warp_abtree.simulate.frame_row import FrameRow


def make_rows(costs, budget=10.0, step=0.5):
    rows = []
    for i, cost in enumerate(costs):
        values = dict.fromkeys(FrameRow.names()[:-1], 0)
        values |= {"frame": i, "time": i * step, "objects": 4, "oscillations": i % 2, "error_mean": float(i)}
        rows.append(FrameRow(**{**values, "budget_ms": budget, "query_ms": cost - 1.5, "answer_ms": 1.5}))
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


def at_lods(costs, lods):
    return [replace(row, lod_max=lod) for row, lod in zip(make_rows(costs), lods, strict=True)]


def test_a_budget_below_the_cost_of_the_coarsest_lods_is_impossible():
    assert cost_at_coarsest(at_lods([99, 12, 14, 13, 9], [0, 0, 0, 0, 7])) == 13
    assert cost_at_coarsest(at_lods([99, 12, 14, 9], [0, 0, 5, 7])) is None, "it climbs from there"
    assert cost_at_coarsest(at_lods([99], [0])) is None and cost_at_coarsest([]) is None
