"""The studies at small sizes, beside plain Python. No time is judged."""

import json
import math

import numpy as np
import pytest
from helpers import refused

import warp_abtree as ab
from bench import __main__ as main
from bench import tables
from bench.shapes import knot
from bench.studies import study
from bench.studies.paper import meshes, static, update
from bench.studies.tradeoff import competitors, distances, lods, motions
from bench.tables import pick

pytestmark = pytest.mark.slow


class KnotFolder:
    def __init__(self, folder=None):
        self.model = ab.Model.from_arrays(*knot(300), name="knot")

    def has(self, name):
        return name.startswith("knot")

    def load(self, names, base_faces):
        return self.model


@pytest.fixture
def context(device):
    return study.Context(device, True, KnotFolder())


def changed_faces(model, splits):
    starts, slices = model.progressive.split_start, model.progressive.split_face
    return np.unique(slices[starts[model.lod_max - splits] :])


def check_paper(parts, model):
    assert [row["paper_model"] for row in parts["table1"]] == ["bones", "cow"]
    assert all(row["faces"] == model.face_count and row["splits"] == model.lod_max for row in parts["table1"])
    moves = pick(parts["figure6"], case="move")
    assert {row["k"] for row in moves if row["splits"] == model.lod_max} == {model.face_count}
    assert all(row["nodes"] <= row["bound"] for row in parts["figure6"]) and all(row["refit_ms"] > 0 for row in moves)
    assert all(row["k"] == len(changed_faces(model, row["splits"])) for row in pick(moves, from_finest=True))
    assert all(row["k"] < 0.1 * model.face_count and row["ratio"] > 0 for row in parts["share"])
    hits = [[row["hits"] for row in pick(parts["share"], configuration=name)] for name in ("touching", "deep")]
    assert all(few <= many for few, many in zip(*hits, strict=True))
    assert all(row["ours_nodes"] == row["static_nodes"] for row in pick(parts["static"], share=1.0))
    steps = pick(parts["figure4"], case="figure 4")
    same = [row["moved"] == row["paper"] for row in steps]
    # In frame 10, still over the budget, the figure stands still where ours goes on by one step: an erratum.
    assert len(steps) == 30 and sum(same) == 27 and all(same[:27])


def check_tradeoff(parts, model):
    levels = pick(parts["lods"], case="level")
    (finest,) = pick(levels, kind="fraction", value=1)
    none = ("missed", "invented", "contacts_missed", "contacts_invented", "bound", "contact_max", "normal_p95")
    assert all(finest[name] == 0 for name in (*none, "region_hausdorff_max")) and finest["any_cost"] == 1
    assert 0 < finest["meet"] < finest["poses"]
    (coarse,) = pick(levels, kind="fraction", value=0.1)
    assert coarse["contact_mean"] > 1e-4 and coarse["missed"] + coarse["invented"] > 0 and coarse["region_mean"] > 1e-4
    assert coarse["share"] == pytest.approx(0.1, abs=0.02) and coarse["node_tests"] < finest["node_tests"]
    assert all(0 < row["bound"] <= row["value"] for row in pick(levels, kind="tolerance"))
    assert sum(row["missed"] for row in pick(parts["lods"], case="offset", value=0.1)) == coarse["missed"]
    rows = parts["competitors"]
    ours, theirs = (pick(rows, method=name) for name in (competitors.OURS, competitors.OURS_FCL))
    assert len(ours) == len(theirs) == 4
    for name in ("missed", "invented", "contact_mean"):
        assert [row[name] for row in ours] == pytest.approx([row[name] for row in theirs], abs=1e-6)
    for row in pick(rows, method=competitors.HULL):
        assert row["missed"] == 0 and row["late_max"] < 1e-6 and row["contact_mean"] > 1e-3
    check_distances(parts["distances"])
    check_motions(parts["motions"])
    assert any(row["front"] for row in rows) and not all(row["front"] for row in rows)


def check_distances(rows):
    ours, theirs, ended = (
        pick(rows, method=name) for name in (distances.OURS, distances.OURS_FCL, distances.TOLERANCE)
    )
    assert len(ours) == len(theirs) == 3 == len(ended)
    for name in ("distance_mean", "distance_max"):
        assert [row[name] for row in ours] == pytest.approx([row[name] for row in theirs], abs=1e-9)
    proved = [row["proved"] for row in ours]
    assert proved == sorted(proved, reverse=True) and proved[-1] == 0 == ours[-1]["distance_max"]
    # Infinite or no distances are written as None.
    found = *ours, *theirs, *ended
    assert all(row["us"] > 0 and row["distance_mean"] is not None for row in found)
    assert all(0 < row["proved"] for row in ended)


