"""The gate finds what differs between two trees, and its worker answers alike twice."""

import io
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from bench.gate import compare, worker

pytestmark = pytest.mark.slow


class Known:
    def __init__(self, digests, ms, kernels):
        self.answers = {"list": {"digests": ["ask_a"], "times": ["a"]}, "digest": digests, "prepare": None}
        self.answers["kernels"], self.ms = {"names": ["registers"], "kernels": kernels}, ms

    def ask(self, do, repeats=0, **command):
        return [self.ms] * repeats if do == "time" else self.answers[do]


def end_of(rows):
    """Return the rows of a generator and what it returns."""
    found = []
    while True:
        try:
            found.append(next(rows))
        except StopIteration as end:
            return found, end.value


def test_differences_are_rows():
    before = Known({"x": "1", "y": "2", "gone": "3"}, 2.0, {"k 32": [[40]], "same 32": [[8]]})
    now = Known({"x": "1", "y": "4", "new": "5"}, 3.0, {"k 32": [[41]], "same 32": [[8]], "new 32": [[1]]})
    trees = {"before": before, "now": now}
    rows, differing = end_of(compare.compare_digests(trees, ({},)))
    assert differing == 3 and [row["answer"] for row in rows] == ["y", "gone", "new"]
    rows, ratios = end_of(compare.compare_times(trees, 2))
    assert ratios == [1.5] and (rows[0]["before_ms"], rows[0]["now_ms"]) == (2.0, 3.0)
    rows, _ = end_of(compare.compare_kernels(trees))
    assert [row["kernel"] for row in rows] == ["k 32", "new 32"]


def test_the_worker_answers_alike_and_says_what_failed(device, monkeypatch):
    asked = [{"do": "digest", "name": name} for name in ("ask_trees", "ask_trees", "nothing")] + [{"do": "first"}]
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(map(json.dumps, asked))))
    monkeypatch.setattr(sys, "stdout", answers := io.StringIO())
    worker.serve(device, True)
    answers.seek(0)
    tree = compare.Tree.__new__(compare.Tree)
    tree.process = SimpleNamespace(stdin=io.StringIO(), stdout=answers)
    first, again = (tree.ask("digest") for _ in range(2))
    assert first == again and len(set(first.values())) == len(first) == 5
    with pytest.raises(RuntimeError, match="StopIteration"):
        tree.ask("digest")
    assert tree.ask("first") == [1]
    assert [json.loads(line)["do"] for line in tree.process.stdin.getvalue().splitlines()] == [*3 * ["digest"], "first"]


def test_digests_tell_arrays_apart():
    digest = worker.digest
    zeros = np.zeros(2, np.float64)
    assert len({digest([a]) for a in (zeros, -zeros, zeros.astype(np.float32), zeros[:1], zeros.reshape(1, 2))}) == 5
    assert digest([zeros]) == digest([np.zeros(4)[::2]])
