"""The gate between two trees and its worker, and the history of times: what differs, and what is named slower."""

import gc
import io
import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from helpers import refused

import warp_abtree as ab
from bench import __main__ as main
from bench.gate import compare, worker
from bench.studies import nightly
from bench.studies.study import StudyError


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
    now.answers["list"]["times"] = ["b", "a"]
    rows, ratios = end_of(compare.compare_times(trees, 2))
    assert ratios == [1.5] and "before has none" in rows[0]["skipped"] and rows[0]["launch"] == "b"
    now.answers["list"]["times"] = ["a"]
    rows, _ = end_of(compare.compare_kernels(trees))
    assert [row["kernel"] for row in rows] == ["k 32", "new 32"]


@pytest.mark.slow
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


def test_kernels_are_listed_that_collections_pass_by(monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_kernel_properties", lambda *_: {"registers": 8})
    ab.Scene("cpu").add(ab.Model.from_arrays(np.eye(3), [[0, 1, 2]]))  # loads kernels
    gc.collect()
    gc.freeze()
    found = worker.kernels_of("cpu")
    gc.freeze()
    assert found["names"] == ["registers"] and len(found["kernels"]) > 1


def line(*times, **about):
    return {"case": "sweep", "device": "x", "quick": True, "series": {"a": list(times)}, **about}


def test_only_what_exceeds_its_own_noise_is_slower():
    steady = [line(1.0, 1.01, 1.02), line(1.01, 1.0, 1.0)]
    assert nightly.find_slower(steady, {"a": [1.3, 1.31, 1.32], "new": [9.0]}) == [("a", 1.005, 1.31, 1.02)]
    assert not nightly.find_slower(steady, {"a": [1.03, 1.03, 1.03]}), "less than processes differ by"
    assert not nightly.find_slower(steady, {"a": [1.0, 1.3, 1.4]}), "its own runs differ by as much"
    assert not nightly.find_slower([line(1.0), line(1.4)], {"a": [1.6]}), "the days before do"
    assert not nightly.find_slower(steady[:1], {"a": [9.0]}), "one day tells no noise"
    assert not nightly.find_slower(steady, {"a": [0.1]})
    # Lines of another device, case or size are not compared.
    lines = [line(1.0, device="y"), line(2.0, case="host"), line(3.0, quick=False), *(line(n) for n in range(9))]
    kept = nightly.same_kind(lines, line(0.0))
    assert [found["series"]["a"] for found in kept] == [[n] for n in range(9)][-nightly.BEFORE :]


@pytest.mark.slow
def test_the_command_appends_a_line_a_case(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(nightly, "RUNS", 2)
    asked = ["nightly", "--device", "cpu", "--quick", "--only", "frame", "--out", str(tmp_path)]
    for count in (1, 2):
        assert main.main(asked) == 0
        lines = [json.loads(text) for text in (tmp_path / "history.jsonl").read_text().splitlines()]
        assert len(lines) == count and {"warp", "device", "date"} < set(lines[-1])
        assert all(len(times) == nightly.RUNS and min(times) > 0 for times in lines[-1]["series"].values())
    assert set(lines[0]["series"]) == set(lines[1]["series"])
    with open(tmp_path / "history.jsonl", "a") as file:
        file.write("{}")
    with pytest.raises(SystemExit):
        main.main(asked)
    assert "a line is none of this command's" in capsys.readouterr().err
    refused(StudyError, "no part nothing", nightly.run, "cpu", tmp_path, only=["nothing"])
