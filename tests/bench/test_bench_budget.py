"""The benchmark of budgets at its smallest size, and the figure that compares controllers. No time is judged."""

import functools
import json
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

import warp_abtree as ab
from bench import budget

pytestmark = pytest.mark.slow

SCENES = Path(__file__).resolve().parents[2] / "scenes"


def test_budget_bench(device, monkeypatch, tmp_path):
    monkeypatch.setattr(budget, "QUICK", {"frames": 63, "step": 6, "probe": 12, "selected": 200})
    monkeypatch.setattr(budget, "QUICK_OBJECTS", 12)
    monkeypatch.setattr(budget, "SCALES", {"cpu": (1,), "cuda": (1,)})
    coarse = [("256", "64"), ("128", "32"), ("96", "24"), ("80", "20"), ("64]", "16]"), ("64\n", "16\n")]
    monkeypatch.setattr(
        budget, "scale_sections", lambda text, _: functools.reduce(lambda t, c: t.replace(*c), coarse, text)
    )
    select, *rows = budget.run(device, quick=True, plots=tmp_path)
    assert select["case"] == "select" and select["objects"] == 200
    assert all(select[f"{name}_ms"] > 0 for name in ("view", "paper", "tolerance", "predictive"))
    assert [(row["scene"], row["case"], row.get("controller")) for row in rows] == [
        (scene, case, controller)
        for scene in ("rain", "focus")
        for case, controllers in (
            ("probe", (None,)),
            ("hold", ("none", "coarsest", "predictive", "paper", "tolerance")),
            ("step", ("none", "predictive", "paper")),
        )
        for controller in controllers
    ]
    for row in rows:
        if row["case"] == "probe":
            assert row["finest_ms"] > 0 and row["coarsest_ms"] > 0 and row["taken"]
        if row["case"] == "hold":
            assert row["judged"] == 3 and 0 <= row["within"] <= row["within_tenth"] <= 1 and row["budget_ms"] > 0
            assert (row["error_max"] == 0) == (row["controller"] == "none") and row["cost_ms"] <= row["cost_p95_ms"]
            assert ("adds" in row) == (row["controller"] in ("none", "coarsest"))
            if row["controller"] == "none":
                assert row["cost_ms"] == pytest.approx(3.5 * row["budget_ms"], abs=0.01)
        if row["case"] == "step" and row["controller"] == "none":
            assert row["within_tenth"] <= 0.5 and row["load"] > 0
    for name in ("rain", "focus"):
        kept = json.loads((tmp_path / f"budget-{name}.json").read_text())
        assert len(kept["runs"]) == 5 and all(len(history) == 63 for history in kept["runs"].values())
        picture = tmp_path / f"budget-{name}.png"
        picture.unlink()
        assert budget.draw_saved(tmp_path / f"budget-{name}.json").endswith(f"budget-{name}.png")
        assert 10_000 < picture.stat().st_size < 150_000


def test_sections_are_scaled():
    text = (SCENES / "rain.toml").read_text()
    found = budget.scale_sections(text, 4).splitlines()
    changed = {(a, b) for a, b in zip(text.splitlines(), found) if a != b}
    assert changed == {
        ("cells = [128, 128]", "cells = [512, 512]"),
        ("major_sections = 128", "major_sections = 512"),
        ("minor_sections = 64", "minor_sections = 256"),
        ("sections = [256, 32]", "sections = [1024, 128]"),
        ("sections = [96, 80]", "sections = [384, 320]"),
    }


def test_a_load_rises_when_objects_join():
    poses = np.random.default_rng(0).normal(size=(4, 50, 7))
    motion, out = budget.Joined(poses, 2, 0.1), np.empty((50, 7))
    for frame in range(6):
        found = motion.poses(0.1 * frame, out)
        same = (found == poses[min(frame, 3)]).all(axis=1)
        assert same.all() if frame >= 2 else 10 < same.sum() < 40
    apart = np.sort(motion.poses(0.0, out)[:, 0])
    assert (np.diff(apart[apart > 500]) > 900).all(), "those that wait meet nobody"


def test_figure_of_controllers(tmp_path):
    def history(cost, faces):
        values = dict.fromkeys(ab.FrameRow.names()[:-2], 1)
        return [
            ab.FrameRow(**values | {"frame": i, "query_ms": cost + i % 2, "faces": faces, "error_mean": 1.0 / faces})
            for i in range(30)
        ]

    runs = {"none": history(30, 1000), "predictive": history(8, 100), "paper": history(9, 50)}
    ab.draw_controllers(runs, 10.0, tmp_path / "figure.png", "Controllers")
    image = matplotlib.image.imread(tmp_path / "figure.png")[:, :, :3]
    for colour in ((0.0, 0.447, 0.698), (0.835, 0.369, 0.0)):
        near = np.abs(image - colour).max(axis=2) < 0.2
        for panel in (near[30:330], near[335:540], near[545:745]):
            assert panel.sum() > 100, colour
    with pytest.raises(ValueError, match="magic"):
        ab.draw_controllers({"magic": runs["none"]}, 10.0, tmp_path / "other.png", "x")
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]
