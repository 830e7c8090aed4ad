"""The history of times: what is named slower, and what is kept."""

import json

import pytest

from bench import __main__ as main
from bench.studies import nightly
from bench.studies.study import StudyError


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


def test_lines_of_another_device_case_or_size_are_not_compared():
    lines = [line(1.0, device="y"), line(2.0, case="host"), line(3.0, quick=False), *(line(n) for n in range(9))]
    kept = nightly.same_kind(lines, line(0.0))
    assert [found["series"]["a"] for found in kept] == [[n] for n in range(9)][-nightly.BEFORE :]


@pytest.mark.slow
def test_the_command_appends_a_line_a_case(tmp_path, capsys):
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
    with pytest.raises(StudyError, match="no part nothing"):
        nightly.run("cpu", tmp_path, only=["nothing"])
