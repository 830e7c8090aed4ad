"""Rows as JSON, Markdown and figures; models kept; docs that repeat their data."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import refused

from bench import meshes, tables
from bench.studies import study
from warp_abtree.app.cli import bench_command
from warp_abtree.app.cli import main as cli

DATA = Path(__file__).resolve().parents[2] / "docs" / "data"


def test_values_of_rows():
    assert tables.plain(np.float64(1 / 3)) == 0.33333 and tables.plain(np.int32(7)) == 7
    assert tables.plain(np.bool_(True)) is True and tables.plain(float("inf")) is None
    refused(TypeError, None, tables.plain, np.zeros(2))
    assert [tables.shown(x, ".1%") for x in (0.5, None, True, "a|b")] == ["50.0%", "-", "yes", "a\\|b"]


def test_figures(tmp_path, monkeypatch):
    figures = tables.pick(tables.read_layout("cases/figures.toml")["figure"], case="scale")
    rows = [{"sweep": "pairs", "pairs": n, "ours_ms": 2.0 * n, "peer_ms": 3.0 * n, "arrays_mib": 1.0} for n in (1, 10)]
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        assert tables.draw(figures, rows, tmp_path).startswith("plots skipped: ")
    pytest.importorskip("matplotlib")
    assert "scale_time.svg, scale_memory.svg" in tables.draw(figures, rows, tmp_path)
    drawn = (tmp_path / "scale_time.svg").read_text()
    assert "ours: slope 1.00" in drawn and "object pairs" in drawn and "faces a mesh" not in drawn
    tables.draw(figures, rows, tmp_path)
    assert (tmp_path / "scale_time.svg").read_text() == drawn, "the same rows, the same file"


def test_labels_of_a_logarithmic_axis_do_not_overlap(tmp_path):
    """As of the times of one mesh, which span a decade or two; labels within it are few and plain."""
    pytest.importorskip("matplotlib")
    panel = {"x": "us", "xlabel": "time", "ylabel": "error", "y": {"error": "mean"}}
    for most, shown in ((90.0, {"10", "20", "50", "100"}), (9000.0, set())):
        rows = [{"us": us, "error": 1.0} for us in (9.0, most)]
        tables.draw([{"file": "axis.svg", "panels": [panel]}], rows, tmp_path)
        words = re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "axis.svg").read_text())
        assert {word for word in words if word.isdigit()} == shown


@pytest.mark.parametrize("file", sorted(DATA.glob("*.json")), ids=lambda path: path.name)
def test_pages_repeat_their_data(file):
    """python -m bench.tables docs/data/*.json writes the pages; all tables have rows."""
    data = json.loads(file.read_text(encoding="utf-8"))
    pages = tables.find_pages(file)
    assert pages and not any("Not measured" in text for text in pages.values())
    assert {page: page.read_text(encoding="utf-8") for page in pages} == pages
    assert not any(part["run"].get("quick") for part in data["parts"].values())
    if data["study"] != "performance":
        assert set(study.find_study(data["study"]).PARTS) == set(data["parts"])


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted(DATA.glob("*.json")), ids=lambda path: path.name)
def test_figures_have_rows(file, tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib.figure")
    monkeypatch.setattr(matplotlib.Figure, "savefig", lambda *_, **__: None)  # test_figures draws
    data = json.loads(file.read_text(encoding="utf-8"))
    figures = tables.read_layout(f"studies/{data['study']}.toml").get("figure", [])
    said = tables.draw(figures, lambda figure: tables.select_rows(figure, data), tmp_path)
    assert all(figure["file"] in said for figure in figures)


def test_tables_of_pages_change_with_their_data(tmp_path):
    """A number of one row stands in three pages; each part and each layout has a place in one."""
    data = json.loads((DATA / "performance.json").read_text(encoding="utf-8"))
    (row,) = tables.pick(data["parts"]["distance"]["rows"], workload="knot", poses=65536)
    row["again_ms"] = 8.7654
    changed = tmp_path / "performance.json"
    tables.write_json(changed, data)
    pages = tables.find_pages(changed)
    own = pages.pop(changed.with_suffix(".md"))
    assert [path.name for path in pages] == ["README.md", "performance.md"] and "8.7654" in own
    for page, text in pages.items():
        assert "8.7654" in text and "8.7654" not in page.read_text(encoding="utf-8")
    laid_out = tables.read_layout("studies/performance.toml")["table"]
    places = {place["table"] for text in pages.values() for place in tables.PLACE.finditer(text)}
    assert {table["name"] for table in laid_out if "title" not in table or "short" in table} <= places
    assert {table["part"] for table in laid_out if "title" in table} == set(data["parts"])


def test_tables_that_are_short_or_not_there():
    study = {"parts": {"one": {"rows": [{"a": n, "b": n + 0.5} for n in range(3)]}}}
    layout = {"part": "one", "columns": [["a", "A"], ["b", "B", ".2f"]]}
    assert tables.markdown_table(layout, study).count("\n") == 4
    short = {"where": {"a": [1, 2]}, "columns": ["b"]}
    assert tables.markdown_table(layout, study, short) == "| B |\n| --: |\n| 1.50 |\n| 2.50 |"
    data = json.loads((DATA / "performance.json").read_text(encoding="utf-8"))
    other = "<!-- table other gone -->\n<!-- end -->"
    assert tables.fill_page(other, "performance", data) == other
    with pytest.raises(ValueError, match="no table gone in "):
        tables.fill_page(other.replace("other", "performance"), "performance", data)


def test_models_are_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("ABTREE_MESHES", str(tmp_path))
    folder = meshes.ModelFolder(tmp_path)
    assert not folder.has("cow") and folder.load(["cow", "knot:200"]).name == "knot:200"
    monkeypatch.setattr(meshes, "knot", None)  # not built again
    assert meshes.ModelFolder(tmp_path).load(["knot:200"]).face_count == 168
    refused(ValueError, "ABTREE_MESHES", folder.load, ["cow", "fandisk 4204"])


def test_command_hands_over(tmp_path, capsys):
    for words, folder, message in ((["paper"], tmp_path, "checkout"), ([], None, "name a benchmark")):
        refused(ValueError, message, bench_command.bench, words, folder)
    study = ["paper", "--out", str(tmp_path / "out")]
    names = [f"'{name}'" for name in ("paper", "tradeoff", "query", "update")]
    for words, parts in (
        ([*study, "--only", "nothing"], ["no part nothing"]),
        ([*study, "--device", "tpu"], ["no device 'tpu'"]),
        (["nosuch"], names),
        (["--device", "cpu", "nosuch"], names),
        (["query", "--nosuch"], ["--nosuch"]),
        (["--device", "cpu", "paper"], ["before its options"]),
    ):
        with pytest.raises(SystemExit) as stop:
            cli.main(["bench", *words])
        (line,) = capsys.readouterr().err.splitlines()
        assert stop.value.code == 2 and all(part in line for part in parts)
    assert not (tmp_path / "out").exists()