def check_motions(rows):
    ended, levels = (pick(rows, method=name) for name in (motions.TOLERANCE, motions.OURS))
    assert len(ended) == len(motions.TOLERANCES) and len(levels) == len(motions.FRACTIONS) + 1
    for row, tolerance in zip(ended, motions.TOLERANCES, strict=True):
        assert row["early_max"] <= tolerance + motions.LEAST and row["late_max"] <= motions.LEAST
        assert row["missed"] == row["invented"] == row["undecided"] == 0 < row["meet"]
    assert levels[0]["time_mean"] > levels[2]["time_mean"] > 1e-6 >= levels[-1]["early_max"]


@pytest.mark.parametrize("name", [name for name, module in main.STUDIES.items() if module == "study"])
def test_study(name, device, tmp_path, monkeypatch):
    pytest.importorskip("scipy")
    pytest.importorskip("fcl")
    monkeypatch.setattr(study, "ModelFolder", KnotFolder)
    monkeypatch.setattr(meshes, "PAPER_MODELS", meshes.PAPER_MODELS[:2])  # the third has a larger base mesh
    monkeypatch.setattr(lods, "QUICK_TOLERANCES", (0.2, 0.05))  # which the knot has LODs for
    assert main.main([name, "--out", str(tmp_path), "--device", device, "--quick"]) == 0
    found = json.loads((tmp_path / f"{name}.json").read_text())
    parts = {part: one["rows"] for part, one in found["parts"].items()}
    for row in [row for rows in parts.values() for row in rows]:
        for key, value in row.items():
            assert not isinstance(value, float) or math.isfinite(value), (key, row)
            if key in ("precision", "recall", "share") and isinstance(value, float):
                assert 0 <= value <= 1, (key, row)
    for table in tables.read_layout(f"studies/{name}.toml")["table"]:
        shown = tables.select_rows(table, found)
        absent = [key for key, *_ in table["columns"] if not any(key in row for row in shown)]
        assert shown and not absent, (table["name"], absent)
    assert "Not measured" not in (tmp_path / f"{name}.md").read_text()
    globals()[f"check_{name}"](parts, KnotFolder().model)


def test_posed_pairs_touch_at_the_depth_asked(context, device):
    model = context.models.model
    posed = meshes.PosedPairs(model, 4, device, first_count=4, steps=12)
    for depth, hits in ((-0.01, 0), (-1e-9, 0), (1e-9, 4)):
        posed.place(depth)
        assert posed.scene.intersect(posed.pairs).any.sum() == hits
    splits = model.lod_max - update.find_tenth(model)
    assert len(changed_faces(model, splits)) < 0.1 * model.face_count <= len(changed_faces(model, splits + 1))


def test_a_static_tree_over_other_vertices_is_noticed(context, monkeypatch):
    whole = ab.Model.mesh_at
    monkeypatch.setattr(ab.Model, "mesh_at", lambda self, lod: (whole(self, lod)[0] * 1.1, *whole(self, lod)[1:]))
    refused(RuntimeError, "other face pairs", list, static.run(context))


def test_parts_asked_alone_keep_the_others(tmp_path, monkeypatch):
    def run(context):
        context.note("Once.")
        context.note("Once.")
        yield {"x": np.float32(context.size(2, 1)), "gap": float("nan")}

    monkeypatch.setattr(study.find_study("paper"), "PARTS", {"one": run, "two": run})
    words = ["paper", "--out", str(tmp_path), "--device", "cpu", "--quick"]
    assert main.main(words) == 0
    before = json.loads((tmp_path / "paper.json").read_text())["parts"]
    assert main.main([*words, "--only", "two"]) == 0
    parts = json.loads((tmp_path / "paper.json").read_text())["parts"]
    assert parts["one"] == before["one"] and parts["two"]["run"]["command"].endswith("--quick --only two")
    assert parts["one"]["rows"] == [{"x": 1.0, "gap": None}] and parts["one"]["notes"] == ["Once."]
