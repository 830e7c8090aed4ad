"""`warp-abtree run`: what it prints, records and draws."""

import csv
import io
import json
import re
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from helpers.samples import SHUTTLE_SCENE
from helpers.viewer import run_command as run

from warp_abtree.app import load_scene
from warp_abtree.app.pictures import scenes
from warp_abtree.app.styles import STAGE_LABELS

SCENE = (
    SHUTTLE_SCENE
    + """
[[lod_sweep]]
objects = ["ball"]
from = 1.0
to = 0.1
period = 2
"""
)


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Work in a folder with a scene."""
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(SCENE)
    return tmp_path


def test_run_for_programs(files, capsys):
    found = json.loads(run(capsys, "run", "scene.toml", "--frames", 3, "--record", "rows.json", "--json")[0])
    rows = json.loads(Path("rows.json").read_text())
    run(capsys, "run", "scene.toml", "--frames", 3, "--record", "rows.csv")
    table = list(csv.DictReader(io.StringIO(Path("rows.csv").read_text())))
    assert [row["hits"] for row in rows] == [int(row["hits"]) for row in table] and len(rows) == 3
    assert found["frames"] == 3 and found["objects"] == 2 and found["models"] == 2 and found["worlds"] == 1
    assert found["hits"]["max"] == max(row["hits"] for row in rows) > 0
    assert found["stages"]["total_ms"]["total"] == pytest.approx(sum(row["total_ms"] for row in rows))
    assert found["lod_min"] == min(row["lod_min"] for row in rows)


def test_run_under_a_budget(files, capsys):
    shown, errors = run(capsys, "run", "scene.toml", "--frames", 8, "--budget", "50ms", "--device", "cpu")
    for line in ("controller +predictive", "budget ms +50", "select_ms +[\\d.]+", "budget +frames 4, .*", "objects +2"):
        assert re.search(f"^{line}", shown, re.M), line
    assert not errors
    found = json.loads(
        run(capsys, "run", "scene.toml", "--budget", "0.05s", "--controller", "paper", "--json", "--device", "cpu")[0]
    )
    assert (found["budget_ms"], found["controller"]) == (50, "paper") and found["budget"] is None
    assert found["stages"]["select_ms"]["total"] > 0 and set(found["stages"]) == {*STAGE_LABELS, "cost_ms", "total_ms"}
    cost = sum(found["stages"][name]["total"] for name in ("select_ms", "refine_ms", "broad_ms", "query_ms"))
    assert found["stages"]["cost_ms"]["total"] == pytest.approx(cost)


@pytest.mark.slow
def test_plot(files, capsys):
    shown, _ = run(capsys, "run", "scene.toml", "--frames", 6, "--budget", "20ms", "--plot", "plots", "--device", "cpu")
    assert re.search(f"^written +{Path('plots', 'frames.png')}$", shown, re.M)
    image = matplotlib.image.imread(Path("plots", "frames.png"))[:, :, :3]
    red, green, blue = image.reshape(-1, 3).T
    assert image.shape[0] > 800 and np.mean((red > 0.98) & (green > 0.98) & (blue > 0.98)) > 0.3, "background"
    third = len(image) // 3
    for part, (r, g, b) in enumerate(((0.12, 0.47, 0.71), (1.0, 0.0, 0.0), (0.84, 0.15, 0.16))):
        panel = image[part * third : (part + 1) * third, :780]
        near = np.abs(panel - (r, g, b)).max(axis=2) < 0.12
        assert near.sum() > 100, ("LODs", "budget", "error")[part]
    assert [path.name for path in Path("plots").iterdir()] == ["frames.png"]
    run(capsys, "run", "scene.toml", "--frames", 2, "--plot", "plots", "--device", "cpu")


def test_picture_of_a_controlled_run_shows_its_lods(files, capsys, monkeypatch):
    pytest.importorskip("pyvista")
    titles = []
    monkeypatch.setattr(scenes, "draw", lambda panels, *_, **__: titles.append([panel.title for panel in panels]))
    words = "run scene.toml --frames 1 --picture out.png --device cpu".split()
    run(capsys, *words, "--budget", "1s")
    run(capsys, *words)
    # The controller begins at the coarsest LOD; a sweep is drawn at both of its ends.
    top = load_scene("scene.toml", device="cpu").models["ball"].lod_max
    lods = [[re.match(r"ball at LOD (\d+) of (\d+)", title).groups() for title in panels] for panels in titles]
    assert lods[0] == [("0", str(top))]
    assert [of for _, of in lods[1]] == [str(top)] * 2 and int(lods[1][0][0]) == top > int(lods[1][1][0]) > 0


@pytest.mark.slow
def test_picture_of_rigid_bodies(files, capsys):
    pytest.importorskip("pyvista")
    text = SCENE.split("[[lod_sweep]]")[0].replace("shuttle = { by = [0.4, 0, 0], period = 2 }", "velocity = [9, 0, 0]")
    Path("bodies.toml").write_text(text + "[dynamics]\ngravity = [0, 0, 0]\n")
    run(capsys, "run", "bodies.toml", "--frames", 1, "--picture", "first.png", "--device", "cpu")
    run(capsys, "run", "bodies.toml", "--frames", 4, "--picture", "last.png", "--device", "cpu")
    first, last = (matplotlib.image.imread(name) for name in ("first.png", "last.png"))
    assert first.shape != last.shape or not np.array_equal(first, last)


@pytest.mark.slow
def test_picture(files, capsys):
    pytest.importorskip("pyvista")
    shown, _ = run(capsys, "run", "scene.toml", "--frames", 2, "--picture", "out.png")
    assert re.search("^written +out.png$", shown, re.M)
    image = matplotlib.image.imread("out.png")[:, :, :3]
    assert image.shape[1] > 600
    # Both panels show plain and intersecting faces of both models.
    for half in np.array_split(image[100:-50], 2, axis=1):
        red, green, blue = half.reshape(-1, 3).T
        assert np.mean((red > 0.98) & (green > 0.98) & (blue > 0.98)) > 0.1, "background"
        assert np.mean((blue > 1.4 * red) & (blue > 1.2 * green)) > 0.02, "ring"
        assert np.mean((red > green) & (green > blue) & (red < 1.4 * blue) & (red < 0.95)) > 0.02, "ball"
        assert np.mean((green > 1.8 * red) & (green > 1.8 * blue)) > 0.002, "intersecting faces of the ball"
        assert np.mean((red > 2 * blue) & (green > 2 * blue)) > 0.002, "intersecting faces of the ring"
    assert sorted(path.name for path in files.glob("out*")) == ["out.png"]
