"""The machinery of studies: resumed runs, tables, reports that need no other file, and docs that repeat their data."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from bench import docs, html, meshes, study
from bench.parts import Claim, Column, Figure, Finished, Part, Table, cells, pick, plain, shown
from warp_abtree.app.cli import bench_command
from warp_abtree.app.cli import main as cli

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]


def draw(rows, figure):
    axes = figure.subplots()
    axes.plot([row["x"] for row in rows], [row["y"] for row in rows])
    axes.set(xlabel="x [m]", ylabel="y [ms]")


def make_part(runs, name="parabola", fails=False):
    """A part that notes each of its runs."""

    def run(context):
        runs.append(name)
        context.note("Measured <roughly>.")
        for x in range(4):
            if fails and x == 2:
                raise RuntimeError("stop here")
            context.progress("x", x, 4)
            yield {"x": x, "y": np.float32(x) ** 2, "kind": "even" if x % 2 == 0 else "odd", "gap": float("nan")}

    return Part(
        name,
        f"The {name} & more",
        run,
        about="x < 4 only.",
        tables=(
            Table(name, "Squares", (Column("x", "x [m]"), Column("y", "y [ms]", ".2f"), Column("gap", "gap"))),
            Table(f"{name}_even", "Even", (Column("kind", "kind"), Column("x", "x [m]")), {"kind": "even"}, thin),
        ),
        figures=(
            Figure(f"{name}_curve", "The curve", draw),
            Figure(f"{name}_none", "Nothing", lambda rows, figure: False),
        ),
        claims=(Claim("y grows", "this project", lambda rows: (rows[-1]["y"] > rows[0]["y"], "By 9.")),),
    )


def thin(rows):
    return rows[1:]


def test_run_is_written_and_resumed(tmp_path, capsys):
    runs = []
    parts = [make_part(runs), make_part(runs, "second")]
    first = study.run_study("toy", parts, tmp_path, "cpu", command="python -m bench toy")
    assert runs == ["parabola", "second"]
    assert first[0].rows[3] == {"x": 3, "y": 9.0, "kind": "odd", "gap": None}
    again = study.run_study("toy", parts, tmp_path, "cpu")
    assert runs == ["parabola", "second"] and [done.rows for done in again] == [done.rows for done in first]
    assert again[0].about_run["command"] == "python -m bench toy"  # that of the run that was kept
    assert "(kept)" in capsys.readouterr().err
    study.run_study("toy", parts, tmp_path, "cpu", quick=True)
    assert runs == ["parabola", "second"] * 2
    study.run_study("toy", parts, tmp_path, "cpu", quick=True, again=True, only=["second"])
    assert runs == ["parabola", "second"] * 2 + ["second"]
    kept = json.loads((tmp_path / "toy.json").read_text())
    assert set(kept["parts"]) == {"parabola", "second"} and kept["parts"]["second"]["run"]["quick"] is True


@pytest.mark.parametrize("damage", ["device", "source", "warp", "whole"])
def test_what_was_run_otherwise_is_run_again(tmp_path, damage):
    runs = []
    study.run_study("toy", [make_part(runs)], tmp_path, "cpu")
    file = tmp_path / "parts" / "parabola.json"
    kept = json.loads(file.read_text())
    if damage == "whole":
        file.write_text(file.read_text()[:-9])
    else:
        kept["run"][damage] = "another"
        file.write_text(json.dumps(kept))
    study.run_study("toy", [make_part(runs)], tmp_path, "cpu")
    assert runs == ["parabola"] * 2


def test_a_part_that_fails_leaves_those_before_it(tmp_path):
    runs = []
    with pytest.raises(RuntimeError, match="stop here"):
        study.run_study("toy", [make_part(runs), make_part(runs, "second", fails=True)], tmp_path, "cpu")
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["parabola.json"]
    study.run_study("toy", [make_part(runs), make_part(runs, "second")], tmp_path, "cpu")
    assert runs == ["parabola", "second", "second"]


def test_values_of_rows():
    assert plain(np.float64(1 / 3)) == 0.33333 and plain(np.int32(7)) == 7 and plain(np.bool_(True)) is True
    assert plain(float("inf")) is None and plain([np.int64(1), "a"]) == [1, "a"]
    with pytest.raises(TypeError):
        plain(np.zeros(2))
    assert [shown(x, ".1%") for x in (0.5, None, True, "text")] == ["50.0%", "-", "yes", "text"]
    assert pick([{"a": 1, "b": 2}, {"a": 1}], a=1, b=2) == [{"a": 1, "b": 2}]


def finished(runs=None):
    part = make_part([] if runs is None else runs)
    context = study.Context("cpu", True, None, lambda *_: None)
    rows = [{name: plain(value) for name, value in row.items()} for row in part.run(context)]
    run = study.describe_run(context.device, True) | {"date": "2026-11-21", "command": "python", "seconds": 1.0}
    return Finished(part, rows, run, context.notes)


def test_tables(tmp_path):
    done = finished()
    assert cells(done.part.tables[0], done.rows)[3] == ["3", "9.00", "-"]
    assert cells(done.part.tables[1], done.rows) == [["even", "2"]]
    html.write_tables([done], tmp_path)
    with open(tmp_path / "parabola.csv", newline="") as file:
        assert list(csv.reader(file))[:2] == [["x [m]", "y [ms]", "gap"], ["0", "0.0", ""]]


def test_page_needs_no_other_file(tmp_path):
    pytest.importorskip("matplotlib")
    study.run_study("toy", [make_part([])], tmp_path, "cpu", quick=True, command="python -m bench toy")
    page = (tmp_path / "toy.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert links and all(link.startswith(("data:", "#")) for link in links)
    assert "<link" not in page and "<script" not in page and "url(" not in page
    assert "Measured &lt;roughly&gt;." in page and "The parabola &amp; more" in page and "x &lt; 4 only." in page
    assert "By 9." in page and ">held<" in page and "python -m bench toy" in page and "quick" in page
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"parabola_curve.svg", "parabola_curve.png"}


PAGE = """# A page
<!-- table: toy/parabola_even -->
old
<!-- /table -->
between
<!-- claims: toy -->
<!-- /claims -->
<!-- run: other -->
<!-- /run -->
"""


def test_docs_are_rendered_from_data(tmp_path, monkeypatch):
    monkeypatch.setattr(docs, "find_parts", lambda name: {"toy": (make_part([]),)}.get(name, ()))
    study.run_study("toy", [make_part([])], tmp_path, "cpu")
    text = docs.render(PAGE, tmp_path)
    assert "| kind | x [m] |\n| --- | --: |\n| even | 2 |" in text and "old" not in text and "between" in text
    assert "| y grows | this project | held | By 9. |" in text and "Not run yet: no `other.json`." in text
    assert docs.render(text, tmp_path) == text
    file = tmp_path / "toy.json"
    file.write_text(file.read_text().replace('"x": 2', '"x": 5'))
    assert docs.render(text, tmp_path) != text
    with pytest.raises(ValueError, match="no_such"):
        docs.render("<!-- table: toy/no_such -->\n<!-- /table -->", tmp_path)


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.name)
def test_numbers_in_the_docs_are_those_of_the_data(page):
    """Every table of a page that shows runs is rendered again from their JSON: python -m bench.docs PAGE writes it."""
    text = page.read_text(encoding="utf-8")
    assert docs.render(text) == text
    blocks = re.findall(r"<!-- (?:table|claims|run): ", text)
    assert len(blocks) == len(docs.BLOCK.findall(text)) == len(re.findall(r"<!-- /(?:table|claims|run) -->", text))


@pytest.mark.parametrize("file", sorted(docs.DATA.glob("*.json")), ids=lambda path: path.name)
def test_data_of_the_docs_is_of_a_full_run(file):
    found = docs.read_run(file)
    assert len(found) == len(json.loads(file.read_text())["parts"]), "the study has lost a part"
    assert not any(done.about_run["quick"] for done in found)
    assert file.stat().st_size < 400_000


def test_names_are_unique():
    parts = [part for name in study.STUDIES for part in study.find_parts(name)]
    for names in (
        [part.name for part in parts],
        [table.name for part in parts for table in part.tables],
        [figure.name for part in parts for figure in part.figures],
    ):
        assert len(set(names)) == len(names)


def test_models_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("ABTREE_MESHES", str(tmp_path))
    folder = meshes.ModelFolder(tmp_path / "models")
    assert not folder.has("cow") and folder.has("knot:200")
    model = folder.load(["cow", "knot:200"])
    assert model.name == "knot:200" and folder.file("knot:200", 10).is_file()
    monkeypatch.setattr(meshes, "knot", None)  # not built again
    again = meshes.ModelFolder(tmp_path / "models").load(["knot:200"])
    assert np.array_equal(again.tree.leaf_node, model.tree.leaf_node)
    with pytest.raises(ValueError, match="ABTREE_MESHES"):
        folder.load(["cow", "fandisk 4204"])


def test_command_hands_over(tmp_path, capsys):
    with pytest.raises(ValueError, match="checkout"):
        bench_command.bench(["paper"], tmp_path)
    with pytest.raises(ValueError, match="name a benchmark"):
        bench_command.bench([])
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", "paper", "--out", str(tmp_path / "out"), "--only", "nothing"])
    assert stop.value.code == 2 and "no part nothing" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        cli.main(["bench", "paper", "--out", str(tmp_path / "out"), "--device", "tpu"])
    assert stop.value.code == 2 and "no device 'tpu'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
